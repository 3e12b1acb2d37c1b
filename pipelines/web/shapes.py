"""Clouds and meshes on a page: read or extracted, coloured, and packed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.textured.mesh import TexturedMesh, colors_at
from ...neural_fields import Field, InputError, Similarity, TextureField, map_colors
from ...neural_fields.meshing.extract import NoSurfaceError, extract_mesh
from ..render.draw import disc_size
from ..render.rasterise import read_painted
from ..render.shade import COLOR_MAPS, apply_color_map
from .payload import Payload


@dataclass(frozen=True)
class Shape:
    """Points or triangles in the coordinates of a page; ``faces`` are None for points.

    Without ``normals`` ``(V, 3)`` those of the faces are taken, or those towards the eye; without ``colors``, display
    RGB in [0, 1], clay. ``hidden``: at first.
    """

    name: str
    vertices: NDArray[np.floating]
    faces: NDArray[np.integer] | None = None
    normals: NDArray[np.floating] | None = None
    colors: NDArray[np.floating] | None = None
    hidden: bool = False


def add_shape(payload: Payload, shape: Shape, index: int) -> dict[str, Any]:
    """Append a shape's arrays to a payload, and return its description for the header.

    Positions are rounded to 1/65535 of its box, normals to 7 bits.
    """
    low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    payload.add(f"shape{index}.vertices", np.rint((shape.vertices - low) / extent * 65535), "u2")
    if shape.faces is not None:
        payload.add(f"shape{index}.faces", shape.faces, "u4")
    if shape.normals is not None:
        payload.add(f"shape{index}.normals", np.rint(127 * shape.normals).astype(np.int64), "i8")
    if shape.colors is not None:
        payload.add(f"shape{index}.colors", np.rint(255 * shape.colors.clip(0, 1)), "u1")
    return {
        "name": shape.name,
        "kind": "points" if shape.faces is None else "triangles",
        "count": len(shape.vertices if shape.faces is None else shape.faces),
        "size": disc_size(shape.vertices) if shape.faces is None else 0.0,
        "low": low.tolist(),
        "high": (low + extent).tolist(),
        "colored": shape.colors is not None,
        "hidden": shape.hidden,
    }


def read_shape(file: Path) -> tuple[Shape, Similarity]:
    """The mesh or cloud of a file in its unit sphere, and the similarity to that; raises InputError.

    A texture is sampled at the corners of faces. At most 200,000 points are taken, evenly: more make browsers slow.
    """
    surface = read_painted(file)
    faces, normals, colors = surface.faces, None, None
    if isinstance(surface, TexturedMesh):
        faces = np.arange(3 * len(surface.faces)).reshape(-1, 3)
        vertices = surface.vertices[surface.faces.reshape(-1)]
        corners = np.tile(np.eye(3), (len(surface.faces), 1))
        colors = colors_at(surface, np.repeat(np.arange(len(surface.faces)), 3), corners)
    else:
        rows = slice(None) if len(faces) else slice(None, None, 1 + (len(surface.vertices) - 1) // 200_000)
        vertices = surface.vertices[rows]
        normals, colors = (None if part is None else part[rows] for part in (surface.normals, surface.colors))
    try:
        similarity = Similarity.to_unit_sphere(vertices[np.unique(faces)] if len(faces) else vertices)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from error
    solid = len(faces) > 0
    shape = Shape("mesh" if solid else "cloud", similarity.to_unit(vertices), faces if solid else None, normals, colors)
    return shape, similarity


@torch.no_grad()
def distance_cloud(file: Path, field: Field, similarity: Similarity) -> Shape:
    """A cloud coloured by its distance to a field's surface; hidden at first. Raises InputError."""
    cloud, own = read_shape(file)
    vertices = similarity.to_unit(own.to_input(cloud.vertices))
    distance = field.value(torch.from_numpy(vertices).to(field.like)).abs().float().cpu()
    limit = float(np.quantile(distance.numpy(), 0.99))
    colors = apply_color_map(distance, (0.0, limit), COLOR_MAPS["magma"]).numpy()
    name = f"cloud, by its distance up to {limit * similarity.scale:.2g}"
    return replace(cloud, name=name, vertices=vertices, faces=None, normals=None, colors=colors, hidden=True)


@torch.no_grad()
def field_shapes(field: Field, texture: TextureField | None = None, *, resolution: int = 160) -> list[Shape]:
    """Meshes of the levels of a field that no shader traces, the finest visible; raises InputError without one."""
    shapes = []
    for level in range(field.num_levels):
        try:
            mesh = extract_mesh(field, resolution=resolution, level=level)
        except NoSurfaceError as error:
            if level < field.num_levels - 1:
                continue
            raise InputError(f"no surface to show ({error})") from error
        colors = None
        if texture is not None:
            colors = map_colors(texture, torch.from_numpy(mesh.vertices).to(field.like)).values.cpu().numpy()
        hidden = level < field.num_levels - 1
        shapes.append(Shape(f"level {level}", mesh.vertices, mesh.faces, mesh.normals, colors, hidden=hidden))
    return shapes
