"""A report for 3-D printing: is a mesh closed, how large and how thin is it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import trimesh

from ...neural_fields import Field, Mesh, Similarity, project_to_surface, sphere_trace
from ...neural_fields.backend.arrays import Float64
from ...neural_fields.fields.similarity import FRAMES, Placement
from ..surface.surface import components, sample_points


class Thickness(NamedTuple):
    """Thickness ``(N,)`` in units of the field, and the points ``(N, 3)`` on the surface where the rays begin.

    A depth is infinite where a ray does not come out, NaN where no surface was found.
    """

    depth: Float64
    points: Float64


@torch.no_grad()
def thickness(field: Field, points: Float64, *, level: int = -1) -> Thickness:
    """The length of the way from points ``(N, 3)`` near a surface inward along the normal to the other side.

    Exact in slabs, tubes and balls; elsewhere more than the largest ball would be.
    """
    feet, reached = project_to_surface(field, torch.from_numpy(points).to(field.like), level=level)
    inward = -torch.nn.functional.normalize(field.jet(feet, level=level).gradient, dim=-1)
    # Feet are within 1e-5 of the surface; rays that begin inside of it are traced to where they come out.
    begin = 2e-5
    out = sphere_trace(
        field, feet + begin * inward, inward, level=level, tolerance=1e-7, lipschitz=1.25, radius=None, far=2.1
    )
    found = (out.depth + begin).masked_fill(~out.mask, torch.inf).masked_fill(~reached, torch.nan)
    return Thickness(found.cpu().double().numpy(), feet.cpu().double().numpy())


@dataclass(frozen=True)
class PrintReport:
    """A mesh in the coordinates and the ``unit`` of its file ("input units" where that is not known).

    Attributes:
        consistent: whether neighbouring faces agree on what is outside.
        parts: connected components, hollows among them.
        volume: inside, hollows subtracted; meaningful for a watertight mesh.
        thinnest: least thickness found, straight through, at ``thinnest_at`` ``(3,)``; None where nothing was found.
        thin: 1 % of the surface is no thicker than this.
    """

    unit: str
    watertight: bool
    consistent: bool
    parts: int
    size: tuple[float, ...]
    volume: float
    area: float
    thinnest: float | None
    thinnest_at: tuple[float, ...] | None
    thin: float | None


def print_report(
    mesh: Mesh,
    field: Field,
    similarity: Similarity,
    placement: Placement,
    suffix: str,
    *,
    level: int = -1,
    samples: int = 5_000,
) -> PrintReport:
    """Measure a mesh, in unit-sphere coordinates, for printing from a file of type ``suffix``.

    The thickness of ``field``, on the CPU, is measured at ``samples`` points, uniform by area, seed 0. Raises a
    ValueError for a mesh without faces.
    """
    if not len(mesh.faces):
        raise ValueError("mesh: has no faces to report on")
    place, whole = placement.into(suffix, similarity.to_input(mesh.vertices)), mesh.merged
    scale = similarity.scale * place.scale
    # In the coordinates of the field, where no digits are lost far from the origin.
    solid = trimesh.Trimesh(whole.vertices, whole.faces, process=False)
    points, _ = sample_points(mesh, samples, np.random.default_rng(0))
    depth, points = thickness(field, points, level=level)
    inside = np.isfinite(depth)
    thick, points = depth[inside] * scale, points[inside]
    thinnest = thinnest_at = thin = None
    if len(thick):
        thinnest, thin = float(thick.min()), float(np.quantile(thick, 0.01))
        thinnest_at = tuple(place.points(similarity.to_input(points[[thick.argmin()]]))[0].tolist())
    return PrintReport(
        unit="input units" if placement.unit is None else FRAMES[suffix.lower()].unit,
        watertight=bool(solid.is_watertight),
        consistent=bool(solid.is_winding_consistent) and float(solid.volume) > 0,
        parts=components(whole),
        size=tuple(np.ptp(place.points(similarity.to_input(mesh.used_vertices())), axis=0).tolist()),
        volume=float(solid.volume) * scale**3,
        area=float(solid.area) * scale**2,
        thinnest=thinnest,
        thinnest_at=thinnest_at,
        thin=thin,
    )


def format_report(report: PrintReport) -> str:
    """A table for people."""
    unit = report.unit
    square, cube = (f"{unit}²", f"{unit}³") if " " not in unit else (f"({unit})²", f"({unit})³")
    thin = "not found"
    if report.thinnest is not None and report.thinnest_at is not None:
        where = ", ".join(f"{number:.4g}" for number in report.thinnest_at)
        thin = f"{report.thinnest:.4g} {unit} at ({where}); 1 % of the surface is under {report.thin:.4g}"
    rows = [
        ("watertight", "yes" if report.watertight else "NO: it has open edges"),
        ("normals", "agree, and point outward" if report.consistent else "contradict each other, or point inward"),
        ("parts", f"{report.parts}"),
        ("size", " × ".join(f"{side:.4g}" for side in report.size) + f" {unit}"),
        ("volume", f"{report.volume:.5g} {cube}" + ("" if report.watertight else " (not closed: not to be trusted)")),
        ("area", f"{report.area:.5g} {square}"),
        ("thinnest part", thin),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)
