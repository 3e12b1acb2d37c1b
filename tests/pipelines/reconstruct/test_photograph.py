"""New pictures of a finished reconstruction: those that its training has measured, and from elsewhere."""

from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from mplicits.datasets import PosedImages, write_transforms
from mplicits.neural_fields import InputError, Sphere, save_field
from mplicits.neural_fields.networks.grids import ValueGrid
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.reconstruct.photograph import open_scene, photograph
from mplicits.pipelines.reconstruct.train import Reconstruction, reconstruct
from mplicits.pipelines.reconstruct.views import render_camera
from mplicits.pipelines.render.draw import RenderOptions
from mplicits.pipelines.training.trainer import Interrupted, Progress
from reconstructions import TINY_SCENE, painted_sphere

TINY = replace(TINY_SCENE, starts=(0.0, 0.4), background="outside", steps=40, rays=16, texture_steps=0, test_every=3)


@pytest.fixture(scope="module")
def images() -> PosedImages:
    return painted_sphere(6, 12, 2)


@pytest.fixture(scope="module")
def run(images: PosedImages, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    directory = tmp_path_factory.mktemp("runs") / "run"
    write_transforms(directory.parent / "photos", images)
    return reconstruct(images, TINY, out=directory)


def test_a_held_out_view_is_seen_as_it_was_measured(run: Reconstruction, images: PosedImages, tmp_path: Path) -> None:
    grid = ValueGrid(8)
    grid.refresh(run.model.geometry)
    seen = render_camera(run.model, images.views[0].camera, Sampling(8, 4), sdf_grid=grid).color
    scene = open_scene(run.directory)
    assert scene.model.outside is not None
    # s goes through a logarithm and back: a few roundings, which its exponential makes ten times as many.
    wanted = (255 * seen).round().astype(int)
    assert np.abs(scene.paint(images.views[0].camera).astype(int) - wanted).max() <= 1
    cameras = run.directory.parent / "photos" / "transforms.json"
    out = tmp_path / "a.png"
    arguments = ["--shading", "radiance", "--cameras", str(cameras), "--frame", "0"]
    assert main(["render", str(run.directory), "-o", str(out), *arguments]) == 0
    assert np.abs(iio.imread(out).astype(int) - wanted).max() <= 1
    assert wanted.std() > 5  # it sees something


def test_it_is_seen_from_anywhere(run: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--shading", "radiance", "--size", "10", "--levels", "--sides", "2"]
    assert main(["render", str(run.directory), "-o", str(tmp_path / "a.png"), *arguments]) == 0
    assert "radiance, 10×10, 2 sides" in capsys.readouterr().out
    assert iio.imread(tmp_path / "a.png").shape == (3 * (10 + 40), 2 * (10 + 12), 3)
    steps: list[tuple[int, int]] = []
    options = RenderOptions(size=(8,), frames=3, samples=2)
    told = photograph(run.directory, tmp_path / "b.gif", options, progress=lambda *s: steps.append(s))
    assert told.endswith("radiance, 8×8, 3 frames")
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert len(iio.imread(tmp_path / "b.gif")) == 3


def test_a_run_without_colours_by_direction_is_refused(
    run: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_field(tmp_path / "field.safetensors", Sphere(radius=0.5))
    with pytest.raises(InputError, match="keeps no colours by direction"):
        open_scene(tmp_path)
    out = str(tmp_path / "a.png")
    assert main(["render", str(tmp_path), "-o", out, "--shading", "radiance"]) == 2
    assert main(["render", str(run.directory), "-o", out, "--shading", "radiance", "--background", "black"]) == 2
    assert "--background: --shading radiance has that of the photographs" in capsys.readouterr().err


@pytest.mark.slow
def test_a_new_training_over_an_old_run_takes_its_colours_away(images: PosedImages, tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        if progress.stage.startswith("reconstruct") and progress.step >= 20:
            raise KeyboardInterrupt

    again = tmp_path / "again"
    reconstruct(images, TINY, out=again)
    assert (again / "radiance.safetensors").is_file()
    with pytest.raises((Interrupted, KeyboardInterrupt)):
        reconstruct(images, replace(TINY, seed=1), out=again, progress=stop)
    if (again / "resume.safetensors").exists():
        assert not (again / "radiance.safetensors").exists()
    else:  # nothing of the new one was written, and all of the old one is there
        assert torch.is_tensor(open_scene(again).model.background)
