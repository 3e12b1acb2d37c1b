"""``TexturedMesh``: triangles with colours at their vertices or in images, and the lookup of colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...neural_fields.backend.arrays import Float32, Float64, Int64
from ...neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from ..files import decode_image, rgb_and_alpha, unit_range

Wrap = Literal["repeat", "clamp", "mirror"]

_WRAPS: tuple[Wrap, ...] = ("repeat", "clamp", "mirror")


class Paint(NamedTuple):
    """The image of one material: ``(h, w, 3)`` display RGB, and its wrapping along u and v."""

    image: Float32
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")


@dataclass(frozen=True)
class Parts:
    """The rectangles of a mesh's image, one for each face; u and v run over the rectangle."""

    face: Int64  # (F,) number of the rectangle
    box: Int64  # (M, 4) first row, first column, rows and columns of each rectangle, in texels
    wrap: NDArray[np.int8]  # (M, 2) along u and v: 0 repeats the image, 1 its border, 2 mirrors


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh in input coordinates, with its colours.

    With both an image and vertex colours, the colour is their product in linear light, as in glTF.

    Attributes:
        vertices: ``(V, 3)``, in input units.
        faces: ``(F, 3)``; the two sides of a seam of the texture share their vertices.
        uv: ``(F, 3, 2)`` texture coordinates of each corner; (0, 0) is the lower left corner of the image, v points up.
        image: ``(H, W, 3)`` display RGB in [0, 1], first row on top.
        vertex_colors: ``(V, 3)`` display RGB in [0, 1].
        source: name in messages, such as the file's path.
        parts: the part of the image of each face; None: the whole image, repeated.

    Raises:
        ValueError: an array has the wrong shape, or of ``uv`` and ``image`` there is only one.
    """

    vertices: Float64
    faces: Int64
    uv: Float64 | None = None
    image: Float32 | None = None
    vertex_colors: Float32 | None = None
    source: str = "mesh"
    parts: Parts | None = None

    def __post_init__(self) -> None:
        for name, rows in (("vertices", self.vertices), ("faces", self.faces)):
            if rows.ndim != 2 or rows.shape[1] != 3:
                raise ValueError(f"{name} has shape {rows.shape}; expected (N, 3)")
        if (self.uv is None) != (self.image is None):
            raise ValueError("uv, image: expected both or neither")
        if self.uv is not None and self.uv.shape != (len(self.faces), 3, 2):
            raise ValueError(f"uv has shape {self.uv.shape}; expected {(len(self.faces), 3, 2)}")
        if self.image is not None and (self.image.ndim != 3 or self.image.shape[2] != 3 or not self.image.size):
            raise ValueError(f"image has shape {self.image.shape}; expected (H, W, 3)")
        if self.vertex_colors is not None and self.vertex_colors.shape != self.vertices.shape:
            raise ValueError(f"vertex_colors has shape {self.vertex_colors.shape}; expected {self.vertices.shape}")

    @property
    def has_colors(self) -> bool:
        """Whether there is an image, or vertex colours."""
        return self.image is not None or self.vertex_colors is not None


def colors_at(mesh: TexturedMesh, face: Int64, barycentric: NDArray[np.floating]) -> Float32:
    """Display colours ``(N, 3)`` at points of faces; images and vertex colours are interpolated in linear light.

    Args:
        mesh: with an image, vertex colours, or both.
        face: ``(N,)``.
        barycentric: ``(N, 3)`` weights of the corners of the faces.

    Raises:
        ValueError: the mesh has no colours.
    """
    if not mesh.has_colors:
        raise ValueError(f"mesh: {mesh.source} has neither an image nor vertex colours")
    light = np.ones((len(face), 3), np.float32)
    if mesh.image is not None and mesh.uv is not None:
        uv = np.einsum("nk,nkc->nc", barycentric, mesh.uv[face])
        part = None if mesh.parts is None else mesh.parts.face[face]
        light *= lookup(mesh.image, uv, mesh.parts, part)
    if mesh.vertex_colors is not None:
        corners = srgb_to_linear(mesh.vertex_colors)[mesh.faces[face]]  # (N, 3, 3)
        light *= np.einsum("nk,nkc->nc", barycentric, corners).astype(np.float32)
    return linear_to_srgb(light.clip(0, 1))


def lookup(image: Float32, uv: Float64, parts: Parts | None = None, part: Int64 | None = None) -> Float32:
    """Linear light ``(N, 3)`` of a display image at any ``uv`` ``(N, 2)``, bilinear between texel centres.

    Texel (row i, column j) of an H × W image has its centre at ``u = (j + 1/2) / W``, ``v = 1 - (i + 1/2) / H``.
    ``part`` ``(N,)`` are numbers of rectangles of ``parts``; without them the whole image repeats.
    """
    if parts is None or part is None:
        start, wrap = np.zeros(2, np.int64), np.zeros(2, np.int8)
        size = np.array(image.shape[1::-1])
    else:
        start, wrap = parts.box[part][:, [1, 0]], parts.wrap[part]
        size = parts.box[part][:, [3, 2]]
    place = np.stack((uv[:, 0], 1 - uv[:, 1]), axis=1) * size - 0.5  # column, row
    low = np.floor(place).astype(np.int64)
    share = (place - low).astype(np.float32)
    light = np.zeros((len(uv), 3), np.float32)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        texel = _wrapped(low + np.array(step), size, wrap) + start
        weight = np.where(step, share, 1 - share).prod(axis=1, keepdims=True)
        light += weight * srgb_to_linear(image[texel[:, 1], texel[:, 0]])
    return light


def _wrapped(index: Int64, size: Int64, wrap: NDArray[np.int8]) -> Int64:
    """Any indices ``(N, 2)`` → those of texels."""
    turn = index % (2 * size)
    mirrored = np.minimum(turn, 2 * size - 1 - turn)
    return np.where(wrap == 0, index % size, np.where(wrap == 1, index.clip(0, size - 1), mirrored))


def pack(paints: Sequence[Paint], face: Int64) -> tuple[Float32, Parts]:
    """Stack the images of one or more materials into one; ``face`` ``(F,)`` is the material of each face."""
    sizes = np.array([paint.image.shape[:2] for paint in paints], np.int64)
    starts = np.cumsum(sizes[:, 0]) - sizes[:, 0]
    image = np.zeros((int(sizes[:, 0].sum()), int(sizes[:, 1].max()), 3), np.float32)
    for paint, start in zip(paints, starts.tolist(), strict=True):
        rows, columns = paint.image.shape[:2]
        image[start : start + rows, :columns] = paint.image
    box = np.stack((starts, np.zeros_like(starts), *sizes.T), axis=1)
    wrap = np.array([[_WRAPS.index(side) for side in paint.wrap] for paint in paints], np.int8)
    return image, Parts(face, box, wrap)


def decode_texture(data: bytes) -> Float32:
    """The bytes of an image file → ``(H, W, 3)`` display RGB in [0, 1], without its alpha channel."""
    return unit_range(rgb_and_alpha(decode_image(data))[0])
