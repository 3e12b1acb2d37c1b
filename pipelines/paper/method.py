"""What stands in a row of a table: a `Method`, which does the work of a cell and says what it found."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..run.config import closest
from .cell import Cell, Report

__all__ = ["Catalogue", "Findings", "Method", "Workplace"]


@dataclass(frozen=True)
class Workplace:
    """Where a method works.

    Attributes:
        out: the folder of the bench, which holds ``meshes``, ``pictures`` and ``runs``.
        key: of the cell; names of files begin with it.
        device: a torch device.
        progress: called now and then with how far the training is.
        first: does another cell, unless it is done, before this one goes on from what it left → where it works; given
            by `run_cell`.
    """

    out: Path
    key: str
    device: str = "cpu"
    progress: Report | None = None
    first: Callable[[Cell], Workplace] | None = None

    def mesh(self, output: str) -> Path:
        """Where the mesh of an output goes, in input coordinates."""
        return self.out / "meshes" / f"{self.key}-{_slug(output)}.ply"

    def picture(self, output: str) -> Path:
        """Where the picture of that mesh goes."""
        return self.out / "pictures" / f"{self.key}-{_slug(output)}.png"

    def run(self) -> Path:
        """Where a fit of ours goes: a run directory with ``field.safetensors`` in it."""
        return self.out / "runs" / self.key


@dataclass(frozen=True)
class Findings:
    """What a cell found.

    Attributes:
        outputs: one dict of figures per surface, coarse to fine, each with its "name"; all of it JSON.
        deltas: half-widths of the bands, where there are any.
        details: anything else worth keeping.
    """

    outputs: tuple[Mapping[str, Any], ...]
    deltas: tuple[float, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)


class Method(ABC):
    """A method, or a measurement, that tables ask for by name.

    Attributes:
        name: as on the command line and in `Cell.method`.
        source: where it comes from.
        differs: what differs from its source here.
        depends: whether it goes on from cells of methods that do not.
    """

    name: str
    source: str
    differs: str
    depends: bool = False

    def missing(self) -> str | None:
        """What must be installed for it, in a few words; None if nothing is missing."""
        return None

    def settings(self, cell: Cell) -> Mapping[str, Any]:
        """What decides the result beside the cell itself, as JSON; part of the key."""
        return {}

    @abstractmethod
    def run(self, cell: Cell, work: Workplace) -> Findings:
        """Do the work of a cell.

        Raises:
            InputError: the cloud cannot be read or used.
        """


@dataclass(frozen=True)
class Catalogue:
    """The methods that a bench knows.

    Attributes:
        methods: all of them, in the order of the tables' rows.
        protocol: what decides the figures of every method beside its own settings, for a cell; part of its key.
    """

    methods: Sequence[Method]
    protocol: Callable[[Cell], Mapping[str, Any]] = lambda _: {}

    def named(self, name: str) -> Method:
        """The method that a cell asks for.

        Raises:
            ValueError: there is none.
        """
        for method in self.methods:
            if method.name == name:
                return method
        raise ValueError(f"method {name!r}: there is none{closest(name, [method.name for method in self.methods])}")

    def key(self, cell: Cell) -> str:
        """The name under which a cell is stored: all that decides its figures.

        Raises:
            OSError: a file cannot be read.
            ValueError: there is no such method.
        """
        return cell.key({**self.protocol(cell), **self.named(cell.method).settings(cell)})


def _slug(name: str) -> str:
    return name.lower().replace(" ", "-")
