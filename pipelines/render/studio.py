"""Posed photographs of a mesh from a file, in the studio of the exact scenes: a reconstruction whose truth is known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.cameras import Camera, Float64
from ...datasets.clouds.readers.meshes import vertex_normals
from ...datasets.synthetic.scenes import Size, cameras_around, developed, lit
from ...datasets.textured.mesh import TexturedMesh
from ...datasets.views.formats.shots import DepthMap
from ...datasets.views.images import Float32, PosedImage, PosedImages
from ...neural_fields import InputError, Mesh, Similarity
from ...neural_fields.meshing.color_space import srgb_to_linear
from ..surface.surface import read_reference, sample_points
from .rasterise import Painted, mesh_view, read_painted
from .trace import Seen, fine_strips

CLAY = 0.7  # display grey of a mesh without colours
# Pixels from a point that is seen to the tangent plane of what the middle of its pixel sees, and to that place itself,
# at most: on a slope the latter is further.
FLAT, NEAR = 1.0, 10.0


def photograph_mesh(
    path: str | Path,
    views: int = 24,
    size: Size = 64,
    *,
    seed: int = 0,
    samples: int = 3,
    up: str = "y",
    shaded: bool = False,
    glossy: bool = False,
    depths: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> PosedImages:
    """Posed images of a mesh in its file's coordinates, as `render_scene` makes them of exact scenes.

    A mesh without colours is grey clay, and always lit. ``size`` is that of the images in pixels, ``samples`` rays
    per pixel and direction, ``seed`` that of the cameras and the sparse points. A fixed lamp lights the mesh if
    ``shaded``, with a highlight if ``glossy``; ``depths`` are those of the pixels' centres. Raises an InputError if the
    mesh cannot be read or has no faces.
    """
    if samples < 1:
        raise ValueError(f"samples={samples}: expected at least one")
    mesh = read_painted(path)
    if not len(mesh.faces):
        raise InputError(f"{path}: has no faces, so there is no surface to photograph; give a mesh")
    ball = Similarity.to_unit_sphere(mesh.vertices[np.unique(mesh.faces)])
    mesh = dataclasses.replace(mesh, vertices=ball.to_unit(mesh.vertices))
    colored = mesh.has_colors if isinstance(mesh, TexturedMesh) else mesh.colors is not None
    light = {"shaded": shaded or not colored, "glossy": glossy}
    # About as many as structure from motion would give.
    points, _ = sample_points(Mesh(mesh.vertices, mesh.faces), 1000, np.random.default_rng(seed))
    images: list[PosedImage] = []
    observed: list[NDArray[np.bool_]] = []
    placed = cameras_around(ball.scale, up=up, views=views, size=size, seed=seed, middle=ball.center)
    for index, camera in enumerate(placed):
        near = camera.moved(ball)
        strips = [_strip(mesh, fine, samples, light) for fine in fine_strips(near, samples, pixels=1 << 21)]
        color, mask = (np.concatenate(part) for part in zip(*strips, strict=True))
        middles = mesh_view(mesh, near)
        observed.append(sees(near, middles, points))
        depth = DepthMap(ball.scale * _depths(near, middles), camera, "metric", Path(path)) if depths else None
        images.append(PosedImage(f"{index:03d}.png", camera, color, mask, depth))
        if progress is not None:
            progress(index + 1, views)
    # The region of interest is a little larger than the mesh.
    region = Similarity(ball.center, 1.05 * ball.scale)
    seen = np.argwhere(np.stack(observed))
    return PosedImages(tuple(images), region, "around the mesh", ball.to_input(points), Path(path), seen)


def true_mesh(path: str | Path) -> Mesh:
    """The photographed mesh with colours at its vertices, to compare reconstructions with; raises InputError."""
    surface = read_reference(path)
    return dataclasses.replace(surface, normals=vertex_normals(surface.vertices, surface.faces))


def sees(camera: Camera, seen: Seen, points: Float64) -> NDArray[np.bool_]:
    """Which surface points ``(P, 3)`` a camera sees: those in its picture at the place that ``seen`` has there."""
    pixels, depths, found = camera.in_view(points)
    if not len(seen.pixel):
        return np.zeros_like(found)
    rows = np.full(camera.height * camera.width, -1)
    rows[seen.pixel] = np.arange(len(seen.pixel))
    column, row = np.rint(pixels[found]).astype(np.int64).T
    met = rows[row * camera.width + column]
    offset = points[found] - seen.position.double().numpy()[met]
    from_plane = np.abs((offset * seen.normal.double().numpy()[met]).sum(axis=1))
    pixel = depths[found] / float(camera.intrinsics[0, 0])
    found[found] = (met >= 0) & (from_plane < FLAT * pixel) & (np.linalg.norm(offset, axis=1) < NEAR * pixel)
    return found


def _strip(mesh: Painted, fine: Camera, samples: int, light: dict[str, bool]) -> tuple[Float32, Float32]:
    """Display RGB ``(H, W, 3)`` with straight alpha, and the mask ``(H, W)``, of a strip of an image.

    Its camera ``fine`` has ``samples`` pixels per pixel and direction.
    """
    seen = mesh_view(mesh, fine)
    own = np.full((len(seen.pixel), 3), CLAY) if seen.color is None else seen.color.double().numpy()
    sent, mask = np.zeros((fine.height * fine.width, 3)), np.zeros(fine.height * fine.width, bool)
    normals, directions = seen.normal.double().numpy(), seen.direction.double().numpy()
    sent[seen.pixel] = lit(srgb_to_linear(own), normals, directions, **light)
    mask[seen.pixel] = True
    return developed(sent.reshape(fine.height, fine.width, 3), mask.reshape(fine.height, fine.width), samples)


def _depths(camera: Camera, seen: Seen) -> Float32:
    """Depths ``(H, W)`` along the axis of view; NaN of what misses."""
    depths = torch.full((camera.height * camera.width,), torch.nan, dtype=torch.float64)
    depths[seen.pixel] = (seen.position.double() - camera.eye) @ camera.forward
    return depths.reshape(camera.height, camera.width).float().numpy()
