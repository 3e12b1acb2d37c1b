"""Point clouds: files → oriented points in the unit sphere, cleaned of strays and noise."""
