"""The cloud of a fit: read, merged where it is large, and signed distances to it without a mesh."""

from __future__ import annotations

import dataclasses
import json
import math
import zipfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

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
from ...datasets.clouds.tiling import TilePlan
from ...neural_fields import Similarity
from ...neural_fields.backend.arrays import Float32
from ...neural_fields.backend.files import whole_file
from ..training.folder import MERGED_FILE


@dataclass(frozen=True)
class CloudOptions:
    """Numbers of `CloudDistance`."""

    largest_area: float = 100.0  # area of a disc over the median one: scans are sparser at grazing angles
    alone: float = 4.0  # largest weight of a point over the median of its neighbours', against strays
    rows: int = 1 << 15  # queries in a block
    places: int = 1 << 18  # winding numbers in a block: larger blocks group dipoles better
    sharing: int = 8  # neighbours that share the disc out to the last of them
    searched: int = 16  # nearest points among which those are looked for
    # A neighbour lies beside a point if its height over the tangent plane is below this part of its distance.
    beside_another: float = 0.25
    odd: float = 2.0  # opposed over agreeing normals beside a point, above which its own sign is wrong
    soft: float = 0.3  # softening of a dipole over the radius of its disc: more would cancel the sides of thin bars
    soft_guessed: float = 2.0  # softening where normals were estimated, in standard deviations of the noise
    sides: float = 4.0  # sides of a square bar: a quarter of the neighbours is on the point's own side
    beside: float = 0.25  # distance to the discs, in spacings, below which their sides give the sign
    doubt: float = 0.25  # distance of a winding number from one half, below which it is in doubt
    rim: float = 0.1  # reach of the discs at the rim of a hole, in units of the domain, where it is in doubt
    face_on: float = 0.2  # sine of the elevation over all discs, from which on they are used there
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
    """Read a cloud, merged to at most ``limit`` points (None: never) → the cloud, and what merging did, or None.

    Merging drops parts further away than ``isolation``, see `merge_cloud`. The run directory ``cache`` keeps a merged
    file until that file changes.
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
        about = file_facts(Path(cloud), limit=limit, isolation=isolation, columns=columns, drop_noise=drop_noise)
    kept = None if cache is None or about is None else _kept(cache / MERGED_FILE, about)
    if kept is not None:
        return kept
    merged = merge_cloud(stream, limit, isolation=isolation)
    if merged is None:  # no usable point: `check_cloud` raises
        check_cloud(stream.cloud if isinstance(stream, MemoryStream) else read(stream.source))
    assert merged is not None
    check_cloud(merged[0])
    if cache is not None and about is not None:
        _keep(cache / MERGED_FILE, about, *merged)
    return merged


def file_facts(path: Path, **options: Any) -> dict[str, Any]:
    """What a merged cloud, or a plan of tiles, depends on."""
    facts = path.stat()
    return {
        "version": 2,  # of merging and tiling: what other versions made is made again
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
    """The cloud that `_keep` wrote for the same, unchanged file; None without one, or if it is damaged."""
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

    Each point stands for a disc in its tangent plane, as wide as its neighbourhood is spaced. The distance to the
    nearest of a few discs has neither the bias of the distance to the nearest point, √(d² + h²) instead of d, nor
    the reach of an infinite tangent plane. The sign is that of the generalised winding number, which closes the holes
    of scans. The sides of the discs give it close to them, and beside the rims of holes.

    Args:
        points: ``(N, 3)`` points.
        normals: ``(N, 3)`` outward unit normals.
        neighbors: discs that are compared at each query.
        noise: standard deviation of the noise that was smoothed off the points.
        guessed: whether the normals were estimated from the points.
        given: number of the cloud's own points, the first ones; None for all. The others densify it.
        gaps: ``(N,)`` spacing of the cloud's own points at each point; None where there are no others.
        repaired: normals of points on edges that were replaced by one side's, for the record.
        beyond: dipoles of a surface that goes on beyond the points, which count for signs only.
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
        beyond: DipoleField | None = None,
        options: CloudOptions = CLOUD,
    ) -> None:
        self.options, self._beyond = options, beyond
        self.points: Float32 = points.cpu().numpy()
        self.normals: Float32 = normals.cpu().numpy()
        self.tree = KDTree(self.points, compact_nodes=False, balanced_tree=False)
        self.noise, self.guessed = noise, guessed
        self.neighbors = min(neighbors, len(points))
        self._dipoles: dict[float, DipoleField] = {}  # by softening
        self.areas, self.weights = self._areas()
        self.radii: Float32 = np.sqrt(self.areas / math.pi)
        self.spacing = float(np.median(np.sqrt(self.areas)))
        self.given, self.repaired = len(points) if given is None else given, repaired
        self.gaps: Float32 = np.sqrt(self.areas) if gaps is None else gaps

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Indices ``(count,)`` drawn with replacement, in proportion to the weights."""
        return drawn(torch.from_numpy(self.weights).double().cumsum(0), count, generator)

    def nearest(self, x: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distance ``(M,)`` from each of ``(M, 3)`` to the nearest point of the cloud."""
        return self.nearest_rows(x)[0]

    def nearest_gap(self, x: NDArray[np.floating]) -> tuple[NDArray[np.float64], Float32]:
        """Distance ``(M,)`` from each of ``(M, 3)`` to the nearest point, and the spacing of the cloud's own there."""
        distance, rows = self.nearest_rows(x)
        return distance, self.gaps[rows]

    def nearest_rows(self, x: NDArray[np.floating], k: int = 1) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
        """Distances from each of ``(M, 3)`` to the ``k`` nearest points and their rows: ``(M,)``, or ``(M, k)``."""
        found = [self.tree.query(part, k=k, workers=-1) for part in _parts(x, self.options.rows)]
        distance, rows = (np.concatenate(part) for part in zip(*found, strict=True))
        return distance, rows

    def signed(self, x: Tensor, *, soft: float = CLOUD.soft) -> Tensor:
        """Signed distance ``(M,)`` of ``(M, 3)`` points on the CPU, negative inside.

        Dipoles are softened by ``soft`` standard deviations of the noise, see `winding_number`.
        """
        query = x.cpu().numpy()
        distance, index = self.nearest_rows(query, self.neighbors)
        offset = query[:, None] - self.points[index]  # (M, k, 3)
        along = np.einsum("mkd,mkd->mk", offset, self.normals[index])
        across = np.sqrt(np.maximum(distance**2 - along**2, 0))
        discs = np.hypot(along, np.maximum(across - self.radii[index], 0))
        magnitude = discs.min(axis=1)
        # Sides of discs, weighted more for near discs that face the place.
        side = np.sum(along / (distance**3 + 1e-12), axis=1)
        # Estimated normals follow the noise: the sides of discs within it are chance.
        chance = distance[:, 0] < (self.options.chance * self.noise if self.guessed else 0.0)
        far = np.flatnonzero(chance | (magnitude > self.options.beside * self.spacing))
        number = 0.5 - self.winding_number(query[far], soft=soft)
        sine = along[far] / np.maximum(distance[far], 1e-12)
        one_side = np.maximum(sine.min(axis=1), -sine.max(axis=1)) >= self.options.face_on
        rim = (
            (np.abs(number) < self.options.doubt)
            & (distance[far, 0] < self.options.rim)
            & one_side
            & ~chance[far]
            & (index[far, 0] < self.given)
        )
        side[far] = np.where(rim, side[far], number)
        return torch.from_numpy(np.where(side < 0, -magnitude, magnitude).astype(np.float32))

    def winding_number(self, x: Float32, *, soft: float = CLOUD.soft) -> NDArray[np.float64]:
        """Generalised winding number ``(M,)``: about 1 inside, 0 outside, in between near holes.

        ``w(x) = Σ_i a_i ⟨p_i − x, n_i⟩ / 4π (|p_i − x|² + ε_i²)^(3/2)`` (Barill et al. 2018), see `DipoleField`.
        ε_i is ``soft`` standard deviations of the noise, or more for large discs.
        """
        fields = [field for field in (self._softened(soft), self._beyond) if field is not None]
        parts = _parts(x, self.options.places)
        return np.concatenate([np.sum([field.winding(part) for field in fields], axis=0) for part in parts])

    def _softened(self, soft: float) -> DipoleField:
        """The dipoles of the points, made once for each softening."""
        if soft not in self._dipoles:
            softening = np.maximum(self.options.soft * self.radii, soft * self.noise)
            self._dipoles[soft] = DipoleField(self.points, self.normals * self.areas[:, None], softening)
        return self._dipoles[soft]

    def _areas(self) -> tuple[Float32, Float32]:
        """Area of each point's disc ``(N,)``, and its weight in the samples ``(N,)``.

        Only neighbours whose normals face the same way share a disc, or a bar would lose half of its surface. All share
        it where most of them oppose the normal of the point, whose sign is then wrong.
        """
        options, most = self.options, len(self.points) - 1
        count, searched = min(options.sharing, most), min(options.searched, most)
        found = self.tree.query(self.points, k=searched + 1, workers=-1)
        reach, near = np.asarray(found[0])[:, 1:], np.asarray(found[1])[:, 1:]
        cosine = np.einsum("nd,nkd->nk", self.normals, self.normals[near])
        alike = (cosine > 0).cumsum(axis=1)
        last = (alike < count).sum(axis=1).clip(max=searched - 1)
        sharing = alike[:, -1].clip(1, count)
        height = np.einsum("nd,nkd->nk", self.normals, self.points[near] - self.points[:, None])
        beside = np.abs(height) < self.options.beside_another * reach
        odd = (beside & (cosine < 0)).sum(axis=1) > self.options.odd * (beside & (cosine > 0)).sum(axis=1)
        last, sharing = np.where(odd, count - 1, last), np.where(odd, count, sharing)
        areas = math.pi * reach[np.arange(len(reach)), last] ** 2 / sharing
        # A normal shared by hardly any neighbour is more likely wrong than isolated.
        areas = np.minimum(areas, self.options.sides * math.pi * reach[:, count - 1] ** 2 / count)
        # Isolated points have no neighbours, but no surface of that size either.
        areas = np.minimum(areas, self.options.largest_area * np.median(areas)).astype(np.float32)
        beside = np.median(areas[near[:, :count]], axis=1)
        return areas, np.minimum(areas, self.options.alone * beside).astype(np.float32)


class Surroundings(NamedTuple):
    """A file of what lies around tile ``number`` of a plan: ``(N, 6)`` points, and outward normals times areas.

    They are means of the whole cloud, in input coordinates; those that the tile has points of are left out.
    """

    file: Path
    plan: TilePlan
    number: int

    def dipoles(self, similarity: Similarity) -> DipoleField | None:
        """Their winding number in the tile's coordinates; None where there is nothing."""
        rows = np.load(self.file)
        rows = np.delete(rows, dict(self.plan.rows(rows[:, :3], margin=2 * self.plan.blend))[self.number], axis=0)
        if not len(rows):
            return None
        dipoles = rows[:, 3:] / similarity.scale**2
        radii = np.sqrt(np.linalg.norm(dipoles, axis=1) / math.pi)
        return DipoleField(similarity.to_unit(rows[:, :3]), dipoles, CLOUD.soft * radii)


def drawn(shares: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices ``(count,)`` drawn with replacement; ``shares`` ``(N,)`` are cumulative weights."""
    place = torch.rand(count, generator=generator, dtype=torch.float64) * shares[-1]
    return torch.searchsorted(shares, place, right=True).clamp_(max=len(shares) - 1)


def _parts(x: NDArray[Any], rows: int) -> list[NDArray[Any]]:
    """Blocks of at most ``rows`` rows; an empty array is one block."""
    return [x[start : start + rows] for start in range(0, max(len(x), 1), rows)]
