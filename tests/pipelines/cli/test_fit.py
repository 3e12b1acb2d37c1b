"""``mplicits fit --mesh``: coloured clouds and depth maps to coloured meshes, interruptions, and mistakes."""

import functools
import json
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from evolutions import fails
from mplicits.datasets import DepthCamera, PointCloud, read_cloud, write_cloud_ply
from mplicits.neural_fields import Mesh
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.mesh import finish as fit_mesh
from mplicits.pipelines.mesh.extract import MeshOptions
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.training.progress import Lines
from mplicits.pipelines.training.settings import TextureConfig
from scipy.spatial import KDTree

CENTER = np.array([3.0, -1.0, 10.0])
SMALL = "--widths 16 --depths 1 --omegas 5 --steps 100 --learning-rates 1e-2 --batch 256 --samples 2000"
LENS = DepthCamera(96, 72, 90.0, 92.0, 46.5, 36.5)


@pytest.fixture(autouse=True)
def small(monkeypatch) -> None:
    """The default texture takes most of a minute."""
    small = TextureConfig(
        width=16, depth=2, omega=8.0, steps=150, learning_rate=1e-2, batch=256, band_batch=64, samples=4000
    )
    monkeypatch.setattr(fit_mesh, "TextureConfig", lambda: small)
    monkeypatch.setattr(fit_mesh, "MeshOptions", functools.partial(MeshOptions, resolution=48))


def painted(unit: np.ndarray) -> np.ndarray:
    """Half red, half blue, with a soft border at x = 0."""
    share = (0.5 + 1.5 * unit[:, :1]).clip(0, 1)
    return (share * (1.0, 0.2, 0.0) + (1 - share) * (0.0, 0.2, 1.0)).astype(np.float32)


