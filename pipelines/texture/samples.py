"""What a texture learns from: points with colours near a surface, and points of the band with ∇f."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets import PointCloud, read_cloud
from ...datasets.textured.reading import TEXTURED_READERS, read_textured, sample_textured
from ...neural_fields import Field, InputError, Similarity
from ..fit.samples import DOMAIN


class ColorSamples(NamedTuple):
    """Points of the band with known colours.

    Attributes:
        points: ``(N, 3)`` in unit-sphere coordinates.
        colors: ``(N, 3)`` display RGB.
        left_out: how many points of the cloud were outside the band, or not finite.
    """

    points: Tensor
    colors: Tensor
    left_out: int


class BandSamples(NamedTuple):
    """Points of the band with the direction along which the colour shall not change.

    Attributes:
        points: ``(M, 3)`` in unit-sphere coordinates.
        gradients: ``(M, 3)`` ∇f there.
    """

    points: Tensor
    gradients: Tensor


def read_colors(path: str | Path, *, samples: int, seed: int, columns: str | None = None) -> PointCloud:
    """Read a cloud with colours; a mesh is sampled, with the colours of its texture or its vertices.

    Args:
        path: any cloud with colours, or an OBJ, GLB, glTF or PLY mesh.
        samples: how many points on a mesh.
        seed: of those.
        columns: of a table; see `read_cloud`.

    Raises:
        InputError: the file cannot be read, or has no colours.
    """
    path = Path(path)
    if path.suffix.lower() in TEXTURED_READERS and _has_faces(path):
        return sample_textured(read_textured(path), samples, seed=seed)
    cloud = read_cloud(path, columns=columns)
    if cloud.colors is None:
        raise InputError(f"{path}: colors: there are none; export the points with their colours, or name a mesh")
    return cloud


def has_colors(path: str | Path, columns: str | None = None) -> bool:
    """Whether `read_colors` would find colours in the file of a cloud or mesh.

    Raises:
        InputError: the file, or an image of its texture, cannot be read.
    """
    path = Path(path)
    cloud = read_cloud(path, columns=columns)
    if path.suffix.lower() in TEXTURED_READERS and _has_faces(path):
        return TEXTURED_READERS[path.suffix.lower()](path).has_colors
    return cloud.colors is not None


def _has_faces(path: Path) -> bool:
    """Whether a file is a mesh; one that does not exist is left to whoever reads it."""
    extension = path.suffix.lower()
    if extension not in (".ply", ".obj") or not path.is_file():
        return True
    with path.open("rb") as file:
        if extension == ".obj":
            return any(line.lstrip().startswith(b"f ") for line in file)
        header = file.read(1 << 16).split(b"end_header", 1)[0]
        return re.search(rb"element\s+face\s+0*[1-9]", header) is not None


@torch.no_grad()
def match_colors(
    cloud: PointCloud, geometry: Field, similarity: Similarity, *, level: int, delta: float
) -> ColorSamples:
    """The points of a cloud that lie in the band, in the field's coordinates.

    Args:
        cloud: with colours, in input coordinates.
        geometry: the samples are made on its device and in its precision.
        similarity: from input to the field's coordinates.
        level: of the geometry.
        delta: half-width of the band, in field units.

    Raises:
        InputError: there are no colours, or most of the points are not near the surface: another shape or scale.
    """
    if cloud.colors is None:
        raise InputError(f"{cloud.source}: colors: there are none; export the points with their colours")
    finite = np.isfinite(cloud.points).all(axis=1)
    unit = similarity.to_unit(cloud.points[finite])
    distances = _distances(unit, geometry, level=level)
    inside = distances < delta
    # With fewer points in the band, the colours are those of something else.
    if inside.mean() < 0.5:
        far, near = np.median(distances) * similarity.scale, delta * similarity.scale
        raise InputError(
            f"{cloud.source}: points: {inside.mean():.0%} of them lie within {near:.3g} of the surface of the run, "
            f"half are further off than {far:.3g} (input units); give the shape that was fitted, in the same "
            "coordinates, or widen the band (--delta)"
        )
    like = geometry.like
    points = torch.from_numpy(unit[inside]).to(like)
    colors = torch.from_numpy(cloud.colors[finite][inside]).to(like)
    return ColorSamples(points, colors, len(cloud) - len(points))


def _distances(unit: NDArray[np.float64], geometry: Field, *, level: int) -> NDArray[np.float64]:
    """|f|, and beyond the cube in which fields are trained the way back into it as well → ``(N,)``."""
    clamped = unit.clip(-DOMAIN, DOMAIN)
    points = torch.from_numpy(clamped).to(geometry.like)
    values = torch.cat([geometry.value(part, level=level).abs() for part in points.split(1 << 17)])
    return values.double().cpu().numpy() + np.linalg.norm(unit - clamped, axis=1)


@torch.no_grad()
def band_directions(
    samples: ColorSamples, geometry: Field, count: int, *, level: int, delta: float, generator: torch.Generator
) -> BandSamples:
    """Points moved by U(−δ, δ) along each axis, those that stay in the band, with ∇f; made once for all steps.

    Args:
        samples: from which to move.
        geometry: on their device.
        count: how many are tried.
        level: of the geometry.
        delta: half-width of the band.
        generator: on the CPU.
    """
    index = torch.randint(len(samples.points), (count,), generator=generator)
    shift = (2 * torch.rand(count, 3, generator=generator) - 1) * delta
    points = samples.points[index.to(samples.points.device)] + shift.to(samples.points)
    jets = [geometry.jet(part, level=level) for part in points.split(1 << 17)]
    kept = (torch.cat([jet.value for jet in jets]).abs() < delta).nonzero()[:, 0]
    return BandSamples(points[kept], torch.cat([jet.gradient for jet in jets])[kept])
