"""How far a mesh is from a reference where photographs see the reference, by how many do: the rest nobody can know."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .surface import Surface

__all__ = ["LEAST", "WITNESSED", "Seen", "SeenBy", "Ways", "Witnesses", "seen_figures", "seen_lines"]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

Witnesses = Callable[[Surface, Float64], Int64]
"""How many photographs see points ``(N, 3)`` of the reference, both in its own coordinates; ``(N,)``."""

LEAST = 2  # photographs that must see a place to measure it
WITNESSED = ((0, 0), (1, 1), (2, 3), (4, 7), (8, None))  # from how many to how many


@dataclass(frozen=True)
class SeenBy:
    """The part of the reference that so many photographs see.

    Attributes:
        least: of them.
        most: of them; None for all that there are.
        share: of the reference's area.
        completeness: mean squared distance reference → mesh there; None where there is no such part.
        floor: the same to another sampling of the reference.
    """

    least: int
    most: int | None
    share: float
    completeness: float | None
    floor: float | None


@dataclass(frozen=True)
class Seen:
    """Figures by what photographs see; distances as in `Metrics`.

    Attributes:
        chamfer: of the part that `LEAST` photographs see: mean squared distances mesh → reference of samples whose
            nearest one is seen, plus reference → mesh of those that are seen. None if nothing is.
        chamfer_floor: the same of another sampling of the reference.
        parts: by how many photographs see them, from few to many.
    """

    chamfer: float | None
    chamfer_floor: float | None
    parts: tuple[SeenBy, ...]


class Ways(NamedTuple):
    """Squared distances between samples of a surface and of the reference, both ways.

    Attributes:
        there: ``(N,)`` of the surface's samples to the reference.
        nearest: ``(N,)`` which of the reference's samples is next to each of them.
        back: ``(M,)`` of the reference's samples to the surface.
    """

    there: Float64
    nearest: Int64
    back: Float64


def seen_figures(counts: Int64, mesh: Ways, floor: Ways) -> Seen:
    """Figures of the parts of a reference that photographs see.

    Args:
        counts: ``(M,)`` how many of them see each sample of the reference.
        mesh: to and from the mesh.
        floor: to and from another sampling of the reference.
    """
    parts = []
    for least, most in WITNESSED:
        part = counts >= least if most is None else (counts >= least) & (counts <= most)
        parts.append(SeenBy(least, most, float(part.mean()), _mean(mesh.back[part]), _mean(floor.back[part])))
    chamfer, chamfer_floor = (_seen_chamfer(counts >= LEAST, ways) for ways in (mesh, floor))
    return Seen(chamfer, chamfer_floor, tuple(parts))


def seen_lines(seen: Seen) -> Sequence[tuple[str, str, str]]:
    """Name, figure and remark of each line that tells of them."""

    def text(number: float | None) -> str:
        return "n/a" if number is None else f"{number:.3e}"

    lines = [(f"chamfer where {LEAST} photographs see", text(seen.chamfer), f"floor {text(seen.chamfer_floor)}")]
    for part in seen.parts:
        many = f"{part.least} or more" if part.most is None else f"{part.least} to {part.most}"
        name = str(part.least) if part.least == part.most else many
        remark = f"reference → mesh, floor {text(part.floor)}; {part.share:.2%} of the area"
        lines.append((f"  seen by {name}", text(part.completeness), remark))
    return lines


def _seen_chamfer(seen: NDArray[np.bool_], ways: Ways) -> float | None:
    there, back = _mean(ways.there[seen[ways.nearest]]), _mean(ways.back[seen])
    return None if there is None or back is None else there + back


def _mean(numbers: Float64) -> float | None:
    return float(numbers.mean()) if len(numbers) else None
