"""What a printer asks of a mesh: is it closed, how large and how thin is it, what hangs over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, Similarity, project_to_surface
from ...neural_fields.meshing.extract import Mesh
from ...neural_fields.meshing.placement import FRAMES, Placement
from ..surface.surface import Surface, component_of_faces, face_normals, sample_points

__all__ = ["PrintReport", "Shells", "Thickness", "format_report", "overhang", "print_report", "shells", "thickness"]

Float64 = NDArray[np.float64]

# Unit-sphere lengths: how deep a ray starts under the surface, its least step, and where it has left the sphere.
DEPTH, STEP, FARTHEST = 1e-3, 4e-3, 2.1
LIPSCHITZ = 1.25  # as for `extract_mesh`
BISECTIONS = 16  # of a step: 6e-8
STEEPEST = 45.0  # degrees from upright that a wall may lean over without support
ON_THE_PLATE = 1e-3  # of the height


@dataclass(frozen=True)
class Shells:
    """The connected parts of a mesh, equal vertices merged.

    Attributes:
        parts: those with a positive volume: normals outward.
        cavities: those with a negative one: hollows, or parts inside out.
        open_edges: edges that have not two faces, one along it each way.
        turned_edges: edges that two faces run along in the same direction: their normals contradict each other.
        volume: inside, hollows subtracted; meaningful for a mesh without open edges.
        area: of all faces.
    """

    parts: int
    cavities: int
    open_edges: int
    turned_edges: int
    volume: float
    area: float

    @property
    def watertight(self) -> bool:
        """Whether every edge has its two faces, which agree on what is outside."""
        return self.open_edges == 0


def shells(surface: Surface) -> Shells:
    """Count the parts of a mesh and what is wrong with them.

    Raises:
        ValueError: there are no faces.
    """
    whole = surface.merged
    if not len(whole.faces):
        raise ValueError("surface: has no faces to report on")
    a, b = whole.faces.reshape(-1), whole.faces[:, [1, 2, 0]].reshape(-1)
    edge, along = np.minimum(a, b) * len(whole.vertices) + np.maximum(a, b), np.where(a < b, 1, -1)
    _, index = np.unique(edge, return_inverse=True)
    uses = np.bincount(index)
    balance = np.bincount(index, weights=along)
    # The volume of the cone from the middle to each face: six times is a determinant.
    corners = whole.vertices[whole.faces] - whole.vertices.mean(axis=0)
    cones = np.linalg.det(corners) / 6
    _, part = np.unique(component_of_faces(whole), return_inverse=True)
    volumes = np.bincount(part, weights=cones)
    return Shells(
        parts=int((volumes > 0).sum()),
        cavities=int((volumes <= 0).sum()),
        open_edges=int(((uses != 2) | (balance != 0)).sum()),
        turned_edges=int(((uses == 2) & (balance != 0)).sum()),
        volume=float(cones.sum()),
        area=float(face_normals(whole)[1].sum()),
    )


class Thickness(NamedTuple):
    """How thick a shape is at points of its surface.

    Attributes:
        depth: ``(N,)`` in units of the field; infinite where a ray does not come out, NaN where no surface was found.
        points: ``(N, 3)`` on the surface, where the rays begin.
    """

    depth: Float64
    points: Float64


@torch.no_grad()
def thickness(field: Field, points: Float64, *, level: int = -1) -> Thickness:
    """How thick the shape is under points of its surface, straight through: inward along the normal to the other side.

    Exact where the other side is opposite, as in slabs, tubes and balls; elsewhere more than the largest ball would be.

    Args:
        field: negative inside.
        points: ``(N, 3)`` near its surface, in its coordinates.
        level: the level whose surface it is.
    """
    feet, reached = project_to_surface(field, torch.from_numpy(points).to(field.like), level=level)
    inward = -torch.nn.functional.normalize(field.jet(feet, level=level).gradient, dim=-1)

    def values(depth: Tensor, rows: Tensor) -> Tensor:
        return field.value(feet[rows] + depth[:, None] * inward[rows], level=level)

    low, high = torch.zeros(len(feet)).to(feet), torch.full((len(feet),), DEPTH).to(feet)
    open_rows = torch.arange(len(feet), device=feet.device)
    while len(open_rows):
        value = values(high[open_rows], open_rows)
        inside = (value < 0) & (high[open_rows] < FARTHEST)
        open_rows, value = open_rows[inside], value[inside]
        low[open_rows] = high[open_rows]
        high[open_rows] += (-value / LIPSCHITZ).clamp(min=STEP)
    rows = torch.arange(len(feet), device=feet.device)
    never = high >= FARTHEST
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        inside = values(middle, rows) < 0
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    found = ((low + high) / 2).masked_fill(never, torch.inf).masked_fill(~reached, torch.nan)
    return Thickness(found.cpu().double().numpy(), feet.cpu().double().numpy())


def overhang(surface: Surface, axis: int, *, steepest: float = STEEPEST) -> tuple[float, float]:
    """Area that leans over by more than ``steepest`` degrees, and the volume of support down to the plate.

    The plate is where the lowest vertex is. What stands on it needs no support; and where the shape itself is below,
    less is needed than is said here.

    Args:
        surface: a mesh.
        axis: that points up: 0, 1 or 2.
        steepest: in degrees from upright.
    """
    normals, areas = face_normals(surface)
    height = surface.vertices[surface.faces][:, :, axis]
    height = height - surface.vertices[np.unique(surface.faces), axis].min()
    hangs = normals[:, axis] < -np.sin(np.radians(steepest)) - 1e-9
    hangs &= height.min(axis=1) > ON_THE_PLATE * height.max()
    under = -normals[:, axis] * areas * height.mean(axis=1)  # a prism with a slanting top
    return float(areas[hangs].sum()), float(under[hangs].sum())


@dataclass(frozen=True)
class PrintReport:
    """A mesh as its file has it: in the coordinates and the unit of the file.

    Attributes:
        unit: of all lengths; "input units" where it is not known.
        up: the axis that is taken to point up.
        shells: parts, holes, volume, area.
        size: of the bounding box, ``(3,)``.
        thinnest: least thickness found, straight through; None where nothing was found.
        thinnest_at: where, ``(3,)``.
        thin: 1 % of the surface is no thicker than this.
        overhang_area: that leans over by more than 45°.
        support_volume: at most so much has to be under that.
        samples: points at which the thickness was asked.
    """

    unit: str
    up: str
    shells: Shells
    size: tuple[float, ...]
    thinnest: float | None
    thinnest_at: tuple[float, ...] | None
    thin: float | None
    overhang_area: float
    support_volume: float
    samples: int


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
    """Look at a mesh as a printer would.

    Args:
        mesh: in unit-sphere coordinates.
        field: whose surface it is; on the CPU.
        similarity: from input to unit-sphere coordinates.
        placement: how the file is placed.
        suffix: of the file.
        level: of the field.
        samples: points at which the thickness is asked, uniform by area; seed 0.

    Raises:
        ValueError: the mesh has no faces.
    """
    frame, vertices = FRAMES[suffix.lower()], similarity.to_input(mesh.vertices)
    place = placement.into(suffix, vertices)
    surface = Surface(place.points(vertices), mesh.faces.astype(np.int64))
    found = shells(surface)
    points, _ = sample_points(Surface(mesh.vertices, surface.faces), samples, np.random.default_rng(0))
    depth, points = thickness(field, points, level=level)
    inside = np.isfinite(depth)
    thick, points = depth[inside] * similarity.scale * place.scale, points[inside]
    thinnest = thinnest_at = thin = None
    if len(thick):
        thinnest, thin = float(thick.min()), float(np.quantile(thick, 0.01))
        thinnest_at = tuple(place.points(similarity.to_input(points[thick.argmin()])).tolist())
    area, volume = overhang(surface, "xyz".index(frame.up))
    return PrintReport(
        unit="input units" if placement.unit is None else frame.unit,
        up=frame.up,
        shells=found,
        size=tuple(np.ptp(surface.used_vertices(), axis=0).tolist()),
        thinnest=thinnest,
        thinnest_at=thinnest_at,
        thin=thin,
        overhang_area=area,
        support_volume=volume,
        samples=samples,
    )


def format_report(report: PrintReport) -> str:
    """A table for people."""
    s, unit = report.shells, report.unit
    square, cube = (f"{unit}²", f"{unit}³") if " " not in unit else (f"({unit})²", f"({unit})³")
    closed = "yes" if s.watertight else f"NO: {s.open_edges:,} open edges"
    normals = "agree, and point outward" if s.watertight and s.volume > 0 else f"{s.turned_edges:,} edges contradict"
    parts = f"{s.parts}" + (f", and {s.cavities} hollow{'s' * (s.cavities > 1)} inside" if s.cavities else "")
    thin = "not found"
    if report.thinnest is not None and report.thinnest_at is not None:
        where = ", ".join(f"{number:.4g}" for number in report.thinnest_at)
        thin = f"{report.thinnest:.4g} {unit} at ({where}); 1 % of the surface is under {report.thin:.4g}"
    rows = [
        ["watertight", closed],
        ["normals", normals],
        ["parts", parts],
        ["size", " × ".join(f"{side:.4g}" for side in report.size) + f" {unit}"],
        ["volume", f"{s.volume:.5g} {cube}" + ("" if s.watertight else " (not closed: not to be trusted)")],
        ["area", f"{s.area:.5g} {square}"],
        ["thinnest part", thin],
        [
            "overhang",
            f"{report.overhang_area:.4g} {square} lean over by more than {STEEPEST:.0f}° ({report.up} up); "
            f"support of at most {report.support_volume:.4g} {cube}",
        ],
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)
