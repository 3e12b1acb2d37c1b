"""Running a bench: which cells there are, doing those that are not done, and saying how far it is."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from mplicits.neural_fields.backend.devices import choose_device, environment
from mplicits.pipelines.training.jobs import Outcome, check_jobs, run_jobs, run_streams
from mplicits.pipelines.training.trainer import Interrupted, Report

from .cells import Catalogue, Cell, Record, Workplace, read_record, write_record

Say = Callable[[str], None]
C = TypeVar("C", bound=Cell)


def run_cell(
    cell: C,
    out: Path,
    catalogue: Catalogue[C],
    *,
    device: str = "cpu",
    progress: Report | None = None,
    say: Say = lambda _: None,
) -> Record:
    """Do the work of a cell and keep its record; a cell that has one is not run again.

    Args:
        cell: what to do.
        out: folder of the bench (see `make_folder`).
        catalogue: the methods.
        device: a torch device.
        progress: called now and then with how far the training is.
        say: told what comes next.

    Returns:
        What the cell is, its method, and what it found: "outputs", "deltas" and "details" of `Findings`.

    Raises:
        InputError: what the cell is about cannot be read or used. Whatever a method raises is kept as the record's
            "error", and such a cell is run again next time.
        Interrupted: Ctrl-C during a fit of ours, which goes on there next time.
    """
    method, key = catalogue.named(cell.method), catalogue.key(cell)
    found = read_record(out, key)
    if found is not None:
        return found
    head = {"cell": cell.as_dict(), "method": {"source": method.source, "differs": method.differs}}

    def first(other: C) -> Workplace:
        run_cell(other, out, catalogue, device=device, progress=progress, say=say)
        return Workplace(out, catalogue.key(other), device, progress, say, first)

    started = time.perf_counter()
    try:
        findings = method.run(cell, Workplace(out, key, device, progress, say, first))
    except Interrupted:
        raise
    except Exception as error:
        write_record(out, key, head | {"error": " ".join(str(error).split()) or type(error).__name__})
        raise
    record = head | {
        "key": key,
        "outputs": [dict(output) for output in findings.outputs],
        "deltas": list(findings.deltas),
        "details": dict(findings.details),
        "seconds": round(time.perf_counter() - started, 3),
        "environment": environment(choose_device(device)),
    }
    write_record(out, key, record)
    return json.loads(json.dumps(record))  # as it will be read next time: tuples are lists


@dataclass(frozen=True)
class Ran(Generic[C]):
    """What became of the cells.

    Attributes:
        records: of those that are done.
        failures: why the others failed.
        lacking: methods that need something that is not installed, and what.
    """

    records: Mapping[C, Record]
    failures: Mapping[C, str]
    lacking: Mapping[str, str]


def run_cells(
    cells: Sequence[C],
    out: Path,
    catalogue: Catalogue[C],
    *,
    jobs: int = 1,
    streams: int = 1,
    device: str = "cpu",
    say: Say,
    progress: Report | None = None,
    tell: Say = lambda _: None,
) -> Ran[C]:
    """Run what has no record yet, one line each.

    Args:
        cells: each once.
        out: folder of the bench.
        catalogue: the methods.
        jobs: how many at a time, in processes (see `run_jobs`).
        streams: how many at a time in this process, on one GPU (see `run_streams`); with one job only.
        device: a torch device, or "auto".
        say: told one line per cell.
        progress: called now and then with how far a training is; with one at a time only.
        tell: told what comes next in a cell; with one at a time only.

    Raises:
        InputError: no such device, or no Ray for more than one job.
        KeyboardInterrupt: Ctrl-C; finished cells are kept.
        Interrupted: the same, during a fit of ours.
    """
    where = str(choose_device(device))
    check_jobs(jobs)
    methods = {cell: catalogue.named(cell.method) for cell in cells}
    lacking = {method.name: why for method in methods.values() if (why := method.missing()) is not None}
    for name, why in lacking.items():
        say(f"left out: {name}, {why}")
    possible = [cell for cell in cells if cell.method not in lacking]
    records = dict(kept_records(possible, out, catalogue))
    waiting = [cell for cell in possible if cell not in records]
    if records and waiting:
        say(f"{len(records)} of {len(possible)} cells are there already")
    counter = _Counter(len(waiting), say, at_once=max(jobs, streams))
    heard = {"progress": progress, "say": tell} if jobs == streams == 1 else {}
    work = functools.partial(run_cell, out=out, catalogue=catalogue, device=where, **heard)
    failures: dict[C, str] = {}
    # What others go on from comes first, so that it is not trained twice side by side.
    for depends in (False, True):
        group = [cell for cell in waiting if methods[cell].goes_on(cell) is depends]
        if streams > 1:
            outcomes = run_streams(work, group, streams=streams, device=torch.device(where), report=counter)
        else:
            outcomes = run_jobs(work, group, jobs=jobs, report=counter)
        for outcome in outcomes:
            if outcome.value is None:
                failures[outcome.item] = outcome.error or "failed"
            else:
                records[outcome.item] = outcome.value
    return Ran({cell: records[cell] for cell in cells if cell in records}, failures, lacking)


def kept_records(cells: Sequence[C], out: Path, catalogue: Catalogue[C]) -> Mapping[C, Record]:
    """The records of those cells that are done."""
    found = {cell: read_record(out, catalogue.key(cell)) for cell in cells}
    return {cell: record for cell, record in found.items() if record is not None}


class _Counter:
    """One line per finished cell, with the time left at the mean pace so far: those under way count as half done."""

    def __init__(self, total: int, say: Say, *, at_once: int = 1) -> None:
        self.total, self.say, self.at_once = total, say, at_once
        self.done, self.started = 0, time.monotonic()

    def __call__(self, outcome: Outcome[Any, Record]) -> None:
        self.done += 1
        under_way = min(self.at_once - 1, self.total - self.done) / 2
        left = (time.monotonic() - self.started) / (self.done + under_way) * (self.total - self.done - under_way)
        rest = f"; about {_duration(left)} left" if self.done < self.total else ""
        result = f"failed: {outcome.error}" if outcome.value is None else _result(outcome.value)
        self.say(f"[{self.done}/{self.total}] {outcome.item.name}: {result}{rest}")


def _result(record: Record) -> str:
    chamfers = [output["chamfer"] for output in record["outputs"] if output.get("chamfer") is not None]
    figure = f", Chamfer {chamfers[-1]:.2e}" if chamfers else ""
    return f"{record['seconds']:.0f} s{figure}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
