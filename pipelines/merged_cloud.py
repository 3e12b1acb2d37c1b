"""The cloud of a fit: small ones as they are, large ones merged as they are read, once per run."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets import PointCloud, read_cloud
from ..datasets.clouds.large import Merging, merge_cloud
from ..datasets.clouds.reading import check_cloud, open_stream
from ..datasets.clouds.stream import MemoryStream
from ..neural_fields.files import whole_file

__all__ = ["MERGED_FILE", "load_cloud"]

MERGED_FILE = "merged_cloud.npz"
# What merging does may change; what an older version left behind is then made again.
VERSION = 1


def load_cloud(
    cloud: PointCloud | str | Path, *, limit: int | None, isolation: float | None = 30.0, cache: Path | None = None
) -> tuple[PointCloud, Merging | None]:
    """Read a cloud; of one with more than ``limit`` points, at most as many that stand for them.

    Args:
        cloud: a file, or what was read from one.
        limit: clouds of no more points are left as they are; None leaves all so.
        isolation: see `merge_cloud`.
        cache: a run directory: keeps what was merged from a file, for as long as that file does not change.

    Returns:
        The cloud, and what merging did to it, if anything.

    Raises:
        InputError: see `read_cloud`.
    """
    if limit is None:
        return cloud if isinstance(cloud, PointCloud) else read_cloud(cloud), None
    stream = MemoryStream(cloud) if isinstance(cloud, PointCloud) else open_stream(cloud)
    if stream is None:
        stream = MemoryStream(read_cloud(cloud))  # pyright: ignore[reportArgumentType]
    if stream.count <= limit:
        return stream.cloud if isinstance(stream, MemoryStream) else read_cloud(stream.source), None
    about = None if isinstance(cloud, PointCloud) else _about(Path(cloud), limit, isolation)
    kept = None if cache is None or about is None else _kept(cache / MERGED_FILE, about)
    if kept is not None:
        return kept
    merged = merge_cloud(stream, limit, isolation=isolation)
    if merged is None:  # nothing to fit, and a message that says so
        check_cloud(stream.cloud if isinstance(stream, MemoryStream) else read_cloud(stream.source))
    assert merged is not None
    check_cloud(merged[0])
    if cache is not None and about is not None:
        _keep(cache / MERGED_FILE, about, *merged)
    return merged


def _about(path: Path, limit: int, isolation: float | None) -> dict[str, Any]:
    """What a merged cloud depends on."""
    facts = path.stat()
    return {
        "version": VERSION,
        "file": str(path.absolute()),
        "bytes": facts.st_size,
        "changed": facts.st_mtime_ns,
        "limit": limit,
        "isolation": isolation,
    }


def _keep(file: Path, about: dict[str, Any], cloud: PointCloud, merging: Merging) -> None:
    """Write a merged cloud, whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    arrays = {"points": cloud.points, "normals": cloud.normals, "colors": cloud.colors}
    text = json.dumps({"about": about, "merging": dataclasses.asdict(merging), "source": cloud.source})
    with whole_file(file) as partial, partial.open("wb") as stream:
        np.savez(stream, record=np.array(text), **{name: a for name, a in arrays.items() if a is not None})


def _kept(file: Path, about: dict[str, Any]) -> tuple[PointCloud, Merging] | None:
    """What `_keep` wrote for the same file, unchanged; None if there is no such thing, or it is damaged."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            record = json.loads(str(archive["record"]))
            if record["about"] != about:
                return None
            normals, colors = (archive[name] if name in archive.files else None for name in ("normals", "colors"))
            cloud = PointCloud(archive["points"], normals, colors, record["source"])
            return cloud, Merging(**record["merging"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
