"""E57, the exchange format of terrestrial laser scanners (ASTM E2807), through pye57."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ..point_cloud import PointCloud
from .columns import Table, choose_layout, cloud_from


def read_e57(path: Path, columns: str | None = None) -> PointCloud:
    """All scans of an E57 file in their common coordinates, with the colours that all of them have."""
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
        scans: list[dict[str, NDArray[Any]]] = [
            file.read_scan(number, colors=True, intensity=True, ignore_missing_fields=True)
            for number in range(file.scan_count)
        ]
        stored = sum(int(file.get_header(number).point_count) for number in range(file.scan_count))
    except Exception as error:  # libE57's own, and what pye57 trips over
        raise InputError(f"{path}: not a readable E57 file ({str(error).splitlines()[0]}); export it again") from error
    shared = [name for name in (scans[0] if scans else ()) if all(name in scan for scan in scans)]
    if not shared:
        raise InputError(f"{path}: no scan with points in it; export it again")
    values = [np.concatenate([scan[name] for scan in scans]) for name in shared]
    partly = sorted({name for scan in scans for name in scan} - set(shared))
    notes = [f"of some scans only, and ignored: {', '.join(partly)}"] * bool(partly)
    notes += [f"{stored - len(values[0]):,} invalid points left out"] * (stored > len(values[0]))
    table = Table(path, values, shared, notes=tuple(notes))
    return cloud_from(table, choose_layout(table, columns))
