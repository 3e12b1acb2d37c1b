"""Cameras: rays and projection undo each other, views are where they say, and nothing is lost far from the origin."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets import Camera, look_at, orbit, turntable
from mplicits.neural_fields import Similarity

BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


def some_camera() -> Camera:
    """Pixels that are not square, an axis that is not in the middle, a pose along no axis."""
    camera = look_at((1.0, 2.0, 3.0), (-0.3, 0.1, 0.2), up=(0.1, 0.9, -0.2), width=31, height=17)
    intrinsics = torch.tensor([[25.0, 0, 14.2], [0, 22.0, 9.1], [0, 0, 1]], dtype=torch.float64)
    return Camera(intrinsics, camera.world_from_camera, 31, 17)


def pixel_grid(camera: Camera) -> torch.Tensor:
    x, y = torch.arange(camera.width).double(), torch.arange(camera.height).double()
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


@pytest.mark.parametrize("lens", [(), (-0.28, 0.09, 1e-3, -7e-4, -0.01), (0.2, 0.05, 0.0, 0.0, 0.01, 0.4, 0.1, 0.02)])
def test_project_undoes_rays(lens):
    camera = replace(some_camera(), distortion=lens)
    eye, directions = camera.rays(dtype=torch.float64)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(17, 31).double(), rtol=0, atol=1e-14)
    depth = torch.rand(17, 31).double() * 5 + 0.1
    pixels, z = camera.project(eye + depth[..., None] * directions)
    torch.testing.assert_close(pixels, pixel_grid(camera), rtol=0, atol=1e-12)
    torch.testing.assert_close(z, depth * (directions @ camera.forward), rtol=0, atol=1e-12)
    pixels, _, inside = camera.in_view((eye + depth[..., None] * directions).reshape(-1, 3).numpy())
    assert inside.all()
    straight = camera.pinhole().project(eye + directions)[0].reshape(-1, 2)
    assert (np.abs(pixels - straight.numpy()).max() > 0.1) == bool(lens)


def test_what_only_a_turned_back_polynomial_brings_into_the_image_is_not_in_view():
    """At r² = 1 / 0.28 this lens maps everything to its middle."""
    camera = replace(look_at((0, 0, -1), (0, 0, 0), width=160, height=120, fov=50), distortion=(-0.28,))
    places = np.array([[0.0, 0, 0], [np.sqrt(1 / 0.28), 0, 0], [0, 0, -2], [0, 5, 0]])
    pixels, depths, inside = camera.in_view(places @ np.diag([-1.0, 1, 1]))
    assert inside.tolist() == [True, False, False, False]
    assert np.abs(pixels[1] - pixels[0]).max() < 1e-6
    assert depths.tolist() == [1, 1, -1, 1]


def test_the_middle_pixel_and_the_corners_look_where_trigonometry_says():
    camera = look_at((0, 0, 2), (0, 0, 0), fov=90, width=5, height=3)
    _, directions = camera.rays(dtype=torch.float64)
    torch.testing.assert_close(directions[1, 2], torch.tensor([0.0, 0, -1]).double())
    # The top edge is half a pixel above the centre of the first row, at 45°: one row is tan 45° / 1.5.
    expected = torch.tensor([-2 / 1.5, 1 / 1.5, -1]).double()
    torch.testing.assert_close(directions[0, 0], expected / expected.norm())


def test_projection_agrees_with_the_matrices_written_out():
    camera = some_camera()
    points = torch.randn(40, 3).double()
    world = torch.cat((points, torch.ones(40, 1).double()), dim=1)
    image = world @ torch.linalg.inv(camera.world_from_camera).T[:, :3] @ camera.intrinsics.T
    pixels, z = camera.project(points)
    torch.testing.assert_close(pixels, image[:, :2] / image[:, 2:], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(z, image[:, 2])


def test_rays_go_to_the_device_and_dtype_asked_for(device, dtype):
    camera = some_camera()
    eye, directions = camera.rays(dtype=dtype, device=device)
    assert eye.dtype == directions.dtype == dtype
    assert eye.device.type == directions.device.type == device.type
    off = 8 * unit_roundoff(dtype)  # a direction is made in a handful of operations on numbers below 1
    torch.testing.assert_close(directions.cpu().double(), camera.rays(dtype=torch.float64)[1], rtol=0, atol=off)
    pixels, _ = camera.project(eye.double() + directions.double())
    torch.testing.assert_close(pixels.cpu(), pixel_grid(camera), rtol=0, atol=1e-4)


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (1.0, 2.0, -0.5)])
def test_look_at_has_right_down_forward_axes_and_its_target_in_the_middle(up):
    eye, target = torch.tensor([3.0, -1, 2]).double(), torch.tensor([0.5, 0.2, -0.3]).double()
    camera = look_at(eye, target, up=up, width=21, height=11)
    axes = camera.world_from_camera[:3, :3]
    torch.testing.assert_close(axes.T @ axes, torch.eye(3).double(), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.cross(camera.right, camera.down), camera.forward)
    torch.testing.assert_close(camera.eye, eye)
    torch.testing.assert_close(camera.forward, (target - eye) / (target - eye).norm())
    above = torch.tensor(up).double()
    assert float(camera.right @ above) == pytest.approx(0, abs=1e-14)
    assert float(camera.down @ above) < 0
    pixel, z = camera.project(target)
    torch.testing.assert_close(pixel, torch.tensor([10.0, 5.0]).double())
    assert float(z) == pytest.approx(float((target - eye).norm()))


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, -2.0), (1, 0, 0)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-7])
def test_looking_along_the_up_direction_is_no_accident(up, sign, tilt):
    eye = sign * torch.tensor(up).double() + tilt
    camera = look_at(eye, (0, 0, 0), up=up, width=8, height=8)
    axes = camera.world_from_camera[:3, :3]
    torch.testing.assert_close(axes.T @ axes, torch.eye(3).double(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("size", [(320, 640), (500, 500), (640, 320)])
@pytest.mark.parametrize("elevation", [-90, -25, 90])
def test_orbit_keeps_all_points_in_view_and_touches_the_margin(up, size, elevation):
    points = np.random.default_rng(1).uniform(-1, 1, (500, 3)) * [3, 1, 2] + [100, -50, 7]
    width, height = size
    view = {"azimuth": 40, "elevation": elevation, "up": up, "fov": 40, "width": width, "height": height}
    camera = orbit(points, **view, margin=0.9)
    pixels, z = camera.project(torch.from_numpy(points))
    assert bool((z > 0).all())
    off = (pixels - torch.tensor([width - 1, height - 1]) / 2).abs() / (torch.tensor([width, height]) / 2)
    assert float(off.max()) == pytest.approx(0.9)
    if abs(elevation) < 90:
        assert float(camera.down["xyz".index(up)]) < 0
    closer, z_closer = orbit(points, **view, margin=0.9, zoom=2.0).project(torch.from_numpy(points))
    middle = torch.tensor([width - 1, height - 1]) / 2
    torch.testing.assert_close(closer - middle, 2 * (pixels - middle))
    torch.testing.assert_close(z_closer, z)


def test_azimuth_and_elevation_are_where_they_say():
    for azimuth, elevation, up, forward in (
        (0, 0, "y", [0, 0, -1]),
        (90, 0, "y", [-1, 0, 0]),
        (0, 0, "z", [0, 1, 0]),
        (90, 0, "z", [-1, 0, 0]),
        (77, 90, "y", [0, -1, 0]),
        (77, -90, "z", [0, 0, 1]),
    ):
        camera = orbit(BOX, azimuth=azimuth, elevation=elevation, up=up)
        assert camera.forward.tolist() == pytest.approx(forward)
    assert orbit(BOX, azimuth=0, elevation=90).right.tolist() == pytest.approx([1, 0, 0])


def test_a_turntable_goes_once_around_at_one_distance_and_crops_nothing():
    points = torch.rand(300, 3).double() * torch.tensor([4.0, 1.0, 0.5]) + torch.tensor([0.0, 5.0, 9.0])
    cameras = turntable(points, 12, azimuth=10, elevation=20, width=64, height=48)
    middle = (points.amin(dim=0) + points.amax(dim=0)) / 2
    distances = [float((camera.eye - middle).norm()) for camera in cameras]
    assert distances == pytest.approx([distances[0]] * 12)
    alone = [orbit(points, azimuth=10 + 30 * k, elevation=20, width=64, height=48) for k in range(12)]
    assert distances[0] == pytest.approx(max(float((camera.eye - middle).norm()) for camera in alone))
    for camera, other in zip(cameras, alone, strict=True):
        torch.testing.assert_close(camera.world_from_camera[:3, :3], other.world_from_camera[:3, :3])
        pixels, _ = camera.project(points)
        assert bool(((pixels >= -0.5) & (pixels <= torch.tensor([63.5, 47.5]))).all())


def test_a_moved_camera_sees_the_same_pixels():
    similarity = Similarity((3.0, -20.0, 700.0), 42.0)
    camera = look_at((30, 10, 600), similarity.center, up=(0, 0, 1), width=64, height=48)
    points = torch.randn(50, 3).double() * 10 + torch.tensor(similarity.center)
    pixels, z = camera.project(points)
    unit = torch.from_numpy(similarity.to_unit(points.numpy()))
    moved, z_moved = camera.moved(similarity).project(unit)
    torch.testing.assert_close(moved, pixels, rtol=0, atol=1e-10)
    torch.testing.assert_close(z_moved * similarity.scale, z)


def test_a_resized_camera_keeps_the_view_to_its_corners():
    camera = some_camera()
    larger = camera.resized(93, 34)
    points = torch.randn(50, 3).double()
    pixels, z = camera.project(points)
    resized, z_resized = larger.project(points)
    torch.testing.assert_close(resized, (pixels + 0.5) * torch.tensor([3.0, 2.0]) - 0.5)
    torch.testing.assert_close(z_resized, z)
    back = larger.resized(31, 17)
    torch.testing.assert_close(back.intrinsics, camera.intrinsics)
    # Three times as large, every pixel is the middle one of nine.
    _, small = camera.rays(dtype=torch.float64)
    _, tripled = camera.resized(93, 51).rays(dtype=torch.float64)
    torch.testing.assert_close(tripled[1::3, 1::3], small)


def test_map_coordinates_keep_their_precision():
    home = torch.tensor([500_000.0, 5_400_000.0, 300.0]).double()
    points = torch.rand(20, 3).double()
    near = look_at((3.0, 4.0, 2.0), (0.5, 0.5, 0.5), up=(0, 0, 1), width=640, height=480)
    far = look_at(home + torch.tensor([3.0, 4.0, 2.0]), home + 0.5, up=(0, 0, 1), width=640, height=480)
    torch.testing.assert_close(far.project(points + home)[0], near.project(points)[0], rtol=0, atol=1e-5)
    moved = far.moved(Similarity(tuple(home.tolist()), 1.0))
    torch.testing.assert_close(moved.rays()[0], near.rays()[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"intrinsics": torch.eye(4).double()}, r"\(4, 4\)"),
        ({"intrinsics": torch.eye(3)}, "torch.float32"),
        ({"intrinsics": torch.tensor([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]).double()}, "fx, 0, cx"),
        ({"intrinsics": torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]]).double()}, "fx, fy > 0"),
        ({"intrinsics": torch.full((3, 3), math.nan).double()}, "not finite"),
        ({"world_from_camera": torch.tensor([1.0, 1, -1, 1]).double().diag()}, "rigid"),
        ({"world_from_camera": torch.tensor([2.0, 2, 2, 1]).double().diag()}, "rigid"),
        ({"world_from_camera": torch.tensor([1.0, 1, 1, 2]).double().diag()}, "rigid"),
        ({"width": 0}, "=0"),
        ({"height": -3}, "=-3"),
        ({"distortion": (0.1, math.inf)}, r"\(0.1, inf\)"),
        ({"distortion": (0.1,) * 9}, "at most 8"),
    ],
)
def test_a_camera_that_cannot_be_says_why(change, message):
    with pytest.raises(ValueError, match=f"{next(iter(change))}.*{message}"):
        replace(some_camera(), **change)


@pytest.mark.parametrize(
    ("view", "message"),
    [
        (lambda: orbit(BOX, up="x"), "up='x'"),
        (lambda: orbit(BOX, elevation=91), "elevation=91"),
        (lambda: orbit(BOX, azimuth=math.inf), "azimuth=inf"),
        (lambda: orbit(BOX, fov=180), "fov=180"),
        (lambda: orbit(BOX, margin=0), "margin=0"),
        (lambda: orbit(BOX, zoom=-1), "zoom=-1"),
        (lambda: orbit(BOX[:, :2]), "points: shape"),
        (lambda: orbit(BOX[:0]), "points: shape"),
        (lambda: orbit(BOX * math.nan), "points: shape"),
        (lambda: orbit(BOX[:1]), "coincide"),
        (lambda: turntable(BOX, 0), "frames=0"),
        (lambda: look_at((0, 0, 0), (0, 0, 0), width=4, height=4), "target"),
        (lambda: look_at((0, 0, 1), (0, 0, 0), up=(0, 0, 0), width=4, height=4), "up"),
        (lambda: look_at((0, 0), (0, 0, 0), width=4, height=4), "eye"),
        (lambda: some_camera().project(torch.zeros(4, 2)), "shape"),
    ],
)
def test_views_that_cannot_be_say_why(view, message):
    with pytest.raises(ValueError, match=message):
        view()


def test_a_strip_sees_what_its_rows_see():
    camera = look_at((1, 2, 5), (0, 0.1, 0), width=7, height=12)
    directions = camera.rays(dtype=torch.float64)[1]
    strip = camera.strip(4, 5)
    assert (strip.width, strip.height) == (7, 5)
    torch.testing.assert_close(strip.rays(dtype=torch.float64)[1], directions[4:9])
