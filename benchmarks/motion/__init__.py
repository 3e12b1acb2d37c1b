"""Shapes that move in closed form, and evolutions measured against them."""
