"""Bake colours and normals of a surface into images over the texture coordinates of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ...datasets.clouds.point_cloud import unit_rows
from ...neural_fields import InputError, Similarity
from ...neural_fields.backend.arrays import Float64, Image
from ...neural_fields.fields.similarity import Placement
from ...neural_fields.meshing.extract import Mesh
from ..surface.raster import cover
from .atlas import decimate, to_frame, unwrap
from .files import write_textured

Attribute = Callable[[Float64], NDArray[np.floating]]


class Baked(NamedTuple):
    """Images ``(size, size, 3)`` uint8, first row on top: display colours, and tangent-space normals n; or None.

    Normals are ``255 (n + 1) / 2``, +y upwards as in glTF and OpenGL.
    """

    color: Image | None
    normal: Image | None


def bake(
    mesh: Mesh,
    colors_at: Attribute | None,
    normals_at: Attribute | None,
    *,
    size: int = 2048,
    batch: int = 1 << 17,
) -> Baked:
    """Colour and normal at the point of an unwrapped mesh under the centre of each of ``size``² texels.

    ``colors_at`` returns display colours ``(N, 3)`` in [0, 1], ``normals_at`` outward normals of any length, at points
    ``(N, 3)`` of the mesh, ``batch`` per call. Texels that no triangle covers get the value of the nearest one that is
    covered, so that filters do not bleed. Raises a ValueError if there is nothing to bake or no texel is covered.
    """
    if colors_at is None and normals_at is None:
        raise ValueError("colors_at, normals_at: expected at least one")
    if mesh.uv is None or mesh.normals is None or mesh.tangents is None:
        raise ValueError("mesh: expected texture coordinates, normals and tangents, as `unwrap` makes them")
    color = None if colors_at is None else np.zeros((size * size, 3), np.uint8)
    normal = None if normals_at is None else np.zeros((size * size, 3), np.uint8)
    covered = np.zeros(size * size, bool)
    # With rows first, the columns of the raster are texels in row-major order; texel 0 has its centre at half a texel.
    place = np.stack((1 - mesh.uv[:, 1], mesh.uv[:, 0]), axis=1) * size - 0.5
    for found in cover(place, mesh.faces, (size, size), chunk=batch):
        for part in np.array_split(np.arange(len(found.face)), -(-len(found.face) // batch) or 1):
            corners, weights, texel = mesh.faces[found.face[part]], found.weights[part], found.column[part]
            points = _interpolated(mesh.vertices, corners, weights)
            covered[texel] = True
            if color is not None and colors_at is not None:
                color[texel] = np.rint(np.clip(colors_at(points), 0, 1) * 255)
            if normal is not None and normals_at is not None:
                directions = unit_rows(np.asarray(normals_at(points)))
                frame = (_interpolated(rows, corners, weights) for rows in (mesh.normals, mesh.tangents))
                normal[texel] = _encoded(to_frame(directions, *frame))
    if not covered.any():
        raise ValueError(f"size: no triangle covers a texel at {size}; expected more texels")
    nearest = distance_transform_edt(~covered.reshape(size, size), return_distances=False, return_indices=True)
    rows, columns = np.asarray(nearest)
    return Baked(*(None if i is None else i.reshape(size, size, 3)[rows, columns] for i in (color, normal)))


def _interpolated(rows: NDArray[np.floating], corners: NDArray[np.integer], weights: Float64) -> Float64:
    return np.einsum("nk,nkc->nc", weights, rows[corners])


def _encoded(coordinates: Float64) -> Image:
    """Tangent-space normals → bytes; one of no length becomes that of the mesh."""
    upright = coordinates.copy()
    # A normal map holds normals of the front only: what is steeper, or turned away, is laid down to this height.
    upright[:, 2] = np.where(coordinates.any(axis=1), coordinates[:, 2].clip(min=0.05), 1.0)
    return np.rint((unit_rows(upright) + 1) * 127.5).astype(np.uint8)


def check_texture_size(size: int) -> None:
    """Raise an InputError for textures that are tiny, or larger than graphics cards take."""
    if not 16 <= size <= 16384:
        raise InputError(f"--texture {size}: expected 16 to 16384 texels along each side, 2048 say")


def textured_mesh(
    path: str | Path,
    mesh: Mesh,
    similarity: Similarity,
    colors_at: Attribute | None,
    normals_at: Attribute | None,
    *,
    size: int = 2048,
    faces: int = 50_000,
    placement: Placement | None = None,
) -> Mesh:
    """Decimate, unwrap, bake, and write a textured GLB, or an OBJ with its MTL and PNG files → the mesh as written.

    Mesh and points are in unit-sphere coordinates. ``colors_at`` and ``normals_at`` (see `bake`) get points of the
    decimated mesh, near the surface. ``size`` is the side of the textures in texels, ``faces`` the triangles to keep.
    Raises InputError.
    """
    unwrapped = unwrap(*decimate(mesh.vertices, mesh.faces, faces), size=size)
    color, normal = bake(unwrapped, colors_at, normals_at, size=size)
    write_textured(path, unwrapped, similarity, color=color, normal=normal, placement=placement)
    return unwrapped
