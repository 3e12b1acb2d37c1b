"""Fits in tiles: one field of many, signs that agree, what is refused, what is resumed."""

import dataclasses
import json
from pathlib import Path

import mplicits.neural_fields as nf
import numpy as np
import pytest
import torch
from mplicits.neural_fields.fields.tiled import Split, Tile, TiledField
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.fit import tiles
from mplicits.pipelines.fit.tiles import compare_tiles, fit_tiles, plan_fit
from mplicits.pipelines.surface.surface import components, is_closed, read_surface
from mplicits.pipelines.training.folder import find_field, load_still
from mplicits.pipelines.training.jobs import check_jobs
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import Interrupted, Progress
from refusals import refused

CENTER, RADIUS = np.array([4.5e5, 200.0, 10.0]), 50.0
SMALL = FitConfig(
    widths=(32, 32),
    depths=(2, 1),
    omegas=(12.0, 20.0),
    steps=(150, 40),
    learning_rates=(3e-3, 1e-3),
    batch=512,
    samples=6000,
    device="cpu",
)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20,000 points of a ball in map coordinates, with their normals."""
    normals = np.random.default_rng(0).normal(size=(20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    path = tmp_path_factory.mktemp("cloud") / "ball.npy"
    np.save(path, np.hstack((RADIUS * normals + CENTER, normals)))
    return path


@pytest.fixture(scope="module")
def run(ball: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ball in eight tiles."""
    out = tmp_path_factory.mktemp("runs") / "ball"
    job = plan_fit(ball, out, SMALL, size=60.0)
    assert fit_tiles(job).record["finished"]
    return out


def test_tiles_are_one_closed_surface_with_the_inside_inside(run: Path, tmp_path: Path) -> None:
    field, similarity, metadata = load_still(run)
    assert isinstance(field, TiledField)
    assert (field.num_tiles, len(metadata["run"]["tiles"])) == (8, 8)
    assert [tile["sign"] for tile in metadata["run"]["tiles"]] == [1] * 8
    assert main(["mesh", str(run), "-o", str(tmp_path / "ball.ply"), "--resolution", "64"]) == 0
    mesh = read_surface(tmp_path / "ball.ply")
    assert (components(mesh), is_closed(mesh)) == (1, True)
    off = np.linalg.norm(mesh.vertices - CENTER, axis=1) - RADIUS
    # Every point of the field is within the error of some tile, or between two of them.
    assert np.abs(off).max() < 0.02 * RADIUS
    world = nf.WorldField(field, similarity)
    assert world.distance(CENTER[None])[0] < 0 < world.distance(CENTER[None] + [0, 0, 2 * RADIUS])[0]
    assert not (run / "points").exists()
    assert metadata["run"]["seams"]["opposed"] == 0


def test_signs_follow_what_tiles_agree_on() -> None:
    """One tile is inside out: it, and not the three others, is turned."""
    ball = nf.Sphere(radius=0.6)
    splits = [Split(0, 0.0, 0.1, 1, 2), Split(1, 0.0, 0.1, -1, -2), Split(1, 0.0, 0.1, -3, -4)]
    tiles_of = [Tile(ball, nf.Similarity.identity(), sign) for sign in (1, 1, -1, 1)]
    field = TiledField(tiles_of.__getitem__, splits, reach=0.2).double()
    points = 0.6 * torch.nn.functional.normalize(torch.randn(4000, 3, dtype=torch.float64), dim=1)
    seams = compare_tiles(field, points, turn=True)
    assert (seams.signs, seams.opposed) == ((1, 1, -1, 1), 0)
    assert seams.gap < 1e-12
    left = compare_tiles(field, points, turn=False)
    assert (left.signs, left.opposed) == ((1, 1, 1, 1), 3)
    assert left.gap > 0.1


def test_an_interrupted_fit_goes_on_with_its_own_plan(ball: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"

    def stop(name: str, step: Progress) -> None:
        if name == "0001" and step.stage == "level 0" and step.step > 20:
            raise KeyboardInterrupt

    quick = dataclasses.replace(SMALL, steps=(60, 2), samples=500)
    job = plan_fit(ball, out, quick, size=120.0)
    assert job.plan.num_tiles == 1
    assert fit_tiles(job).field.num_tiles == 1
    job = plan_fit(ball, out, quick, size=90.0)
    with pytest.raises((KeyboardInterrupt, Interrupted)):
        fit_tiles(job, progress=stop)
    again = plan_fit(ball, out, None, resume=True)
    assert (again.plan, again.config) == (job.plan, quick)
    first = (out / "tiles" / "0000" / "field.safetensors").read_bytes()
    assert main(["fit", str(ball), "-o", str(out), "--resume", "--quiet"]) == 0  # it is known to be one of tiles
    assert (out / "tiles" / "0000" / "field.safetensors").read_bytes() == first
    assert find_field(out).is_file()


def test_a_failed_tile_is_named_and_nothing_is_joined(ball: Path, tmp_path: Path) -> None:
    quick = dataclasses.replace(SMALL, steps=(5, 2), samples=500)
    job = plan_fit(ball, tmp_path / "run", quick, size=90.0)
    (tmp_path / "run" / "points" / "0001.npy").write_bytes(b"")
    with refused(tmp_path / "run", "1 of .* tiles failed, tile 0001: .*empty"):
        fit_tiles(job)
    assert not (tmp_path / "run" / "field.safetensors").exists()


def test_mistakes_cost_no_work(ball: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(*words: object) -> str:
        assert main(["fit", *map(str, words)]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    new = tmp_path / "new"
    assert "name only one" in told(ball, ball, "-o", new, "--tiles", "auto")
    assert "--mesh" in told(ball, "-o", new, "--tiles", "auto", "--mesh", "x.ply")
    assert "--ray-address" in told(ball, "-o", new, "--ray-address", "auto")
    assert "not empty" in told(ball, "-o", run, "--tiles", "auto")
    assert "nothing to resume" in told(ball, "-o", new, "--tiles", "auto", "--resume")
    assert not new.exists()
    other = tmp_path / "other.npy"
    other.write_bytes(ball.read_bytes())
    assert "has changed" in told(other, "-o", run, "--tiles", "auto", "--resume")
    about = json.loads((run / tiles.PLAN_FILE).read_text())
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / tiles.PLAN_FILE).write_text(json.dumps(about | {"plan": {}}))
    assert "damaged" in told(ball, "-o", tmp_path / "damaged", "--tiles", "auto", "--resume")


def test_a_cluster_needs_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with refused("--ray-address here", "pip install mplicits"):
        check_jobs(1, "here")


def test_the_command_says_how_far_it_is(ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--widths", "16", "--depths", "1", "--omegas", "10", "--steps", "20", "--learning-rates", "1e-2"]
    words += ["--batch", "64", "--samples", "2000", "--device", "cpu", "--tile-size", "90"]
    assert main(["fit", str(ball), "-o", str(tmp_path / "run"), *words]) == 0
    captured = capsys.readouterr()
    assert "0001: fitted after" in captured.err
    assert "TiledField" in captured.out
    assert f"mplicits mesh {tmp_path / 'run'}" in captured.out
