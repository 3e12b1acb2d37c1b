"""Display colours ↔ linear light, as images and meshes hold them."""

from ..neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear

__all__ = ["linear_to_srgb", "srgb_to_linear"]
