"""What tests share that end with a texture: one that takes no time."""

from functools import partial

import pytest
from mplicits.pipelines.reconstruct import train as reconstruct_texture
from mplicits.pipelines.run.settings import TextureConfig


def small_textures(patch: pytest.MonkeyPatch) -> None:
    """Colour fewer points of a coarser mesh by a smaller network: how textures are trained is tested elsewhere."""
    patch.setattr(reconstruct_texture, "TEXTURE_SAMPLES", 2000)
    patch.setattr(reconstruct_texture, "TEXTURE_RESOLUTION", 32)
    small = partial(TextureConfig, samples=2000, width=16, depth=1, batch=256, band_batch=256)
    patch.setattr(reconstruct_texture, "TextureConfig", small)
