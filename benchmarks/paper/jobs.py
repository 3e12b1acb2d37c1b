"""Jobs of the paper's tables, one method trained once on one cloud, and what tables read in their records.

A record holds the results of a job, as its JSON file does::

    {"cell": {"shape": stem, "method", "preset", "seed", "noise", "outliers", "flipped", "overrides": {…}, …},
     "outputs": [{"name", "chamfer", "iou", …}, …],   # one per surface, coarse to fine
     "deltas": [δ_1, …], …}

A job that failed has no record; tables say "–" where one is missing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..harness.jobs import Record
from ..harness.plots import Plot
from ..harness.tables import Table

# smoke: seconds, for tests; cpu: 15 to 30 s of training on two cores, each method; paper: as published.
Preset = Literal["smoke", "cpu", "paper"]


@dataclass(frozen=True)
class PaperJob:
    """One training, with all that decides how it ends; see `benchmarks.harness.jobs.Job`.

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

    @property
    def inputs(self) -> tuple[Path | None, Path | None]:
        """The cloud, and what results are measured against."""
        return self.shape, self.reference

    @property
    def parameters(self) -> Mapping[str, Any]:
        """All but the files and the method."""
        names = ("preset", "seed", "noise", "outliers", "flipped")
        return {name: getattr(self, name) for name in names} | {"overrides": dict(self.overrides)}

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON; the shape by its stem."""
        reference = None if self.reference is None else str(self.reference)
        files = {"shape": self.shape.stem, "file": str(self.shape), "reference": reference}
        return {**files, "method": self.method, **self.parameters}


def _text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


@dataclass(frozen=True)
class Input:
    """One cloud that tables are about.

    Attributes:
        path: its vertices are the cloud.
        reference: what results are measured against; None for the file itself.
    """

    path: Path
    reference: Path | None = None


@dataclass(frozen=True)
class TableSpec:
    """One table of the paper.

    Attributes:
        name: as after ``--table``.
        label: the paper's own, e.g. "Tab. 1 (t-comparison)".
        summary: what it shows, in one line.
        jobs: the shapes and the preset → what must be trained. Seeds, references and the choice of methods are
            the harness's business.
        tables: the records of those jobs, as many as there are → the tables.
        plots: the same → the plots.
        sheets: whether there is a contact sheet of its meshes per shape.
    """

    name: str
    label: str
    summary: str
    jobs: Callable[[Sequence[Path], Preset], list[PaperJob]]
    tables: Callable[[Sequence[Record]], tuple[Table, ...]]
    plots: Callable[[Sequence[Record]], tuple[Plot, ...]] = lambda _: ()
    sheets: bool = False


def jobs_of(spec: TableSpec, inputs: Sequence[Input], preset: Preset, *, seed: int = 0) -> list[PaperJob]:
    """The jobs of a table, with seed and references, each once.

    Args:
        spec: the table.
        inputs: the clouds.
        preset: how large and how long.
        seed: of everything.
    """
    references = {one.path: one.reference for one in inputs}
    jobs = spec.jobs([one.path for one in inputs], preset)
    planned = [dataclasses.replace(job, seed=seed, reference=references.get(job.shape)) for job in jobs]
    return list(dict.fromkeys(planned))


def select(records: Iterable[Record], **wanted: Any) -> list[Record]:
    """The records whose jobs have these fields; a field that is not named may be anything.

    ``overrides`` is compared as a dict: ``select(records, method="ours", noise=0.0, overrides={})``.
    """
    return [r for r in records if all(r["cell"][field] == value for field, value in wanted.items())]


def shapes_of(records: Iterable[Record]) -> list[str]:
    """Names of the shapes, each once, in their order."""
    return list(dict.fromkeys(record["cell"]["shape"] for record in records))


def outputs_of(records: Iterable[Record]) -> list[str]:
    """Names of the surfaces, each once, in their order."""
    return list(dict.fromkeys(output["name"] for record in records for output in record["outputs"]))


def of_output(records: Iterable[Record], name: str, figure: str) -> list[float | None]:
    """One figure of the surface called ``name`` in every record that has one; None where it was not found."""
    return [o.get(figure) for record in records for o in record["outputs"] if o["name"] == name]


def figure(records: Sequence[Record], name: str) -> float | None:
    """One figure of the finest surface of the first record; None where there is no record or no surface."""
    outputs = records[0]["outputs"] if records else []
    return outputs[-1].get(name) if outputs else None


def by_shape(records: Iterable[Record], output: str, name: str) -> dict[str, float | None]:
    """One figure of an output, by shape."""
    return {
        record["cell"]["shape"]: found.get(name)
        for record in records
        for found in record["outputs"]
        if found["name"] == output
    }


def printed_name(shape: str, names: Iterable[str]) -> str | None:
    """Which of the paper's shapes a file is, by its name.

    Example:
        >>> printed_name("Armadillo_50k", ["lucy", "armadillo"])
        'armadillo'
    """
    return next((name for name in names if name in shape.lower()), None)
