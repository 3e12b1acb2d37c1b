"""Neural signed distance fields, and the mathematics that evaluates them."""

import importlib
import warnings
from typing import Any

from .backend.errors import InputError
from .checkpoint import load_field, load_texture, save_field
from .fields.csg import Difference, Intersection, Offset, Shell, Union
from .fields.field import Field, FunctionField, Jet
from .fields.primitives import Box, Capsule, Plane, Sphere, Torus
from .fields.similarity import Similarity
from .hosts.adapters import InstantNSRGeometry, NerfstudioField, NeuSGeometry
from .meshing.extract import NoSurfaceError, extract_mesh
from .meshing.mesh import Mesh
from .networks.colors import ColorNetwork, TextureField
from .networks.multiscale import MultiscaleSDF, fit_sphere
from .networks.siren import Siren
from .shape import WorldField
from .spacetime.field import SpaceTimeSDF, TimeSlice, at_time
from .spacetime.flow import flow
from .spacetime.moving import Moving, RigidMotion
from .tracing.sphere import map_colors, project_to_surface, sphere_trace
from .volume.render import render_volume

__all__ = [
    "Box", "Capsule", "ColorNetwork", "Difference", "Field", "FunctionField", "InputError", "InstantNSRGeometry",
    "Intersection", "Jet", "Mesh", "Moving", "MultiscaleSDF", "NerfstudioField", "NeuSGeometry", "NoSurfaceError",
    "Offset", "Plane", "RigidMotion", "Shell", "Similarity", "Siren", "SpaceTimeSDF", "Sphere", "TextureField",
    "TimeSlice", "Torus", "Union", "WorldField", "at_time", "extract_mesh", "fit_sphere", "flow", "load_field",
    "load_texture", "map_colors", "project_to_surface", "render_volume", "save_field", "sphere_trace",
]  # fmt: skip

# Names of earlier releases, by the module that has them; gone with the next.
_MOVED = {
    "backend.fixed_shapes": "FixedShapes fixed_shapes",
    "checkpoint": "SavedField load_radiance save_radiance save_texture",
    "fields.csg": "Bounded Placed",
    "fields.field": "FieldLike OneLevelField SecondJet as_field",
    "fields.similarity": "Placement",
    "hosts.adapters": "Deviation",
    "hosts.learning_rates": "parameter_groups share_rate=rescale_parameters",
    "meshing.extract": "map_normals",
    "networks.colors": "ColorSiren Outside=BackgroundField Radiance ViewColor=ColorNetwork",
    "networks.encoded": "EncodedField",
    "networks.multiscale": "levels_of",
    "shape": "Closest WorldHits in_one_frame",
    "spacetime.evolution": "Law curvature key_loss law_loss mean_curvature morph near_surface normal_speed transport",
    "spacetime.field": "SpaceTimeJet spacetime_jet",
    "spacetime.flow": "IntegrationError Solver trajectories",
    "spacetime.moving": "Keyframes",
    "spacetime.velocity": "CarriedKeyframes Velocity VelocityJet VelocitySiren",
    "tracing.cones": "cone_starts",
    "tracing.sphere": "Hits Mapped map_attribute",
    "volume.render": "Rendered Sampling",
}


def __getattr__(name: str) -> Any:
    for module, names in _MOVED.items():
        for old, _, new in (pair.partition("=") for pair in names.split()):
            if name == old:
                home, now = f"{__name__}.{module}", new or old
                warnings.warn(f"import {now} from {home}", DeprecationWarning, stacklevel=2)
                return getattr(importlib.import_module(home), now)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
