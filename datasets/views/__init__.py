"""Posed photographs: files → pictures, the cameras that took them, and where the object is."""
