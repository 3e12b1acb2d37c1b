"""Reconstruction from files to files: what a run holds, where it is, how it is interrupted and resumed."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from evolutions import fails
from fits import assert_same, interrupt
from mplicits.datasets import read_cloud
from mplicits.datasets.clouds.cleaning.orientation import fibonacci_directions
from mplicits.datasets.synthetic.samples import sample_surface
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import PosedImage, PosedImages
from mplicits.datasets.views.writing import write_neus, write_transforms
from mplicits.neural_fields import ColorNetwork, InputError, Similarity, Sphere, extract_mesh, load_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.mesh.extract import MeshOptions, mesh_run
from mplicits.pipelines.reconstruct import hull, train
from mplicits.pipelines.reconstruct.model import SceneModel
from mplicits.pipelines.reconstruct.train import reconstruct, surface_colors
from mplicits.pipelines.surface.measure import chamfer
from mplicits.pipelines.training.folder import load_state, read_record, state_bytes
from mplicits.pipelines.training.settings import ReconstructConfig, load_config
from mplicits.pipelines.training.trainer import Interrupted
from reconstructions import TINY_SCENE, painted_sphere, small_reconstructions, with_views, without
from safetensors.torch import load_file
from torch import Tensor

from benchmarks.scenes.view_faults import with_fault

WORLD = Similarity(center=(120.0, -30.0, 8.0), scale=5.0)
TINY = replace(TINY_SCENE, starts=(0.0, 0.4), steps=40, rays=16, start="sphere", texture_steps=3, test_every=3)
FLAGS = (
    "--widths 16 16 --depths 1 1 --omegas 10 15 --starts 0 0.4 --features 4 --color-width 16 --color-depth 1 "
    "--color-frequencies 2 --color-grid 8 --steps 3 --rays 16 --uniform 8 --importance 4 --texture-steps 3 --quiet "
    "--march-grid 8 --start sphere"
)


@pytest.fixture(autouse=True)
def _small_reconstructions(monkeypatch: pytest.MonkeyPatch) -> None:
    small_reconstructions(monkeypatch)


def moved(images: PosedImages, similarity: Similarity) -> PosedImages:
    """Images of the unit sphere as if all had happened elsewhere."""

    def there(_: int, view: PosedImage) -> PosedImage:
        pose = view.camera.world_from_camera.clone()
        pose[:3, 3] = torch.from_numpy(similarity.to_input(view.camera.eye.numpy()))
        return replace(view, camera=replace(view.camera, world_from_camera=pose))

    return replace(with_views(images, there), similarity=similarity, points=similarity.to_input(images.points))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A painted sphere of radius 3 around WORLD.center, in NeuS's files."""
    folder = tmp_path_factory.mktemp("data") / "sphere"
    write_neus(folder, moved(painted_sphere(6, 12, 2), WORLD))
    return folder


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        small_reconstructions(patch)
        reconstruct(data, TINY, out=directory)
    return directory


def contents(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in run.iterdir() if path.name != "run.lock"}


def assert_same_run(first: Path, second: Path) -> None:
    """That the fields and textures of two runs are the same to the bit."""
    for name in ("field.safetensors", "texture.safetensors"):
        torch.testing.assert_close(load_file(second / name), load_file(first / name), rtol=0, atol=0)


def test_the_run_directory(finished: Path, data: Path) -> None:
    names = {name.split(".")[0] for name in contents(finished)}
    assert names == {"field", "held_out", "radiance", "run", "support", "texture"}
    record = read_record(finished)
    assert record["finished"] is True
    assert record["data"] == str(data / "cameras_sphere.npz")
    assert record["views"] == {"trained": 4, "held_out": 2}
    assert record["region"] == "scale_mat_i of cameras_sphere.npz"
    assert (record["steps"], record["texture"]["steps"]) == (40, 3)
    assert set(record["held_out"]["views"]) == {"image/000.png", "image/003.png"}
    for name in ("psnr", "ssim", "psnr_object"):
        figures = [view[name] for view in record["held_out"]["views"].values()]
        assert record["held_out"][name] == pytest.approx(np.mean(figures))
    assert load_config(ReconstructConfig, None, record["config"]) == TINY


