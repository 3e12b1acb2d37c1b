"""Many independent pieces of work: one after the other, or in local workers of Ray."""

from __future__ import annotations

import importlib.util
import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch

from ...neural_fields import InputError
from .trainer import Interrupted

Item = TypeVar("Item")
Result = TypeVar("Result")

# Read by Ray when it is imported: no usage reports, devices stay visible to tasks that ask for none, and workers keep
# the usual priority, as their seconds are measured.
RAY_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",
}


@dataclass(frozen=True)
class Outcome(Generic[Item, Result]):
    """What became of one item."""

    item: Item
    value: Result | None  # what the function returned; None if it failed
    error: str | None  # why it failed, in one line; None if it did not
    seconds: float


def check_jobs(jobs: int, address: str | None = None) -> None:
    """Refuse less than one job, and what needs Ray where there is none, by an `InputError` before any work."""
    if jobs < 1:
        raise InputError(f"--jobs {jobs}: expected a whole number from 1")
    flag = f"--jobs {jobs}" if address is None else f"--ray-address {address}"
    if (jobs > 1 or address is not None) and importlib.util.find_spec("ray") is None:
        raise InputError(f"{flag}: needs Ray; pip install mplicits[ray], or leave it out")


def run_jobs(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    jobs: int = 1,
    address: str | None = None,
    retries: int = 0,
    report: Callable[[Outcome[Item, Result]], None] | None = None,
) -> list[Outcome[Item, Result]]:
    """Call ``function`` on every item → one outcome per item, in their order; one that raises does not stop the others.

    With several ``jobs`` at a time it runs in other processes: what it takes, holds and returns is pickled, and torch
    there has its share of the cores, ``cores // jobs``. One job needs no Ray, and runs in this process. ``report`` is
    told every outcome, as it comes. With the ``address`` of a Ray cluster, they run there, each with as many cores. An
    item whose worker died is begun again ``retries`` times.

    Raises:
        InputError: see `check_jobs`.
        KeyboardInterrupt: Ctrl-C. Fits under way have written their checkpoints, nothing else is begun.
        Interrupted: the same, where ``function`` is a fit in this process.
    """
    check_jobs(jobs, address)
    report = report or (lambda _: None)
    if address is None and (jobs == 1 or len(items) < 2):
        outcomes = []
        for item in items:
            outcomes.append(outcome_of(function, item))
            report(outcomes[-1])
        return outcomes
    return _side_by_side(function, items, min(jobs, len(items)), report, address, retries)


def outcome_of(function: Callable[[Item], Result], item: Item) -> Outcome[Item, Result]:
    """What becomes of one item; only `Interrupted` is raised."""
    started = time.monotonic()
    try:
        value = function(item)
    except Interrupted:
        raise
    except Exception as error:  # whatever went wrong with one item is no reason to leave out the next
        text = " ".join(str(error).split())
        if not isinstance(error, InputError):
            text = f"{type(error).__name__}: {text}".removesuffix(": ")
        return Outcome(item, None, text, time.monotonic() - started)
    return Outcome(item, value, None, time.monotonic() - started)


def _side_by_side(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    jobs: int,
    report: Callable[[Outcome[Item, Result]], None],
    address: str | None,
    retries: int,
) -> list[Outcome[Item, Result]]:
    for name, value in RAY_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    import ray  # after its environment is set

    threads, gpus = max(1, torch.get_num_threads() // jobs), _gpus_each(torch.cuda.device_count(), jobs)

    def work(item: Item) -> Outcome[Item, Result]:
        torch.set_num_threads(threads)
        return outcome_of(function, item)

    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    if address is None:
        own = {"num_cpus": threads * jobs, "include_dashboard": False}
        ray.init(address="local", object_store_memory=128 << 20, **own, **quiet)  # items and results are small
    else:
        try:
            ray.init(address=address, **quiet)
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"--ray-address {address}: no Ray cluster answers there ({reason})") from error
    try:
        task: Any = ray.remote(num_cpus=threads, num_gpus=gpus, max_retries=retries)(work)
        waiting = {task.remote(item): index for index, item in enumerate(items)}
        outcomes: dict[int, Outcome[Item, Result]] = {}
        try:
            while waiting:
                for done in ray.wait(list(waiting), num_returns=1)[0]:
                    index = waiting.pop(done)
                    outcomes[index] = _collected(ray, done, items[index])
                    report(outcomes[index])
        except KeyboardInterrupt:
            # What runs is interrupted, as Ctrl-C would; what waits is forgotten; checkpoints get a minute.
            for left in waiting:
                ray.cancel(left)
            ray.wait(list(waiting), num_returns=len(waiting), timeout=60.0)
            raise
    finally:
        ray.shutdown()
    return [outcomes[index] for index in range(len(items))]


def _collected(ray: Any, done: Any, item: Item) -> Outcome[Item, Any]:
    """The outcome that a task returned, or one that says how its worker died."""
    try:
        return ray.get(done)
    except ray.exceptions.RayError as error:
        lines = str(error).splitlines() or [""]
        reason = lines[-1] if isinstance(error, ray.exceptions.RayTaskError) else lines[0]  # the end of a traceback
        return Outcome(item, None, f"{type(error).__name__}: {reason}", math.nan)


def _gpus_each(gpus: int, jobs: int) -> float:
    """GPUs, or the part of one, for each job."""
    if gpus >= jobs:
        return gpus // jobs
    return 1 / math.ceil(jobs / gpus) if gpus else 0
