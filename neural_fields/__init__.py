"""Neural signed distance fields, and the mathematics that evaluates them."""

from .analytic import Box, Capsule, Plane, Sphere, Torus, Union
from .checkpoint import SavedField, load_field, save_field
from .errors import InputError
from .field import Field, Jet
from .meshing import Mesh, NoSurfaceError, extract_mesh, map_normals
from .multiscale import MultiscaleSDF
from .similarity import Similarity
from .siren import Siren
from .tracing import Hits, cone_starts, sphere_trace

__all__ = [
    "Box",
    "Capsule",
    "Field",
    "Hits",
    "InputError",
    "Jet",
    "Mesh",
    "MultiscaleSDF",
    "NoSurfaceError",
    "Plane",
    "SavedField",
    "Similarity",
    "Siren",
    "Sphere",
    "Torus",
    "Union",
    "cone_starts",
    "extract_mesh",
    "load_field",
    "map_normals",
    "save_field",
    "sphere_trace",
]
