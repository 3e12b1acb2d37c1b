"""E57, the exchange format of terrestrial laser scanners (ASTM E2807), through pye57.

pye57 reads colours as bytes, and rotations in the order of the file; its library libE57 reads both as they are.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ....neural_fields import InputError
from ..point_cloud import Float64, PointCloud, color_scale
from .columns import Table, choose_layout, cloud_from

_READ = re.compile(r"(cartesian|spherical|color|nor:normal)\w+")
_COLORS = ("colorRed", "colorGreen", "colorBlue")


def read_e57(path: Path, columns: str | None = None) -> PointCloud:
    """All scans of an E57 file in their common coordinates, with the normals and colours that all of them have."""
    try:
        import pye57
    except ImportError as error:
        raise InputError(f"{path}: E57 needs pye57; pip install 'mplicits[e57]'") from error
    with path.open("rb") as stream:
        head = stream.read(48)
    if len(head) < 48 or head[:8] != b"ASTM-E57":
        raise InputError(f"{path}: does not start with 'ASTM-E57', so it is not an E57 file; check its extension")
    try:
        file = pye57.E57(str(path))
        headers = [header for header in map(file.get_header, range(file.scan_count)) if header.point_count]
        scans = [_scan(file.image_file, header) for header in headers]
        stored = sum(int(header.point_count) for header in headers)
    except Exception as error:  # libE57's own, and what pye57 trips over
        reason = [*str(error).splitlines(), type(error).__name__][0]
        raise InputError(f"{path}: not a readable E57 file ({reason}); export it again") from error
    shared = [name for name in (scans[0] if scans else ()) if all(name in scan for scan in scans)]
    if not shared:
        raise InputError(f"{path}: no scan with points in it; export it again")
    values = [np.concatenate([scan[name] for scan in scans]) for name in shared]
    partly = sorted({name for scan in scans for name in scan} - set(shared))
    notes = [f"of some scans only, and ignored: {', '.join(partly)}"] * bool(partly)
    notes += [f"{stored - len(values[0]):,} invalid points left out"] * (stored > len(values[0]))
    table = Table(path, values, shared, notes=tuple(notes))
    return cloud_from(table, choose_layout(table, columns))


def _scan(image: Any, header: Any) -> dict[str, Float64]:
    """The valid points of a scan in the file's coordinates, with colours as fractions; other fields are left empty."""
    from pye57 import libe57  # pyright: ignore[reportAttributeAccessIssue]

    count = int(header.point_count)
    read = {name: np.empty(count) for name in header.point_fields if _READ.fullmatch(name)}
    buffers = [libe57.SourceDestBuffer(image, name, values, count, True, True) for name, values in read.items()]
    header.points.reader(libe57.VectorSourceDestBuffer(buffers)).read()
    pose = {}
    for part, axes in (("rotation", "xyzw"), ("translation", "xyz")):
        there = header.node.isDefined(f"pose/{part}")
        pose[part] = [header["pose"][part][axis].value() for axis in axes] if there else (0, 0, 0, 1)[: len(axes)]
    turn = Rotation.from_quat(pose["rotation"]).as_matrix().T
    if cartesian := "cartesianX" in read:
        points = np.stack([read[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    else:
        length, azimuth, height = (read[f"spherical{part}"] for part in ("Range", "Azimuth", "Elevation"))
        flat = length * np.cos(height)
        points = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), length * np.sin(height)), axis=1)
    found = dict(zip("xyz", (points @ turn + pose["translation"]).T, strict=True))
    if "nor:normalX" in read:
        normals = np.stack([read[f"nor:normal{axis}"] for axis in "XYZ"], axis=1) @ turn
        found |= dict(zip(("nx", "ny", "nz"), normals.T, strict=True))
    if all(name in read for name in _COLORS):
        scale = _full(header, np.stack([read[name] for name in _COLORS], axis=1))
        found |= {name: (read[name] / scale).clip(0, 1) for name in _COLORS}
    valid = read.get("cartesianInvalidState" if cartesian else "sphericalInvalidState", np.zeros(count)) == 0
    others = {name: np.empty(0) for name in header.point_fields if name not in read}
    return {name: values[valid] for name, values in found.items()} | others


def _full(header: Any, colors: Float64) -> float:
    """The number of full brightness: the limit that the scan states, to whole bits, where its colours keep to it."""
    if header.node.isDefined("colorLimits/colorRedMaximum"):
        stated = 2.0 ** math.ceil(math.log2(header["colorLimits"]["colorRedMaximum"].value() + 1)) - 1
        if np.quantile(colors, 0.999) <= stated:
            return stated
    return color_scale(colors)
