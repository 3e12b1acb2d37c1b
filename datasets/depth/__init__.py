"""Depth maps: files of depth sensors → oriented, coloured clouds."""
