"""Exact signed distances to a triangle mesh, and a closed mesh as a field."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.clouds.point_cloud import Float64, Int64, sums_by
from ...neural_fields import Jet, Mesh
from ...neural_fields.fields.field import OneLevelField
from .surface import face_normals, is_closed, volume


class MeshDistance:
    """Signed distance to a mesh, negative inside, exact to rounding.

    The search in a k-d tree of face centres (long faces in pieces) widens until no face left out can be nearer. The
    sign is that of the angle-weighted pseudo-normal of the nearest face, edge or vertex (Bærentzen and Aanæs, IEEE TVCG
    2005), exact for closed, consistently oriented meshes.

    Raises a ValueError for a mesh without a face of any area; equal vertices are made one.
    """

    pairs_at_once = 1 << 19  # rows times candidates looked at together: about 100 MiB of temporaries

    def __init__(self, mesh: Mesh) -> None:
        whole = mesh.merged
        normals, areas = face_normals(whole)
        kept = areas > 0
        if not kept.any():
            raise ValueError("mesh: has no faces to measure from")
        whole, normals = Mesh(whole.vertices, whole.faces[kept]), normals[kept]
        self.corners: Float64 = whole.vertices[whole.faces]  # (F, 3, 3)
        self.pseudo_normals = _pseudo_normals(whole, normals, self.corners)
        centers, self.owner, self.radius = _pieces(self.corners, float(areas.sum()))
        self.tree = KDTree(centers, balanced_tree=False)
        self.rounding = 64 * float(np.finfo(np.float64).eps) * float(np.abs(self.corners).max())

    def signed(self, points: Float64) -> Float64:
        """Distances ``(M,)`` of points ``(M, 3)``."""
        return self.with_slope(points)[0]

    def with_slope(self, points: Float64, *, certain: bool = True) -> tuple[Float64, Float64]:
        """Distances ``(M,)`` of points ``(M, 3)`` and their gradients ``(M, 3)``: on the surface, the pseudo-normals.

        Unless ``certain``, the search ends after the eight pieces whose centres are nearest: a distance may be too long
        by the radius of a piece, far from the surface above all, where certainty costs much.
        """
        result, slopes = np.empty(len(points)), np.empty((len(points), 3))
        rows, count = np.arange(len(points)), min(16 if certain else 8, len(self.owner))
        while len(rows):
            unsure = []
            for part in np.array_split(rows, 1 + len(rows) * count // self.pairs_at_once):
                reach, nearest = self.tree.query(points[part], k=count, workers=-1)
                reach, nearest = np.reshape(reach, (len(part), -1)), np.reshape(nearest, (len(part), -1))
                result[part], slopes[part] = self._nearest_of(points[part], self.owner[nearest])
                # Every piece that was not looked at is at least this far away.
                unsure.append(part[np.abs(result[part]) > reach[:, -1] - self.radius])
            rows = np.concatenate(unsure) if certain and count < len(self.owner) else rows[:0]
            count = min(4 * count, len(self.owner))
        return result, slopes

    def _nearest_of(self, points: Float64, faces: Int64) -> tuple[Float64, Float64]:
        """Signed distance ``(M,)`` to the nearest of each point's own faces ``(M, k)``, and its gradient ``(M, 3)``."""
        corners = self.corners[faces]  # (M, k, 3, 3)
        weights = barycentric_of_nearest(points[:, None], corners)
        offset = points[:, None] - (weights[..., None] * corners).sum(axis=2)
        distance = np.linalg.norm(offset, axis=2)
        best = distance.argmin(axis=1)
        row = np.arange(len(points))
        feature = (weights[row, best] > 0) @ np.array([1, 2, 4])
        outward, away = self.pseudo_normals[faces[row, best], feature], offset[row, best]
        signed = np.where((away * outward).sum(axis=1) < 0, -distance[row, best], distance[row, best])
        outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
        # A way as short as its rounding leads nowhere.
        there = (np.abs(signed) <= self.rounding)[:, None]
        return signed, np.where(there, outward, away / np.where(there, 1.0, signed[:, None]))


