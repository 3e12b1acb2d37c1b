"""What tests of reconstructions share: scenes, starts and textures that take no time."""

import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from fields import solve_sphere
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import PosedImage, PosedImages
from mplicits.neural_fields import Jet, Sphere
from mplicits.pipelines.reconstruct import hull
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct import train as reconstruct_texture
from mplicits.pipelines.reconstruct.consistency import ConsistencyOptions, GreyPictures
from mplicits.pipelines.reconstruct.measured import MeasuredDepths
from mplicits.pipelines.reconstruct.objective import SceneObjective
from mplicits.pipelines.training.settings import ReconstructConfig, TextureConfig
from mplicits.pipelines.training.trainer import Trainer
from torch import Tensor, nn

CPU = torch.device("cpu")
# Two levels that take no time, for a few steps on a few rays.
TINY_SCENE = ReconstructConfig(
    widths=(16, 16),
    depths=(1, 1),
    omegas=(10.0, 15.0),
    starts=(0.0, 0.5),
    features=4,
    color_width=16,
    color_depth=1,
    color_grid=8,
    color_frequencies=2,
    rays=32,
    uniform=8,
    importance=4,
    march_grid=8,
)
# What few steps need to get anywhere.
QUICK = {"learning_rate": 2e-3, "color_rate": 12.0, "sharpening": 8.0}
# Patches for small pictures by few cameras all around.
SMALL_PATCHES = ConsistencyOptions(
    patches=16, reach=1, usual_angle=60.0, most_angle=150.0, facing=0.05, floor=-1.0, residual=0.05
)


def small_reconstructions(patch: pytest.MonkeyPatch) -> None:
    """Begin by one linear solve or a short fit, and colour few points by a small network."""
    patch.setattr(scene_model, "fit_sphere", solve_sphere)
    patch.setitem(inspect.unwrap(hull.start_at_hull).__kwdefaults__, "steps", 50)
    finish = reconstruct_texture.FinishOptions(texture_samples=2000, texture_resolution=32)
    patch.setattr(reconstruct_texture, "FINISH", finish)
    small = partial(TextureConfig, samples=2000, width=16, depth=1, batch=256, band_batch=256)
    patch.setattr(reconstruct_texture, "TextureConfig", small)


def painted_sphere(views: int, size: int, samples: int = 1, **options: bool) -> PosedImages:
    """Photographs of a sphere of radius 0.6 around the origin."""
    return render_scene(SCENES["painted-sphere"](), views, size, samples=samples, **options)


def with_views(images: PosedImages, change: Callable[[int, PosedImage], PosedImage]) -> PosedImages:
    """The data set with ``change(number, view)`` in the place of each view."""
    return replace(images, views=tuple(change(number, view) for number, view in enumerate(images.views)))


def without(images: PosedImages, part: str) -> PosedImages:
    """The data set without the ``mask`` or ``depth`` of each view."""
    return with_views(images, lambda _, view: replace(view, **{part: None}))


def scene_parts(
    images: PosedImages, config: ReconstructConfig, *, depths: bool = False, device: torch.device = CPU
) -> tuple[tuple[scene_model.SceneModel, scene_model.RayPool, ReconstructConfig], dict[str, Any]]:
    """What a training of a scene takes: model, rays and settings; and measured depths and pictures that it wants."""
    masked = all(view.mask is not None for view in images.views)
    model = scene_model.build_scene(config, has_masks=masked, views=len(images.views)).to(device)
    pool = scene_model.RayPool(images.views, images.similarity, device, whole=model.outside is not None)
    measured = MeasuredDepths(images.views, images, device) if depths else None
    pictures = GreyPictures(images.views, device) if config.consistency else None
    return (model, pool, config), {"measured": measured, "pictures": pictures}


class Paint(nn.Module):
    """The exact colours of the painted sphere, from anywhere."""

    def forward(self, x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
        return torch.from_numpy(SCENES["painted-sphere"]().color(x.double().numpy())).float()


def exact_model(inv_std: float = 2000.0, exposures: scene_model.Exposures | None = None) -> scene_model.SceneModel:
    """The painted sphere as a model that has learnt it, but for its uncertainty."""
    model = scene_model.SceneModel(Sphere(radius=0.6), Paint(), None, torch.ones(3), exposures)
    with torch.no_grad():
        model.variance.fill_(math.log(inv_std) / 10)
    return model


def weights(trainer: Trainer[SceneObjective]) -> dict[str, Tensor]:
    """A copy of all weights of a scene in training."""
    return {name: tensor.detach().cpu().clone() for name, tensor in trainer.objective.model.state_dict().items()}
