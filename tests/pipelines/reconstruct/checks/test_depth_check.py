"""Depth maps are held against the region and against each other: right ones pass, wrong ones are said to be wrong."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets.synthetic.scenes import SCENES, scene_cameras, scene_depths
from mplicits.datasets.views.images import PosedImage, PosedImages
from mplicits.datasets.views.writing import write_transforms
from mplicits.neural_fields import Similarity
from mplicits.pipelines.cli import main
from mplicits.pipelines.reconstruct.checks.check import check_cameras
from mplicits.pipelines.reconstruct.checks.depth_check import DepthCheck, check_depths

VIEWS = 10
Numbers = np.ndarray


@pytest.fixture(scope="module")
def scene() -> PosedImages:
    """The depths of the figure, and photographs in which it is black."""
    figure, views = SCENES["figure"](), []
    for index, camera in enumerate(scene_cameras(figure, views=VIEWS, size=48)):
        depth = scene_depths(figure, camera)
        mask = np.isfinite(depth.numbers).astype(np.float32)
        views.append(PosedImage(f"{index:03d}.png", camera, np.zeros((48, 48, 3), np.float32), mask, depth))
    return PosedImages(tuple(views), Similarity.identity(), "the unit sphere", None, Path("figure"))


def changed(images: PosedImages, change: Callable[[int, list[Numbers]], Numbers]) -> PosedImages:
    """The same views; the map of each is what ``change`` says of its number and all maps."""
    maps = [view.depth.numbers for view in images.views if view.depth is not None]
    views = [
        replace(view, depth=replace(view.depth, numbers=change(index, maps)))
        for index, view in enumerate(images.views)
        if view.depth is not None
    ]
    return replace(images, views=tuple(views))


def checked(images: PosedImages) -> DepthCheck:
    check = check_depths(images)
    assert check is not None
    return check


@pytest.mark.parametrize("masks", [True, False])
def test_exact_maps_agree(scene: PosedImages, masks: bool) -> None:
    images = scene if masks else replace(scene, views=tuple(replace(view, mask=None) for view in scene.views))
    check = checked(images)
    assert (check.maps, check.inside, check.warnings) == (VIEWS, 1.0, ())
    assert check.seen_through == 0  # what lies around a pixel is nearer than its reading, or as near, but for slopes


def test_a_sensor_s_noise_is_no_contradiction(scene: PosedImages) -> None:
    random = np.random.default_rng(0)
    noisy = changed(scene, lambda index, maps: maps[index] * (1 + 0.01 * random.standard_normal(maps[index].shape)))
    assert not checked(noisy).warnings


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_other_units_are_seen_through(scene: PosedImages, factor: float) -> None:
    (warning,) = checked(changed(scene, lambda index, maps: factor * maps[index])).warnings
    assert "contradict each other" in warning
    assert "--depth-scale" in warning


def test_far_too_far_is_outside(scene: PosedImages) -> None:
    (warning,) = checked(changed(scene, lambda index, maps: 1000 * maps[index])).warnings
    assert warning.startswith("0.0% of the depths in all maps end in the region of interest")


@pytest.mark.parametrize(
    "change",
    [lambda index, maps: maps[index][:, ::-1].copy(), lambda index, maps: maps[index - 1]],
    ids=["mirrored", "next"],
)
def test_maps_of_something_else_contradict_each_other(
    scene: PosedImages, change: Callable[[int, list[Numbers]], Numbers]
) -> None:
    (warning,) = checked(changed(scene, change)).warnings
    assert "are they of these photographs" in warning


def test_maps_of_unknown_scale_are_counted(scene: PosedImages) -> None:
    loose = [replace(view, depth=replace(view.depth, kind="disparity")) for view in scene.views if view.depth]
    assert checked(replace(scene, views=tuple(loose))) == DepthCheck(VIEWS)
    assert check_depths(replace(scene, views=tuple(replace(view, depth=None) for view in scene.views))) is None


def test_one_map_cannot_be_held_against_others(scene: PosedImages) -> None:
    check = checked(replace(scene, views=scene.views[:1]))
    assert check.seen_through is None
    empty = changed(scene, lambda index, maps: np.full_like(maps[index], np.nan))
    assert checked(empty).warnings == ("no depth map has a reading",)


def test_the_command_says_so(tmp_path: Path, scene: PosedImages, capsys: pytest.CaptureFixture[str]) -> None:
    write_transforms(tmp_path / "photos", scene)
    assert main(["check-cameras", str(tmp_path / "photos")]) == 0
    said = capsys.readouterr()
    line = f"depth maps: {VIEWS} of {VIEWS} photographs have one; 100.0% of the readings end in the region; other views"
    assert line in said.out
    assert "depth" not in said.err
    wrong = ["--depth-maps", str(tmp_path / "photos" / "depths"), "--depth-scale", "0.8"]
    assert main(["check-cameras", str(tmp_path / "photos"), *wrong]) == 0
    assert "warning: the depth maps contradict each other" in capsys.readouterr().err


def test_the_command_believes_what_kind_they_are(
    tmp_path: Path, scene: PosedImages, capsys: pytest.CaptureFixture[str]
) -> None:
    write_transforms(tmp_path / "photos", changed(scene, lambda index, maps: 0.5 * maps[index] + 1))
    assert main(["check-cameras", str(tmp_path / "photos"), "--depth-kind", "relative"]) == 0
    said = capsys.readouterr()
    assert f"depth maps: {VIEWS} of {VIEWS} photographs have one\n" in said.out
    assert "depth" not in said.err


def test_wrong_cameras_are_said_alone(scene: PosedImages) -> None:
    turned = [replace(view, camera=scene.views[0].camera) for view in scene.views]
    check = check_cameras(replace(scene, views=tuple(turned)))
    assert check.depths is not None
    assert not any("depth" in warning for warning in check.warnings[1:])
