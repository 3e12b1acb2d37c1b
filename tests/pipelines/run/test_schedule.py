"""The time left, on a clock that the tests turn: machines of other speeds than was thought, resumed and cut stages."""

from collections.abc import Callable

import pytest
from mplicits.pipelines.run.schedule import Progress, Schedule, Stage

# A fit's stages as they are predicted, in seconds: reading, and samples and steps of three levels.
STAGES = [
    Stage("reading", "reading", 1.0),
    *(
        stage
        for level, (samples, steps) in enumerate([(6.0, 26.0), (8.0, 50.0), (10.0, 75.0)])
        for stage in (Stage(f"level {level}: samples", "samples", samples), Stage(f"level {level}", "steps", steps))
    ),
]
TOLD = 50  # messages per stage


class Machine:
    """Plays the stages, so many times slower than predicted, and keeps what it was told at every message."""

    def __init__(self, slowness: Callable[[Stage], float]) -> None:
        self.now, self.slowness = 0.0, slowness
        self.schedule = Schedule(self._keep, clock=lambda: self.now)
        self.said: list[tuple[float, Progress]] = []

    def _keep(self, progress: Progress) -> None:
        self.said.append((self.now, progress))

    def play(self, stages: list[Stage]) -> None:
        for stage in stages:
            begun, seconds = self.now, stage.seconds * self.slowness(stage)
            for step in range(TOLD + 1):
                self.now = begun + seconds * step / TOLD
                self.schedule(Progress(stage.name, step, TOLD, step / TOLD, {}))

    def total_at(self, moment: float) -> float:
        """The whole time that was expected at a moment: at the last message before it."""
        now, progress = [each for each in self.said if each[0] <= moment][-1]
        assert progress.left is not None
        return now + progress.left


def ratio(found: float, true: float) -> float:
    return max(found / true, true / found)


@pytest.mark.parametrize("slowness", [0.2, 1.0, 3.0])
def test_a_machine_of_another_speed_is_found_out(slowness: float) -> None:
    """All kinds of work are wrongly predicted by one factor: what is measured of one is half believed of the others."""
    machine = Machine(lambda _: slowness)
    machine.schedule.plan(STAGES)
    machine.play(STAGES)
    true = machine.now
    assert ratio(machine.total_at(0.0), true) == pytest.approx(max(slowness, 1 / slowness))
    # With the reading and a part of the samples seen: two kinds, of which the third keeps a third of its distance.
    assert ratio(machine.total_at(0.05 * true), true) < 1e-9 + max(slowness, 1 / slowness) ** 0.5
    assert ratio(machine.total_at(0.25 * true), true) < 1.05
    assert ratio(machine.total_at(0.5 * true), true) < 1.02
    assert machine.total_at(true) == pytest.approx(true)


@pytest.mark.parametrize("of", ["samples", "steps", "reading"])
def test_one_kind_of_work_that_is_slower_than_thought(of: str) -> None:
    machine = Machine(lambda stage: 2.0 if stage.kind == of else 1.0)
    machine.schedule.plan(STAGES)
    machine.play(STAGES)
    true = machine.now
    assert ratio(machine.total_at(0.25 * true), true) < 1.2
    assert ratio(machine.total_at(0.5 * true), true) < 1.1


def test_the_whole_only_grows_and_ends_at_one() -> None:
    machine = Machine(lambda stage: {"samples": 3.0, "steps": 0.5, "reading": 1.0}[stage.kind])
    machine.schedule.plan(STAGES)
    machine.play(STAGES)
    shares = [progress.whole or 0.0 for _, progress in machine.said]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert machine.said[-1][1].left == 0.0


def test_a_budget_is_the_longest_that_it_takes() -> None:
    machine = Machine(lambda _: 1.0)
    machine.schedule.plan(STAGES, budget=40.0)
    machine.schedule.follow([Stage("mesh", "mesh", 5.0)])
    machine.play(STAGES[:1])
    assert machine.schedule.left() == pytest.approx(39.0 + 5.0)
    machine.now = 41.0
    machine.schedule(Progress("mesh", 0, 0, 0.0, {}))  # the rest of the plan is dropped
    assert machine.schedule.left() == pytest.approx(5.0)


def test_a_stage_cut_by_a_budget_says_how_fast_its_steps_were() -> None:
    """Half of its steps in half of the time: neither slower nor faster than predicted."""
    machine = Machine(lambda _: 1.0)
    machine.schedule.plan([Stage("level 0", "steps", 100.0), Stage("level 1", "steps", 100.0)], budget=1000.0)
    machine.schedule(Progress("level 0", 0, 1000, 0.0, {}))
    machine.now = 50.0
    machine.schedule(Progress("level 0", 500, 1000, 1.0, {}))
    assert machine.schedule.slowness("steps") == pytest.approx(1.0)
    assert machine.schedule.left() == pytest.approx(100.0)


def test_a_resumed_stage_counts_what_is_done_now() -> None:
    machine = Machine(lambda _: 1.0)
    machine.schedule.plan([Stage("level 0", "steps", 100.0)])
    machine.schedule(Progress("level 0", 600, 1000, 0.6, {}))
    assert machine.schedule.left() == pytest.approx(40.0)
    machine.now = 40.0  # a fifth of the stage in what was predicted for two
    machine.schedule(Progress("level 0", 800, 1000, 0.8, {}))
    total = (0.03 * 100 + 40) / (0.03 + 0.2)
    assert machine.schedule.left() == pytest.approx(total * 0.4 - 40)


def test_a_silent_stage_that_takes_longer_is_never_done() -> None:
    machine = Machine(lambda _: 1.0)
    machine.schedule.plan([Stage("preparing", "preparing", 10.0)])
    machine.schedule(Progress("preparing", 0, 0, 0.0, {}))
    machine.now = 4.0
    assert machine.schedule.left() == pytest.approx(6.0)
    machine.now = 50.0
    assert machine.schedule.left() == pytest.approx(5.0)  # a tenth of what it took so far


def test_work_that_nobody_planned_is_extrapolated() -> None:
    machine = Machine(lambda _: 1.0)
    machine.schedule(Progress("pictures", 0, 10, 0.0, {}))
    assert machine.schedule.left() is None
    machine.now = 6.0
    machine.schedule(Progress("pictures", 2, 10, 0.2, {}))
    assert machine.schedule.left() == pytest.approx(24.0)


def test_a_schedule_is_shared_by_what_it_is_handed_to() -> None:
    schedule = Schedule()
    assert Schedule.of(schedule) is schedule
    said: list[Progress] = []
    Schedule.of(said.append)(Progress("a", 1, 1, 1.0, {}))
    assert said[0].stage == "a"
