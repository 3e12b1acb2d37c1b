"""``read_cloud``: a point cloud or mesh from a file of any known format."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ...files import readable
from ..point_cloud import PointCloud, usable_rows
from .columns import CloudStream
from .e57 import read_e57
from .las import LAS_SUFFIXES, LasStream, read_las
from .meshes import read_obj, read_off, read_stl
from .pcd import read_pcd
from .ply import ply_stream, read_ply, read_ply_mesh
from .tables import npy_stream, read_npy, read_npz, read_text

MIN_POINTS = 10
"""Fewer points than this are no surface."""

MESH_READERS: Mapping[str, Callable[[Path], tuple[PointCloud, NDArray[np.int64]]]] = MappingProxyType(
    {".ply": read_ply_mesh, ".obj": read_obj, ".stl": read_stl, ".off": read_off}
)
"""What reads which extension as vertices and triangles."""

TABLE_READERS: dict[str, Callable[[Path, str | None], PointCloud]] = {
    ".ply": read_ply,
    **dict.fromkeys((".xyz", ".txt", ".asc", ".csv", ".pts"), read_text),
    ".npy": read_npy,
    ".npz": read_npz,
    ".pcd": read_pcd,
    ".e57": read_e57,
}
"""What reads which extension as a cloud, with the names of its columns where the file has none."""


CLOUD_SUFFIXES: tuple[str, ...] = tuple(dict.fromkeys((*TABLE_READERS, *MESH_READERS, *LAS_SUFFIXES)))
"""Extensions that `read_cloud` knows."""


def read_cloud(path: str | Path, *, columns: str | None = None, drop_noise: bool = False) -> PointCloud:
    """Read a point cloud; of a mesh, its vertices with area-weighted vertex normals.

    Args:
        path: a PLY, PCD, E57, OBJ, STL, OFF, XYZ, TXT, ASC, CSV, PTS, NPY, NPZ, LAS or LAZ file.
        columns: names of all columns of a table, where the file does not tell: ``x,y,z,nx,ny,nz,r,g,b,-``.
        drop_noise: whether LAS points of the classes for noise are left out.

    Raises:
        InputError: the file cannot be read, or holds no usable cloud.
    """
    path = check_cloud_path(path)
    suffix = path.suffix.lower()
    with readable(path):
        if suffix in LAS_SUFFIXES:
            cloud = read_las(path, columns, drop_noise=drop_noise)
        elif suffix in TABLE_READERS:
            cloud = TABLE_READERS[suffix](path, columns)
        elif columns is not None:
            raise InputError(f"{path}: --columns is for tables; {suffix[1:].upper()} files say what they hold")
        else:
            cloud = MESH_READERS[suffix](path)[0]
    check_cloud(cloud)
    return cloud


def read_mesh(path: str | Path) -> tuple[PointCloud, NDArray[np.int64]]:
    """The vertices and the triangles ``(F, 3)``, F ≥ 0, of a PLY, OBJ, STL or OFF file."""
    path = check_cloud_path(path)
    with readable(path):
        return MESH_READERS[path.suffix.lower()](path)


def check_cloud_path(path: str | Path) -> Path:
    """The path, if it names a file that exists, is not empty and has a known extension; else an InputError."""
    path = Path(path)
    with readable(path):
        if path.is_dir():
            raise InputError(f"{path}: is a directory; name the point-cloud file in it")
        if not path.exists():
            raise InputError(f"{path}: no such file; check the path")
    if (extension := path.suffix.lower()) not in CLOUD_SUFFIXES:
        known = ", ".join(CLOUD_SUFFIXES)
        nearest = difflib.get_close_matches(extension, CLOUD_SUFFIXES, n=1, cutoff=0.5)
        hint = f"did you mean {nearest[0]}? " if nearest else ""
        raise InputError(f"{path}: unknown extension {extension!r}; {hint}known are {known}")
    with readable(path):
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; export it again")
    return path


def open_stream(path: str | Path, *, columns: str | None = None, drop_noise: bool = False) -> CloudStream | None:
    """A binary PLY, NPY, LAS or LAZ file in pieces; None for what only `read_cloud` reads."""
    path = check_cloud_path(path)
    suffix = path.suffix.lower()
    with readable(path):
        if suffix in LAS_SUFFIXES:
            return LasStream(path, columns, drop_noise=drop_noise)
        return {".ply": ply_stream, ".npy": npy_stream}.get(suffix, lambda *_: None)(path, columns)


def check_cloud(cloud: PointCloud) -> None:
    """Refuse a cloud with too few finite points, or with all of them at one place, by an InputError."""
    finite = cloud.points[usable_rows(cloud.points)]
    if len(finite) == 0:
        raise InputError(f"{cloud.source}: points: none with finite coordinates among {len(cloud)}; export it again")
    if bool((finite == finite[0]).all()) and len(finite) > 1:
        raise InputError(f"{cloud.source}: points: all {len(finite)} coincide; export it with more digits")
    extent = float(np.ptp(finite, axis=0).max())
    if len(finite) > 1 and extent < 1e-100:  # squares of distances would vanish
        raise InputError(f"{cloud.source}: points: {extent:.3g} across; export it in a smaller unit")
    if len(finite) < MIN_POINTS:
        count = f"{len(finite)} with finite coordinates"
        raise InputError(f"{cloud.source}: points: {count}; at least {MIN_POINTS} are needed")
