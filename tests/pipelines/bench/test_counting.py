import torch
from fields import FIELDS, small_multiscale
from mplicits.pipelines.bench.speed import counted


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
