"""Undistorted pictures agree with their pinholes, and nothing in them is made up."""

import numpy as np
import pytest
import torch
from mplicits.datasets import Camera, look_at
from mplicits.datasets.views.images import undistort, undistorted_camera
from photographs import project_by_opencv

WIDTH, HEIGHT = 160, 120
LENSES = {
    "barrel": (-0.3, 0.1),
    "pincushion": (0.3, -0.05),
    "tangential": (0.1, -0.04, 0.015, -0.01),
    "five": (-0.2, 0.06, 0.001, 0.002, -0.01),
    "rational": (0.2, 0.05, 0.001, -0.001, 0.01, 0.4, 0.1, 0.02),
}


def camera(*lens: float) -> Camera:
    """Pixels that are not square, and an axis away from the middle."""
    view = look_at((0.4, -0.3, -4), (0.05, 0.02, 0), width=WIDTH, height=HEIGHT)
    intrinsics = torch.tensor([[150.0, 0, 86.0], [0, 146.0, 55.5], [0, 0, 1]], dtype=torch.float64)
    return Camera(intrinsics, view.world_from_camera, WIDTH, HEIGHT, lens)


def distorted_pixels(camera: Camera, points: torch.Tensor) -> np.ndarray:
    return project_by_opencv(camera, points, (*camera.distortion, *(0.0,) * (8 - len(camera.distortion))))


def draw(dots: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Round spots of 1.5 pixels."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    squares = (x - dots[:, 0, None, None]) ** 2 + (y - dots[:, 1, None, None]) ** 2
    return np.exp(-squares / (2 * 1.5**2)).sum(axis=0).astype(np.float32)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_dots_land_where_the_pinhole_has_them(lens):
    before = camera(*lens)
    grid = torch.stack(torch.meshgrid(torch.linspace(-1.2, 1.2, 7), torch.linspace(-0.9, 0.9, 5), indexing="ij"), -1)
    points = torch.cat((grid.reshape(-1, 2), 0.2 * grid.reshape(-1, 2)[:, :1]), dim=1).double()
    pinhole = undistorted_camera(before)
    picture = undistort(draw(distorted_pixels(before, points), (WIDTH, HEIGHT)), before, pinhole)
    expected = pinhole.project(points)[0].numpy()
    checked = 0
    for x, y in expected:
        column, row = round(x), round(y)
        if 6 <= column < WIDTH - 6 and 6 <= row < HEIGHT - 6:
            window = picture[row - 5 : row + 6, column - 5 : column + 6].astype(float)
            place = (window.sum(axis=0) @ np.arange(-5, 6), window.sum(axis=1) @ np.arange(-5, 6)) / window.sum()
            np.testing.assert_allclose(place + np.array((column, row)), (x, y), atol=0.1)
            checked += 1
    assert checked > 20
    apart = np.abs(distorted_pixels(before, points) - before.pinhole().project(points)[0].numpy()).max()
    assert apart > 1  # without undistortion they would not


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_picture_is_all_seen_and_no_smaller_than_it_must_be(lens):
    before = camera(*lens)
    pinhole = undistorted_camera(before)
    assert (pinhole.width, pinhole.height) == (WIDTH, HEIGHT)
    assert pinhole.world_from_camera is before.world_from_camera
    # Pictures that hold their own coordinates show from where each pixel was taken.
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    fx, fy, cx, cy = pinhole.fx_fy_cx_cy
    rays = np.stack(((x - cx) / fx, (y - cy) / fy, np.ones_like(x))).reshape(3, -1).T
    points = torch.from_numpy(rays.astype(np.float64)) @ before.world_from_camera[:3, :3].T
    taken = distorted_pixels(before, points + before.eye)
    assert taken.min() > -0.05
    assert (taken.max(axis=0) < (WIDTH - 0.95, HEIGHT - 0.95)).all()
    near = (taken.min(axis=0), (WIDTH - 1, HEIGHT - 1) - taken.max(axis=0))
    assert np.max(near) < 0.3  # each side of the distorted picture is reached
    for image in (x, y):
        got = undistort(image, before, pinhole).reshape(-1)
        np.testing.assert_allclose(got, taken[:, 0 if image is x else 1].clip(0, image.max()), atol=0.05)


def test_without_distortion_the_camera_stays():
    for before in (camera(), camera(0.0, 0.0, 0.0, 0.0)):
        assert undistorted_camera(before) is before


@pytest.mark.parametrize("lens", [(-3.0,), (-1.5, 0.0), (0.0, -20.0), (50.0, -900.0)])
def test_a_lens_that_folds_the_picture_over_is_refused(lens):
    with pytest.raises(ValueError, match="distortion="):
        undistorted_camera(camera(*lens))