def test_the_mesh_is_in_world_coordinates(finished: Path, tmp_path: Path) -> None:
    mesh_run(finished, tmp_path / "mesh.ply", MeshOptions(resolution=48))
    vertices = read_cloud(tmp_path / "mesh.ply")
    radii = np.linalg.norm(vertices.points - np.array(WORLD.center), axis=1) / WORLD.scale
    assert 0.3 < radii.min() < radii.max() < 0.8  # the start of radius 0.5, after a few steps towards 0.6
    assert vertices.colors is not None


def test_what_comes_back_is_what_was_written(data: Path, finished: Path) -> None:
    run = reconstruct(data, TINY)
    assert run.directory is None
    assert run.texture is not None
    assert_same(run.model.geometry, load_field(finished / "field.safetensors").field)
    assert run.record["held_out"]["psnr"] == read_record(finished)["held_out"]["psnr"]


def test_pictures_without_masks_have_an_outside() -> None:
    run = reconstruct(without(painted_sphere(4, 12), "mask"), replace(TINY, steps=2, texture_steps=0))
    assert run.model.outside is not None
    assert "psnr_object" not in run.record["held_out"]


def test_measured_depths_are_used_as_soon_as_there_are_any(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def in_world(_: int, view: PosedImage) -> PosedImage:
        return replace(view, depth=replace(view.depth, numbers=view.depth.numbers * np.float32(WORLD.scale)))

    data, run = tmp_path / "data", tmp_path / "run"
    write_neus(data, with_views(moved(painted_sphere(5, 12, depths=True), WORLD), in_world))
    command = f"reconstruct {data} -o {run} {FLAGS} --depth-maps {data / 'depths'}"
    assert main(command.split()) == 0
    record = read_record(run)
    assert record["measured_depths"] > 50
    assert record["config"]["depth_maps"] == str(data / "depths")
    assert "depth" in record["losses"]
    # In other units than the cameras they are refused before anything is trained.
    assert "--depth-scale" in fails(capsys, f"{command} --force --depth-scale 1000")
    assert read_record(run) == record
    assert main(f"{command} --force --depth-scale 1000 --depth-kind relative".split()) == 0
    assert main(f"{command} --force --depth-weight 0".split()) == 0
    assert "measured_depths" not in read_record(run)


@pytest.mark.parametrize(("stage", "step"), [("reconstruct", 20), ("held-out views", 1)])
def test_an_interrupted_run_is_usable_and_resumes_to_the_same_bits(
    data: Path, finished: Path, tmp_path: Path, stage: str, step: int
) -> None:
    with pytest.raises((Interrupted, KeyboardInterrupt)):
        reconstruct(data, TINY, out=tmp_path, progress=interrupt(stage, step))
    assert read_record(tmp_path)["finished"] is False
    assert load_field(tmp_path / "field.safetensors").field.num_levels == 2
    assert len(mesh_run(tmp_path, tmp_path / "mesh.ply", MeshOptions(resolution=32)).faces) > 100
    record, whole = reconstruct(data, out=tmp_path, resume=True).record, read_record(finished)
    assert (record["finished"], record["steps"]) == (True, 40)
    assert (record["losses"], record["held_out"]) == (whole["losses"], whole["held_out"])
    assert not (tmp_path / "resume.safetensors").exists()
    assert_same_run(finished, tmp_path)


def test_nothing_is_lost_while_the_texture_is_trained(data: Path, tmp_path: Path) -> None:
    config = replace(TINY, steps=2, texture_steps=21)
    with pytest.raises(Interrupted, match="checkpoint"):
        reconstruct(data, config, out=tmp_path, progress=interrupt("texture", 20))
    assert read_record(tmp_path)["finished"] is False
    texture = reconstruct(data, out=tmp_path, resume=True).record["texture"]
    assert (texture["finished"], texture["steps"]) == (True, 21)


@pytest.fixture
def stopped(data: Path, tmp_path: Path) -> Path:
    directory = tmp_path / "stopped"
    with pytest.raises(Interrupted):
        reconstruct(data, TINY, out=directory, progress=interrupt("reconstruct", 20))
    return directory


def test_other_pictures_are_refused(stopped: Path, tmp_path: Path) -> None:
    images = moved(painted_sphere(6, 12, 2), WORLD)
    held, last = contents(stopped), images.views[-1]
    pose = last.camera.world_from_camera.clone()
    pose[0, 3] += 0.01
    others = {
        "colour": [replace(last, color=1 - last.color)],
        "mask": [replace(last, mask=1 - last.mask)],
        "camera": [replace(last, camera=replace(last.camera, world_from_camera=pose))],
        "fewer": [],
    }
    for name, other in others.items():
        write_neus(tmp_path / name, replace(images, views=(*images.views[:-1], *other)))
        with pytest.raises(InputError, match=r"not the pictures that .* was trained on; resume with those"):
            reconstruct(tmp_path / name, out=stopped, resume=True)
    assert contents(stopped) == held


def test_the_command_leaves_a_coloured_mesh(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    assert main(f"reconstruct {data} -o {run} {FLAGS}".split()) == 0
    output = capsys.readouterr().out
    assert f"{data / 'cameras_sphere.npz'}: 5 views, 3 steps" in output
    assert "1 held-out views: PSNR" in output
    assert f"next: mplicits view {run}" in output
    assert (run / "mesh.ply").read_bytes().startswith(b"ply")

    assert "--force" in fails(capsys, f"reconstruct {data} -o {run} {FLAGS}")
    # A mistake in the new run costs nothing of the old one.
    held = contents(run)
    assert "no such file" in fails(capsys, f"reconstruct {tmp_path / 'nowhere'} -o {run} --force {FLAGS}")
    assert contents(run) == held
    # A new one leaves nothing of it.
    assert main(f"reconstruct {data} -o {run} --force {FLAGS} --texture-steps 0 --test-every 0".split()) == 0
    assert {name.split(".")[0] for name in contents(run)} == {"field", "mesh", "radiance", "run", "support"}
    record = read_record(run)
    assert (record["views"], record["held_out"]) == ({"trained": 6, "held_out": 0}, None)
    assert record["texture"] is None
    assert "is finished, so there is nothing to resume" in fails(capsys, f"reconstruct {data} -o {run} --resume")


def test_a_contradicted_picture_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd = with_views(painted_sphere(12, 12), lambda k, v: replace(v, mask=0 * v.mask) if k == 2 else v)
    write_neus(tmp_path / "odd", odd)
    assert main(f"reconstruct {tmp_path / 'odd'} -o {tmp_path / 'run'} {FLAGS} --texture-steps 0".split()) == 0
    assert "left out: image/002.png\n" in capsys.readouterr().err
    record = read_record(tmp_path / "run")
    assert record["left_out"] == ["image/002.png"]
    assert record["views"] == {"trained": 9, "held_out": 2}


def test_what_is_behind_holes_of_masks_is_not_learnt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits = hull.Limits(few=4)
    monkeypatch.setattr(hull, "Limits", lambda: limits)
    torn = with_fault(painted_sphere(6, 24), "holes")
    write_neus(tmp_path / "torn", torn)
    assert main(f"reconstruct {tmp_path / 'torn'} -o {tmp_path / 'run'} {FLAGS} --texture-steps 0".split()) == 0
    missing = (torn.views[3].mask > 0.5) & (torn.views[2].mask <= 0.5)
    assert read_record(tmp_path / "run")["mask_holes"] == {"image/002.png": missing.sum()}


def test_the_command_says_how_to_go_on(
    stopped: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "--resume continues it" in fails(capsys, f"reconstruct {data} -o {stopped}")
    assert "run's own settings" in fails(capsys, f"reconstruct {data} -o {stopped} --resume --steps 3")

    def interrupted(*_: object, **__: object) -> None:
        raise Interrupted(stopped)

    monkeypatch.setattr("mplicits.pipelines.reconstruct.train.reconstruct", interrupted)
    assert main(["reconstruct", str(data), "-o", str(stopped), "--resume", "--quiet"]) == 130
    assert f"to continue: mplicits reconstruct {data} -o {stopped} --resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--widths 16", "depths: 2 entries for 1 widths"),
        ("--starts 0.5 0.6", "starts: (0.5, 0.6); expected 0 first"),
        ("--starts 0 1", "starts: (0.0, 1.0); expected 0 first, then growing shares below 1"),
        ("--ryas 8", "unknown flag --ryas; did you mean '--rays'?"),
        ("--device abacus", "device"),
    ],
)
def test_settings_that_make_no_sense_are_refused_at_once(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: str, message: str
) -> None:
    assert message in fails(capsys, f"reconstruct {data} -o {tmp_path / 'run'} {flags}")
    assert not (tmp_path / "run").exists()


