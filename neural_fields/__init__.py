"""Neural signed distance fields, and the mathematics that evaluates them."""

from ._fixed import FixedShapes, fixed_shapes
from .adapters import Deviation, InstantNSRGeometry, NerfstudioField, NeuSGeometry
from .algebra import Bounded, Difference, Intersection, Offset, Placed, Shell, Union
from .analytic import Box, Capsule, Plane, Sphere, Torus
from .attributes import Mapped, map_attribute, map_colors, project_to_surface
from .characteristics import (
    IntegrationError,
    Solver,
    Tracks,
    flow,
    flow_jacobian,
    track,
    trajectories,
    transport_error,
)
from .checkpoint import (
    SavedField,
    load_field,
    load_radiance,
    load_texture,
    save_field,
    save_radiance,
    save_texture,
)
from .color import ColorSiren, TextureField
from .cones import cone_starts
from .encoded import EncodedField
from .errors import InputError
from .evolution import Law, curvature, key_loss, law_loss, mean_curvature, morph, near_surface, normal_speed, transport
from .field import Field, Jet, OneLevelField, SecondJet
from .function import FieldLike, FunctionField, as_field
from .mesh import Mesh
from .meshing import NoSurfaceError, extract_mesh, map_normals
from .moving import Keyframes, Moving, RigidMotion, ShrinkingSphere
from .multiscale import MultiscaleSDF, levels_of
from .placement import Placement
from .radiance import Outside, Radiance, ViewColor
from .rates import parameter_groups, share_rate
from .similarity import Similarity
from .siren import Siren
from .spacetime import SpaceTimeJet, SpaceTimeSDF, TimeSlice, at_time, spacetime_jet
from .sphere_start import fit_sphere, solve_sphere
from .tracing import Hits, sphere_trace
from .velocity import CarriedKeyframes, Velocity, VelocityJet, VelocitySiren
from .volume_renderer import Rendered, Sampling, render_volume
from .world import Closest, WorldField, WorldHits, in_one_frame

__all__ = [
    "Bounded",
    "Box",
    "Capsule",
    "CarriedKeyframes",
    "Closest",
    "ColorSiren",
    "Deviation",
    "Difference",
    "EncodedField",
    "Field",
    "FieldLike",
    "FixedShapes",
    "FunctionField",
    "Hits",
    "InputError",
    "InstantNSRGeometry",
    "IntegrationError",
    "Intersection",
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
    "Offset",
    "OneLevelField",
    "Outside",
    "Placed",
    "Placement",
    "Plane",
    "Radiance",
    "Rendered",
    "RigidMotion",
    "Sampling",
    "SavedField",
    "SecondJet",
    "Shell",
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
    "Velocity",
    "VelocityJet",
    "VelocitySiren",
    "ViewColor",
    "WorldField",
    "WorldHits",
    "as_field",
    "at_time",
    "cone_starts",
    "curvature",
    "extract_mesh",
    "fit_sphere",
    "fixed_shapes",
    "flow",
    "flow_jacobian",
    "in_one_frame",
    "key_loss",
    "law_loss",
    "levels_of",
    "load_field",
    "load_radiance",
    "load_texture",
    "map_attribute",
    "map_colors",
    "map_normals",
    "mean_curvature",
    "morph",
    "near_surface",
    "normal_speed",
    "parameter_groups",
    "project_to_surface",
    "render_volume",
    "save_field",
    "save_radiance",
    "save_texture",
    "share_rate",
    "solve_sphere",
    "spacetime_jet",
    "sphere_trace",
    "track",
    "trajectories",
    "transport",
    "transport_error",
]
