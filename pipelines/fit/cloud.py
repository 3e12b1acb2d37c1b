"""The cloud of a fit: read, merged where it is large, and signed distances to it, which level 0 learns from.

No mesh is needed for these. Magnitude: each point stands for a disc in its tangent plane, as wide as its neighbourhood
is spaced; the distance to the nearest of a few discs has neither the bias of the distance to the nearest point
(√(d² + h²) instead of d) nor the reach of an infinite tangent plane. Sign: by the generalised winding number of the
cloud, which closes the holes that scans have, and weighs all normals against each other where some are wrong. Within a
fourth of a spacing of the discs, where a sum over single points says little, and beside the rims of holes, where it is
in doubt and the nearest discs agree, their side says more; but not where normals were estimated from noise.
"""

from __future__ import annotations

import dataclasses
import json
import math
import zipfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets import PointCloud, read_cloud
from ...datasets.clouds.cleaning.winding import DipoleField
from ...datasets.clouds.large import Merging, merge_cloud
from ...datasets.clouds.readers.columns import CloudStream, MemoryStream
from ...datasets.clouds.readers.reading import check_cloud, open_stream
from ...neural_fields.backend.files import whole_file
from ..training.folder import MERGED_FILE

__all__ = ["CloudDistance", "CloudOptions", "load_cloud"]

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class CloudOptions:
    """Numbers of `CloudDistance`."""

    # Area of a point's disc over the median one: scans are this much sparser where they graze the surface, hardly
    # more.
    largest_area: float = 100.0
    # Weight of a point in the samples: its area, but no more than so many times its neighbours', as of a stray that
    # nobody has found.
    alone: float = 4.0
    # Queries at a time: between two of them a progress display is told.
    rows: int = 1 << 15
    # Winding numbers at a time: of more places, groups of neighbouring ones are smaller, and fewer points are near
    # them.
    places: int = 1 << 18
    # Neighbours that share the disc out to the last of them, and among how many nearest ones they are looked for.
    sharing: int = 8
    asked: int = 16
    # Points in each other's tangent plane, to within this part of their distance, lie beside each other on one side.
    # A normal that so many times as many of those contradict as confirm has the wrong sign.
    beside_another: float = 0.25
    odd: float = 2.0
    # Dipoles are softened by this part of the radius of their discs, or of the noise that was smoothed off, whichever
    # is more: close to the surface, between two of them, the winding number would waver. Of wider ones the sides of a
    # thin bar cancel.
    soft: float = 0.3
    # Where normals were estimated from noisy points, dipoles of so many standard deviations of the noise are asked:
    # what is left of it moves the sides of a thin part into each other. It is as wide as those that gave the normals
    # their signs.
    soft_guessed: float = 2.0
    # Sides of a square bar: of all neighbours of a point on it at least one in so many is on its own side.
    sides: float = 4.0
    # Nearer to the discs than this many spacings, sides of discs are right more often than winding numbers.
    beside: float = 0.25
    # So near to one half a winding number says little: in the holes of scans. Up to this far from their rims the
    # discs there, which go on where the surface ends, say more; if a place is on one side of all, by this sine or
    # more. Elsewhere winding numbers are in doubt too, beside bars and in the folds of coarse meshes, and discs say
    # nothing there. Nor do those of points that fill a sparse cloud in: at a sharp corner they may go on where there
    # is nothing.
    doubt: float = 0.25
    rim: float = 0.1
    face_on: float = 0.2
    chance: float = 3.0  # standard deviations of the noise


CLOUD = CloudOptions()


def load_cloud(
    cloud: PointCloud | str | Path,
    *,
    limit: int | None,
    isolation: float | None = 30.0,
    cache: Path | None = None,
    columns: str | None = None,
    drop_noise: bool = False,
) -> tuple[PointCloud, Merging | None]:
    """Read a cloud; of one with more than ``limit`` points, at most as many that stand for them.

    Args:
        cloud: a file, or what was read from one.
        limit: clouds of no more points are left as they are; None leaves all so.
        isolation: see `merge_cloud`.
        cache: a run directory: keeps what was merged from a file, for as long as that file does not change.
        columns: see `read_cloud`.
        drop_noise: see `read_cloud`.

    Returns:
        The cloud, and what merging did to it, if anything.

    Raises:
        InputError: see `read_cloud`.
    """
    read = partial(read_cloud, columns=columns, drop_noise=drop_noise)
    if limit is None:
        return cloud if isinstance(cloud, PointCloud) else read(cloud), None
    if isinstance(cloud, PointCloud):
        stream: CloudStream = MemoryStream(cloud)
    else:
        stream = open_stream(cloud, columns=columns, drop_noise=drop_noise) or MemoryStream(read(cloud))
    if stream.count <= limit:
        return stream.cloud if isinstance(stream, MemoryStream) else read(stream.source), None
    about = None
    if not isinstance(cloud, PointCloud):
        about = _about(Path(cloud), limit=limit, isolation=isolation, columns=columns, drop_noise=drop_noise)
    kept = None if cache is None or about is None else _kept(cache / MERGED_FILE, about)
    if kept is not None:
        return kept
    merged = merge_cloud(stream, limit, isolation=isolation)
    if merged is None:  # nothing to fit, and a message that says so
        check_cloud(stream.cloud if isinstance(stream, MemoryStream) else read(stream.source))
    assert merged is not None
    check_cloud(merged[0])
    if cache is not None and about is not None:
        _keep(cache / MERGED_FILE, about, *merged)
    return merged


