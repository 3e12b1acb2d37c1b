"""Cameras and sparse points of photographs, by COLMAP."""
