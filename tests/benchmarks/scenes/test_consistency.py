"""The benchmark of consistency, at its smallest."""

import json
from pathlib import Path

import pytest
from fields import solve_sphere
from mplicits.pipelines.reconstruct import model as scene_model

from benchmarks.__main__ import main


def test_a_row_for_each_weight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_model, "fit_sphere", solve_sphere)
    small = "--widths 16 16 --depths 1 1 --color-width 16 --color-depth 1 --color-grid 8 --rays 16 --uniform 8"
    words = f"consistency --views 6 --size 24x18 --samples 1 {small} --importance 4 --march-grid 12 --start sphere"
    words += " --weights 0 0.5 --train-steps 4 3 --resolution 24 --eval-samples 500"
    assert main([*words.split(), "-o", str(tmp_path), "--json", str(tmp_path / "figures.json")]) == 0
    assert "weight 0.5" in capsys.readouterr().out
    figures = json.loads((tmp_path / "figures.json").read_text())
    text = json.dumps(figures)
    assert all(name in text for name in ("accuracy", "completeness", "flat_angle", "memory"))
    assert main([*words.split(), "--consistency", "1"]) == 2
    assert main([*words.replace("4 3", "4").split(), "-o", str(tmp_path / "other")]) == 2
