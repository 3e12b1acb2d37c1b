"""Cameras found by COLMAP against those that drew the pictures; what can be read, continued and refused."""

import math
import sys
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
from mplicits.datasets import look_at, read_cameras
from mplicits.datasets.synthetic.scenes import pictures
from mplicits.datasets.views.poses import colmap_process
from mplicits.datasets.views.poses import find_cameras as module
from mplicits.datasets.views.poses.colmap_process import Found
from mplicits.datasets.views.poses.find_cameras import find_cameras
from mplicits.neural_fields import InputError
from photographs import SPECKLED, eyes
from refusals import refused

VIEWS, SIZE, DISTANCE = 6, 240, 2.4
FOV = math.degrees(2 * math.atan(0.5 / 1.2))  # COLMAP's guess: six small pictures do not tell their lens
EYES = eyes(VIEWS, DISTANCE)


def write(folder: Path, *pictures: np.ndarray) -> Path:
    folder.mkdir()
    for number, picture in enumerate(pictures):
        iio.imwrite(folder / f"{number}.png", (picture * 255).round().astype(np.uint8))
    return folder


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cameras = [look_at(eye, (0, 0, 0), fov=FOV, width=SIZE, height=SIZE) for eye in EYES]
    shown = [color for color, _ in pictures(SPECKLED, cameras, samples=2)]
    return write(tmp_path_factory.mktemp("photographs") / "data", *shown)


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A stand-in for COLMAP places all but the last photograph; its calls are listed."""
    asked: list[dict[str, Any]] = []

    def solve(project: Path, job: Any, *, photographs: int, pairs: int, report: Any) -> dict[str, Any]:
        asked.append({"count": photographs, **job.keywords})
        names = sorted(file.name for file in (project / "images").iterdir())
        return {"names": names[:-1], "points": 7, "error": 0.25}

    monkeypatch.setattr(module, "solve", solve)
    monkeypatch.setattr(module, "check_colmap", lambda: None)
    return asked


def test_found_cameras_stand_where_the_pictures_were_drawn_from(photographs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    stages: list[tuple[str, int, int]] = []
    found = find_cameras(photographs, tmp_path / "project", report=lambda *said: stages.append(said))
    assert (found.photographs, found.left_out) == (VIEWS, ())
    assert found.error < 1  # half a pixel's rounding in each direction is 0.4 in the mean
    assert {stage for stage, _, _ in stages} <= {colmap_process.FEATURES, colmap_process.MATCHING, module.PLACING}
    assert all(0 <= done <= total for _, done, total in stages)
    cameras = dict(read_cameras(tmp_path / "project"))
    ours = np.array([cameras[f"{number}.png"].eye.numpy() for number in range(VIEWS)])
    truth = np.array(EYES)
    # The similarity between them by Procrustes. A pixel is 0.5 % of the distance; features are found to one or so.
    a, b = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
    u, sizes, v = np.linalg.svd(a.T @ b)
    assert np.linalg.det(u @ v) > 0  # not mirrored
    off = sizes.sum() / (a * a).sum() * a @ u @ v - b
    assert np.abs(off).max() < 0.03 * DISTANCE
    assert len({camera.width for camera in cameras.values()}) == 1


@pytest.mark.slow
def test_nothing_to_see_is_said(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    grey = write(tmp_path / "grey", *3 * [np.full((40, 60, 3), 0.5)])
    with pytest.raises(InputError, match="no photographs could be placed"):
        find_cameras(grey, tmp_path / "project")


def test_what_is_found_is_kept_and_not_sought_again(photographs: Path, tmp_path: Path, solved: list) -> None:
    first = find_cameras(photographs, tmp_path / "project")
    assert first == Found(tmp_path / "project", VIEWS, 7, 0.25, (f"{VIEWS - 1}.png",))
    assert find_cameras(photographs, tmp_path / "project") == first
    assert [(asked["count"], asked["one"], asked["film"]) for asked in solved] == [(VIEWS, True, False)]
    with pytest.raises(InputError, match="of other settings"):
        find_cameras(photographs, tmp_path / "project", lens="each")
    assert len(solved) == 1


def test_an_interrupted_search_goes_on(photographs: Path, tmp_path: Path, solved: list, monkeypatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, "solve", interrupted)
        with pytest.raises(KeyboardInterrupt):
            find_cameras(photographs, tmp_path / "project")
    assert find_cameras(photographs, tmp_path / "project").photographs == VIEWS
    assert len(solved) == 1


def test_photographs_of_two_sizes_have_lenses_of_their_own(tmp_path: Path, solved: list[dict[str, Any]]) -> None:
    mixed = write(tmp_path / "mixed", *(np.zeros((20, width, 3)) for width in (20, 20, 21)))
    find_cameras(mixed, tmp_path / "a")
    find_cameras(mixed, tmp_path / "b", lens="one")
    assert [asked["one"] for asked in solved] == [False, True]


def test_the_sharpest_frames_of_a_film_are_taken(tmp_path: Path, solved: list[dict[str, Any]]) -> None:
    film, frames, size = tmp_path / "film.avi", 12, 64
    random = np.random.default_rng(1)
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 10, (size, size))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no films")
    sharp = (1, 4, 11)  # one in each third
    for index in range(frames):
        noise = random.integers(0, 256, (size, size, 1), np.uint8).repeat(3, axis=2)
        frame = noise if index in sharp else cv2.GaussianBlur(noise, (0, 0), 4)
        frame[:8, :8] = 20 * index  # its number, in brightness
        writer.write(frame)
    writer.release()
    found = find_cameras(film, tmp_path / "project", frames=3)
    pictures = sorted((tmp_path / "project" / "images").iterdir())
    assert tuple(round(iio.imread(file)[2:6, 2:6].mean() / 20) for file in pictures) == sharp
    assert (found.photographs, solved[0]["one"], solved[0]["film"]) == (3, True, True)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none", None, "no such file or folder"),
        ("folder", "", "0 photographs"),
        ("source", "x", "neither a folder of photographs nor a film"),
        ("film.mp4", "no film", r"film\.mp4: not a film that can be read"),
    ],
)
def test_sources_that_are_none(tmp_path: Path, solved: Any, name: str, content: str | None, message: str) -> None:
    if content:
        (tmp_path / name).write_text(content)
    elif content is not None:
        (tmp_path / name).mkdir()
    with refused(tmp_path / name, message):
        find_cameras(tmp_path / name, tmp_path / "project")


def test_folders_of_others_are_left_alone(photographs: Path, tmp_path: Path, solved: Any) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "cameras.json").write_text("[")
    for name, message in ((".", "is not empty"), ("mine.txt", "is a file"), ("mine", r"cameras\.json: damaged")):
        with refused(tmp_path / name, message):
            find_cameras(photographs, tmp_path / name)


def test_without_pycolmap_the_extra_is_named(photographs: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"mplicits\[poses\]"):
        find_cameras(photographs, tmp_path / "project")
