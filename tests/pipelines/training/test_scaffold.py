"""Shares of a time budget, by costs and clocks that the tests choose."""

from functools import partial

import pytest
import torch
from mplicits.pipelines.training import scaffold as module
from mplicits.pipelines.training.scaffold import Budget, affordable, step_seconds

STEPS, COSTS = (1000, 500, 500), (0.01, 0.02, 0.04)  # 10 s, 10 s, 20 s


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time by `time.monotonic`, to be turned."""
    clock = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    return clock


def test_what_is_left(now: list[float]) -> None:
    budget = Budget(10.0)
    now[0] += 4.0
    budget.before = 1.0  # of a process that was interrupted
    assert budget.left() == 5.0
    now[0] += 60.0
    assert budget.left() == 0.0
    assert Budget(None).left() is None
    assert Budget(None).record() == {}


@pytest.mark.parametrize("seconds", [400.0, 20.0])
def test_time_is_shared_by_steps_and_their_costs(seconds: float) -> None:
    budget, left, shares = Budget(seconds), seconds, []
    for level in range(3):
        shares.append(budget.share(left, level, STEPS, COSTS.__getitem__))
        left -= shares[-1]
    assert shares == pytest.approx([seconds / 4, seconds / 4, seconds / 2])


def test_levels_are_left_out_the_finest_first() -> None:
    """A level is left out where it, or one before it, would get less than its fewest steps."""
    share = partial(Budget(1.0).share, steps=STEPS, cost=COSTS.__getitem__)
    assert all(share(0.1 * each, 0) is not None for each in range(200))
    assert share(4.7, 0) == 2.35  # 59 steps in all three are not worth it
    assert share(4.9, 0) == pytest.approx(4.9 / 4)
    assert share(0.0, 0) == 0.0  # without level 0 there is nothing
    assert share(1.0, 1) is None
    assert share(1.0, 1, begun=True) == 1.0
    assert share(1.3, 1) == pytest.approx(1.3)
    # A part of a share may be for other things than steps.
    assert share(7.0, 0, training=2 / 3) == 3.5
    assert share(7.4, 0, training=2 / 3) == pytest.approx(7.4 / 4)


def test_samples_are_as_many_as_can_be_made(now: list[float]) -> None:
    """Of a second for whatever number, and a millisecond for each."""
    made: list[int] = []

    def make(count: int) -> None:
        made.append(count)
        now[0] += 1.0 + 1e-3 * count

    assert affordable(make, 10**6, 51.0, fewest=1000) == pytest.approx(50_000, rel=1e-3)
    assert affordable(make, 20_000, 51.0, fewest=1000) == 20_000
    assert affordable(make, 10**6, 1.2, fewest=1000) == 1000
    assert affordable(make, 10**6, 0.0, fewest=1000) == 1000
    assert max(made) == 2000
    made.clear()
    assert affordable(make, 1000, 0.0, fewest=1000) == 1000
    assert made == []


def test_the_fastest_step_counts(now: list[float]) -> None:
    took = [3.0, 0.5, 0.25, 0.75, 9.0]

    def step() -> torch.Tensor:
        now[0] += took.pop(0)
        return torch.ones((), requires_grad=True)

    assert step_seconds(step, 10_000.0) == 0.25
    assert took == [9.0]
    assert step_seconds(step, 10.0) == 9.0  # one that takes a large part of what is left is not tried again
