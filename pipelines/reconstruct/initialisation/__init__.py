"""The geometry that a reconstruction begins with."""
