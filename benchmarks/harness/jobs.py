"""A job is a piece of work that runs once; its results are kept and shared by all tables that need them.

A `Method` runs a job and returns its results. A bench keeps a JSON file per job, and the meshes, fields
and pictures that were made on the way.
"""

from __future__ import annotations

import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from mplicits.neural_fields import InputError
from mplicits.neural_fields.backend.files import write_json
from mplicits.pipelines.training.settings import closest
from mplicits.pipelines.training.trainer import Progress, Report

# The results of a job as its JSON file holds them; see `benchmarks.harness.run.run_job`.
Record = Mapping[str, Any]


class Job(Protocol):
    """A piece of work, with everything that determines its result; hashable."""

    @property
    def method(self) -> str:
        """Name of the `Method` that does it."""
        ...

    @property
    def name(self) -> str:
        """One line for people."""
        ...

    @property
    def inputs(self) -> Sequence[Path | None]:
        """Files that count by what they hold; None where one is left out."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """All else that decides the result, as JSON."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        ...


C = TypeVar("C", bound=Job)


def key_of(job: Job, settings: Mapping[str, Any]) -> str:
    """Twelve hexadecimal digits of everything that decides the result of a job.

    Files count by what they hold, not by their names, so that a file that has moved does not make work again.

    Args:
        job: the work.
        settings: of the protocol and of the method, as far as they are not in the job.

    Raises:
        OSError: a file cannot be read.
    """
    files = [None if path is None else _digest(path) for path in job.inputs]
    text = json.dumps([files, {"method": job.method, **job.parameters}, dict(settings)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class Context:
    """Folder, device and callbacks that a method is given for one job.

    Attributes:
        out: the folder of the bench, which holds ``meshes``, ``pictures`` and ``runs``.
        key: of the job; names of files begin with it.
        device: a torch device.
        progress: called now and then with how far the training is.
        say: told what comes next.
        first: runs another job, unless it has a record, and returns that job's context; set by `run_job`.
    """

    out: Path
    key: str
    device: str = "cpu"
    progress: Report | None = None
    say: Callable[[str], None] = lambda _: None
    first: Callable[[Any], Context] | None = None

    def stage(self, name: str) -> Report:
        """A receiver of progress that puts ``name`` before the names of its stages."""

        def report(step: Progress, /) -> None:
            if self.progress is not None:
                self.progress(replace(step, stage=f"{name} {step.stage}"))

        return report

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
class Results:
    """The results of a job.

    Attributes:
        outputs: one dict of figures per surface (coarse to fine, each with its "name") or row; all of it JSON.
        deltas: half-widths of the bands, where there are any.
        details: anything else worth keeping.
    """

    outputs: tuple[Mapping[str, Any], ...]
    deltas: tuple[float, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)


class Method(ABC, Generic[C]):
    """A method, or a measurement, that tables ask for by name.

    Attributes:
        name: as in `Job.method`.
        source: where it comes from.
        differs: what differs from its source here.
        depends: whether its jobs go on from jobs of methods that do not.
    """

    name: str
    source: str
    differs: str
    depends: bool = False

    def goes_on(self, job: C) -> bool:
        """Whether a job starts from the results of others, which themselves start from none."""
        return self.depends

    def missing(self) -> str | None:
        """What must be installed for it, in a few words; None if nothing is missing."""
        return None

    def settings(self, job: C) -> Mapping[str, Any]:
        """What decides the result beside the job itself, as JSON; part of the key."""
        return {}

    @abstractmethod
    def run(self, job: C, context: Context) -> Results:
        """Run a job.

        Raises:
            InputError: an option or a file cannot be read or used.
        """


@dataclass(frozen=True)
class Registry(Generic[C]):
    """The methods that a bench knows.

    Attributes:
        methods: all of them, in the order of the tables' rows.
        protocol: what decides the figures of every method beside its own settings, for a job; part of its key.
    """

    methods: Sequence[Method[C]]
    protocol: Callable[[C], Mapping[str, Any]] = lambda _: {}

    def named(self, name: str) -> Method[C]:
        """The method that a job asks for.

        Raises:
            ValueError: there is none.
        """
        for method in self.methods:
            if method.name == name:
                return method
        raise ValueError(f"method {name!r}: there is none{closest(name, [method.name for method in self.methods])}")

    def key(self, job: C) -> str:
        """The name under which a job is stored: all that decides its figures.

        Raises:
            OSError: a file cannot be read.
            ValueError: there is no such method.
        """
        return key_of(job, {**self.protocol(job), **self.named(job.method).settings(job)})


def _slug(name: str) -> str:
    return name.lower().replace(" ", "-")


def make_folder(out: Path) -> None:
    """Make the folder of a bench, and see that files can be written there, before the long work.

    Raises:
        InputError: a file stands in its place, or it cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder")
    try:
        for folder in (out, out / "cells", out / "meshes", out / "pictures"):
            folder.mkdir(parents=True, exist_ok=True)
        probe = out / f".{os.getpid()}.partial"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another -o") from error


def record_file(out: Path, key: str) -> Path:
    """Where the record of a job is."""
    return out / "cells" / f"{key}.json"


def read_record(out: Path, key: str) -> Record | None:
    """The record of a finished job; None where there is none, it is damaged, or the job failed."""
    try:
        record: dict[str, Any] = json.loads(record_file(out, key).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and "outputs" in record else None


def write_record(out: Path, key: str, record: Record) -> None:
    """Write a record, whole or not at all."""
    write_json(record_file(out, key), record)
