"""What a finished evolution is judged by: its ends, its frames, and how much of a distance it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from ...neural_fields import Field, TimeSlice
from ...neural_fields.meshing.extract import surface_of
from ..fit.samples import value_and_gradient
from ..surface.measure import chamfer
from ..surface.surface import sample_points, volume
from .problem import End
from .samples import band_points
from .topology import Topology, find_changes, topology_of

END_RESOLUTION = 192


def check_evolution(
    field: Field,
    ends: Sequence[End],
    *,
    frames: int,
    resolution: int,
    count: Callable[[int, int], None] | None = None,
    until: float = math.inf,
) -> dict[str, Any]:
    """All figures of a trained field, on the CPU, as ``run.json`` holds them under ``checks``.

    ``frames`` times are meshed at a ``resolution``; ``count`` is told how many of how many are done. After the moment
    ``until``, by `time.monotonic`, changes of topology are not searched for more closely.
    """
    total = frames + len(ends) + 2
    count = count or (lambda _done, _total: None)
    shown, met = [], []
    for time in torch.linspace(0, 1, frames).tolist():
        shown.append(frame_figures(field, time, resolution))
        count(len(shown), total)
    for end in ends:
        met.append(end_figures(field, end))
        count(frames + len(met), total)
    slopes = slope_figures(field)
    count(total - 1, total)
    times, found = [frame["time"] for frame in shown], [Topology(each["components"], each["holes"]) for each in shown]
    changes = find_changes(field, times, found, resolution=resolution, until=until)
    count(total, total)
    checks = {
        "ends": met,
        "slopes": slopes,
        "frames": shown,
        "changes": [
            vars(change) | {"before": change.before._asdict(), "after": change.after._asdict()} for change in changes
        ],
    }
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
    if (mesh := surface_of(at, resolution=END_RESOLUTION)) is None:
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
    return {"mean": float(slope.mean()), "low": low, "high": high, "mean_error": float((slope - 1).abs().mean())}


def warnings(checks: dict[str, Any]) -> list[str]:
    """What a reader of the figures should know, one line each."""
    found = []
    if empty := [frame["time"] for frame in checks["frames"] if not frame["components"]]:
        found.append(
            f"no surface at {len(empty)} of {len(checks['frames'])} times, the first at t = {empty[0]:.3g}; align the "
            "shapes so that they overlap, or train longer"
        )
    found.extend(_loose_parts(checks))
    for end in checks["ends"]:
        # A surface that shall be met counts as missed where its Chamfer distance is so much above what it would score
        # itself.
        if end["ratio"] is None or end["ratio"] > 1.5:
            how = "nothing is there" if end["ratio"] is None else f"Chamfer {end['ratio']:.2f} times the sampling floor"
            found.append(f"{end['name']} is not met at t = {end['time']:g} ({how}); train longer (--steps)")
    return found


def _loose_parts(checks: dict[str, Any]) -> list[str]:
    """A warning where there are more pieces than at any of the times at which a shape is met, if those are several."""
    times = [end["time"] for end in checks["ends"]]
    if len(times) < 2:
        return []
    frames = checks["frames"]
    most = max(min(frames, key=lambda frame: abs(frame["time"] - time))["components"] for time in times)
    worst = max(frames, key=lambda frame: frame["components"])
    if worst["components"] <= most:
        return []
    return [
        f"{worst['components']} pieces at t = {worst['time']:.3g}, and {most} at most where shapes are met; a motion "
        "that is learnt carries parts instead (--kind deform)"
    ]


def frame_figures(field: Field, time: float, resolution: int) -> dict[str, Any]:
    """Figures of the surface at a time, from a mesh of ``resolution`` cells along each side.

    Its volume in units of the field, its topology, and the mean of ||∇f| − 1| at its vertices; 0 and None without any.
    """
    still, inside, error = TimeSlice(field, time), 0.0, None
    if (surface := surface_of(still, resolution=resolution)) is not None:
        slope = value_and_gradient(still, torch.from_numpy(surface.vertices).float())[1].norm(dim=1)
        inside, error = volume(surface), float((slope - 1).abs().mean())
    return {"time": time, "volume": inside, **topology_of(surface)._asdict(), "slope_error": error}
