"""What a finished evolution is judged by: its ends, its frames, and how much of a distance it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...neural_fields import Field, NoSurfaceError, TimeSlice, extract_mesh
from ..surface.measure import chamfer
from ..surface.surface import Surface, components, from_mesh, sample_points
from .problem import End
from .samples import band_points

__all__ = ["FrameFigures", "check_evolution", "end_figures", "slope_figures", "volume", "warnings"]

END_RESOLUTION = 192
# A surface that shall be met counts as missed where its Chamfer distance is so much above what it would score itself.
MISSED = 1.5


@dataclass(frozen=True)
class FrameFigures:
    """The surface at one time.

    Attributes:
        time: when.
        volume: inside it, in units of the field; 0 where there is no surface.
        components: of it.
        slope_error: mean of ||∇f| − 1| at its vertices; None where there are none.
    """

    time: float
    volume: float
    components: int
    slope_error: float | None


def check_evolution(
    field: Field,
    ends: Sequence[End],
    *,
    frames: int,
    resolution: int,
    count: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """All figures of a trained field, on the CPU, as ``run.json`` holds them under ``checks``.

    Args:
        field: four-dimensional.
        ends: the surfaces that it should have met.
        frames: at how many times it is meshed.
        resolution: of those meshes; ends are meshed finer.
        count: told how many frames, ends and slopes are done, and of how many.
    """
    total = frames + len(ends) + 1
    count = count or (lambda _done, _total: None)
    shown, met = [], []
    for time in torch.linspace(0, 1, frames).tolist():
        shown.append(_frame_figures(field, time, resolution))
        count(len(shown), total)
    for end in ends:
        met.append(end_figures(field, end))
        count(frames + len(met), total)
    slopes = slope_figures(field)
    count(total, total)
    checks = {"ends": met, "slopes": slopes, "frames": [vars(frame) for frame in shown]}
    return checks | {"warnings": warnings(checks)}


def end_figures(field: Field, end: End) -> dict[str, Any]:
    """How well a surface is met: |f| at its points, and the Chamfer distance of the slice's mesh.

    Chamfer distances are of squared lengths, both ways added, in units of the field; ``floor`` is what the surface
    scores against another sampling of itself.
    """
    at = TimeSlice(field, end.time)
    with torch.no_grad():
        value = torch.cat([at.value(part) for part in end.points.split(1 << 16)]).abs()
    figures: dict[str, Any] = {
        "name": end.name,
        "time": end.time,
        "mean_value": float(value.mean()),
        "max_value": float(value.max()),
        "chamfer": None,
        "floor": sum(chamfer(*(points.double().numpy() for points in (end.points, end.others)))),
    }
    try:
        mesh = from_mesh(extract_mesh(at, resolution=END_RESOLUTION, normals=False))
    except NoSurfaceError:
        return figures | {"ratio": None}
    found, _ = sample_points(mesh, len(end.points), np.random.default_rng(0))
    figures["chamfer"] = sum(chamfer(found, end.others.double().numpy()))
    return figures | {"ratio": figures["chamfer"] / figures["floor"]}


@torch.no_grad()
def slope_figures(field: Field, *, count: int = 20_000, width: float = 0.05) -> dict[str, float | None]:
    """Mean and quantiles of |∇f| where |f| is small, over all of space and time."""
    points = band_points(field, count, width, torch.Generator().manual_seed(0), level=0)
    if not len(points):
        return dict.fromkeys(("mean", "low", "high", "mean_error"))
    slope = field.jet(points).gradient[:, :3].norm(dim=1)
    low, high = slope.quantile(torch.tensor([0.05, 0.95])).tolist()
    return {
        "mean": float(slope.mean()),
        "low": low,
        "high": high,
        "mean_error": float((slope - 1).abs().mean()),
    }


def warnings(checks: dict[str, Any]) -> list[str]:
    """What a reader of the figures should know, one line each."""
    found = []
    empty = [frame["time"] for frame in checks["frames"] if not frame["components"]]
    if empty:
        found.append(
            f"no surface at {len(empty)} of {len(checks['frames'])} times, the first at t = {empty[0]:.3g}; align the "
            "shapes so that they overlap, or train longer"
        )
    for end in checks["ends"]:
        if end["ratio"] is None or end["ratio"] > MISSED:
            how = "nothing is there" if end["ratio"] is None else f"Chamfer {end['ratio']:.2f} times its floor"
            found.append(f"{end['name']} is not met at t = {end['time']:g} ({how}); train longer (--steps)")
    return found


def volume(surface: Surface) -> float:
    """Volume inside a closed surface: the sum of signed tetrahedra from its middle."""
    vertices = surface.vertices - surface.vertices.mean(axis=0)
    a, b, c = (vertices[surface.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def _frame_figures(field: Field, time: float, resolution: int) -> FrameFigures:
    slice_ = TimeSlice(field, time)
    try:
        surface = from_mesh(extract_mesh(slice_, resolution=resolution, normals=False))
    except NoSurfaceError:
        return FrameFigures(time, 0.0, 0, None)
    slope = _slopes(slice_, torch.from_numpy(surface.vertices).float())
    return FrameFigures(time, volume(surface), components(surface), float((slope - 1).abs().mean()))


@torch.no_grad()
def _slopes(field: Field, points: Tensor) -> Tensor:
    return torch.cat([field.jet(part).gradient.norm(dim=1) for part in points.split(1 << 16)])