def test_pictures_that_cannot_be_used_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert str(tmp_path) in fails(capsys, f"reconstruct {tmp_path} -o {tmp_path / 'run'} {FLAGS}")
    away = replace(moved(painted_sphere(2, 8), Similarity((0, 0, 90), 1.0)), similarity=Similarity.identity())
    write_neus(tmp_path / "away", away)
    message = fails(capsys, f"reconstruct {tmp_path / 'away'} -o {tmp_path / 'run'} {FLAGS}")
    assert "no pixel of any picture sees the region of interest; see `mplicits check-cameras`" in message


@pytest.mark.slow
def test_a_painted_sphere_is_recovered_from_its_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """24 views of 64², somewhere in the world, whose region is found from their masks; a minute or two."""
    monkeypatch.undo()  # begins as a user's training does
    scene = SCENES["painted-sphere"]()
    write_transforms(tmp_path / "data", moved(render_scene(scene, views=24, size=64), WORLD))
    small = {"widths": (64, 96), "depths": (2, 3), "features": 16, "color_width": 96, "color_depth": 2}
    few = {"steps": 600, "rays": 128, "uniform": 24, "importance": 24, "texture_steps": 0}
    config = load_config(ReconstructConfig, "fast", small | few)
    run = reconstruct(tmp_path / "data", config)
    assert "masks" in run.images.region
    mesh = extract_mesh(run.model.geometry, resolution=128)
    # What is beyond the region of interest was in no view.
    seen = mesh.vertices[np.linalg.norm(mesh.vertices, axis=1) < 1]
    here = WORLD.to_unit(run.images.similarity.to_input(seen))
    assert abs(np.linalg.norm(here, axis=1) - 0.6).mean() < 0.004
    assert sum(chamfer(here, sample_surface(scene.field, 20_000).points)) < 3e-4
    assert run.record["held_out"]["psnr"] > 27
    assert run.record["inv_std"] > 100


