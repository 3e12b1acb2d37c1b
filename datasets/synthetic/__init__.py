"""Shapes known in closed form: clouds, simulated scans and posed images with exact truth."""
