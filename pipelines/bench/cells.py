"""A cell: one method trained once on one cloud. Every table that needs it shares what it found.

What stands in a row of a table: a `Method`, which does the work of a cell and says what it found.

What a bench keeps between two runs: a JSON file per cell, meshes, fields and pictures.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ...neural_fields import InputError
from ...neural_fields.files import write_json
from ..run.config import closest
from ..run.trainer import Report

__all__ = [
    "Catalogue",
    "Cell",
    "Findings",
    "Method",
    "Preset",
    "Record",
    "Report",
    "Workplace",
    "make_folder",
    "read_record",
    "record_file",
    "write_record",
]

# smoke: seconds, for tests; cpu: 15 to 30 s of training on two cores, each method; paper: as published.
Preset = Literal["smoke", "cpu", "paper"]
# Told now and then how far a training is.

# What a cell found, as it stands in its JSON file; see `mplicits.pipelines.bench.run.run_cell`.
Record = Mapping[str, Any]


@dataclass(frozen=True)
class Cell:
    """One training, with all that decides how it ends.

    Attributes:
        shape: the file; its vertices are the cloud.
        method: name of a `Method`, as on the command line.
        preset: how large and how long.
        seed: of everything random.
        noise: the points move by up to this many diagonals of the bounding box along their normals.
        outliers: strays appended, as a fraction of the points.
        flipped: fraction of the points whose normals are turned round.
        overrides: fields of `FitConfig` that differ from the preset's; only for our own method and its variants.
        reference: the surface that results are measured against; None for ``shape`` itself.
    """

    shape: Path
    method: str
    preset: Preset
    seed: int = 0
    noise: float = 0.0
    outliers: float = 0.0
    flipped: float = 0.0
    overrides: tuple[tuple[str, Any], ...] = ()
    reference: Path | None = None

    @property
    def name(self) -> str:
        """One line for people, e.g. "armadillo + noise 0.01, idf"."""
        damage = [
            f"{what} {amount:g}"
            for what, amount in (("noise", self.noise), ("outliers", self.outliers), ("flipped normals", self.flipped))
            if amount
        ]
        changes = [f"{key}={_text(value)}" for key, value in self.overrides]
        return ", ".join([" + ".join([self.shape.stem, *damage]), self.method, *changes])

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON; the shape by its stem."""
        pairs = dataclasses.asdict(self)
        pairs |= {"shape": self.shape.stem, "file": str(self.shape), "overrides": dict(self.overrides)}
        return pairs | {"reference": None if self.reference is None else str(self.reference)}

    def key(self, settings: Mapping[str, Any]) -> str:
        """Twelve hexadecimal digits of everything that decides the result.

        The files count by what they hold, not by their names, so that a shape that has moved is not trained again.

        Args:
            settings: of the protocol and of the method, as far as they are not in the cell.

        Raises:
            OSError: a file cannot be read.
        """
        files = [None if path is None else _digest(path) for path in (self.shape, self.reference)]
        pairs = {field: value for field, value in self.as_dict().items() if field not in ("shape", "file", "reference")}
        text = json.dumps([files, pairs, dict(settings)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


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


def make_folder(out: Path) -> None:
    """Make the folder of a bench, and see that files can be written there, before the long work.

    Raises:
        InputError: a file stands in its place, its parent does not exist, or it cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder")
    if not out.absolute().parent.is_dir():
        raise InputError(f"{out}: the folder {out.absolute().parent} does not exist; make it first")
    try:
        for folder in (out, out / "cells", out / "meshes", out / "pictures"):
            folder.mkdir(exist_ok=True)
        probe = out / f".{os.getpid()}.partial"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another -o") from error


def record_file(out: Path, key: str) -> Path:
    """Where the record of a cell is."""
    return out / "cells" / f"{key}.json"


def read_record(out: Path, key: str) -> Record | None:
    """The record of a finished cell; None where there is none, it is damaged, or the cell failed."""
    try:
        record: dict[str, Any] = json.loads(record_file(out, key).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and "outputs" in record else None


def write_record(out: Path, key: str, record: Record) -> None:
    """Write a record, whole or not at all."""
    write_json(record_file(out, key), record)
