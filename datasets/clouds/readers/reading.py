"""``read_cloud``: any supported file → ``PointCloud``."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ....neural_fields import InputError
from ...files import readable
from ..point_cloud import PointCloud, usable_rows
from .las import LasStream, read_las
from .meshes import read_obj, read_off, read_stl
from .ply import ply_stream, read_ply
from .stream import CloudStream
from .tables import npy_stream, read_npy, read_npz, read_text

__all__ = ["MIN_POINTS", "READERS", "check_cloud", "check_cloud_path", "open_stream", "read_cloud"]

MIN_POINTS = 10
"""Fewer points than this are no surface."""

SMALLEST = 1e-100
"""Clouds of a smaller extent cannot be computed with: squares of distances within them vanish."""

READERS: Mapping[str, Callable[[Path], PointCloud]] = MappingProxyType(
    {
        ".ply": read_ply,
        ".obj": read_obj,
        ".stl": read_stl,
        ".off": read_off,
        ".xyz": read_text,
        ".txt": read_text,
        ".csv": read_text,
        ".npy": read_npy,
        ".npz": read_npz,
        ".las": read_las,
        ".laz": read_las,
    }
)
"""What reads which extension."""

STREAMS: Mapping[str, Callable[[Path], CloudStream | None]] = MappingProxyType(
    {".ply": ply_stream, ".npy": npy_stream, ".las": LasStream, ".laz": LasStream}
)
"""What reads which extension in pieces."""


def read_cloud(path: str | Path) -> PointCloud:
    """Read a point cloud; of a mesh, its vertices with area-weighted vertex normals.

    Args:
        path: a PLY, OBJ, STL, OFF, XYZ, TXT, CSV, NPY, NPZ, LAS or LAZ file.

    Raises:
        InputError: the file is missing, damaged, foreign or of an unknown kind, or holds no usable cloud.

    Example:
        >>> read_cloud("scan.xyzz")
        Traceback (most recent call last):
        ...
        mplicits.neural_fields.backend.errors.InputError: scan.xyzz: no such file; check the path
    """
    path = check_cloud_path(path)
    with readable(path):
        cloud = READERS[path.suffix.lower()](path)
    check_cloud(cloud)
    return cloud


def check_cloud_path(path: str | Path) -> Path:
    """The path of a file that is there, is not empty and has an extension that is known.

    Raises:
        InputError: it is not.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; name the point-cloud file in it")
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    extension = path.suffix.lower()
    if extension not in READERS:
        known = ", ".join(READERS)
        nearest = difflib.get_close_matches(extension, READERS, n=1, cutoff=0.5)
        hint = f"did you mean {nearest[0]}? " if nearest else ""
        raise InputError(f"{path}: unknown extension {extension!r}; {hint}known are {known}")
    with readable(path):
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; export it again")
    return path


def open_stream(path: str | Path) -> CloudStream | None:
    """A file to be read in pieces: binary PLY, NPY, LAS and LAZ; None for all that only `read_cloud` reads.

    Raises:
        InputError: the file is missing, damaged or of an unknown kind.
    """
    path = check_cloud_path(path)
    with readable(path):
        return STREAMS[path.suffix.lower()](path) if path.suffix.lower() in STREAMS else None


def check_cloud(cloud: PointCloud) -> None:
    """Refuse a cloud that is no surface.

    Raises:
        InputError: too few finite points, or all at one place.
    """
    finite = cloud.points[usable_rows(cloud.points)]
    if len(finite) == 0:
        raise InputError(f"{cloud.source}: points: none with finite coordinates among {len(cloud)}; export it again")
    if bool((finite == finite[0]).all()) and len(finite) > 1:
        raise InputError(f"{cloud.source}: points: all {len(finite)} coincide; export it with more digits")
    if len(finite) > 1 and (extent := float(np.ptp(finite, axis=0).max())) < SMALLEST:
        raise InputError(f"{cloud.source}: points: {extent:.3g} across; export it in a smaller unit")
    if len(finite) < MIN_POINTS:
        raise InputError(
            f"{cloud.source}: points: {len(finite)} with finite coordinates; at least {MIN_POINTS} are needed"
        )
