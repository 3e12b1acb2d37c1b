"""``python -m benchmarks paper``: mistakes before any work, and a whole bench with a method that knows the answer."""

import csv
import json
import re
from pathlib import Path

import imageio.v3 as iio
import pytest
from benches import RADIUS, Exact
from evolutions import fails

from benchmarks.cli import main
from benchmarks.harness.jobs import Registry
from benchmarks.paper import bench, names


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> dict[str, Exact]:
    """The methods of the paper by their names; IDF fails."""
    titles = {"ours": "Ours fine", "siren": "SIREN"}
    methods = [Exact(name, None if name == "idf" else RADIUS, title=titles.get(name, name)) for name in names.METHODS]
    monkeypatch.setattr(bench, "REGISTRY", Registry(methods))
    monkeypatch.setattr(bench, "sgemm_rate", lambda *_, **__: 1e9)
    return {method.name: method for method in methods}


def runs(exact: dict[str, Exact]) -> int:
    return sum(method.runs for method in exact.values())


def test_a_bench(ball: Path, tmp_path: Path, exact, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "bench"
    command = f"paper {ball} -o {out} --preset smoke --device cpu --methods ours,siren".split()
    figures = tmp_path / "figures.json"
    assert main([*command, "--table", "comparison", "--json", str(figures)]) == 0
    assert runs(exact) == 2
    assert "\nSIREN " in capsys.readouterr().out
    page = (out / "results.md").read_text()
    assert f"python -m benchmarks paper {ball.name} -o {out.name} --preset smoke" in page
    with (out / "comparison.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    first = json.loads(figures.read_text())[0]["tables"][0]["rows"][0]
    assert float(rows["Ours fine"]["mean CD"]) == first["values"][0]
    kept = json.loads((out / "comparison.json").read_text())["records"]
    assert [record["outputs"][0]["name"] for record in kept] == ["Ours fine", "SIREN"]
    assert kept[0]["outputs"][0]["chamfer"] == first["values"][0]
    assert iio.imread(out / "sheets" / "comparison-ball.jpg").shape == (136, 4 * 108, 3)
    assert (out / "plots" / "comparison-per-mesh-all.svg").read_text().startswith("<?xml")
    for link in ("sheets/comparison-ball.jpg", "plots/comparison-per-mesh-all.svg"):
        assert f"]({link})" in page

    # Another table shares the job; the page keeps the first, and a third run does nothing.
    assert main([*command, "--table", "deltas"]) == 0
    assert runs(exact) == 3
    page = (out / "results.md").read_text()
    assert page.index("## comparison:") < page.index("## deltas:")
    assert main([*command, "--table", "comparison", "deltas"]) == 0
    assert runs(exact) == 3

    # Results of methods left out of the command stay; the page can be written elsewhere, with its pictures.
    elsewhere = tmp_path / "docs" / "figures.md"
    elsewhere.parent.mkdir()
    assert main([*command[:-1], "ours", "--table", "comparison", "--page", str(elsewhere)]) == 0
    links = re.findall(r"\]\(([^)]+)\)", elsewhere.read_text())
    assert "figures/sheets/comparison-ball.jpg" in links
    assert all((elsewhere.parent / link).is_file() for link in links)
    assert runs(exact) == 3
    assert "| SIREN |" in (out / "results.md").read_text()


def test_failures_are_told_and_the_rest_is_written(
    ball: Path, tmp_path: Path, exact, capsys: pytest.CaptureFixture[str]
) -> None:
    command = f"paper {ball} -o {tmp_path} --preset smoke --device cpu --methods idf ours"
    assert main(command.split()) == 1
    printed, said = capsys.readouterr()
    assert "ball, idf: failed: RuntimeError: no luck" in said
    assert all(part in printed for part in ("\nidf: failed, RuntimeError: no luck ", "\nOurs fine "))


def test_ctrl_c(ball: Path, tmp_path: Path, exact, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Exact, "run", stop)
    assert main(f"paper {ball} -o {tmp_path} --preset smoke".split()) == 130
    assert "goes on after the last finished job" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--table nosie", "--table: there is no 'nosie'; did you mean 'noise'?"),
        ("--table comparison,bamf", "--table: there is no 'bamf'; did you mean 'banf'?"),
        ("--methods igp-fine", "--methods: there is no 'igp-fine'; did you mean 'ingp-fine'?"),
        ("--reference BALL", "every shape is a mesh"),
    ],
)
def test_mistakes(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, message: str) -> None:
    line = f"paper {ball} -o {tmp_path / 'bench'} --preset smoke {words.replace('BALL', str(ball))}"
    assert message in fails(capsys, line, main)
    assert not (tmp_path / "bench" / "results.md").exists()
