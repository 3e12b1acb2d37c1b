"""A benchmark of ours: its options are its fields. All of them run, are kept and are written in this one way.

A folder of results holds ``cells/KEY.json`` for each finished job, ``runs/NAME-KEY`` for each fit, one CSV per table,
``results.json`` with all tables and records, and ``results.md``.
"""

from __future__ import annotations

import dataclasses
import json
import platform
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

import torch
from mplicits.neural_fields import InputError
from mplicits.neural_fields.backend.devices import choose_device, sgemm_rate
from mplicits.neural_fields.backend.files import write_json, write_whole
from mplicits.pipelines.training.scaffold import environment

from .jobs import Context, Method, Record, Registry, Results, make_folder
from .report import Section, as_csv, as_dict, as_page
from .run import kept_records, run_job
from .tables import Table

R = TypeVar("R")


@dataclass(frozen=True)
class Part:
    """The work of one job of a benchmark; see `benchmarks.harness.jobs.Job`.

    Attributes:
        method: name of the benchmark.
        name: one line for people.
        files: count by what they hold.
        options: all that tells this part from the benchmark's others.
    """

    method: str
    name: str
    files: tuple[Path, ...] = ()
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def inputs(self) -> tuple[Path, ...]:
        """See `Job.inputs`."""
        return self.files

    @property
    def parameters(self) -> Mapping[str, Any]:
        """See `Job.parameters`."""
        return dict(self.options)

    def as_dict(self) -> dict[str, Any]:
        """See `Job.as_dict`."""
        return {
            "method": self.method,
            "name": self.name,
            "files": [str(file) for file in self.files],
            **self.parameters,
        }


@dataclass(frozen=True, kw_only=True)
class Benchmark(Method[Part], Generic[R]):
    """Measures something, row by row; its subclasses are data classes of their options.

    Attributes:
        row: data class of a row; its fields, and its properties, are what JSON files hold of it.
        device: a torch device.
    """

    row: ClassVar[type[Any]]
    # Fields that change no figure, or are in the jobs.
    apart: ClassVar[tuple[str, ...]] = ()
    differs = ""
    device: str = "cpu"

    @abstractmethod
    def jobs(self) -> list[Part]:
        """What is to be done, one job for each part that may be kept on its own.

        Raises:
            InputError: something cannot be measured; nothing has been done yet.
        """

    @abstractmethod
    def measure(self, job: Part, context: Context) -> list[R]:
        """The rows of a job.

        Raises:
            InputError: an option or a file cannot be used.
        """

    @abstractmethod
    def tables(self, rows: Sequence[R], *, sgemm: float) -> tuple[Table, ...]:
        """The figures that people read.

        Args:
            rows: of all jobs that are done, one at least.
            sgemm: the machine's matrix rate in FLOP/s, the limit of every network.
        """

    def settings(self, job: Part) -> Mapping[str, Any]:
        """All options, and the machine: times are its own."""
        options = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in self.apart}
        where = environment(choose_device(self.device))
        options |= {"device": where["device"], "threads": where["threads"]}
        return json.loads(json.dumps(options, default=plain))

    def run(self, job: Part, context: Context) -> Results:
        """See `Method.run`: one output per row."""
        return Results(tuple(_figures(row) for row in self.measure(job, context)))

    def read(self, records: Sequence[Record]) -> list[R]:
        """The rows in records."""
        return [from_figures(self.row, output) for record in records for output in record["outputs"]]

    def rows(self, out: Path, **heard: Any) -> list[R]:
        """The rows of all jobs, from results on disk where they exist; raises what a job raises.

        Args:
            out: folder of the results.
            heard: ``progress`` and ``say`` of `run_job`.
        """
        jobs = self.jobs()
        make_folder(out)
        return self.read([run_job(job, out, Registry([self]), device=self.device, **heard) for job in jobs])


def plain(value: Any) -> Any:
    """Options as JSON; the settings of a training without the device that it runs on."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {name: one for name, one in dataclasses.asdict(value).items() if name != "device"}
    return str(value)


def _figures(row: Any) -> dict[str, Any]:
    """Fields of a row and of rows in it, and what follows from them."""
    found = {field.name: getattr(row, field.name) for field in dataclasses.fields(row)}
    found |= {name: getattr(row, name) for name, value in vars(type(row)).items() if isinstance(value, property)}
    return {name: _figures(value) if dataclasses.is_dataclass(value) else value for name, value in found.items()}


def from_figures(kind: Any, figures: Any) -> Any:
    """A row of a kind, or a part of one, from what its JSON file holds.

    Example:
        >>> from_figures(tuple[float, ...], [1.0, 2.0])
        (1.0, 2.0)
    """
    if get_origin(kind) in (Union, UnionType):
        kind = next(one for one in get_args(kind) if (one is type(None)) is (figures is None))
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        names = [field.name for field in dataclasses.fields(kind)]
        return kind(**{name: from_figures(hints[name], figures[name]) for name in names if name in figures})  # type: ignore[operator]
    if isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return kind(*figures)  # JSON keeps a NamedTuple as a list
    return tuple(figures) if get_origin(kind) is tuple else figures


def network_name(sizes: Iterable[tuple[int, int]]) -> str:
    """Widths and depths of levels as the paper writes them.

    Example:
        >>> network_name([(128, 2), (256, 2)])
        '(128,2)▷(256,2)'
    """
    return "▷".join(f"({width},{depth})" for width, depth in sizes)


def one_of_each(names: Sequence[str], what: str) -> None:
    """Refuse two things of one name, which tables could not tell apart.

    Raises:
        InputError: there are.
    """
    if len(set(names)) < len(names):
        raise InputError(f"{max(names, key=names.count)}: two of the {what} are called that; rename one of them")


def write_results(
    planned: Sequence[tuple[Benchmark[Any], Sequence[Part]]], out: Path, *, command: str
) -> tuple[Sequence[Table], Mapping[str, Any]]:
    """Write the tables of all that is done in a folder, as CSV, JSON and Markdown.

    Args:
        planned: the benchmarks, each with its jobs.
        out: the folder.
        command: as it will stand on the page.

    Returns:
        The tables, and what the JSON file holds; no tables where nothing is done.
    """
    device = choose_device(planned[0][0].device)
    rate = sgemm_rate(256, device=device)
    machine = machine_words(device, rate)
    sections, records = [], []
    for bench, jobs in planned:
        done = list(kept_records(jobs, out, Registry([bench])).values())
        if done:
            sections.append(Section(bench.name, "", bench.source, bench.tables(bench.read(done), sgemm=rate)))
            records += done
    tables = [table for section in sections for table in section.tables]
    for table in tables:
        write_whole(out / f"{table.name}.csv", as_csv(table))
    figures = {"machine": machine, "tables": [as_dict(table) for table in tables], "records": records}
    write_json(out / "results.json", figures)
    write_whole(out / "results.md", as_page(sections, title="Results", command=command, machine=machine))
    return tables, figures


def machine_words(device: torch.device, rate: float) -> str:
    """What figures were measured on: processor, threads, matrix rate in FLOP/s, and torch."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else _processor()
    return (
        f"{name}, {torch.get_num_threads()} threads, float32 matrices at {rate / 1e9:.0f} GFLOP/s, "
        f"torch {torch.__version__}"
    )


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
