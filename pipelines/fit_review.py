"""What the coarse level tells of the points it was fitted to: outliers by their residual, flipped normals."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datasets.clouds.outliers import agreement
from ..neural_fields import Field

__all__ = ["Review", "review_points"]

# Largest |f_0| in units of its robust scale: half of a sound cloud's errors are below 0.67, and what a coarse level
# misses of fine parts is above 8; so is every stray that is worth finding.
FAR = 8.0
MAD = 1.4826  # a Gaussian's standard deviation over its median magnitude
AGAINST = -0.7  # cosine between a normal and the gradient of level 0, below which the normal may be flipped
OPPOSED = -0.3  # and the mean of its neighbours', along its own


class Review(NamedTuple):
    """Which points of a cloud the next levels must not see as they are; each ``(N,)``.

    Attributes:
        dropped: outliers.
        turned: kept points whose normals are to be turned round.
        scale: the robust scale of |f_0| at the points.
    """

    dropped: NDArray[np.bool_]
    turned: NDArray[np.bool_]
    scale: float

    def report(self) -> dict[str, Any]:
        """Counts for ``run.json``."""
        return {
            "dropped_outliers": int(self.dropped.sum()),
            "turned_normals": int(self.turned.sum()),
            "scale": self.scale,
        }


@torch.no_grad()
def review_points(
    points: Tensor,
    normals: Tensor,
    coarse: Field,
    *,
    device: torch.device,
    outliers: bool,
    turn: bool,
) -> Review:
    """Judge a cloud by the level that was fitted to it.

    A small network with a few hundred steps does not bend to single points. An outlier is one that it passes at more
    than `FAR` times the robust scale, that has another normal than the field there, and that fewer than half of its
    neighbours support: fine parts that the level misses support themselves. A flipped normal opposes the field's
    gradient and its neighbours' mean normal, which the gradient follows.

    Args:
        points: ``(N, 3)``.
        normals: ``(N, 3)``.
        coarse: its level 0 judges.
        device: where the field is.
        outliers: whether to look for outliers.
        turn: whether to look for flipped normals.
    """
    jets = [coarse.jet(part.to(device), level=0) for part in points.split(1 << 16)]
    value = torch.cat([jet.value for jet in jets]).cpu()
    gradient = torch.nn.functional.normalize(torch.cat([jet.gradient for jet in jets]).cpu(), dim=1)
    cosine = (gradient * normals).sum(dim=1)
    scale = MAD * float(value.abs().median())
    places, directions = points.double().numpy(), normals.double().numpy()
    dropped, turned = np.zeros((2, len(points)), bool)
    if outliers:
        far = ((value.abs() > FAR * scale) & (cosine < 0.5)).nonzero()[:, 0].numpy()
        support, _ = agreement(places, directions, far)
        dropped[far] = support < 0.5
    if turn:
        against = ((cosine < AGAINST) & torch.from_numpy(~dropped)).nonzero()[:, 0].numpy()
        _, means = agreement(places, directions, against)
        opposed = (means * directions[against]).sum(axis=1) < OPPOSED
        followed = (means * gradient.double().numpy()[against]).sum(axis=1) > -OPPOSED
        turned[against] = opposed & followed
    return Review(dropped, turned, scale)
