"""From colours that depend on the view to the texture of a surface, which every other command can use."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ..datasets import PointCloud
from ..datasets.views.images import PosedImages
from ..neural_fields import Jet, NoSurfaceError, extract_mesh
from .run.settings import ReconstructConfig, TextureConfig
from .run.trainer import Progress
from .scene_model import SceneModel
from .surface.surface import from_mesh, sample_surface
from .surface.trim import in_region
from .texture.train import FittedTexture, fit_texture

__all__ = ["scene_texture", "surface_colors"]

RESOLUTION = 128  # of the mesh whose points are coloured: finer than the texture's band is wide
SAMPLES = 100_000
BATCH = 1 << 15


@torch.no_grad()
def surface_colors(model: SceneModel, points: Tensor) -> Tensor:
    """Colours ``(N, 3)`` of points ``(N, 3)`` near the surface, each seen along its normal, from outside."""
    parts = []
    for part in points.split(BATCH):
        jet: Jet = model.geometry.jet(part)
        parts.append(model.color(part, -torch.nn.functional.normalize(jet.gradient, dim=-1), jet))
    return torch.cat(parts)


def scene_texture(
    model: SceneModel,
    images: PosedImages,
    config: ReconstructConfig,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FittedTexture:
    """Train a `TextureField` on the head-on colours of a scene's surface.

    Args:
        model: trained, on the CPU.
        images: of it; for the coordinates and the name.
        config: the reconstruction's; ``texture_steps``, seed and device are used.
        progress: see `fit_texture`.

    Raises:
        NoSurfaceError: the geometry has no surface.
    """
    mesh = in_region(extract_mesh(model.geometry, resolution=RESOLUTION))
    if mesh is None:
        raise NoSurfaceError("all of it is outside the region of interest")
    points, _ = sample_surface(from_mesh(mesh), SAMPLES, np.random.default_rng(config.seed))
    colors = surface_colors(model, torch.from_numpy(points).float()).numpy()
    cloud = PointCloud(images.similarity.to_input(points), colors=colors, source=str(images.source))
    settings = TextureConfig(steps=config.texture_steps, samples=SAMPLES, seed=config.seed, device=config.device)
    return fit_texture(model.geometry, cloud, settings, similarity=images.similarity, progress=progress)
