"""What goes wrong between a surface and the points of a scan, beside noise of the ranges: each fault by itself.

Every function applies one of them to the readings of one scanner. :mod:`.scanner` applies them in this order: the beam
(smear), the clock (noise, then quantisation), the position (isotropic noise), what is kept (uneven density), and where
the scan is taken to stand (misalignment).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..depth.cleaning import both_sides

__all__ = ["ScanFaults", "depth_jumps", "kept_unevenly", "quantised", "rigid_motion", "smeared"]

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ScanFaults:
    """How strong each fault of a simulated scan is; lengths in the units of the scanned field.

    Attributes:
        isotropic: standard deviation of each coordinate of each point.
        quantise: ranges are rounded to multiples of this; 0 leaves them.
        misalign: registration error: standard deviation of each coordinate of the shift of each scan, and of the way
            that its turn moves points at a distance of 1 from the origin, about each axis; see `rigid_motion`.
        smear: share of the readings beside a jump in depth that lie between its two sides, from 0 to 1; see `smeared`.
        uneven: how many times as dense the points are on one side as on the other, 1 or more; see `kept_unevenly`.

    Raises:
        ValueError: one of them is out of its bounds.
    """

    isotropic: float = 0.0
    quantise: float = 0.0
    misalign: float = 0.0
    smear: float = 0.0
    uneven: float = 1.0

    def __post_init__(self) -> None:
        for name in ("isotropic", "quantise", "misalign"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name}={value}: expected a length, 0 or more")
        if not 0 <= self.smear <= 1:
            raise ValueError(f"smear={self.smear}: expected a share from 0 to 1")
        if not 1 <= self.uneven < math.inf:
            raise ValueError(f"uneven={self.uneven}: expected a factor of 1 or more")


def quantised(ranges: Float64, step: float) -> Float64:
    """Ranges rounded to multiples of ``step``, ``⌊r / step + ½⌋ · step``: off by half a step at most.

    Where ranges spread over many steps the error is uniform, with the standard deviation ``step / √12``.
    """
    return np.floor(ranges / step + 0.5) * step if step else ranges


def depth_jumps(ranges: Float64, rays: Float64, axis: int) -> Mask:
    """Between which neighbours along ``axis`` of a grid of ranges ``(H, W)`` depth jumps; one shorter along it.

    Two readings r and r' on rays an angle α apart are on different surfaces if ``|r − r'| > tan(84°) α min(r, r')``:
    one surface between them would be seen at 84° or flatter. Without one of the readings (NaN) there is no jump.

    Args:
        ranges: NaN without reading.
        rays: ``(H, W, 3)`` unit directions.
        axis: 0 or 1.
    """
    r, direction = np.moveaxis(ranges, axis, 0), np.moveaxis(rays, axis, 0)
    sine = np.linalg.norm(direction[1:] - direction[:-1], axis=-1) / 2  # of half the angle
    nearer = np.minimum(r[1:], r[:-1])
    jump = np.abs(r[1:] - r[:-1]) > math.tan(math.radians(84.0)) * 2 * np.arcsin(sine) * nearer
    return np.moveaxis(jump, 0, axis)


def smeared(ranges: Float64, rays: Float64, share: float, random: np.random.Generator) -> tuple[Float64, Mask]:
    """Mixed pixels: beams at the rim of something return what lies in the air between it and what is behind.

    A reading r beside a jump in depth (see `depth_jumps`), along rows or columns, becomes ``r + t (r' − r)`` with
    the probability ``share``; r' is the reading of that neighbour across a jump from which it differs most, and t is
    uniform in (0, 1).

    Args:
        ranges: ``(H, W)``, NaN without reading.
        rays: ``(H, W, 3)`` unit directions.
        share: from 0 to 1.
        random: asked for two numbers per pixel, whatever the share.

    Returns:
        The ranges, and which of them are mixed, each ``(H, W)``.
    """
    step, size = np.zeros_like(ranges), np.zeros_like(ranges)
    for axis in (0, 1):
        change = np.where(depth_jumps(ranges, rays, axis), np.diff(ranges, axis=axis), 0.0)
        after, before = both_sides(change, axis)
        for towards in (after, -before):
            larger = np.abs(towards) > size
            step, size = np.where(larger, towards, step), np.where(larger, np.abs(towards), size)
    chosen, way = random.uniform(size=(2, *ranges.shape))
    mixed = (size > 0) & (chosen < share)
    return np.where(mixed, ranges + way * step, ranges), mixed


def kept_unevenly(points: Float64, direction: Float64, factor: float, random: np.random.Generator) -> Mask:
    """Which points ``(..., 3)`` of the unit sphere are kept: each with the probability ``factor^−(1 + ⟨x, d⟩)/2``.

    All of them at one end of the unit ``direction`` d, one in ``factor`` at the other, and exponentially fewer between.
    """
    height = (1 + points @ direction) / 2
    return random.uniform(size=height.shape) < factor ** -height.clip(0, 1)


def rigid_motion(size: float, random: np.random.Generator) -> Float64:
    """A small random motion ``(4, 4)``, x → R x + t.

    t has the standard deviation ``size`` in each coordinate, and so has the rotation vector of R, in radians: at a
    distance of 1 from the origin it moves points as far as the shift does.
    """
    motion = np.eye(4)
    shift, turn = random.normal(0, 1, (2, 3)) * size
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return motion