def _about(path: Path, **options: Any) -> dict[str, Any]:
    """What a merged cloud depends on."""
    facts = path.stat()
    return {
        "version": 2,  # of what merging does; a cloud that was merged otherwise is made again
        "file": str(path.absolute()),
        "bytes": facts.st_size,
        "changed": facts.st_mtime_ns,
        **options,
    }


def _keep(file: Path, about: dict[str, Any], cloud: PointCloud, merging: Merging) -> None:
    """Write a merged cloud, whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    arrays = {"points": cloud.points, "normals": cloud.normals, "colors": cloud.colors}
    record = {"about": about, "merging": dataclasses.asdict(merging), "source": cloud.source, "reading": cloud.reading}
    text = json.dumps(record)
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
            cloud = PointCloud(archive["points"], normals, colors, record["source"], reading=record["reading"])
            return cloud, Merging(**record["merging"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


class CloudDistance:
    """Nearest distances to, and signed distances from, an oriented cloud in the unit sphere.

    Args:
        points: ``(N, 3)`` points.
        normals: ``(N, 3)`` outward unit normals.
        neighbors: how many discs are compared at each query.
        noise: standard deviation of the noise that was smoothed off the points.
        guessed: whether the normals were estimated from the points, noisy or not.
        given: how many of the points are the cloud's own, the first ones; None for all. The others fill it in.
        gaps: ``(given,)`` the spacing at each of those; None where there are no others.
        repaired: how many normals of points on edges were replaced by one side's.
        options: numbers of the algorithm.
    """

    def __init__(
        self,
        points: Tensor,
        normals: Tensor,
        *,
        neighbors: int = 6,
        noise: float = 0.0,
        guessed: bool = False,
        given: int | None = None,
        gaps: Float32 | None = None,
        repaired: int = 0,
        options: CloudOptions = CLOUD,
    ) -> None:
        self.options = options
        self.points: Float32 = points.cpu().numpy()
        self.normals: Float32 = normals.cpu().numpy()
        self.tree = KDTree(self.points, compact_nodes=False, balanced_tree=False)
        self.noise, self.guessed = noise, guessed
        self.neighbors = min(neighbors, len(points))
        self._dipoles: dict[float, DipoleField] = {}  # by how much they are softened
        self.areas, self.weights = self._areas()
        self.radii: Float32 = np.sqrt(self.areas / math.pi)
        self.spacing = float(np.median(np.sqrt(self.areas)))
        self.given, self.repaired = len(points) if given is None else given, repaired
        self.gaps: Float32 = np.sqrt(self.areas) if gaps is None else gaps
        if len(self.gaps) < len(self.points):
            own = KDTree(self.points[: self.given]).query(self.points[self.given :], workers=-1)[1]
            self.gaps = np.concatenate((self.gaps, self.gaps[np.asarray(own)]))

    @property
    def filled(self) -> float:
        """Share of the surface's area that points between those of the cloud stand for, where it is sparse."""
        return float(self.areas[self.given :].sum() / self.areas.sum())

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Indices ``(count,)`` of points drawn with replacement, each in proportion to its weight."""
        return drawn(torch.from_numpy(self.weights).double().cumsum(0), count, generator)

    def nearest(self, x: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distance from each of ``(M, 3)`` to the nearest point of the cloud → ``(M,)``."""
        return np.concatenate([self._query(part, 1)[0] for part in _parts(x, self.options.rows)])

    def beyond(self, x: NDArray[np.floating], gaps: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distances ``(M,)`` of ``(M, 3)`` to the nearest point, and ``gaps`` times the cloud's spacing there."""
        parts = [self._query(part, 1) for part in _parts(x, self.options.rows)]
        distance, index = (np.concatenate(part) for part in zip(*parts, strict=True))
        return distance, gaps * self.gaps[index].astype(np.float64)

    def signed(self, x: Tensor, *, soft: float = CLOUD.soft) -> Tensor:
        """Signed distance of ``(M, 3)`` points → ``(M,)`` on the CPU, negative inside.

        Args:
            x: the points.
            soft: softening of the dipoles that the signs are asked of, in standard deviations of the noise.
        """
        query = x.cpu().numpy()
        parts = [self._query(part, self.neighbors) for part in _parts(query, self.options.rows)]
        distance, index = (np.concatenate(part) for part in zip(*parts, strict=True))
        offset = query[:, None] - self.points[index]  # (M, k, 3)
        along = np.einsum("mkd,mkd->mk", offset, self.normals[index])
        across = np.sqrt(np.maximum(distance**2 - along**2, 0))
        discs = np.hypot(along, np.maximum(across - self.radii[index], 0))
        magnitude = discs.min(axis=1)
        # Each disc votes with its side, the nearer and the more face-on the louder.
        side = np.sum(along / (distance**3 + 1e-12), axis=1)
        # Where normals follow noise, sides of discs as near as that are chance.
        chance = distance[:, 0] < (self.options.chance * self.noise if self.guessed else 0.0)
        asked = np.flatnonzero(chance | (magnitude > self.options.beside * self.spacing))
        number = 0.5 - self.winding_number(query[asked], soft=soft)
        sine = along[asked] / np.maximum(distance[asked], 1e-12)
        one_side = np.maximum(sine.min(axis=1), -sine.max(axis=1)) >= self.options.face_on
        rim = (
            (np.abs(number) < self.options.doubt)
            & (distance[asked, 0] < self.options.rim)
            & one_side
            & ~chance[asked]
            & (index[asked, 0] < self.given)
        )
        side[asked] = np.where(rim, side[asked], number)
        return torch.from_numpy(np.where(side < 0, -magnitude, magnitude).astype(np.float32))

    def _query(self, x: NDArray[np.floating], k: int) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
        """Distances to the k nearest points, and their indices."""
        distance, index = self.tree.query(x, k=k, workers=-1)
        return np.asarray(distance), np.asarray(index)

    def winding_number(self, x: Float32, *, soft: float = CLOUD.soft) -> NDArray[np.float64]:
        """Generalised winding number at ``(M, 3)`` points: about 1 inside, 0 outside, in between near holes.

        ``w(x) = Σ_i a_i ⟨p_i − x, n_i⟩ / 4π (|p_i − x|² + ε_i²)^(3/2)`` (Barill et al. 2018), see `DipoleField`.

        Args:
            x: the points.
            soft: softening of the dipoles, in standard deviations of the noise.
        """
        dipoles = self._softened(soft)
        return np.concatenate([dipoles.winding(part) for part in _parts(x, self.options.places)])

    def _softened(self, soft: float) -> DipoleField:
        """The points as dipoles, softened by so many standard deviations of the noise, or `soft` of their discs."""
        if soft not in self._dipoles:
            softening = np.maximum(self.options.soft * self.radii, soft * self.noise)
            self._dipoles[soft] = DipoleField(self.points, self.normals * self.areas[:, None], softening)
        return self._dipoles[soft]

    def _areas(self) -> tuple[Float32, Float32]:
        """The area that each point has to itself ``(N,)``, and its weight in the samples ``(N,)``.

        The area is that of the disc out to neighbours whose normals face the point's own way.

        Those of the far side of a thin part do not share it: with them a bar would have half of its surface, and
        winding numbers of one half inside. Where most of those beside a point face the other way, its own normal is
        wrong, and all of them share the disc.
        """
        count, asked = (min(number, len(self.points) - 1) for number in (self.options.sharing, self.options.asked))
        found = self.tree.query(self.points, k=asked + 1, workers=-1)
        reach, near = np.asarray(found[0])[:, 1:], np.asarray(found[1])[:, 1:]
        cosine = np.einsum("nd,nkd->nk", self.normals, self.normals[near])
        alike = (cosine > 0).cumsum(axis=1)
        last = (alike < count).sum(axis=1).clip(max=asked - 1)
        sharing = alike[:, -1].clip(1, count)
        height = np.einsum("nd,nkd->nk", self.normals, self.points[near] - self.points[:, None])
        beside = np.abs(height) < self.options.beside_another * reach
        odd = (beside & (cosine < 0)).sum(axis=1) > self.options.odd * (beside & (cosine > 0)).sum(axis=1)
        last, sharing = np.where(odd, count - 1, last), np.where(odd, count, sharing)
        areas = math.pi * reach[np.arange(len(reach)), last] ** 2 / sharing
        # A normal that hardly any neighbour shares is more likely wrong than its point is alone.
        areas = np.minimum(areas, self.options.sides * math.pi * reach[:, count - 1] ** 2 / count)
        # A few points on their own have nobody near, but no surface of that size either.
        areas = np.minimum(areas, self.options.largest_area * np.median(areas)).astype(np.float32)
        beside = np.median(areas[near[:, :count]], axis=1)
        return areas, np.minimum(areas, self.options.alone * beside).astype(np.float32)


def drawn(shares: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices ``(count,)`` drawn with replacement, each in proportion to its step in the sums ``shares`` ``(N,)``."""
    place = torch.rand(count, generator=generator, dtype=torch.float64) * shares[-1]
    return torch.searchsorted(shares, place, right=True).clamp_(max=len(shares) - 1)


def _parts(x: NDArray[Any], rows: int) -> list[NDArray[Any]]:
    """At most so many rows each; of none there is one part."""
    return [x[start : start + rows] for start in range(0, max(len(x), 1), rows)]
