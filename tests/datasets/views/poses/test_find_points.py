"""Points triangulated by COLMAP lie on the sphere that was drawn; which views are matched; what is kept and refused."""

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mplicits.datasets import look_at, read_cameras
from mplicits.datasets.synthetic.scenes import pictures
from mplicits.datasets.views.images import PosedImage, PosedImages, read_posed_images
from mplicits.datasets.views.poses import find_points as module
from mplicits.datasets.views.poses.colmap_process import Found
from mplicits.datasets.views.poses.find_points import find_points, neighbours
from mplicits.datasets.views.writing import write_transforms
from mplicits.neural_fields import InputError, Similarity
from photographs import SPECKLED, eyes

VIEWS, SIZE, RADIUS, DISTANCE = 5, 240, 0.8, 2.4
FOV = math.degrees(2 * math.asin(1.05 * RADIUS / DISTANCE))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a speckled sphere from one side, in a transforms.json."""
    views = []
    for number, eye in enumerate(eyes(VIEWS, DISTANCE)):
        camera = look_at(eye, (0, 0, 0), fov=FOV, width=SIZE, height=SIZE)
        views.append(PosedImage(f"{number}.png", camera, *pictures(SPECKLED, [camera], samples=2)[0]))
    folder = tmp_path_factory.mktemp("photographs") / "data"
    write_transforms(folder, PosedImages(tuple(views), Similarity.identity(), "", None, Path()))
    return folder


@pytest.mark.slow
def test_points_lie_on_what_was_drawn_and_cameras_stay(photographs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    stages: list[tuple[str, int, int]] = []
    found = find_points(photographs, tmp_path / "project", report=lambda *said: stages.append(said))
    assert (found.photographs, found.error < 1) == (VIEWS, True)
    assert all(0 <= done <= total for _, done, total in stages)
    for ours, theirs in zip(read_cameras(tmp_path / "project"), read_cameras(photographs), strict=True):
        np.testing.assert_allclose(ours[1].world_from_camera, theirs[1].world_from_camera, atol=1e-9)
        np.testing.assert_allclose(ours[1].intrinsics, theirs[1].intrinsics, atol=1e-9)
    images = read_posed_images(tmp_path / "project")
    assert len(images.points) == found.points > 50
    # A pixel is 0.8 % of the radius there; rays that meet at 9 degrees miss each other by six times as much along them.
    away = np.abs(np.linalg.norm(images.points, axis=1) - RADIUS)
    assert float(np.median(away)) < 0.01
    assert len(np.unique(images.observations[:, 0])) == VIEWS
    assert np.bincount(images.observations[:, 1], minlength=found.points).min() >= 2
    assert images.views[0].mask is not None  # transparency is kept


@pytest.mark.slow
def test_nothing_to_see_is_said(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    cameras = [look_at((2, 0.2 * k, 1), (0, 0, 0), width=60, height=40) for k in range(3)]
    grey = tuple(PosedImage("", camera, np.full((40, 60, 3), 0.5, np.float32), None) for camera in cameras)
    write_transforms(tmp_path / "grey", PosedImages(grey, Similarity.identity(), "", None, Path()))
    with pytest.raises(InputError, match="no two photographs show the same thing"):
        find_points(tmp_path / "grey", tmp_path / "project")


def test_an_interrupted_search_goes_on_and_a_finished_one_is_kept(
    photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, int]] = []

    def solve(project: Path, job: Any, *, photographs: int, pairs: int, report: Any) -> dict[str, Any]:
        asked.append((photographs, pairs))
        assert len(list((project / "images").iterdir())) == VIEWS
        if len(asked) == 1:
            raise KeyboardInterrupt
        return {"points": 7, "error": 0.25}

    monkeypatch.setattr(module, "solve", solve)
    monkeypatch.setattr(module, "check_colmap", lambda: None)
    with pytest.raises(KeyboardInterrupt):
        find_points(photographs, tmp_path / "project")
    written = (tmp_path / "project" / "images" / "000.png").stat().st_mtime_ns
    found = find_points(photographs, tmp_path / "project")
    assert found == Found(tmp_path / "project", VIEWS, 7, 0.25)
    assert (tmp_path / "project" / "images" / "000.png").stat().st_mtime_ns == written
    assert find_points(photographs, tmp_path / "project") == found
    assert asked == 2 * [(VIEWS, VIEWS * (VIEWS - 1) // 2)]
    with pytest.raises(InputError, match="holds the cameras of other photographs"):
        find_points(tmp_path / "project" / "given", tmp_path / "project")
    # Other cameras for the same photographs are refused, too.
    changed = shutil.copytree(photographs, tmp_path / "changed")
    find_points(changed, tmp_path / "again")
    (changed / "transforms.json").write_text((changed / "transforms.json").read_text() + "\n")
    with pytest.raises(InputError, match="holds the cameras of other photographs"):
        find_points(changed, tmp_path / "again")


def test_views_are_paired_with_those_that_look_from_the_same_side() -> None:
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = np.stack((np.cos(angle), np.sin(angle), 0 * angle), axis=1) * np.linspace(1, 5, 12)[:, None]
    beside = {tuple(sorted((k, (k + 1) % 12))) for k in range(12)}
    assert set(neighbours(around, 2)) == beside
    assert neighbours(around[:3], 20) == [(0, 1), (0, 2), (1, 2)]
    assert neighbours(around[:1]) == []
