"""Running a bench: which jobs there are, doing those that are not done, and saying how far it is."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from mplicits.neural_fields.backend.devices import choose_device
from mplicits.pipelines.training.jobs import Outcome, check_jobs, run_jobs
from mplicits.pipelines.training.scaffold import environment
from mplicits.pipelines.training.trainer import Interrupted, Report

from .jobs import Context, Job, Record, Registry, read_record, write_record
from .streams import run_streams

Say = Callable[[str], None]
C = TypeVar("C", bound=Job)


def run_job(
    job: C,
    out: Path,
    registry: Registry[C],
    *,
    device: str = "cpu",
    progress: Report | None = None,
    say: Say = lambda _: None,
) -> Record:
    """Run a job and keep its record; a job that has one is not run again.

    Args:
        job: what to do.
        out: folder of the bench (see `make_folder`).
        registry: the methods.
        device: a torch device.
        progress: called now and then with how far the training is.
        say: told what comes next.

    Returns:
        The record: the job, its method, and "outputs", "deltas" and "details" of `Results`.

    Raises:
        InputError: what the job is about cannot be read or used. Whatever a method raises is kept as the record's
            "error", and such a job is run again next time.
        Interrupted: Ctrl-C during a fit of ours, which goes on there next time.
    """
    method, key = registry.named(job.method), registry.key(job)
    found = read_record(out, key)
    if found is not None:
        return found
    head = {"cell": job.as_dict(), "method": {"source": method.source, "differs": method.differs}}

    def first(other: C) -> Context:
        run_job(other, out, registry, device=device, progress=progress, say=say)
        return Context(out, registry.key(other), device, progress, say, first)

    started = time.perf_counter()
    try:
        results = method.run(job, Context(out, key, device, progress, say, first))
    except Interrupted:
        raise
    except Exception as error:
        write_record(out, key, head | {"error": " ".join(str(error).split()) or type(error).__name__})
        raise
    record = head | {
        "key": key,
        "outputs": [dict(output) for output in results.outputs],
        "deltas": list(results.deltas),
        "details": dict(results.details),
        "seconds": round(time.perf_counter() - started, 3),
        "environment": environment(choose_device(device)),
    }
    write_record(out, key, record)
    return json.loads(json.dumps(record))  # as it will be read next time: tuples are lists


@dataclass(frozen=True)
class Ran(Generic[C]):
    """What became of the jobs.

    Attributes:
        records: of those that are done.
        failures: why the others failed.
        lacking: methods that need something that is not installed, and what.
    """

    records: Mapping[C, Record]
    failures: Mapping[C, str]
    lacking: Mapping[str, str]


def run_pending(
    jobs: Sequence[C],
    out: Path,
    registry: Registry[C],
    *,
    workers: int = 1,
    streams: int = 1,
    device: str = "cpu",
    say: Say,
    progress: Report | None = None,
    tell: Say = lambda _: None,
) -> Ran[C]:
    """Run what has no record yet, one line each.

    Args:
        jobs: each once.
        out: folder of the bench.
        registry: the methods.
        workers: jobs at a time, in processes (see `run_jobs`).
        streams: how many at a time in this process, on one GPU (see `run_streams`); with one worker only.
        device: a torch device, or "auto".
        say: told one line per job.
        progress: called now and then with how far a training is; with one at a time only.
        tell: told what comes next in a job; with one at a time only.

    Raises:
        InputError: no such device, or no Ray for more than one worker.
        KeyboardInterrupt: Ctrl-C; finished jobs are kept.
        Interrupted: the same, during a fit of ours.
    """
    where = str(choose_device(device))
    check_jobs(workers)
    methods = {job: registry.named(job.method) for job in jobs}
    lacking = {method.name: why for method in methods.values() if (why := method.missing()) is not None}
    for name, why in lacking.items():
        say(f"left out: {name}, {why}")
    possible = [job for job in jobs if job.method not in lacking]
    records = dict(kept_records(possible, out, registry))
    waiting = [job for job in possible if job not in records]
    if records and waiting:
        say(f"{len(records)} of {len(possible)} jobs are there already")
    counter = _Counter(len(waiting), say, at_once=max(workers, streams))
    heard = {"progress": progress, "say": tell} if workers == streams == 1 else {}
    work = functools.partial(run_job, out=out, registry=registry, device=where, **heard)
    failures: dict[C, str] = {}
    # What others go on from comes first, so that it is not trained twice side by side.
    for depends in (False, True):
        group = [job for job in waiting if methods[job].goes_on(job) is depends]
        if streams > 1:
            outcomes = run_streams(work, group, streams=streams, device=torch.device(where), report=counter)
        else:
            outcomes = run_jobs(work, group, jobs=workers, report=counter)
        for outcome in outcomes:
            if outcome.value is None:
                failures[outcome.item] = outcome.error or "failed"
            else:
                records[outcome.item] = outcome.value
    return Ran({job: records[job] for job in jobs if job in records}, failures, lacking)


def kept_records(jobs: Sequence[C], out: Path, registry: Registry[C]) -> Mapping[C, Record]:
    """The records of those jobs that are done."""
    found = {job: read_record(out, registry.key(job)) for job in jobs}
    return {job: record for job, record in found.items() if record is not None}


class _Counter:
    """One line per finished job, with the time left at the mean pace so far: those under way count as half done."""

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
