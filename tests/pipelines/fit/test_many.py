"""Many clouds in one command: what is checked first, what fails alone, what is resumed."""

import importlib.util
import signal
from pathlib import Path

import pytest
import torch
from mplicits.datasets import sample_sphere, sample_torus, write_cloud_ply
from mplicits.neural_fields import load_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.fit.many import fit_many, plan_fits
from mplicits.pipelines.training.folder import STATE_FILE, find_field, read_record
from mplicits.pipelines.training.settings import FitConfig, load_config
from mplicits.pipelines.training.trainer import Interrupted, Progress

SMALL = (
    *("--widths", "16", "--depths", "1", "--omegas", "15", "--steps", "30", "--learning-rates", "1e-2"),
    *("--batch", "64", "--samples", "500", "--device", "cpu"),
)


@pytest.fixture
def clouds(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / "ball.ply", tmp_path / "ring.ply"]
    for path, cloud in zip(paths, (sample_sphere(300), sample_torus(300)), strict=True):
        write_cloud_ply(path, cloud)
    (tmp_path / "broken.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    return paths


def weights(directory: Path) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in load_field(find_field(directory)).field.parameters()])


def run(*words: object) -> int:
    return main(["fit", *map(str, words)])


def test_a_run_for_each_and_one_failure(clouds: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "runs"
    assert run(clouds[0], tmp_path / "broken.ply", clouds[1], "-o", out, "--quiet", *SMALL) == 1
    table = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in table[2:]] == ["ball", "broken", "ring"]
    assert "failed:" in table[3]
    assert "vertex" in table[3]
    for name in ("ball", "ring"):
        assert find_field(out / name).is_file()
        record = read_record(out / name)
        assert (record["finished"], record["config"]["steps"]) == (True, [30])


def test_mistakes_cost_no_work(clouds: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "runs"
    (tmp_path / "more").mkdir()
    write_cloud_ply(tmp_path / "more" / "ball.ply", sample_sphere(50))

    def told(*words: object) -> str:
        assert run(*words) == 2
        assert not (out / "ball").exists()
        return capsys.readouterr().err

    assert "none.ply: no such file" in told(clouds[0], tmp_path / "none.ply", "-o", out, *SMALL)
    assert "would both be fitted into" in told(clouds[0], tmp_path / "more" / "ball.ply", "-o", out, *SMALL)
    assert "--mesh: is for one cloud" in told(*clouds, "-o", out, "--mesh", tmp_path / "a.ply", *SMALL)
    assert "nothing to resume" in told(*clouds, "-o", out, "--resume")
    assert "expected a whole number from 1" in told(*clouds, "-o", out, "--jobs", 0, *SMALL)
    (out / "ring").mkdir(parents=True)
    (out / "ring" / "notes.txt").write_text("mine")
    assert "ring: exists and is not empty" in told(*clouds, "-o", out, *SMALL)


def test_interrupted_runs_are_resumed_and_finished_ones_left_alone(
    clouds: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the second of two: `--resume` trains that one to its end, with the settings of the first command."""
    out, again = tmp_path / "runs", tmp_path / "again"
    assert run(*clouds, "-o", out, "--quiet", *SMALL, "--seed", 3) == 0
    expected = weights(out / "ring")
    config = load_config(FitConfig, None, read_record(out / "ball")["config"])

    def interrupt(name: str, step: Progress) -> None:
        if name == "ring" and step.step >= 20:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):
        fit_many(plan_fits(clouds, again, config), again, progress=interrupt)
    before = find_field(again / "ball").stat().st_mtime_ns
    assert (again / "ring" / STATE_FILE).is_file()
    assert run(*clouds, "-o", again, "--quiet", "--resume") == 0
    assert weights(again / "ring").equal(expected)
    assert find_field(again / "ball").stat().st_mtime_ns == before
    assert run(*clouds, "-o", again, "--quiet", "--force", *SMALL, "--seed", 4) == 0
    assert read_record(again / "ring")["config"]["seed"] == 4


@pytest.mark.slow  # test_jobs has two workers in each run; here each loads everything for a fit
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is an extra")
def test_two_workers_fit_as_one_does(clouds: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*clouds, "-o", tmp_path / "one", "--quiet", *SMALL) == 0
    assert run(clouds[0], tmp_path / "broken.ply", clouds[1], "-o", tmp_path / "two", "--jobs", 2, *SMALL) == 1
    said = capsys.readouterr()
    assert "failed:" in said.out
    assert f"{clouds[1].stem}: fitted after" in said.err
    for name in ("ball", "ring"):
        alone, beside = (read_record(tmp_path / folder / name)["stages"][-1] for folder in ("one", "two"))
        assert beside["rms_at_points"] == pytest.approx(alone["rms_at_points"], rel=1e-3)


def test_force_keeps_what_is_there_until_the_new_cloud_is_usable(clouds: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert run(clouds[0], "-o", out, "--quiet", *SMALL) == 0
    (out / STATE_FILE).write_bytes(b"of an interrupted run")
    assert run(tmp_path / "broken.ply", "-o", out, "--quiet", "--force", *SMALL) == 2
    assert (out / STATE_FILE).read_bytes() == b"of an interrupted run"
    assert run(clouds[1], "-o", out, "--quiet", "--force", *SMALL) == 0
    assert not (out / STATE_FILE).exists()
