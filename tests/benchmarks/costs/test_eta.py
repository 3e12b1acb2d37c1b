"""What was said of the time left is read off a clock that the test turns; and the bench's rows."""

from pathlib import Path

import pytest
from mplicits.neural_fields import InputError
from mplicits.pipelines.run.schedule import Progress, Report
from mplicits.pipelines.run.settings import EvolveConfig

from benchmarks.costs.eta import EtaBench, EtaRow, Watch
from benchmarks.harness.report import as_text


def test_what_was_said_last() -> None:
    now, heard = [100.0], list[Progress]()
    watch = Watch(heard.append, clock=lambda: now[0])
    for second, left in ((0, 50.0), (4, 30.0), (6, 20.0), (10, 12.0), (19, None)):
        now[0] = 100.0 + second
        watch(Progress("a", 0, 0, 0.0, {}, left=left))
    now[0] = 120.0
    assert watch.row("fit") == EtaRow("fit", 20.0, at_first=34.0, at_quarter=34.0, at_half=22.0)
    assert len(heard) == 5
    assert watch.total_at(-1.0) == 50.0


def test_rows_and_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The morph itself is tested elsewhere; here it is three messages."""

    def quick(config: EvolveConfig, *, progress: Report) -> None:
        assert config.steps == (120,)  # a tenth of the fast preset's
        for left in (3.0, 2.0, 1.0):
            progress(Progress("level 0", 0, 0, 0.0, {}, left=left))

    monkeypatch.setattr("benchmarks.costs.eta.evolve", quick)
    bench = EtaBench(works=("evolve",), share=0.1)
    rows = bench.rows(tmp_path)
    assert [row.work for row in rows] == ["evolve"]
    assert min(rows[0].at_quarter, rows[0].at_half) > 0
    table = as_text(*bench.tables(rows, sgemm=1e9))
    assert f"{rows[0].at_half / rows[0].seconds:.2f}" in table


def test_other_works_are_refused() -> None:
    with pytest.raises(InputError, match="mesh: expected fit, reconstruct, evolve"):
        EtaBench(works=("mesh",)).cells()
