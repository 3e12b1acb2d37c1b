"""Scalars for TensorBoard are those that were reported; without tensorboard a command says so before any work."""

import sys
from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets import sample_sphere, write_cloud_ply
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.training.report import Progress
from mplicits.pipelines.training.tensorboard import tensorboard_log


def test_scalars_are_those_that_were_reported(tmp_path: Path) -> None:
    loading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    with tensorboard_log(tmp_path / "logs") as log:
        for step in (0, 20, 40):
            losses = {"data": 0.5**step} if step else {}
            log(Progress("level 0", step, 40, step / 40, losses))
    found = loading.EventAccumulator(str(tmp_path / "logs"))
    found.Reload()
    data = [(event.step, event.value) for event in found.Scalars("level 0/data")]
    assert [step for step, _ in data] == [20, 40]
    np.testing.assert_array_equal([value for _, value in data], np.float32([0.5**20, 0.5**40]))


@pytest.mark.parametrize("command", ["fit", "evolve", "reconstruct"])
def test_without_tensorboard_nothing_is_begun(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = tmp_path / "ball.ply"
    write_cloud_ply(cloud, sample_sphere(100))
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
    given = {"fit": str(cloud), "evolve": "sphere:0.5", "reconstruct": str(tmp_path)}[command]
    kind = ["--kind", "transport"] if command == "evolve" else []
    code = main([command, given, "-o", str(tmp_path / "run"), *kind, "--tensorboard", str(tmp_path / "logs")])
    assert code == 2
    error = capsys.readouterr().err
    assert error == "mplicits: error: --tensorboard: needs tensorboard; pip install mplicits[tensorboard]\n"
    assert not (tmp_path / "run").exists()
    assert not (tmp_path / "logs").exists()
