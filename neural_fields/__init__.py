"""Neural signed distance fields, and the mathematics that evaluates them."""

from .analytic import Box, Capsule, Plane, Sphere, Torus, Union
from .errors import InputError
from .field import Field, Jet
from .similarity import Similarity

__all__ = [
    "Box",
    "Capsule",
    "Field",
    "InputError",
    "Jet",
    "Plane",
    "Similarity",
    "Sphere",
    "Torus",
    "Union",
]
