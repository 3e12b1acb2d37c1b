"""The cloud of a fit: read, merged where it is large, and signed distances to it, which level 0 learns from.

No mesh is needed for these. Magnitude: each point stands for a disc in its tangent plane, as wide as its neighbourhood
is spaced; the distance to the nearest of a few discs has neither the bias of the distance to the nearest point
(√(d² + h²) instead of d) nor the reach of an infinite tangent plane. Sign: away from the surface by the generalised
winding number of the cloud, which closes the holes that scans have; close to it by the side of the nearest discs.
Beside the edge of a blade, where all discs are seen edge-on, what smoothing has left of noise would decide: of a cloud
that was noisy, the winding number is asked down to half the width of the noise.
"""

from __future__ import annotations

import dataclasses
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets import PointCloud, read_cloud
from ...datasets.clouds.large import Merging, merge_cloud
from ...datasets.clouds.reading import check_cloud, open_stream
from ...datasets.clouds.stream import MemoryStream
from ...neural_fields.files import whole_file
from ..run.costs import queries, windings
from ..run.folder import MERGED_FILE

__all__ = ["CloudDistance", "load_cloud"]

Float32 = NDArray[np.float32]

# What merging does may change; what an older version left behind is then made again.
VERSION = 1
# Area of a point's disc over the median one: scans are this much sparser where they graze the surface, hardly more.
LARGEST_AREA = 100.0
# Queries at a time: between two of them a progress display is told.
ROWS = 1 << 15


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


