"""The points that a fit rests on, kept in its run: what meshing needs to tell a part from a blob, without the cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..datasets.clouds.point_cloud import voxel_representatives
from ..neural_fields import InputError
from .mesh_trim import support_radius
from .run.folder import FIELD_FILE, load_state, save_state

__all__ = ["SUPPORT_FILE", "Support", "read_support", "write_support"]

SUPPORT_FILE = "support.safetensors"
# Voxels of this size, in the unit sphere, keep one point each: some 60,000 of a surface of area 4, in half precision
# (off by 0.0003 at most) 400 KB.
VOXEL = 1 / 128


class Support(NamedTuple):
    """Points ``(N, 3)`` in the unit sphere, and how near some of them a surface that they support passes."""

    points: NDArray[np.float64]
    radius: float


def write_support(directory: Path, points: NDArray[np.floating]) -> None:
    """Keep the points ``(N, 3)`` of a fit, one per voxel, beside its field; whole or not at all."""
    thinned = points[voxel_representatives(np.asarray(points, np.float64), VOXEL)]
    save_state(directory, {"points": torch.from_numpy(thinned).half()}, {}, name=SUPPORT_FILE)


def read_support(field: Path, record: dict[str, Any], level: int) -> Support | None:
    """What supports a level of the field in a file; None if the file is no run's, or that level is still in training.

    Args:
        field: the checkpoint.
        record: what ``run.json`` holds.
        level: counted from 0.

    Raises:
        InputError: the points are damaged.
    """
    path = field.with_name(SUPPORT_FILE)
    stages = record.get("stages", [])
    if field.name != FIELD_FILE or not path.is_file() or level >= len(stages):
        return None
    tensors, _ = load_state(field.parent, name=SUPPORT_FILE)
    if "points" not in tensors or tensors["points"].ndim != 2 or tensors["points"].shape[1] != 3:
        raise InputError(f"{path}: damaged (no points); remove it, or fit again")
    points = tensors["points"].double().numpy()
    error = stages[level]["rms_at_points"] / record["similarity"]["scale"]
    return Support(points, support_radius(points, error=error))
