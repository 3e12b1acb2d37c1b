"""Posed photographs: files → pictures, their cameras, and where the object is."""
