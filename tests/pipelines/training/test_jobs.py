"""The engine: what fails alone, what runs side by side, what stops."""

import importlib.util
import os
import signal
import threading

import pytest
import torch
from mplicits.neural_fields import InputError
from mplicits.pipelines.training.jobs import Outcome, run_jobs
from mplicits.pipelines.training.trainer import Interrupted, seeded, stop_on_signals

from benchmarks.harness.streams import run_streams


def reciprocal(number: int) -> float:
    if number == 3:
        raise InputError("three: is not wanted;\nleave it out")
    return 1 / number


def assert_reciprocals(outcomes: list[Outcome[int, float]]) -> None:
    assert [outcome.item for outcome in outcomes] == [1, 0, 2, 3]
    assert [outcome.value for outcome in outcomes] == [1.0, None, 0.5, None]
    zero, three = "ZeroDivisionError: division by zero", "three: is not wanted; leave it out"
    assert [outcome.error for outcome in outcomes] == [None, zero, None, three]


def test_a_failed_item_does_not_stop_the_rest() -> None:
    seen: list[Outcome[int, float]] = []
    assert_reciprocals(run_jobs(reciprocal, [1, 0, 2, 3], report=seen.append))
    assert [outcome.item for outcome in seen] == [1, 0, 2, 3]


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), Interrupted(None)])
def test_ctrl_c_stops_all(stop: BaseException) -> None:
    done: list[int] = []

    def work(number: int) -> None:
        if number == 2:
            raise stop
        done.append(number)

    with pytest.raises(type(stop)):
        run_jobs(work, [1, 2, 3])
    assert done == [1]


def test_several_jobs_without_ray_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"--jobs 2: needs Ray; pip install mplicits\[ray\]"):
        run_jobs(reciprocal, [1, 2], jobs=2)
    with pytest.raises(InputError, match="--jobs 0: expected a whole number from 1"):
        run_jobs(reciprocal, [1, 2], jobs=0)


def test_streams_work_at_the_same_time_and_report_what_failed() -> None:
    seen: list[Outcome[int, float]] = []
    both = threading.Barrier(2, timeout=60)

    def work(number: int) -> float:
        if number < 2:
            both.wait()
        return reciprocal(number)

    assert_reciprocals(run_streams(work, [1, 0, 2, 3], streams=2, device=torch.device("cpu"), report=seen.append))
    assert sorted(outcome.item for outcome in seen) == [0, 1, 2, 3]


def test_ctrl_c_stops_every_stream_and_nothing_else_begins() -> None:
    begun: list[int] = []
    both = threading.Barrier(2, timeout=60)

    def work(number: int) -> None:
        begun.append(number)
        with stop_on_signals() as flag:
            if both.wait() == 0:
                os.kill(os.getpid(), signal.SIGINT)
            while not flag.requested:
                threading.Event().wait(0.001)
        raise Interrupted(None)

    with pytest.raises(Interrupted):
        run_streams(work, [1, 2, 3, 4], streams=2, device=torch.device("cpu"))
    assert sorted(begun) == [1, 2]


def test_random_numbers_of_a_seed_are_the_same_in_every_stream() -> None:
    def work(seed: int) -> list[float]:
        with seeded(seed):
            return [float(torch.rand(())) for _ in range(300)]

    alone = [work(seed) for seed in range(8)]
    outcomes = run_streams(work, range(8), streams=4, device=torch.device("cpu"))
    assert [outcome.value for outcome in outcomes] == alone


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is an extra")
def test_two_workers_share_the_items_and_the_threads() -> None:
    def work(number: int) -> tuple[int, int, float, int]:
        if number == 4:
            os._exit(1)  # a worker that dies, as one killed for its memory does
        return os.getpid(), torch.get_num_threads(), reciprocal(number), os.getpriority(os.PRIO_PROCESS, 0)

    seen: list[Outcome[int, tuple[int, int, float, int]]] = []
    outcomes = run_jobs(work, [1, 2, 3, 4, 5], jobs=2, report=seen.append)
    values = [outcome.value for outcome in outcomes if outcome.value is not None]
    assert [value[2] for value in values] == [1.0, 0.5, 0.2]
    assert all(value[0] != os.getpid() for value in values)
    assert {value[3] for value in values} == {os.getpriority(os.PRIO_PROCESS, 0)}  # with the same priority
    assert {value[1] for value in values} == {max(1, torch.get_num_threads() // 2)}
    assert outcomes[2].error == "three: is not wanted; leave it out"
    assert "WorkerCrashedError" in outcomes[3].error
    assert sorted(outcome.item for outcome in seen) == [1, 2, 3, 4, 5]
