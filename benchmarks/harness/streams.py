"""Many trainings at a time in one process, each in a CUDA stream of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

import torch
from mplicits.pipelines.training.jobs import Item, Outcome, Result, outcome_of
from mplicits.pipelines.training.trainer import SHARED_FLAG, Interrupted, stop_on_signals


def run_streams(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    streams: int,
    device: torch.device,
    report: Callable[[Outcome[Item, Result]], None] | None = None,
) -> list[Outcome[Item, Result]]:
    """`run_jobs` in ``streams`` threads of this process, each with a CUDA stream of its own (on a CPU: threads alone).

    A training of small networks keeps a small part of a GPU busy; several streams are worked on at the same time, with
    the same results.

    Raises:
        Interrupted: Ctrl-C. Trainings under way see it by `stop_on_signals`, nothing else is begun.
    """
    outcomes: dict[int, Outcome[Item, Result]] = {}

    def enter() -> None:
        if device.type == "cuda":
            torch.cuda.set_stream(torch.cuda.Stream(device))

    with stop_on_signals() as flag, ThreadPoolExecutor(streams, initializer=enter) as threads:

        def work(item: Item) -> Outcome[Item, Result]:
            if flag.requested:
                raise Interrupted(None)
            SHARED_FLAG.set(flag)
            return outcome_of(function, item)

        waiting = {threads.submit(work, item): index for index, item in enumerate(items)}
        while waiting:
            # A signal that arrives just before a wait is heard after it, so that no wait may be long.
            for done in wait(waiting, 0.2, FIRST_COMPLETED).done:
                outcome = outcomes[waiting.pop(done)] = done.result()
                if report is not None:
                    report(outcome)
    return [outcomes[index] for index in range(len(items))]
