"""The benchmark of consistency, at its smallest."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fields import solve_sphere
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct.objective import SceneObjective
from reconstructions import SMALL_PATCHES, TINY_SCENE, painted_sphere, scene_parts
from torch import Tensor

from benchmarks.__main__ import main
from benchmarks.scenes.consistency import only


def test_a_row_for_each_choice_of_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scene_model, "fit_sphere", solve_sphere)
    small = "--widths 16 16 --depths 1 1 --color-width 16 --color-depth 1 --color-grid 8 --rays 16 --uniform 8"
    words = f"consistency --views 6 --size 24x18 --samples 1 {small} --importance 4 --march-grid 12 --start sphere"
    words += " --parts none both --steps 4 --resolution 24 --eval-samples 500"
    assert main([*words.split(), "-o", str(tmp_path), "--json", str(tmp_path / "figures.json")]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("both, seed 0", "accuracy", "completeness", "flat °", "MiB"))
    (table,) = json.loads((tmp_path / "figures.json").read_text())["tables"]
    assert [row["name"] for row in table["rows"]] == ["none, seed 0", "both, seed 0"]
    assert all(number > 0 for row in table["rows"] for number in row["values"][:5])  # angles need finer meshes
    assert main([*words.split(), "-o", str(tmp_path / "other"), "--consistency", "0"]) == 2
    assert "give it a weight" in capsys.readouterr().err


def terms() -> dict[str, Tensor]:
    """Of a step late in a training of a painted sphere."""
    images, config = painted_sphere(4, 16), replace(TINY_SCENE, consistency=0.5)
    parts, others = scene_parts(images, config)
    made = SceneObjective(*parts, **others).losses(0, 0.9)[0]
    return {name: term.detach() for name, term in made.items()}


@pytest.mark.parametrize(("parts", "absent"), [("correlation", "flatness"), ("flatness", "consistency")])
def test_one_part_alone_leaves_the_other_out(parts: str, absent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_model, "fit_sphere", solve_sphere)
    monkeypatch.setattr(SceneObjective, "patches", SMALL_PATCHES)
    whole = terms()
    with only(parts):
        alone = terms()
    assert float(whole[absent]) > float(alone[absent]) == 0
    (left,) = {"consistency", "flatness"} - {absent}
    torch.testing.assert_close(alone[left], whole[left])
