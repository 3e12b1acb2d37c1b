"""A cell: one method trained once on one cloud. Every table that needs it shares what it found."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..run.trainer import Progress

__all__ = ["Cell", "Preset", "Record", "Report"]

# smoke: seconds, for tests; cpu: 15 to 30 s of training on two cores, each method; paper: as published.
Preset = Literal["smoke", "cpu", "paper"]
# Told now and then how far a training is.
Report = Callable[[Progress], None]

# What a cell found, as it stands in its JSON file; see `mplicits.pipelines.paper.run.run_cell`.
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