def barycentric_of_nearest(points: Float64, corners: Float64) -> Float64:
    """Weights ``(..., 3)`` of the corners ``(..., 3, 3)`` for the point of each triangle nearest to ``(..., 3)``.

    A weight is exactly 0 where that point is on an edge; two are at a corner.
    """
    a, b, c = (corners[..., k, :] for k in range(3))
    ab, ac, ap = b - a, c - a, points - a
    bb, bc, cc = (ab * ab).sum(-1), (ab * ac).sum(-1), (ac * ac).sum(-1)
    pb, pc = (ap * ab).sum(-1), (ap * ac).sum(-1)
    determinant = np.maximum(bb * cc - bc * bc, 1e-300)
    v, w = (cc * pb - bc * pc) / determinant, (bb * pc - bc * pb) / determinant
    inside = (v > 0) & (w > 0) & (v + w < 1)
    best = np.stack((1 - v - w, v, w), axis=-1)
    least = np.where(inside, -1.0, np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, along = corners[..., first, :], corners[..., second, :] - corners[..., first, :]
        t = ((points - start) * along).sum(-1) / np.maximum((along * along).sum(-1), 1e-300)
        t = t.clip(0, 1)
        square = ((points - start - t[..., None] * along) ** 2).sum(-1)
        nearer = square < least
        best[nearer] = 0
        best[nearer, first], best[nearer, second] = 1 - t[nearer], t[nearer]
        least = np.where(nearer, square, least)
    return best


def _pseudo_normals(mesh: Mesh, normals: Float64, corners: Float64) -> Float64:
    """``(F, 8, 3)``: for each face and each set of its corners, as bits, the normal of the feature they span."""
    faces, size = mesh.faces, len(mesh.vertices)
    result = np.zeros((len(faces), 8, 3))
    result[:, 7] = normals
    ends = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    _, edge = np.unique(ends.min(axis=1) * size + ends.max(axis=1), return_inverse=True)
    total = sums_by(edge.reshape(-1), np.tile(normals, (3, 1)))[edge.reshape(-1)].reshape(3, -1, 3)
    for k in range(3):
        result[:, (1 << k) | (1 << (k + 1) % 3)] = total[k]
    angles = np.stack([_angle(corners, k) for k in range(3)], axis=1)  # (F, 3)
    weighted = (angles[..., None] * normals[:, None]).reshape(-1, 3)
    vertex = sums_by(faces.reshape(-1), weighted, size)
    for k in range(3):
        result[:, 1 << k] = vertex[faces[:, k]]
    return result


def _angle(corners: Float64, k: int) -> Float64:
    """Angle ``(F,)`` of the triangles at corner k."""
    u, v = (corners[:, (k + i) % 3] - corners[:, k] for i in (1, 2))
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))


def _pieces(corners: Float64, area: float) -> tuple[Float64, Int64, float]:
    """Centres ``(P, 3)`` of pieces of the faces, their faces ``(P,)``, and their largest radius.

    Faces much longer than the median are halved across their longest edge until none is.
    """
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)  # (F, 3): edges ab, bc, ca
    limit = max(float(np.median(lengths.max(axis=1))), (area / 200_000) ** 0.5)  # at most some 200,000 pieces
    owner = np.arange(len(corners))
    done: list[tuple[Float64, Int64]] = []
    while len(corners):
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = lengths.max(axis=1) > limit
        done.append((corners[~long], owner[~long]))
        corners, owner, edge = corners[long], owner[long], lengths[long].argmax(axis=1)
        row = np.arange(len(corners))
        first, second = edge, (edge + 1) % 3
        middle = (corners[row, first] + corners[row, second]) / 2
        halves = [corners.copy(), corners.copy()]
        halves[0][row, second], halves[1][row, first] = middle, middle
        corners, owner = np.concatenate(halves), np.tile(owner, 2)
    pieces, owner = np.concatenate([p for p, _ in done]), np.concatenate([o for _, o in done])
    centers = pieces.mean(axis=1)
    return centers, owner, float(np.linalg.norm(pieces - centers[:, None], axis=2).max())


class MeshField(OneLevelField):
    """The signed distance to a closed mesh, exact to rounding, in float64 on the CPU, without a graph.

    A mesh that is turned inside out is turned back. Raises a ValueError if it is not closed or encloses nothing.
    """

    def __init__(self, mesh: Mesh) -> None:
        super().__init__()
        if not is_closed(mesh):
            raise ValueError("mesh: is not closed, so that it has no inside")
        inside = volume(mesh)
        if inside == 0:
            raise ValueError("mesh: encloses nothing")
        faces = mesh.faces if inside > 0 else mesh.faces[:, ::-1]
        self.volume, self.distance = abs(inside), MeshDistance(Mesh(mesh.vertices, faces))

    def extra_repr(self) -> str:
        """How many triangles there are."""
        return f"faces={len(self.distance.corners)}"

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.jet(x, level=level).value

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; the gradient leads away from the nearest point of the mesh."""
        self.resolve_level(level)
        rows = self.check_points(x).detach().reshape(-1, 3).cpu().double().numpy()
        value, slope = (torch.from_numpy(part).to(x) for part in self.distance.with_slope(rows, certain=False))
        return Jet(value.reshape(x.shape[:-1]), slope.reshape(x.shape), x.new_empty((*x.shape[:-1], 0)))
