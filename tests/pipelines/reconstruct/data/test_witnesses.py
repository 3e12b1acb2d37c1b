"""Who sees a place of a known surface, against the closed form of two balls, one before the other."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from mplicits.datasets.cameras import Camera, look_at
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.writing import write_transforms
from mplicits.neural_fields import Mesh
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.reconstruct.data.witnesses import count_witnesses

BALLS = (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.5]))
RADII = (0.5, 0.3)


def balls() -> Mesh:
    parts = [trimesh.creation.icosphere(4, radius=r) for r in RADII]
    for part, center in zip(parts, BALLS, strict=True):
        part.apply_translation(center)
    both = trimesh.util.concatenate(parts)
    return Mesh(np.asarray(both.vertices), np.asarray(both.faces))


def hidden_by(eye: np.ndarray, points: np.ndarray, margin: float) -> np.ndarray:
    """Whether the way from an eye to points meets a ball of a radius that is larger by ``margin``."""
    found = np.zeros(len(points), dtype=bool)
    for center, radius in zip(BALLS, RADII, strict=True):
        way = points - eye
        length = np.linalg.norm(way, axis=1)
        along = ((center - eye) * way).sum(axis=1) / length
        off = np.linalg.norm(eye + along[:, None] * way / length[:, None] - center, axis=1)
        on_it = np.abs(np.linalg.norm(points - center, axis=1) - radius) < 1e-2
        # The far side of its own ball: the way enters it before it gets there.
        # A larger margin hides more.
        found |= np.where(on_it, along - margin < length, (off < radius + margin) & (along < length))
    return found


@pytest.mark.parametrize("size", [64, 512])  # both are looked at in 512 pixels
def test_counts_are_those_of_the_closed_form(size: int) -> None:
    eyes = [(0.0, 0.0, 4.0), (4.0, 0.5, 0.0), (0.3, 3.0, -2.0)]
    cameras = [
        look_at(torch.tensor(eye, dtype=torch.float64), (0, 0, 0.6), up=(0, 1, 0), fov=40, width=size, height=size)
        for eye in eyes
    ]
    surface = balls()
    middle = surface.vertices[surface.faces].mean(axis=1)
    asked: list[tuple[int, int]] = []
    counts = count_witnesses(cameras, surface, middle, finest=512, progress=lambda *done: asked.append(done))
    assert asked == [(1, 3), (2, 3), (3, 3)]
    sure = np.ones(len(middle), dtype=bool)
    exact = np.zeros(len(middle), dtype=int)
    for camera, eye in zip(cameras, eyes, strict=True):
        # A pixel is 0.006 at that distance, and near a rim a place counts that is up to ten beyond it.
        least, most = (~hidden_by(np.array(eye), middle, margin) for margin in (0.06, -0.06))
        framed = camera.in_view(middle)[2]
        sure &= least == most
        exact += least & framed
    assert sure.mean() > 0.4
    assert np.array_equal(counts[sure], exact[sure])
    assert set(np.unique(exact)) >= {0, 1, 2}


@pytest.mark.slow
def test_the_command_says_how_near_the_mesh_is_where_photographs_see(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_transforms(tmp_path / "photos", render_scene(SCENES["painted-sphere"](), views=2, size=8, samples=1))
    truth, cloud, figures = (tmp_path / name for name in ("ball.ply", "cloud.xyz", "figures.json"))
    trimesh.creation.icosphere(2, radius=0.6).export(truth)
    some = ["--photos", str(tmp_path / "photos"), "--samples", "2000", "--json", str(figures)]
    assert main(["evaluate", str(truth), str(truth), *some]) == 0
    assert "chamfer where 2 photographs see" in capsys.readouterr().out
    parts = json.loads(figures.read_text())["seen"]["parts"]
    assert sum(part["share"] for part in parts) == pytest.approx(1)
    # A camera at four radii sees (1 - 1/4) / 2 of a ball, and so do both; some 40 samples of 2000 are beside a rim.
    assert parts[1]["share"] + 2 * parts[2]["share"] == pytest.approx(2 * 0.375, abs=0.05)
    assert parts[3]["share"] == parts[4]["share"] == 0
    np.savetxt(cloud, np.random.default_rng(0).normal(size=(50, 3)))
    assert main(["evaluate", str(truth), str(cloud), *some]) == 2
    assert f"{cloud}: points hide nothing" in capsys.readouterr().err


def test_cameras_keep_their_shape() -> None:
    camera: Camera = look_at(torch.tensor([0.0, 0.0, 3.0]), (0, 0, 0), up=(0, 1, 0), fov=50, width=3, height=2)
    counts = count_witnesses([camera], balls(), np.array([[0.0, 0.0, 1.8], [0.0, 0.0, -0.5]]), finest=256)
    assert counts.tolist() == [1, 0]