def test_a_budget_counts_all_but_leaves_most_for_the_training(data: Path, tmp_path: Path) -> None:
    """The texture alone would take longer: it gets what is left."""
    config = replace(TINY, steps=10**6, texture_steps=10**6, time_budget=2.0)
    record = reconstruct(data, config, out=tmp_path / "run").record
    assert record["training_seconds"] < record["budget"]["seconds"] == 2.0
    assert record["steps"] < config.steps
    assert record["texture"]["steps"] < config.texture_steps
    assert record["texture"]["budget"]["seconds"] < 2.0


@pytest.mark.parametrize(
    ("room", "measured"),
    [(9000.0, None), (6000.0, "1 of 2 held-out views are measured, at 64 × 64"), (500.0, "at 32 × 32")],
)
def test_as_many_held_out_views_are_measured_as_a_budget_has_room_for(
    room: float, measured: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pixel takes a second. A single view that is too large is measured small."""
    monkeypatch.setattr(train._Reconstruction, "_pixel_seconds", lambda _: 1.0)
    monkeypatch.setattr(train._Reconstruction, "left", lambda _: room)
    write_neus(tmp_path / "data", painted_sphere(6, 64, 1))
    record = reconstruct(tmp_path / "data", replace(TINY, texture_steps=0, time_budget=2.0)).record
    notes = " ".join(record["budget"]["notes"])
    assert len(record["held_out"]["views"]) == (1 if measured else 2)
    assert measured in notes if measured else "measured" not in notes


class Glossy(ColorNetwork):
    """Paint of 0.3 + 0.4 x, under a lamp that is reflected."""

    def forward(self, x: Tensor, direction: Tensor, jet: Any) -> Tensor:
        normal = torch.nn.functional.normalize(jet.gradient, dim=-1)
        halfway = torch.nn.functional.normalize(torch.tensor([0.6, 0.8, 0.0]) - direction, dim=-1)
        return 0.3 + 0.4 * x + 0.5 * (normal * halfway).sum(dim=-1, keepdim=True).clamp(min=0) ** 40


def test_colours_of_the_surface_are_without_highlights() -> None:
    model = SceneModel(Sphere(radius=0.5), Glossy(0, width=1, depth=1), None, torch.zeros(3))
    points = 0.5 * torch.from_numpy(fibonacci_directions(500)).float()
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    eyes = 2 * torch.from_numpy(fibonacci_directions(40)).float() @ turn.T
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    wrong, ahead = (  # the second has fewer than three eyes
        (surface_colors(model, points, some) - 0.3 - 0.4 * points).abs().amax(dim=1) for some in (eyes[order], eyes[:2])
    )
    assert float(ahead.max()) > 0.45  # the highlight, head-on
    # It is 0.5 high where n · h = 1 and half of that 11° away, which turns the eye by twice as much: of nine eyes
    # within 60° some are there, and the third darkest is well off its middle.
    assert float(wrong.max()) < 0.2 * float(ahead.max())
    assert float(wrong.mean()) < 0.05 * float(ahead.mean())


def test_the_colour_is_the_lower_quartile_of_those_that_face_a_point() -> None:
    class Direction(ColorNetwork):
        """Everything is coloured by where it is seen from."""

        def forward(self, x: Tensor, direction: Tensor, jet: Any) -> Tensor:
            return 0.5 - 0.5 * direction

    model = SceneModel(Sphere(radius=0.5), Direction(0, width=1, depth=1), None, torch.zeros(3))
    top = torch.tensor([[0.0, 0.0, 0.5]])
    eyes = torch.tensor([[0.3, 0.1, 2.0], [0.0, 0.0, -2.0], [0.1, -0.4, 2.0], [-0.2, 0.2, 2.0], [5.0, 0.0, 0.6]])
    facing = torch.nn.functional.normalize(eyes[[0, 2, 3]] - top, dim=1)
    wanted = 0.5 + 0.5 * facing.quantile(0.25, dim=0)
    torch.testing.assert_close(surface_colors(model, top, eyes)[0], wanted, atol=1e-6, rtol=0)
    alone = surface_colors(model, top, eyes[:3])[0]  # two of them face it: the colour along the normal
    torch.testing.assert_close(alone, torch.tensor([0.5, 0.5, 1.0]), atol=1e-6, rtol=0)


def test_meshes_of_what_is_visible(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Cameras stand all around the sphere, so that its mesh stays; with the points of a side, that side is left."""
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    whole = mesh_run(run, tmp_path / "whole.ply", MeshOptions(resolution=32))
    assert main(["mesh", str(run), "-o", str(tmp_path / "seen.ply"), "--resolution", "32", "--seen"]) == 0
    held, about = load_state(run, name="support.safetensors")
    upper = held["points"][:, 2] > 0
    (run / "support.safetensors").write_bytes(state_bytes({**held, "points": held["points"][upper]}, about))
    said: list[str] = []
    part = mesh_run(run, tmp_path / "part.ply", MeshOptions(resolution=32, seen=True), say=said.append)
    assert len(part.faces) < 0.8 * len(whole.faces)
    assert part.vertices[:, 2].min() > -0.2
    assert any("fewer than two photographs" in line for line in said)
    (run / "support.safetensors").write_bytes(state_bytes({"points": held["points"]}, about))
    capsys.readouterr()
    assert main(["mesh", str(run), "-o", str(tmp_path / "seen.ply"), "--seen"]) == 2
    assert "support.safetensors: damaged" in capsys.readouterr().err
