"""What tests of reconstructions share: scenes, starts and textures that take no time."""

import inspect
from functools import partial

import pytest
from mplicits.neural_fields.networks.multiscale import solve_sphere
from mplicits.pipelines.reconstruct import hull
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct import train as reconstruct_texture
from mplicits.pipelines.training.settings import ReconstructConfig, TextureConfig

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


def small_reconstructions(patch: pytest.MonkeyPatch) -> None:
    """Begin by one linear solve or a short fit, and colour few points by a small network.

    How good starts and textures are is tested elsewhere.
    """
    patch.setattr(scene_model, "fit_sphere", solve_sphere)
    patch.setitem(inspect.unwrap(hull.start_at_hull).__kwdefaults__, "steps", 50)
    finish = reconstruct_texture.FinishOptions(texture_samples=2000, texture_resolution=32)
    patch.setattr(reconstruct_texture, "FINISH", finish)
    small = partial(TextureConfig, samples=2000, width=16, depth=1, batch=256, band_batch=256)
    patch.setattr(reconstruct_texture, "TextureConfig", small)