def ball(*, colors: bool = True) -> PointCloud:
    unit = np.random.default_rng(0).normal(size=(3000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return PointCloud(CENTER + 2 * unit, unit.astype(np.float32), painted(unit) if colors else None)


@pytest.fixture
def cloud(tmp_path) -> Path:
    write_cloud_ply(tmp_path / "ball.ply", ball())
    return tmp_path / "ball.ply"


def run_fit(*words: object) -> int:
    return main(["fit", *map(str, words), *SMALL.split(), "--quiet"])


def check_colours(mesh: Mesh) -> None:
    out = (mesh.vertices - CENTER) / 2
    assert np.abs(np.linalg.norm(out, axis=1) - 1).mean() < 0.05
    assert np.abs(mesh.colors - painted(out)).mean() < 0.03


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_a_coloured_cloud_becomes_a_coloured_mesh(cloud: Path, tmp_path, suffix: str):
    run = tmp_path / "run"
    mesh = run / f"mesh{suffix}"  # in the folder that the fit makes
    assert run_fit(cloud, "-o", run, "--mesh", mesh, "--seed", 3) == 0
    check_colours(read_surface(mesh))
    record = json.loads((run / "run.json").read_text())
    assert record["finished"]
    assert record["texture"]["finished"]
    assert record["texture"]["config"]["seed"] == 3
    assert not (run / "resume.safetensors").exists()


@pytest.mark.parametrize(
    ("flags", "suffix", "colors"), [((), "ply", False), (("--no-colors",), "ply", True), ((), "stl", True)]
)
def test_no_texture_is_trained_where_no_colours_would_show(tmp_path, flags, suffix, colors):
    cloud, mesh = tmp_path / "ball.ply", tmp_path / f"mesh.{suffix}"
    write_cloud_ply(cloud, ball(colors=colors))
    assert run_fit(cloud, "-o", tmp_path / "run", "--mesh", mesh, *flags) == 0
    assert read_surface(mesh).colors is None
    assert not (tmp_path / "run" / "texture.safetensors").exists()


def test_the_texture_of_a_mesh_is_taken(tmp_path):
    """Colours of an OBJ with an image are in the image, and none at the vertices that are fitted."""
    sphere = trimesh.creation.icosphere(3)
    cv2.imwrite(str(tmp_path / "green.png"), np.full((4, 4, 3), (0, 255, 0), np.uint8))
    (tmp_path / "ball.mtl").write_text("newmtl a\nmap_Kd green.png\n")
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in sphere.vertices)
    faces = "".join(f"f {a}/1 {b}/1 {c}/1\n" for a, b, c in sphere.faces + 1)
    source = tmp_path / "ball.obj"
    source.write_text(f"mtllib ball.mtl\n{vertices}vt 0.5 0.5\nusemtl a\n{faces}")
    assert run_fit(source, "-o", tmp_path / "run", "--mesh", tmp_path / "mesh.ply") == 0
    assert np.abs(read_surface(tmp_path / "mesh.ply").colors - (0, 1, 0)).max() < 0.05


@pytest.fixture
def frame(tmp_path) -> list[object]:
    """The lower part of a ball, seen from below: red left of the axis, blue right of it."""
    rays = LENS.rays().numpy()
    a, b = (rays**2).sum(axis=2), 3 * rays[..., 2]
    inside = b**2 - 8 * a
    depth = np.where(inside > 0, 1000 * (b - np.sqrt(inside.clip(min=0))) / a, 0).astype(np.uint16)
    color = np.full((72, 96, 3), (255, 0, 0), np.uint8)
    color[:, rays[0, :, 0] < 0] = (0, 0, 255)  # blue comes first in OpenCV
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    cv2.imwrite(str(tmp_path / "color.png"), color)
    lens = {name: getattr(LENS, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (tmp_path / "camera.json").write_text(json.dumps(lens))
    return [tmp_path / "depth.png", "--intrinsics", tmp_path / "camera.json", "--color", tmp_path / "color.png"]


def test_a_depth_map_becomes_a_trimmed_coloured_mesh(frame: list[object], tmp_path, capsys):
    assert run_fit(*frame, "-o", tmp_path / "run", "--mesh", tmp_path / "mesh.ply") == 0
    trim = float(capsys.readouterr().out.rsplit("--trim-distance ", 1)[1].split(",")[0])
    mesh, cloud = read_surface(tmp_path / "mesh.ply"), read_cloud(tmp_path / "run" / "cloud.ply")
    assert KDTree(cloud.points).query(mesh.vertices)[0].max() < 1.05 * trim  # which was printed with two digits
    assert mesh.vertices[:, 2].max() < 3  # the other half of the ball was not seen
    left, right = mesh.vertices[:, 0] < -0.1, mesh.vertices[:, 0] > 0.1
    assert min(left.sum(), right.sum()) > 100
    assert np.abs(mesh.colors[left] - (1, 0, 0)).mean() < 0.1
    assert np.abs(mesh.colors[right] - (0, 0, 1)).mean() < 0.1


def test_a_depth_map_without_a_picture_gives_a_bare_mesh(frame: list[object], tmp_path):
    assert run_fit(*frame[:3], "-o", tmp_path / "run", "--mesh", tmp_path / "mesh.ply") == 0
    assert read_surface(tmp_path / "mesh.ply").colors is None


def interrupt_at(stage: str, monkeypatch) -> None:
    """Press Ctrl-C at the first report of a stage that has begun."""

    def stop(self: Lines, progress: object, /) -> None:
        if progress.stage == stage and progress.step > 0:  # type: ignore[attr-defined]
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Lines, "__call__", stop)


@pytest.mark.parametrize(("kind", "stage"), [("cloud", "level 0"), ("cloud", "texture"), ("depth map", "texture")])
def test_an_interrupted_command_is_continued_as_it_says(cloud, frame, tmp_path, monkeypatch, capsys, kind, stage):
    run, mesh = tmp_path / "run", tmp_path / "mesh.ply"
    source = [cloud] if kind == "cloud" else frame
    with monkeypatch.context() as patch:
        interrupt_at(stage, patch)
        words = ["fit", *map(str, source), "-o", str(run), "--mesh", str(mesh), *SMALL.split()]
        assert main(words) == 130
    assert not mesh.exists()
    said = capsys.readouterr().err.splitlines()[-1]
    assert "interrupted; " in said
    assert (run / "texture.safetensors").exists() == (stage == "texture")
    assert main(["mesh", str(run), "-o", str(tmp_path / "partial.ply"), "--resolution", "32"]) == 0  # usable
    proposed = said.split("to continue: mplicits ")[1].split()
    assert proposed == ["fit", str(source[0]), "-o", str(run), "--resume", "--mesh", str(mesh)]
    assert main([*proposed, "--quiet"]) == 0
    record = json.loads((run / "run.json").read_text())
    assert record["finished"]
    assert record["texture"]["finished"]
    assert run_fit(*source, "-o", tmp_path / "whole", "--mesh", tmp_path / "whole.ply") == 0
    assert (tmp_path / "whole.ply").read_bytes() == mesh.read_bytes()


def test_a_finished_run_only_lacks_its_mesh(cloud: Path, tmp_path, capsys):
    run, mesh = tmp_path / "run", tmp_path / "mesh.ply"
    assert run_fit(cloud, "-o", run) == 0
    resumed = ["fit", str(cloud), "-o", str(run), "--resume", "--quiet"]
    assert main(resumed) == 2
    assert "is finished" in capsys.readouterr().err
    assert main([*resumed, "--mesh", str(mesh)]) == 0
    check_colours(read_surface(mesh))
    before = (run / "texture.safetensors").read_bytes()
    assert main([*resumed, "--mesh", str(mesh)]) == 0
    assert (run / "texture.safetensors").read_bytes() == before


def test_mistakes_are_one_line_before_any_work(cloud: Path, frame: list[object], tmp_path, capsys):
    run, far, broken, before = tmp_path / "run", tmp_path / "far.xyz", tmp_path / "broken.obj", cloud.read_bytes()
    np.savetxt(far, ball().points + np.array([500_000, 5_600_000, 0]))
    broken.write_text("mtllib none.mtl\n" + "".join(f"v {i} {i * i} 0\n" for i in range(12)) + "usemtl a\nf 1 2 3\n")
    for words, message in (
        (f"{cloud} --mesh mesh.foo", "mesh.foo: unknown mesh format"),
        (f"{cloud} --mesh {broken}/mesh.ply", "broken.obj is no folder"),
        (f"{cloud} --mesh {tmp_path}", "unknown mesh format"),
        (f"{cloud} --mesh {cloud}", "is the cloud that is fitted"),
        (f"{cloud} --no-colors", "--no-colors: is about --mesh FILE"),
        (f"{' '.join(map(str, frame))} --mesh {run}/cloud.ply", "is the cloud that is fitted"),
        (f"{tmp_path}/none.ply --mesh mesh.ply", "no such file"),
        (f"{broken} --mesh mesh.ply", "--no-colors"),
        (f"{far} --mesh mesh.stl", "STL keeps"),
    ):
        assert message in fails(capsys, f"fit {words} -o {run}")
        assert not run.exists()
    assert cloud.read_bytes() == before
