"""Changes of topology of a surface that moves. Of c pieces with h holes the Euler number is χ = V − E + F = 2 (c − h).

f(x, t) changes it only where ∇f = 0 on the surface, at single points of space-time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from time import monotonic
from typing import NamedTuple

import numpy as np

from ...neural_fields import Field, Mesh, TimeSlice
from ...neural_fields.meshing.extract import surface_of
from ..surface.surface import components


@dataclass(frozen=True)
class ChangeOptions:
    """How changes of topology are searched for."""

    narrow: float = 2e-3  # a change is searched for until it lies between two moments that are no further apart
    one: float = 1e-2  # changes that follow each other so soon are one: on a lattice a neck closes in several places
    most: int = 60  # moments that are meshed on the way, of all changes together


CHANGES = ChangeOptions()


class Topology(NamedTuple):
    """What a surface is like as a whole."""

    components: int  # pieces
    holes: int  # through them, the sum of their genera

    def __str__(self) -> str:
        """As in "1 piece with 0 holes"."""
        pieces, holes = self
        return f"{pieces} piece{'s' * (pieces != 1)} with {holes} hole{'s' * (holes != 1)}"


@dataclass(frozen=True)
class Change:
    """One change of topology."""

    time: float  # the middle of the moments that it lies between
    within: float  # how far they are from it
    before: Topology  # the surface at the first of them
    after: Topology  # at the second


def topology_of(surface: Mesh | None) -> Topology:
    """Pieces and holes of a closed mesh; none where there is no surface. Smaller parts than its cells do not count."""
    if surface is None:
        return Topology(0, 0)
    faces = surface.merged.faces
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    euler, pieces = len(np.unique(faces)) - len(edges) + len(faces), components(surface)
    return Topology(pieces, pieces - euler // 2)


def find_changes(
    field: Field, times: Sequence[float], found: Sequence[Topology], *, resolution: int = 96, until: float = math.inf
) -> list[Change]:
    """The changes between growing ``times`` whose topology is ``found``, each by halving the interval that it lies in.

    What happens and is undone between two of the given moments, or within 0.01, is not seen. From the moment ``until``,
    by `time.monotonic`, intervals stay as wide as they are.
    """
    pending = [
        _Bracket(times[index - 1], times[index], found[index - 1], found[index])
        for index in range(len(times) - 1, 0, -1)
        if found[index - 1] != found[index]
    ]
    narrow: list[_Bracket] = []
    looked = 0
    while pending:
        start, end, before, after = bracket = pending.pop()
        if end - start > CHANGES.narrow and looked < CHANGES.most and monotonic() < until:
            looked += 1
            middle = (start + end) / 2
            now = topology_of(surface_of(TimeSlice(field, middle), resolution=resolution))
            halves = (_Bracket(middle, end, now, after), _Bracket(start, middle, before, now))
            pending.extend(half for half in halves if half.before != half.after)
        elif narrow and start - narrow[-1].end < CHANGES.one:
            narrow[-1] = _Bracket(narrow[-1].start, end, narrow[-1].before, after)
        else:
            narrow.append(bracket)
    changed = (bracket for bracket in narrow if bracket.before != bracket.after)
    return [Change((start + end) / 2, (end - start) / 2, before, after) for start, end, before, after in changed]


class _Bracket(NamedTuple):
    """Two moments, and the topology at each."""

    start: float
    end: float
    before: Topology
    after: Topology
