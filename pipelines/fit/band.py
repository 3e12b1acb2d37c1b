"""The band around a frozen level: where the next one is trained, and evaluated (paper Sec. 3.2, Eq. 5).

Eq. 5 takes it as wide as the level misses the input points by. That holds the surface. But what a coarse level makes of
a part that is too thin for it may also be a sheet of surface far from all points, and beyond it a place that is deeper
inside than the band is wide: no finer level would ever be evaluated there, and the sheet would stay. So the band holds
the places too of which winding numbers say for sure that they are on the other side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...neural_fields import Field
from .cloud import CloudDistance
from .samples import SAMPLING, spread_points

__all__ = ["Band", "BandOptions", "band_of", "delta_of", "with_wrong_sides"]


@dataclass(frozen=True)
class BandOptions:
    """Numbers of `band_of` and `with_wrong_sides`."""

    # Largest error over its 99th percentile: 1.0 for uniform noise, 1.6 for Gaussian, 2 to 3 for what a coarse level
    # misses of the fine parts of a clean cloud.
    stray: float = 4.0
    # The same over the 90th percentile, generous: a level may miss a thin part as a whole.
    tail: float = 20.0
    # Places on the wrong side widen a band to so many times its width at most: a level that is lost would have no
    # band.
    widest: float = 2.0
    # Of the places this part is asked first: most levels have none on the wrong side, and winding numbers take time.
    first: int = 4


BAND = BandOptions()


@dataclass(frozen=True)
class Band:
    """The band around a level.

    Attributes:
        delta: its half-width.
        rule: "quantile" where one was asked for, "maximum" over all points, or "maximum but for strays"; "places on the
            wrong side", see `with_wrong_sides`; or "no wider than the band before", see `within`.
        outside: input points that it does not hold.
    """

    delta: float
    rule: str
    outside: int

    @classmethod
    def of(cls, delta: float, rule: str, errors: Tensor) -> Band:
        """The band of half-width ``delta``, with the count of the ``errors`` ``(n,)`` at the input points beyond it."""
        return cls(delta, rule, int((errors.abs() >= delta).sum()))

    def within(self, before: float | None, errors: Tensor) -> Band:
        """This band, or where the one ``before`` it is narrower, that: bands nest.

        Args:
            before: half-width of the band around the level before; None if there is none.
            errors: ``(n,)`` values at the input points.
        """
        if before is None or self.delta <= before:
            return self
        return Band.of(before, "no wider than the band before", errors)


def band_of(errors: Tensor, *, epsilon: float, quantile: float | None) -> Band:
    """The band of `delta_of`, and what chose it.

    Args:
        errors: ``(n,)`` values f(x_j) at the input points.
        epsilon: the ε of Eq. 5.
        quantile: q in (0, 1], or None.
    """
    # A level that met every point exactly would leave its successor no band at all.
    delta = max(delta_of(errors, epsilon=epsilon, quantile=quantile), 1e-6)
    strays = float(errors.abs().max()) * (1 + epsilon) > delta
    rule = "quantile" if quantile is not None else "maximum but for strays" if strays else "maximum"
    return Band.of(delta, rule, errors)


def delta_of(errors: Tensor, *, epsilon: float, quantile: float | None, options: BandOptions = BAND) -> float:
    """The half-width of a band, ``δ = (1 + ε) · Q_q(|f(x_j)|)``; the paper's Eq. 5 at ``quantile = 1``.

    The maximum of Eq. 5 is fragile: one stray point far from the surface widens the band to half the domain. With
    ``quantile=None`` it is taken over the points with no more than ``stray`` times the 99th percentile and ``tail``
    times the 90th, which all points of a sound cloud are: their errors have a bounded distribution, strays do not.
    The second bound holds where more than one point in a hundred is a stray.

    Args:
        errors: ``(n,)`` values f(x_j) at the input points.
        epsilon: the ε of Eq. 5.
        quantile: q in (0, 1], or None.
        options: numbers of the algorithm.
    """
    ordered = errors.abs().flatten().sort().values
    if quantile is None:
        usual = min(
            q * ordered[math.ceil(share * len(ordered)) - 1]
            for q, share in ((options.stray, 0.99), (options.tail, 0.9))
        )
        return (1 + epsilon) * float(ordered[ordered <= usual][-1])
    return (1 + epsilon) * float(ordered[max(0, math.ceil(quantile * len(ordered)) - 1)])


@torch.no_grad()
def with_wrong_sides(
    band: Band,
    errors: Tensor,
    cloud: CloudDistance,
    field: Field,
    *,
    epsilon: float,
    count: int,
    seed: int,
    device: torch.device,
    options: BandOptions = BAND,
) -> Band:
    """This band, or a wider one that also holds the places which ``field`` puts on the wrong side.

    Those are the places that are further than δ inside of the field and, by the winding number of the cloud, surely
    outside of it, or the other way round. Of a level that is right within its band there are none.

    Args:
        band: see `band_of`.
        errors: ``(n,)`` values at the input points.
        cloud: the points.
        field: the frozen levels.
        epsilon: the ε of Eq. 5.
        count: how many places are tried, spread as for level 0; a fourth of them only if none of those is wrong.
        seed: draws them.
        device: where the field is.
        options: numbers of the algorithm.

    Returns:
        A band with ``δ = (1 + ε) · max |f|`` over those places, `widest` times as wide at most.
    """
    generator = torch.Generator().manual_seed(seed)
    wrong = _wrong_sides(band.delta, cloud, field, spread_points(cloud, count // options.first, generator), device)
    if not len(wrong):
        return band
    more = _wrong_sides(band.delta, cloud, field, spread_points(cloud, count, generator), device)
    widest = float(torch.cat((wrong, more)).abs().max())
    delta = min((1 + epsilon) * widest, options.widest * band.delta)
    return Band.of(delta, "places on the wrong side", errors)


def _wrong_sides(delta: float, cloud: CloudDistance, field: Field, places: Tensor, device: torch.device) -> Tensor:
    """Values ``(m,)`` of the field at those of the places ``(M, 3)`` that it has further than δ on the wrong side."""
    value = torch.cat([field.value(part.to(device)).cpu() for part in places.split(1 << 16)])
    beyond = (value.abs() > delta).nonzero()[:, 0]
    points, value = places[beyond].numpy(), value[beyond]
    depth = cloud.winding_number(points) - 0.5
    wrong = (np.abs(depth) > SAMPLING.sure) & ((depth > 0) == (value.numpy() > 0))
    distance, clear = cloud.beyond(points, SAMPLING.clear)
    wrong &= distance > clear
    return value[torch.from_numpy(wrong)]
