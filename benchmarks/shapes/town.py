"""An exact town of any size, and any number of points of it: streets, houses with gables, trees, posts and wires."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from mplicits.datasets.clouds.point_cloud import PointCloud, spread_on_faces
from mplicits.datasets.clouds.readers.columns import CloudStream, RawRows
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class TownOptions:
    """Its measures in metres, and how it is scanned."""

    plot: float = 24.0  # edge of the square of ground around one house
    house: tuple[float, float, float] = (11.0, 8.0, 6.0)  # length, width and height of the walls
    gable: float = 3.0
    post: float = 8.0  # height of the posts at street corners, which carry wires
    wire: float = 0.06  # radius
    crown: float = 2.2  # radius
    hills: float = 1.5  # height of the ground's waves
    ground: float = 2.0  # edge of its squares
    facade: float = 0.12  # density of an airborne scan on vertical faces over that on level ones
    mobile: float = 0.6  # share of the points that a car measures, from the streets
    distance: float = 6.0  # from a street's middle at which a car's density has fallen to a half
    origin: tuple[float, float, float] = (447_000.0, 5_411_000.0, 320.0)  # map coordinates of its corner


TOWN = TownOptions()


class _Solid(NamedTuple):
    """A convex solid as ``normals · x ≤ offsets``, and its triangles ``(F, 3, 3)``, outward."""

    normals: Float64
    offsets: Float64
    triangles: Float64


def _hull(points: Float64) -> _Solid:
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    triangles = points[hull.simplices]
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("fc,fc->f", across, hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return _Solid(hull.equations[:, :3], -hull.equations[:, 3], triangles)


def _ring(radius: float, sides: int = 8) -> Float64:
    angle = 2 * math.pi * np.arange(sides) / sides
    return radius * np.column_stack((np.cos(angle), np.sin(angle)))


class Town:
    """``plots`` × ``plots`` plots of `TOWN`; all faces are triangles, so distances to it are exact.

    Attributes:
        triangles: ``(F, 3, 3)`` corners, counter-clockwise from outside, in metres from its corner.
        normals: ``(F, 3)`` unit normals.
        areas: ``(F,)``.
    """

    def __init__(self, plots: int, *, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self.size = plots * TOWN.plot
        self._solids: list[_Solid] = []
        for x in range(plots):
            for y in range(plots):
                self._build(TOWN.plot * np.array([x, y]), random, wires=(x + 1 < plots, y + 1 < plots))
        ground = self._ground()
        own = [np.full(len(solid.triangles), k) for k, solid in enumerate(self._solids)]
        self.triangles = np.concatenate([ground, *(solid.triangles for solid in self._solids)])
        self._owner = np.concatenate([np.full(len(ground), -1), *own])
        across = np.cross(self.triangles[:, 1] - self.triangles[:, 0], self.triangles[:, 2] - self.triangles[:, 0])
        length = np.linalg.norm(across, axis=1)
        self.areas, self.normals = length / 2, across / length[:, None]
        self._boxes = np.array([[s.triangles.min(axis=(0, 1)), s.triangles.max(axis=(0, 1))] for s in self._solids])

    def height(self, places: NDArray[np.floating]) -> Float64:
        """Height of the ground ``(N,)`` at lattice points ``(N, 2)``."""
        x, y = places.T / self.size * 2 * math.pi
        return np.asarray(TOWN.hills * (np.sin(2 * x) * np.cos(3 * y) + np.cos(x + y)), np.float64)

    def _ground(self) -> Float64:
        cells = round(self.size / TOWN.ground)
        x, y = (axis.ravel() for axis in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
        corners = [np.column_stack((x + a, y + b)) * TOWN.ground for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
        a, b, c, d = (np.column_stack((place, self.height(place))) for place in corners)
        return np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)), dtype=np.float64)

    def _build(self, corner: Float64, random: np.random.Generator, *, wires: tuple[bool, bool]) -> None:
        """The house, the trees and the post of one plot, and the wires from there."""
        middle = corner + TOWN.plot / 2 + random.uniform(-1, 1, 2)
        angle = random.uniform(-0.3, 0.3) + random.integers(2) * math.pi / 2
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        half = np.array(TOWN.house[:2]) / 2 * random.uniform(0.8, 1.1, 2)
        walls, low = TOWN.house[2] * random.uniform(0.7, 1.6), self._low(middle, 8.0)
        outline = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        levels = [np.column_stack((outline @ turn.T + middle, np.full(4, z))) for z in (low, low + walls + 1)]
        ridge = np.array([[-half[0], 0.0], [half[0], 0.0]]) @ turn.T + middle
        top = np.column_stack((ridge, np.full(2, low + walls + 1 + TOWN.gable)))
        self._solids.append(_hull(np.concatenate((*levels, top))))
        for _ in range(random.integers(0, 3)):
            place = corner + random.choice([3.5, TOWN.plot - 3.5], 2) + random.uniform(-0.5, 0.5, 2)
            self._tree(place, random)
        post = np.concatenate(
            [
                np.column_stack((_ring(0.12) + corner + 0.5, np.full(8, z)))
                for z in (self._low(corner + 0.5, 1.0), TOWN.post + self._low(corner + 0.5, 1.0))
            ]
        )
        self._solids.append(_hull(post))
        for there, step in zip(wires, ([TOWN.plot, 0.0], [0.0, TOWN.plot]), strict=True):
            if there:
                self._wire(corner + 0.5, corner + 0.5 + np.array(step))

    def _low(self, place: Float64, around: float) -> float:
        """A height below the ground within ``around`` of a place."""
        return float(self.height(place + around * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1], [0, 0]])).min()) - 0.5

    def _tree(self, place: Float64, random: np.random.Generator) -> None:
        low, radius = self._low(place, 1.0), TOWN.crown * random.uniform(0.7, 1.2)
        self._solids.append(
            _hull(np.concatenate([np.column_stack((_ring(0.2) + place, np.full(8, z))) for z in (low, low + 4.0)]))
        )
        directions = random.normal(size=(60, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        self._solids.append(_hull(radius * directions + [*place, low + 3.5 + radius]))

    def _wire(self, start: Float64, end: Float64) -> None:
        """A chain of prisms that sags by half a metre."""
        low = [self._low(place, 1.0) + TOWN.post - 0.3 for place in (start, end)]
        s = np.linspace(0, 1, 9)
        path = np.column_stack((start + s[:, None] * (end - start), low[0] + s * (low[1] - low[0]) - 2 * s * (1 - s)))
        side = np.array([start[1] - end[1], end[0] - start[0], 0.0]) / np.linalg.norm(end - start)
        ring = _ring(TOWN.wire, 6)
        for a, b in itertools.pairwise(path):
            ends = [place + ring[:, :1] * side + ring[:, 1:] * np.array([0, 0, 1.0]) for place in (a, b)]
            self._solids.append(_hull(np.concatenate(ends)))

    def buried(self, points: Float64, owner: Int64) -> NDArray[np.bool_]:
        """Which points ``(N, 3)``, on solids ``owner``, lie inside another solid or below the ground."""
        cell = np.floor(points[:, :2] / TOWN.ground).clip(0, round(self.size / TOWN.ground) - 1)
        inner = points[:, :2] / TOWN.ground - cell
        corner = [self.height((cell + at) * TOWN.ground) for at in ((0, 0), (1, 0), (1, 1), (0, 1))]
        u, v = inner.T
        lower = corner[0] + u * (corner[1] - corner[0]) + v * (corner[2] - corner[1])
        upper = corner[0] + u * (corner[2] - corner[3]) + v * (corner[3] - corner[0])
        found = (owner >= 0) & (points[:, 2] < np.where(v <= u, lower, upper))
        order = np.argsort(points[:, 0])
        places = points[order, 0]
        for number, (solid, (low, high)) in enumerate(zip(self._solids, self._boxes, strict=True)):
            rows = order[np.searchsorted(places, low[0]) : np.searchsorted(places, high[0], "right")]
            rows = rows[((points[rows] >= low) & (points[rows] <= high)).all(axis=1) & (owner[rows] != number)]
            found[rows] |= (points[rows] @ solid.normals.T < solid.offsets - 1e-9).all(axis=1)
        return found

    def even(self, count: int, *, seed: int = 0) -> tuple[Float64, Float64]:
        """About ``count`` points ``(N, 3)`` uniform by area, in metres from the corner, and their normals."""
        return self._drawn(count, np.random.default_rng(seed), None)

    def _drawn(self, count: int, random: np.random.Generator, mobile: bool | None) -> tuple[Float64, Float64]:
        """Points of a scan from the air, of one from the streets, or (None) of neither."""
        weights = self.areas
        if mobile is not None:
            slope = self.normals[:, 2]
            weights = weights * (np.abs(slope) < 2 if mobile else np.maximum(slope, TOWN.facade))
            if mobile:  # nearest street: around the lines between plots
                middle = self.triangles.mean(axis=1)[:, :2] / TOWN.plot
                away = TOWN.plot * np.abs(middle - np.round(middle)).min(axis=1)
                weights = weights / (1 + (away / TOWN.distance) ** 2) ** 2
        face, shares = spread_on_faces(weights, count, random)
        points = np.einsum("nk,nkc->nc", shares, self.triangles[face])
        kept = ~self.buried(points, self._owner[face])
        return points[kept], self.normals[face[kept]]


class TownScan(CloudStream):
    """About ``count`` points of a town in map coordinates, from the air and from the streets, made when they are read.

    Args:
        town: what is scanned.
        count: points before those inside other parts are left out.
        noise: standard deviation along the normals, in metres.
        seed: of the points.
    """

    def __init__(self, town: Town, count: int, *, noise: float = 0.01, seed: int = 0) -> None:
        self.town, self.count, self.noise, self.seed = town, count, noise, seed
        self.source, self.reading = f"town of {count:,} points", "points and normals"

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`."""
        for start in range(0, self.count, rows):
            random = np.random.default_rng((self.seed, start))
            ahead = min(rows, self.count - start)
            car = round(TOWN.mobile * ahead)
            parts = [self.town._drawn(part, random, mobile) for part, mobile in ((car, True), (ahead - car, False))]
            points, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
            points = points + self.noise * random.normal(size=(len(points), 1)) * normals
            yield RawRows(points + TOWN.origin, normals.astype(np.float32), None)

    def cloud(self) -> PointCloud:
        """All of them at once."""
        (piece,) = self.pieces(self.count)
        return PointCloud(piece.points, piece.normals, None, self.source)
