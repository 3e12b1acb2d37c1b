"""What is printed of a progress, with and without a terminal."""

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets import sample_sphere, write_cloud_ply
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.training import progress as module
from rich.console import Console


def test_times_in_words() -> None:
    said = [module.time_words(seconds) for seconds in (0.2, 59.4, 59.6, 65.1, 594.0, 596.0, 3599.0, 7260.0)]
    assert said == ["0 s", "59 s", "1 min", "1 min 10 s", "9 min 50 s", "10 min", "1 h 00 min", "2 h 01 min"]


def test_lines_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    """A line for each stage that ends, and one for each half minute between, with the time left of the stage."""
    now = [0.0]
    lines = module.Lines(clock=lambda: now[0])
    for second in (0, 10):
        now[0] = float(second)
        lines(module.Progress("samples", 0, 0, second / 10, {}))
    for second in range(191):
        now[0] = 10.0 + second
        lines(module.Progress("level 0", second, 190, second / 190, {"data": 1e-3}))
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "samples: done in 10 s"
    assert said[1] == "level 0: 16%; about 2 min 40 s left"
    assert said[-1] == "level 0: 190 steps in 3 min 10 s; data 1.0e-03"
    assert len(said) == 1 + 190 // 30 + 1


def test_the_time_left_of_a_resumed_stage_follows_from_the_steps_since() -> None:
    assert module.seconds_left(0.0, 0.6, 0.6) is None
    assert module.seconds_left(40.0, 0.6, 0.8) == pytest.approx(40.0)


def test_bars_show_elapsed_time_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where messages are further apart than rich remembers."""
    screen, now = io.StringIO(), [0.0]
    console = Console(file=screen, force_terminal=True, width=100, color_system=None)
    monkeypatch.setattr(module, "Console", lambda **_: console)
    with contextlib.suppress(KeyboardInterrupt), module.progress_bars(clock=lambda: now[0]) as report:
        report(module.Progress("preparing", 0, 0, 0.0, {}))
        report(module.Progress("preparing", 0, 0, 1.0, {}))
        report(module.Progress("level 0", 0, 100, 0.0, {}))
        now[0] = 45.0
        report(module.Progress("level 0", 50, 100, 0.5, {"data": 1e-3}))
        now[0] = 55.0
        raise KeyboardInterrupt  # what is drawn last is the state in between
    lines = screen.getvalue().splitlines()[-4:]
    for line, words in zip(lines, ("preparing.*100%", "level 0.*55 s, about 35 s left", "data 1.0e-03"), strict=False):
        assert re.search(words, line)


def test_a_counter_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    with module.counter_bar("scan", clock=lambda: now[0]) as count:
        for done in range(5):
            count(done, 4)
            now[0] += 20.0
    assert capsys.readouterr().err.splitlines() == ["scan: 50%; about 40 s left"]


def test_a_bar_can_be_shown_before_torch_is_loaded() -> None:
    code = "import sys, mplicits.pipelines.training.progress; assert not {'torch', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_scalars_are_those_that_were_reported(tmp_path: Path) -> None:
    loading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    with module.tensorboard_log(tmp_path / "logs") as log:
        for step in (0, 20, 40):
            losses = {"data": 0.5**step} if step else {}
            log(module.Progress("level 0", step, 40, step / 40, losses))
    found = loading.EventAccumulator(str(tmp_path / "logs"))
    found.Reload()
    data = [(event.step, np.float32(event.value)) for event in found.Scalars("level 0/data")]
    assert data == [(20, np.float32(0.5**20)), (40, np.float32(0.5**40))]


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
    assert main([command, given, "-o", str(tmp_path / "run"), *kind, "--tensorboard", str(tmp_path / "logs")]) == 2
    assert re.search(r"--tensorboard: .*pip install mplicits\[tensorboard\]\n$", capsys.readouterr().err)
    assert set(tmp_path.iterdir()) == {cloud}
