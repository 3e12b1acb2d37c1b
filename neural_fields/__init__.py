"""Neural signed distance fields, and the mathematics that evaluates them."""

from .backend.errors import InputError
from .backend.fixed_shapes import FixedShapes, fixed_shapes
from .checkpoint import (
    SavedField,
    load_field,
    load_radiance,
    load_texture,
    save_field,
    save_radiance,
    save_texture,
)
from .fields.csg import Bounded, Difference, Intersection, Offset, Placed, Shell, Union
from .fields.field import Field, Jet, OneLevelField, SecondJet
from .fields.function import FieldLike, FunctionField, as_field
from .fields.primitives import Box, Capsule, Plane, Sphere, Torus
from .fields.similarity import Similarity
from .hosts.adapters import Deviation, InstantNSRGeometry, NerfstudioField, NeuSGeometry
from .hosts.learning_rates import parameter_groups, share_rate
from .meshing.extract import NoSurfaceError, extract_mesh, map_normals
from .meshing.mesh import Mesh
from .meshing.placement import Placement
from .networks.encoded import EncodedField
from .networks.multiscale import MultiscaleSDF, levels_of
from .networks.radiance import Outside, Radiance, ViewColor
from .networks.siren import Siren
from .networks.sphere_init import fit_sphere, solve_sphere
from .networks.texture import ColorSiren, TextureField
from .shape import Closest, WorldField, WorldHits, in_one_frame
from .spacetime.evolution import (
    Law,
    curvature,
    key_loss,
    law_loss,
    mean_curvature,
    morph,
    near_surface,
    normal_speed,
    transport,
)
from .spacetime.field import SpaceTimeJet, SpaceTimeSDF, TimeSlice, at_time, spacetime_jet
from .spacetime.flow import IntegrationError, Solver, Tracks, flow, flow_jacobian, track, trajectories, transport_error
from .spacetime.moving import Keyframes, Moving, RigidMotion, ShrinkingSphere
from .spacetime.velocity import CarriedKeyframes, Velocity, VelocityJet, VelocitySiren
from .tracing.cones import cone_starts
from .tracing.projection import Mapped, map_attribute, map_colors, project_to_surface
from .tracing.sphere import Hits, sphere_trace
from .volume.render import Rendered, Sampling, render_volume

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
