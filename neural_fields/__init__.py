"""Neural signed distance fields, and the mathematics that evaluates them."""

from .adapters import Deviation, InstantNSRGeometry, NerfstudioField, NeuSGeometry
from .analytic import Box, Capsule, Plane, Sphere, Torus, Union
from .attributes import Mapped, map_attribute, map_colors, project_to_surface
from .characteristics import IntegrationError, Solver, Tracks, flow, track, trajectories, transport_error
from .checkpoint import SavedField, load_field, load_texture, save_field, save_texture
from .color import ColorSiren, TextureField
from .cones import cone_starts
from .errors import InputError
from .evolution import Law, curvature, key_loss, law_loss, mean_curvature, morph, near_surface, normal_speed, transport
from .field import Field, Jet, OneLevelField, SecondJet
from .function import FunctionField
from .meshing import Mesh, NoSurfaceError, extract_mesh, map_normals
from .moving import Keyframes, Moving, RigidMotion, ShrinkingSphere
from .multiscale import MultiscaleSDF, levels_of
from .radiance import Outside, ViewColor
from .similarity import Similarity
from .siren import Siren
from .spacetime import SpaceTimeJet, SpaceTimeSDF, TimeSlice, at_time, spacetime_jet
from .sphere_start import fit_sphere
from .tracing import Hits, sphere_trace
from .volume_renderer import Rendered, Sampling, render_volume
from .world import Closest, WorldField, WorldHits

__all__ = [
    "Box",
    "Capsule",
    "Closest",
    "ColorSiren",
    "Deviation",
    "Field",
    "FunctionField",
    "Hits",
    "InputError",
    "InstantNSRGeometry",
    "IntegrationError",
    "Jet",
    "Keyframes",
    "Law",
    "Mapped",
    "Mesh",
    "Moving",
    "MultiscaleSDF",
    "NerfstudioField",
    "NeuSGeometry",
    "NoSurfaceError",
    "OneLevelField",
    "Outside",
    "Plane",
    "Rendered",
    "RigidMotion",
    "Sampling",
    "SavedField",
    "SecondJet",
    "ShrinkingSphere",
    "Similarity",
    "Siren",
    "Solver",
    "SpaceTimeJet",
    "SpaceTimeSDF",
    "Sphere",
    "TextureField",
    "TimeSlice",
    "Torus",
    "Tracks",
    "Union",
    "ViewColor",
    "WorldField",
    "WorldHits",
    "at_time",
    "cone_starts",
    "curvature",
    "extract_mesh",
    "fit_sphere",
    "flow",
    "key_loss",
    "law_loss",
    "levels_of",
    "load_field",
    "load_texture",
    "map_attribute",
    "map_colors",
    "map_normals",
    "mean_curvature",
    "morph",
    "near_surface",
    "normal_speed",
    "project_to_surface",
    "render_volume",
    "save_field",
    "save_texture",
    "spacetime_jet",
    "sphere_trace",
    "track",
    "trajectories",
    "transport",
    "transport_error",
]
