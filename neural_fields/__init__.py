"""Neural signed distance fields, and the mathematics that evaluates them."""

from .analytic import Box, Capsule, Plane, Sphere, Torus, Union
from .attributes import Mapped, map_attribute, map_colors, project_to_surface
from .checkpoint import SavedField, load_field, load_texture, save_field, save_texture
from .color import ColorSiren, TextureField
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
    "ColorSiren",
    "Field",
    "Hits",
    "InputError",
    "Jet",
    "Mapped",
    "Mesh",
    "MultiscaleSDF",
    "NoSurfaceError",
    "Plane",
    "SavedField",
    "Similarity",
    "Siren",
    "Sphere",
    "TextureField",
    "Torus",
    "Union",
    "cone_starts",
    "extract_mesh",
    "load_field",
    "load_texture",
    "map_attribute",
    "map_colors",
    "map_normals",
    "project_to_surface",
    "save_field",
    "save_texture",
    "sphere_trace",
]
