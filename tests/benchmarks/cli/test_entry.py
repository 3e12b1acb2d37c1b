"""``python -m benchmarks``: help, mistakes, and one benchmark from its command to its files."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from evolutions import fails

from benchmarks.cli import main
from benchmarks.cli.entry import BENCHMARKS

ROOT = Path(__file__).parents[3]


def test_it_runs_from_a_checkout() -> None:
    words = [sys.executable, "-m", "benchmarks", "--help"]
    said = subprocess.run(words, check=True, cwd=ROOT, capture_output=True, text=True).stdout
    assert all(f"  {name} " in said for name in BENCHMARKS.commands)


@pytest.mark.parametrize("name", BENCHMARKS.commands)
def test_help_of_each_has_examples_that_parse(capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert main([name, "--help"]) == 0
    assert f"usage: python -m benchmarks {name} " in capsys.readouterr().out
    examples = [line.strip() for line in BENCHMARKS.commands[name].examples.splitlines()]
    assert examples
    for example in examples:
        python, m, module, command, *rest = example.split()
        assert (python, m, module, command) == ("python", "-m", "benchmarks", name)
        parser = BENCHMARKS.parser(name)
        parser.check_flags(rest)
        parser.parse_args(rest)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("normls", "unknown command 'normls'; did you mean 'normals'?"),
        ("fit a.ply --isotropic", "--isotropic: how much noise? add --noise"),
    ],
)
def test_mistakes_are_one_line(capsys: pytest.CaptureFixture[str], words: str, message: str) -> None:
    assert message in fails(capsys, words, main)


def test_help_does_not_load_torch() -> None:
    code = "import sys; from benchmarks.cli import main; main(['--help']); sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, capture_output=True)


def test_a_table_is_printed_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures, out = tmp_path / "normals.json", tmp_path / "out"
    assert main(f"normals --points 256 --repeats 1 --json {figures} -o {out}".split()) == 0
    assert len(json.loads(figures.read_text())["records"]) == 4
    assert "autograd" in capsys.readouterr().out
    assert "python -m benchmarks normals --points 256" in (out / "results.md").read_text()
