"""What every benchmark of ours shares: rows to JSON and back, finished jobs that are kept, tables in three forms."""

import csv
import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from mplicits.neural_fields import InputError
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import Progress

from benchmarks.harness.benchmark import Benchmark, Part, from_figures, write_results
from benchmarks.harness.jobs import Registry
from benchmarks.harness.report import as_text
from benchmarks.harness.run import run_job, run_pending
from benchmarks.harness.tables import Column, Table, tabulated


@dataclass(frozen=True)
class Size:
    edge: float
    corners: tuple[int, ...]


@dataclass(frozen=True)
class Row:
    name: str
    size: Size | None
    times: tuple[float, ...] = ()

    @property
    def area(self) -> float | None:
        return None if self.size is None else self.size.edge**2


@dataclass(frozen=True, kw_only=True)
class Squares(Benchmark[Row]):
    name = "squares"
    source = "a test"
    row = Row
    apart = ("edges",)
    edges: Sequence[float]
    config: FitConfig = dataclasses.field(default_factory=FitConfig)
    done: list[str] = dataclasses.field(default_factory=list, compare=False)

    def settings(self, job):
        return {k: v for k, v in super().settings(job).items() if k != "done"}

    def jobs(self):
        return [Part(self.name, f"edge {edge:g}", options=(("edge", edge),)) for edge in self.edges]

    def measure(self, job, context):
        edge = job.parameters["edge"]
        if edge < 0:
            raise InputError("no such square")
        self.done.append(job.name)
        context.say(f"drawing {job.name}")
        context.stage("square")(Progress("drawn", 1, 1, 1.0, {}))
        return [Row(job.name, Size(edge, (1, 2)) if edge else None, (0.5,))]

    def tables(self, rows, *, sgemm) -> tuple[Table, ...]:
        figures = [(Column("area", ".1f", "lowest"), lambda row: row.area)]
        named = [(row.name, row) for row in rows]
        return (tabulated(self.name, "Squares", "square", figures, named, notes=["A note."]),)


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    bench, said, stages = Squares(edges=[2.0, 0.0]), [], []
    rows = bench.rows(tmp_path, say=said.append, progress=lambda step: stages.append(step.stage))
    assert rows == [Row("edge 2", Size(2.0, (1, 2)), (0.5,)), Row("edge 0", None, (0.5,))]
    assert said == ["drawing edge 2", "drawing edge 0"]
    assert stages == ["square drawn"] * 2
    assert bench.rows(tmp_path) == rows
    assert len(bench.done) == 2
    record = run_job(bench.jobs()[0], tmp_path, Registry([bench]))
    size = {"edge": 2.0, "corners": [1, 2]}
    assert record["outputs"] == [{"name": "edge 2", "size": size, "times": [0.5], "area": 4.0}]
    assert record["cell"] == {"method": "squares", "name": "edge 2", "files": [], "edge": 2.0}
    assert from_figures(Size | None, None) is None


def test_keys_are_of_settings_but_not_of_other_cells_and_devices() -> None:
    bench = Squares(edges=[2.0])
    (part,) = bench.jobs()

    def key(**changes: object) -> str:
        return Registry([dataclasses.replace(bench, **changes)]).key(part)  # type: ignore[arg-type]

    assert key() == key(edges=[2.0, 3.0]) == key(config=FitConfig(device="cpu"))
    assert key() != key(config=FitConfig(seed=1))
    assert json.loads(json.dumps(bench.settings(part))) == bench.settings(part)
    assert {"device", "threads"} <= set(bench.settings(part))


def test_results_of_what_is_done(tmp_path: Path) -> None:
    bench = Squares(edges=[2.0, -1.0, 1.0])
    lines: list[str] = []
    (tmp_path / "cells").mkdir()
    ran = run_pending(bench.jobs(), tmp_path, Registry([bench]), say=lines.append)
    assert [part.name for part in ran.records] == ["edge 2", "edge 1"]
    assert "edge -1: failed: no such square" in lines[1]
    with pytest.raises(InputError, match="no such square"):
        bench.rows(tmp_path)
    other = Squares(edges=[7.0])
    planned = [(bench, bench.jobs()), (other, other.jobs())]
    tables, figures = write_results(planned, tmp_path, command="python -m benchmarks squares")
    (table,) = tables
    written = json.loads((tmp_path / "results.json").read_text())
    assert written == json.loads(json.dumps(figures))
    assert [record["outputs"][0]["area"] for record in written["records"]] == [4.0, 1.0]
    assert [row["values"] for row in written["tables"][0]["rows"]] == [[4.0], [1.0]]
    with (tmp_path / "squares.csv").open() as file:
        assert [row["area"] for row in csv.DictReader(file)] == ["4.0", "1.0"]
    page = (tmp_path / "results.md").read_text()
    for part in ("    python -m benchmarks squares\n", "| edge 1 | **1.0** |", "- A note.", "GFLOP/s"):
        assert part in page
    heads = ["Squares", "square  area", "------  ----"]
    assert as_text(table).splitlines() == [*heads, "edge 2   4.0", "edge 1   1.0", "A note."]
    assert write_results(planned[1:], tmp_path, command="x")[0] == []
