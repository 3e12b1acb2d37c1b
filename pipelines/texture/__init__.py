"""``texture``: colours around a fitted surface (paper Sec. 3)."""

from .train import FittedTexture, fit_texture, texture_of, texture_run

__all__ = ["FittedTexture", "fit_texture", "texture_of", "texture_run"]
