from types import SimpleNamespace

import pytest
import torch
from fields import FIELDS, small_multiscale
from mplicits.pipelines.training.cuda_graphs import Recorder

from benchmarks.costs.speed import counted
from benchmarks.scenes.flops import Tallied


def test_counters_do_not_change_the_field_and_count_only_the_bands():
    field = small_multiscale()
    same, levels = counted(field)
    x = torch.rand(500, 3) - 0.5
    assert torch.equal(same.value(x), field.value(x))
    assert [level.values for level in levels] == [
        500,
        int(field.in_band(x, level=1).sum()),
        int(field.in_band(x, level=2).sum()),
    ]
    assert 0 < levels[2].values < levels[1].values < 500
    assert torch.equal(same.jet(x[:7]).gradient, field.jet(x[:7]).gradient)
    assert levels[0].jets == 7


def test_a_field_of_one_level_is_counted_whole():
    same, levels = counted(FIELDS["sphere"]())
    same.value(torch.zeros(4, 5, 3), level=0)
    same.jet(torch.zeros(3), level=-1)
    assert [(level.values, level.jets) for level in levels] == [(20, 1)]


class Traced(Recorder):
    """Records as a graph does: the work's Python runs once, and never again."""

    def record(self, work):
        results = work()
        return (lambda: None), results


def test_replays_count_as_much_as_what_was_recorded():
    level, colors = SimpleNamespace(values=5, jets=2), SimpleNamespace(rows=1)

    def work():
        level.values, level.jets, colors.rows = level.values + 10, level.jets + 3, colors.rows + 4
        return {}

    replay, _ = Tallied(Traced(), [level, colors]).record(work)
    assert (level.values, level.jets, colors.rows) == (5, 2, 1)  # nothing has been done
    for _ in range(2):
        replay()
    assert (level.values, level.jets, colors.rows) == (25, 8, 9)


def test_what_cannot_be_recorded_is_not_counted():
    level = SimpleNamespace(values=5)

    def work():
        level.values += 10
        raise RuntimeError("no graph")

    with pytest.raises(RuntimeError, match="no graph"):
        Tallied(Traced(), [level]).record(work)
    assert level.values == 5