class CloudDistance:
    """Nearest distances to, and signed distances from, an oriented cloud in the unit sphere.

    Args:
        points: ``(N, 3)`` points.
        normals: ``(N, 3)`` outward unit normals.
        neighbors: how many discs are compared at each query.
        cell: edge of the cells in which points are merged into dipoles for the winding number; dipoles
            are used only further than ``2 · cell`` from the surface, where their error is below 0.05.
        noise: standard deviation of the noise that was smoothed off the points.
        guessed: whether the normals were estimated from those noisy points.
        given: how many of the points are the cloud's own, the first ones; None for all. The others fill it in.
        gap: the spacing of those; None for that of all.
        repaired: how many normals of points on edges were replaced by one side's.

    Attributes:
        watch: told of work as it is done, in the units of :mod:`..run.costs`.
    """

    def __init__(
        self,
        points: Tensor,
        normals: Tensor,
        *,
        neighbors: int = 6,
        cell: float = 0.05,
        noise: float = 0.0,
        guessed: bool = False,
        given: int | None = None,
        gap: float | None = None,
        repaired: int = 0,
    ) -> None:
        self.watch: Callable[[float], None] = lambda _: None
        self.points: Float32 = points.cpu().numpy()
        self.normals: Float32 = normals.cpu().numpy()
        self.tree = KDTree(self.points, compact_nodes=False, balanced_tree=False)
        self.noise, self.guessed = noise, guessed
        self.neighbors, self.cell = min(neighbors, len(points)), cell
        count = min(8, len(points) - 1)
        reach = np.asarray(self.tree.query(self.points, k=count + 1, workers=-1)[0])[:, -1]
        # `count` neighbours share the disc of radius `reach`: each of them has this much area to itself.
        areas = math.pi * reach**2 / count
        # A few points on their own have nobody near, but no surface of that size either.
        self.areas: Float32 = np.minimum(areas, LARGEST_AREA * np.median(areas)).astype(np.float32)
        self.radii: Float32 = np.sqrt(self.areas / math.pi)
        self.spacing = float(np.median(np.sqrt(self.areas)))
        self.given, self.repaired = len(points) if given is None else given, repaired
        self.gap = self.spacing if gap is None else gap

    @property
    def filled(self) -> bool:
        """Whether there are points between those of the cloud, which was too sparse for what is fitted to it."""
        return len(self.points) > self.given

    def nearest(self, x: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distance from each of ``(M, 3)`` to the nearest point of the cloud → ``(M,)``."""
        return np.concatenate([self._query(x[start : start + ROWS], 1)[0] for start in _starts(len(x))])

    def signed(self, x: Tensor) -> Tensor:
        """Signed distance of ``(M, 3)`` points → ``(M,)`` on the CPU, negative inside."""
        query = x.cpu().numpy()
        parts = [self._query(query[start : start + ROWS], self.neighbors) for start in _starts(len(query))]
        distance, index = (np.concatenate(part) for part in zip(*parts, strict=True))
        offset = query[:, None] - self.points[index]  # (M, k, 3)
        along = np.einsum("mkd,mkd->mk", offset, self.normals[index])
        across = np.sqrt(np.maximum(distance**2 - along**2, 0))
        discs = np.hypot(along, np.maximum(across - self.radii[index], 0))
        magnitude = discs.min(axis=1)
        # Each disc votes with its side, the nearer and the more face-on the louder.
        side = np.sum(along / (distance**3 + 1e-12), axis=1)
        far = distance[:, 0] > 2 * self.cell
        near = ~far & (distance[:, 0] > 0.5 * self.noise) if self.noise else np.zeros_like(far)
        for some, cell in ((far, self.cell), (near, self.cell / 2)):
            if some.any():
                side[some] = 0.5 - self.winding_number(query[some], cell=cell)
        return torch.from_numpy(np.where(side < 0, -magnitude, magnitude).astype(np.float32))

    def _query(self, x: NDArray[np.floating], k: int) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
        """Distances to the k nearest points, and their indices."""
        distance, index = self.tree.query(x, k=k, workers=-1)
        self.watch(queries(len(x), len(self.points)))
        return np.asarray(distance), np.asarray(index)

    def winding_number(self, x: Float32, *, cell: float | None = None, chunk: int = 1024) -> NDArray[np.float64]:
        """Generalised winding number at ``(M, 3)`` points: about 1 inside, 0 outside, in between near holes.

        ``w(x) = Σ_i a_i ⟨p_i − x, n_i⟩ / (4π |p_i − x|³)`` over dipoles (Barill et al. 2018, first order).

        Args:
            x: the points.
            cell: edge of the cells of one dipole each; None for that of the index.
            chunk: points at a time.
        """
        centers, moments = self._dipoles(cell or self.cell)
        offset = (centers * moments).sum(dim=1)
        squares = (centers**2).sum(dim=1)
        query = torch.from_numpy(np.ascontiguousarray(x, np.float32))
        result = torch.empty(len(query))
        for start in range(0, len(query), chunk):
            part = query[start : start + chunk]
            flux = torch.addmm(offset, part, moments.t(), alpha=-1)
            d2 = torch.addmm(squares, part, centers.t(), alpha=-2).add_((part**2).sum(dim=1)[:, None])
            inverse = d2.clamp_(min=1e-8).rsqrt_()
            result[start : start + chunk] = flux.mul_(inverse).mul_(inverse).mul_(inverse).sum(dim=1)
            self.watch(windings(len(part), len(centers)))
        return (result / (4 * math.pi)).double().numpy()

    def _dipoles(self, cell: float) -> tuple[Tensor, Tensor]:
        """Area-weighted centres and area-weighted normal sums of the cloud's occupied cells."""
        cells = np.floor(self.points / cell).astype(np.int64)
        _, owner = np.unique(cells @ np.array([1 << 40, 1 << 20, 1]), return_inverse=True)
        area = np.bincount(owner, self.areas)
        center = np.stack([np.bincount(owner, self.areas * self.points[:, i]) for i in range(3)], 1) / area[:, None]
        moment = np.stack([np.bincount(owner, self.areas * self.normals[:, i]) for i in range(3)], 1)
        return torch.from_numpy(center.astype(np.float32)), torch.from_numpy(moment.astype(np.float32))


def _starts(count: int) -> range:
    """Where the parts of so many queries begin; of none there is one."""
    return range(0, max(count, 1), ROWS)
