"""LAS and LAZ (airborne and terrestrial laser scans), through laspy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..neural_fields import InputError
from .point_cloud import PointCloud, colors_from

__all__ = ["read_las"]

_NORMALS = (("NormalX", "NormalY", "NormalZ"), ("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))


def read_las(path: Path) -> PointCloud:
    """Read points, and colours and normals where the file has them.

    Raises:
        InputError: laspy is not installed, or it cannot read the file.
    """
    try:
        import laspy
    except ImportError as error:
        raise InputError(f"{path}: LAS and LAZ need laspy; pip install mplicits[las]") from error
    try:
        las: Any = laspy.read(path)
        points = np.stack((las.x, las.y, las.z), axis=1).astype(np.float64)
    except OSError:
        raise
    except Exception as error:  # laspy lets through its own errors and those of its decompressors
        raise InputError(f"{path}: not a readable LAS file ({_first_line(error)}); export it again") from error
    names = set(las.point_format.dimension_names)
    colors = np.stack((las.red, las.green, las.blue), axis=1) if "red" in names else None
    # without colours, writers fill the columns with zeros
    colors = None if colors is None or not colors.any() else colors_from(colors)
    triple = next((triple for triple in _NORMALS if names.issuperset(triple)), None)
    normals = None if triple is None else np.stack([las[name] for name in triple], axis=1).astype(np.float32)
    return PointCloud(points, normals, colors, str(path))


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
