"""Regions of interest: exact where the geometry says so, tight where it is estimated, refused where there is none."""

import math

import numpy as np
import pytest
import torch
from mplicits.datasets import Camera, look_at
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.datasets.views.region import region_from_cameras, region_from_masks, region_from_points

CENTER = np.array([500_000.0, 20.0, -7.0])


def moved(x: float = 0, y: float = 0, z: float = 0) -> list[float]:
    return (CENTER + np.array((x, y, z))).tolist()


def around(count: int = 12, *, size: tuple[int, int] = (48, 32)) -> list[Camera]:
    """Cameras all around CENTER, from above and below, with a vertical angle of 40 degrees."""
    turns = 2 * np.pi * np.arange(count) / count
    heights = 0.6 * np.sin(3 * turns)
    ways = np.stack((np.cos(turns) * np.cos(heights), np.sin(heights), np.sin(turns) * np.cos(heights)), axis=1)
    return [look_at(eye.tolist(), moved(), fov=40, width=size[0], height=size[1]) for eye in CENTER + 5 * ways]


def ball() -> np.ndarray:
    return CENTER + unit_rows(np.random.default_rng(0).normal(size=(500, 3)))


def silhouettes(cameras: list[Camera], center: np.ndarray, radius: float) -> list[np.ndarray]:
    masks = []
    for camera in cameras:
        eye, ways = (tensor.numpy() for tensor in camera.rays(dtype=torch.float64))
        to = center - eye
        masks.append((to @ to - (ways @ to) ** 2 < radius**2).astype(np.float32))
    return masks


@pytest.mark.parametrize("size", [(48, 32), (32, 48)])
def test_cameras_that_look_at_a_point_fit_the_sphere_to_their_longer_side(size):
    region = region_from_cameras(around(size=size))
    np.testing.assert_allclose(region.center, CENTER, atol=1e-6)
    slope = math.tan(math.radians(20)) * max(size) / size[1]
    assert region.scale == pytest.approx(5 * slope / math.hypot(1, slope), rel=1e-6)


def test_the_sphere_holds_no_camera():
    near = look_at(moved(0, 0, 0.5), moved(), fov=40, width=48, height=32)
    region = region_from_cameras([*around(), near])
    assert region.scale == pytest.approx(0.9 * 0.5, rel=1e-6)


def test_the_nearest_point_of_axes_that_do_not_meet():
    """Two skew axes, along x at height 1 and along z at height −1: half-way between them."""
    axes = (((-5, 1, 0), (0, 1, 0)), ((0, -1, -5), (0, -1, 0)))
    cameras = [look_at(eye, target, width=8, height=8, fov=60) for eye, target in axes]
    np.testing.assert_allclose(region_from_cameras(cameras).center, (0, 0, 0), atol=1e-12)


@pytest.mark.parametrize(
    ("eyes", "targets", "message"),
    [
        ([], [], "parallel"),
        ([(0, 0, 5)], [(0, 0, 0)], "parallel"),
        ([(0, 0, 5), (1, 0, 5)], [(0, 0, 0), (1, 0, 0)], "parallel"),
        ([(1, 0, 0), (-1, 0, 0), (0, 0, 1)], [(2, 0, 0), (-2, 0, 0), (0, 0, 2)], "half of them do not see"),
    ],
)
def test_cameras_that_look_at_nothing_in_common_are_refused(eyes, targets, message):
    cameras = [look_at(eye, target, width=8, height=8) for eye, target in zip(eyes, targets, strict=True)]
    with pytest.raises(ValueError, match=message):
        region_from_cameras(cameras)


def test_sparse_points_on_a_ball_give_it_whatever_is_far_outside():
    rng = np.random.default_rng(1)
    background = CENTER + rng.normal(size=(300, 3)) * 40
    stray = CENTER + np.array([[0.0, 1.7, 0], [1.6, 0, 0], [0, 0, -1.7]])
    region = region_from_points(np.concatenate((ball(), background, stray)), around())
    assert np.linalg.norm(np.array(region.center) - CENTER) < 0.05
    assert 1.0 < region.scale < 1.15


def test_too_few_points_in_view_are_refused():
    elsewhere = ball() + np.array((0, 900, 0))
    for points, message in ((elsewhere, "points: 0 of 500"), (np.tile(CENTER, (20, 1)), "points: all")):
        with pytest.raises(ValueError, match=message):
            region_from_points(points, around())


def test_cameras_side_by_side_take_the_points_that_they_share():
    front = [look_at(moved(k, 0, 6), moved(k), width=48, height=32) for k in (0, 0.2)]
    region = region_from_points(ball(), front)
    assert np.linalg.norm(np.array(region.center) - CENTER) < 0.1
    assert 1.0 < region.scale < 1.15


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.2)])
def test_the_visual_hull_of_a_ball_holds_it_closely(offset):
    cameras = around(size=(96, 64))
    center, radius = CENTER + offset, 0.9
    region = region_from_masks(cameras, silhouettes(cameras, center, radius))
    away = np.linalg.norm(np.array(region.center) - center)
    assert away < 0.1
    assert radius + away <= region.scale < 1.35 * radius


def test_a_view_that_cuts_the_object_does_not_cut_the_hull():
    cameras = around(size=(96, 64))
    zoomed = look_at(cameras[0].eye, CENTER.tolist(), fov=6, width=64, height=64)
    masks = silhouettes([*cameras, zoomed], CENTER, 0.9)
    assert masks[-1].all()
    region = region_from_masks([*cameras, zoomed], masks)
    assert 0.9 <= region.scale < 1.35 * 0.9


def test_masks_that_say_nothing_or_contradict_each_other_are_refused():
    cameras = around()
    masks, wide = silhouettes(cameras, CENTER, 0.5), silhouettes(cameras, CENTER, 1.5)
    masks[3:5] = [1 - wide[3], 1 - wide[4]]
    white = [np.ones((32, 48), np.float32)] * len(cameras)
    for found, message in ((white, "show no background"), (masks, "no part of space is object")):
        with pytest.raises(ValueError, match=message):
            region_from_masks(cameras, found)


@pytest.mark.parametrize("count", [4, 12, pytest.param(40, marks=pytest.mark.slow)])
def test_one_wrong_mask_does_not_cut_the_region(count):
    cameras = around(count, size=(96, 64))
    masks = silhouettes(cameras, CENTER, 0.9)
    right = region_from_masks(cameras, masks)
    masks[1] = 0 * masks[1]
    assert region_from_masks(cameras, masks).scale == pytest.approx(right.scale, rel=0.35 if count == 4 else 0.1)
    if count == 40:  # half of the ball is missing in two
        masks = silhouettes(cameras, CENTER, 0.9)
        for wrong in (1, 7):
            masks[wrong][:, :48] = 0
        assert region_from_masks(cameras, masks).scale == pytest.approx(right.scale, rel=0.1)
