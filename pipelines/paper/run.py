"""Running a bench: which cells there are, doing those that are not done, and saying how far it is."""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ..fit import choose_device
from ..fit_state import environment
from ..jobs import Outcome, run_jobs
from .cell import Cell, Record
from .method import Method, Workplace
from .methods import method_named
from .protocol import protocol_of
from .recipe import Preset, Report
from .store import read_record, write_record
from .tables import TableSpec

__all__ = ["Shape", "cell_key", "cells_of", "run_cell", "run_cells"]

Say = Callable[[str], None]


@dataclass(frozen=True)
class Shape:
    """One input.

    Attributes:
        path: its vertices are the cloud.
        reference: what results are measured against; None for the shape itself.
    """

    path: Path
    reference: Path | None = None


def cell_key(cell: Cell, method: Method) -> str:
    """The name under which a cell is stored: all that decides its figures."""
    return cell.key({**protocol_of(cell.preset).as_dict(), **method.settings(cell)})


def cells_of(
    spec: TableSpec,
    shapes: Sequence[Shape],
    preset: Preset,
    *,
    seed: int = 0,
    skipped: Sequence[str] = (),
) -> list[Cell]:
    """The cells of a table, with seed and references, each once.

    Args:
        spec: the table.
        shapes: the inputs.
        preset: how large and how long.
        seed: of everything.
        skipped: methods that were not asked for; ablations' variants of ours are never left out by it.
    """
    references = {shape.path: shape.reference for shape in shapes}
    cells = spec.cells([shape.path for shape in shapes], preset)
    planned = [dataclasses.replace(cell, seed=seed, reference=references.get(cell.shape)) for cell in cells]
    return list(dict.fromkeys(cell for cell in planned if cell.method not in skipped))


def run_cell(cell: Cell, out: Path, *, device: str = "cpu", progress: Report | None = None) -> Record:
    """Do the work of a cell and keep its record; a cell that has one is not run again.

    Args:
        cell: what to do.
        out: folder of the bench (see `store.make_folder`).
        device: a torch device.
        progress: called now and then with how far the training is.

    Returns:
        See `mplicits.pipelines.paper.tables`.

    Raises:
        InputError: the cloud cannot be read or used. Whatever a method raises is kept as the record's "error", and
            such a cell is run again next time.
    """
    method = method_named(cell.method)
    key = cell_key(cell, method)
    found = read_record(out, key)
    if found is not None:
        return found
    started = time.perf_counter()
    try:
        findings = method.run(cell, Workplace(out, key, device, progress))
    except Exception as error:
        write_record(out, key, _failed(cell, method, " ".join(str(error).split()) or type(error).__name__))
        raise
    record = _head(cell, method) | {
        "key": key,
        "outputs": [dict(output) for output in findings.outputs],
        "deltas": list(findings.deltas),
        "details": dict(findings.details),
        "seconds": round(time.perf_counter() - started, 3),
        "environment": environment(torch.device(device)),
    }
    write_record(out, key, record)
    return json.loads(json.dumps(record))  # as it will be read next time: tuples are lists


def _failed(cell: Cell, method: Method, error: str) -> dict[str, Any]:
    """The record of a cell that found nothing, and why."""
    return _head(cell, method) | {"error": error}


def _head(cell: Cell, method: Method) -> dict[str, Any]:
    return {"cell": cell.as_dict(), "method": {"source": method.source, "differs": method.differs}}


def run_cells(
    cells: Sequence[Cell], out: Path, *, jobs: int = 1, device: str = "cpu", say: Say
) -> tuple[Mapping[Cell, Record], int]:
    """Run what has no record yet, one line each.

    Args:
        cells: each once.
        out: folder of the bench.
        jobs: how many at a time (see `run_jobs`).
        device: a torch device, or "auto".
        say: told one line per cell.

    Returns:
        A record for every cell, for those that failed or lack an extra one without outputs but with an "error"; and
        how many failed.

    Raises:
        InputError: no such device, or no Ray for more than one job.
        KeyboardInterrupt: Ctrl-C; finished cells are kept.
    """
    where = str(choose_device(device))
    methods = {cell: method_named(cell.method) for cell in cells}
    lacking = {cell: why for cell, method in methods.items() if (why := method.missing()) is not None}
    records: dict[Cell, Record] = {
        cell: _failed(cell, methods[cell], why) | {"outputs": [], "deltas": []} for cell, why in lacking.items()
    }
    for why in sorted({f"{cell.method}: {why}" for cell, why in lacking.items()}):
        say(f"left out: {why}")
    waiting: list[Cell] = []
    for cell in cells:
        if cell in lacking:
            continue
        record = read_record(out, cell_key(cell, methods[cell]))
        if record is None:
            waiting.append(cell)
        else:
            records[cell] = record
    if records and waiting:
        say(f"{len(cells) - len(waiting)} of {len(cells)} cells are there already")
    counter = _Counter(len(waiting), jobs, say)
    work = functools.partial(run_cell, out=out, device=where)
    failures = 0
    for outcome in run_jobs(work, waiting, jobs=jobs, report=counter):
        if outcome.value is None:
            failures += 1
            why = outcome.error or "failed"
            records[outcome.item] = _failed(outcome.item, methods[outcome.item], why) | {"outputs": [], "deltas": []}
        else:
            records[outcome.item] = outcome.value
    return {cell: records[cell] for cell in cells}, failures


class _Counter:
    """One line per finished cell, with the time left at the mean pace so far."""

    def __init__(self, total: int, jobs: int, say: Say) -> None:
        self.total, self.jobs, self.say = total, jobs, say
        self.done, self.started = 0, time.monotonic()

    def __call__(self, outcome: Outcome[Cell, Record]) -> None:
        self.done += 1
        left = (time.monotonic() - self.started) / self.done * (self.total - self.done)
        rest = f"; about {_duration(left)} left" if self.done < self.total else ""
        result = f"failed: {outcome.error}" if outcome.value is None else _result(outcome.value)
        self.say(f"[{self.done}/{self.total}] {outcome.item.name}: {result}{rest}")


def _result(record: Record) -> str:
    chamfers = [output["chamfer"] for output in record["outputs"] if output.get("chamfer") is not None]
    figure = f", Chamfer {chamfers[-1]:.2e}" if chamfers else ""
    return f"{record['seconds']:.0f} s{figure}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
