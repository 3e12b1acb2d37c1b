"""How far a field is from exact distances: the error of the paper's ablations."""

from __future__ import annotations

import numpy as np
import torch
from mplicits.neural_fields import Field, Mesh
from mplicits.pipelines.surface.surface import sample_points
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def near_surface(mesh: Mesh, count: int, *, reach: float, seed: int = 0) -> Float64:
    """Points ``(count, 3)`` uniform on a mesh, each moved along its face's normal by U(−reach, reach)."""
    rng = np.random.default_rng(seed)
    points, normals = sample_points(mesh, count, rng)
    assert normals is not None
    return points + rng.uniform(-reach, reach, (count, 1)) * normals


@torch.no_grad()
def approximation_error(field: Field, points: Float64, distances: Float64, *, level: int = -1) -> float:
    """The mean of |f_level(x) − d(x)| over points ``(N, 3)`` with their exact distances ``(N,)``."""
    rows = torch.from_numpy(points).float().to(field.like.device)
    values = torch.cat([field.value(part, level=level) for part in rows.split(1 << 18)])
    return float((values.cpu().double() - torch.from_numpy(distances)).abs().mean())
