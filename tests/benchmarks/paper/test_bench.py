"""``python -m benchmarks paper``: mistakes before any work, and a whole bench with a method that knows the answer."""

import csv
import json
import re
from pathlib import Path

import imageio.v3 as iio
import pytest
from mplicits.neural_fields import Similarity, Sphere, extract_mesh
from mplicits.pipelines.mesh.files import write_mesh

from benchmarks.cli import main
from benchmarks.harness.cells import Catalogue, Findings, Method
from benchmarks.paper import bench, names
from benchmarks.paper.cells import PaperCell
from benchmarks.paper.judge import Judge

PLACE = Similarity((0.0, 0.0, 0.0), 2.0)


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    path = tmp_path / "ball.ply"
    write_mesh(path, extract_mesh(Sphere(radius=0.9), resolution=24), PLACE)
    return path


class Exact(Method[PaperCell]):
    source, differs = "a test", "nothing"
    runs = 0

    def __init__(self, name: str) -> None:
        self.name = name

    def run(self, cell, work):
        Exact.runs += 1
        if self.name == "idf":
            raise RuntimeError("no luck")
        title = {"ours": "Ours fine", "siren": "SIREN"}[self.name]
        figures = Judge(cell, work).field(title, Sphere(radius=0.9), PLACE, parameters=4, train_seconds=60.0)
        return Findings((figures,), (0.02, 0.01))


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> type[Exact]:
    monkeypatch.setattr(bench, "CATALOGUE", Catalogue([Exact(name) for name in names.METHODS]))
    monkeypatch.setattr(bench, "sgemm_rate", lambda *_, **__: 1e9)
    Exact.runs = 0
    return Exact


def test_a_bench(ball: Path, tmp_path: Path, exact, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bench"
    command = ["paper", str(ball), "-o", str(out), "--preset", "smoke", "--device", "cpu"]
    command += ["--methods", "ours,siren"]
    figures = tmp_path / "figures.json"
    assert main([*command, "--table", "comparison", "--json", str(figures)]) == 0
    assert exact.runs == 2
    printed, said = capsys.readouterr()
    assert "\nSIREN " in printed
    assert "1 tables, 1 shapes, 2 cells" in said
    page = (out / "results.md").read_text()
    assert (
        f"python -m benchmarks paper {ball.name} -o {out.name} --preset smoke --device cpu --methods ours,siren" in page
    )
    with (out / "comparison.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    (section,) = json.loads(figures.read_text())
    first = section["tables"][0]["rows"][0]
    assert first["name"] == "Ours fine"
    assert float(rows["Ours fine"]["mean CD"]) == first["values"][0]
    kept = json.loads((out / "comparison.json").read_text())
    assert [record["outputs"][0]["name"] for record in kept["records"]] == ["Ours fine", "SIREN"]
    assert kept["records"][0]["outputs"][0]["chamfer"] == first["values"][0]
    assert iio.imread(out / "sheets" / "comparison-ball.jpg").shape == (136, 4 * 108, 3)
    assert (out / "plots" / "comparison-per-mesh-all.svg").read_text().startswith("<?xml")
    for link in ("sheets/comparison-ball.jpg", "plots/comparison-per-mesh-all.svg"):
        assert f"]({link})" in page

    # Another table shares the cell; the page keeps the first, and a third run does nothing.
    assert main([*command, "--table", "deltas"]) == 0
    assert exact.runs == 3
    page = (out / "results.md").read_text()
    assert page.index("## comparison:") < page.index("## deltas:")
    assert main([*command, "--table", "comparison", "deltas"]) == 0
    assert exact.runs == 3

    # What a method that is not asked for has found stays; the page can be had elsewhere, with its pictures.
    elsewhere = tmp_path / "docs" / "figures.md"
    elsewhere.parent.mkdir()
    assert main([*command[:-1], "ours", "--table", "comparison", "--page", str(elsewhere)]) == 0
    links = re.findall(r"\]\(([^)]+)\)", elsewhere.read_text())
    assert "figures/sheets/comparison-ball.jpg" in links
    assert all((elsewhere.parent / link).is_file() for link in links)
    assert exact.runs == 3
    assert "| SIREN |" in (out / "results.md").read_text()
    capsys.readouterr()


def test_failures_are_told_and_the_rest_is_written(
    ball: Path, tmp_path: Path, exact, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bench"
    command = ["paper", str(ball), "-o", str(out), "--preset", "smoke", "--device", "cpu"]
    assert main([*command, "--methods", "idf", "ours"]) == 1
    printed, said = capsys.readouterr()
    assert "ball, idf: failed: RuntimeError: no luck" in said
    assert "1 cells failed" in said
    assert "\nidf: failed, RuntimeError: no luck " in printed
    assert "\nOurs fine " in printed


def test_ctrl_c(ball: Path, tmp_path: Path, exact, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Exact, "run", stop)
    command = ["paper", str(ball), "-o", str(tmp_path / "bench"), "--preset", "smoke"]
    assert main(command) == 130
    assert "goes on after the last finished cell" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--table", "nosie"], "--table: there is no 'nosie'; did you mean 'noise'?"),
        (["--table", "comparison,bamf"], "--table: there is no 'bamf'; did you mean 'banf'?"),
        (["--methods", "igp-fine"], "--methods: there is no 'igp-fine'; did you mean 'ingp-fine'?"),
        (["--reference", "BALL"], "every shape is a mesh"),
    ],
)
def test_mistakes(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    out = tmp_path / "bench"
    given = [str(ball) if word == "BALL" else word for word in arguments]
    assert main(["paper", str(ball), "-o", str(out), "--preset", "smoke", *given]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (out / "results.md").exists()
