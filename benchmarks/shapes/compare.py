"""How far two images of a shape are apart: over all pixels, over those that see it in either, and inside both."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from mplicits.neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from mplicits.pipelines.render.trace import Seen
from numpy.typing import NDArray
from torch import Tensor

LEAST_MSE = 1e-12  # 120 dB: images that are the same have a finite PSNR


@dataclass(frozen=True)
class Drawing:
    """An image on white.

    Attributes:
        rgb: ``(H, W, 3)`` display RGB in [0, 1].
        coverage: ``(H, W)`` share of each pixel's samples that see the shape.
    """

    rgb: NDArray[np.float32]
    coverage: NDArray[np.float32]


@dataclass(frozen=True)
class ImageError:
    """Mean squared differences of display RGB in [0, 1], over pixels, channels and cameras.

    Attributes:
        everywhere: over all pixels; where both see the background, the difference is 0.
        either: over the pixels where at least a part sees the shape in one of the images.
        both: over the pixels that wholly see the shape in both images.
        pixels_either: how many those are.
        pixels_both: how many these are.
    """

    everywhere: float
    either: float
    both: float
    pixels_either: int
    pixels_both: int


def draw(seen: Seen, colors: Tensor, *, samples: int = 1) -> Drawing:
    """Put colours on white, and average squares of pixels in linear light.

    Args:
        seen: what the pixels of an image ``samples`` times as wide and high see.
        colors: ``(P, 3)`` display RGB of those pixels.
        samples: per pixel and direction.

    Raises:
        ValueError: ``samples`` does not divide the sides of the image.
    """
    width, height = seen.size
    if samples < 1 or width % samples or height % samples:
        raise ValueError(f"samples={samples}: expected a divisor of both sides of a {width} × {height} image")
    light = torch.ones(height * width, 4)
    light[:, 3] = 0
    light[seen.pixel.cpu(), :3] = torch.from_numpy(srgb_to_linear(colors.detach().cpu().float().clamp(0, 1).numpy()))
    light[seen.pixel.cpu(), 3] = 1
    mean = light.reshape(height // samples, samples, width // samples, samples, 4).mean(dim=(1, 3))
    return Drawing(linear_to_srgb(mean[..., :3].clamp(0, 1).numpy()), mean[..., 3].numpy())


def image_error(pairs: Iterable[tuple[Drawing, Drawing]]) -> ImageError:
    """Compare the two drawings of each pair, which must be of one size; every pixel counts the same.

    Where there are no pixels to compare, the error is NaN.
    """
    sums, counts = np.zeros(3), np.zeros(3, np.int64)
    for first, second in pairs:
        squared = np.square(first.rgb - second.rgb, dtype=np.float64).mean(axis=2)
        either = (first.coverage > 0) | (second.coverage > 0)
        both = (first.coverage == 1) & (second.coverage == 1)
        for index, mask in enumerate((np.ones_like(either), either, both)):
            sums[index] += squared[mask].sum()
            counts[index] += mask.sum()
    means = np.divide(sums, counts, out=np.full(3, np.nan), where=counts > 0)
    return ImageError(float(means[0]), float(means[1]), float(means[2]), int(counts[1]), int(counts[2]))


def psnr(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of display RGB in [0, 1]: ``-10 log10 mse``, at most 120."""
    return -10 * math.log10(max(mse, LEAST_MSE))
