"""Cameras from files: every dialect gives the camera that was written, and what cannot be read says why."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from mplicits.datasets import Camera, look_at, read_cameras
from photographs import projections, same_cameras, write_image
from photographs import transforms as transforms_of
from refusals import refused

WIDTH, HEIGHT = 40, 30


def cameras(count: int = 3) -> list[Camera]:
    """Cameras around the origin whose pixels are not square and whose axis is not in the middle."""
    intrinsics = torch.tensor([[55.0, 0, 18.5], [0, 53.0, 16.25], [0, 0, 1]], dtype=torch.float64)
    views = [look_at((3 - k, 0.5 * k, 2 + k), (0, 0.1, 0), width=WIDTH, height=HEIGHT) for k in range(count)]
    return [Camera(intrinsics, view.world_from_camera, WIDTH, HEIGHT) for view in views]


def transforms(**shared: object) -> dict:
    return transforms_of(cameras(), **shared)


FOCAL = {"fl_x": 55.0, "fl_y": 53.0, "cx": 19.0, "cy": 16.75}  # counted from the corner, half a pixel before the centre
SIZE = {"w": float(WIDTH), "h": HEIGHT}
BLANK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def write_json(folder: Path, content: object) -> Path:
    path = folder / "transforms.json"
    path.write_text(json.dumps(content))
    return path


def write_neus(folder: Path, **changes: np.ndarray | None) -> Path:
    for index in range(3):
        write_image(folder / "image" / f"{index:03d}.png", BLANK)
    path = folder / "cameras_sphere.npz"
    arrays = {**projections(cameras()), **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def assert_same(read: list[tuple[str, Camera]], names: list[str]) -> None:
    assert [name for name, _ in read] == names
    same_cameras([camera for _, camera in read], cameras())


NAMES = [f"images/{k}.png" for k in range(3)]


def test_intrinsics_in_each_frame_go_before_those_at_the_top(tmp_path):
    content = transforms(fl_x=1.0, fl_y=1.0, cx=1.0, cy=1.0, w=1, h=1)
    for frame in content["frames"]:
        frame.update(FOCAL, **SIZE)
    assert_same(read_cameras(write_json(tmp_path, content)), NAMES)


@pytest.mark.parametrize("file", ["images/{}.png", "images/{}.png.png"])
def test_without_a_size_that_of_the_image_counts_with_or_without_its_extension(file, tmp_path):
    for k in range(3):
        write_image(tmp_path / file.format(k), BLANK)
    assert_same(read_cameras(write_json(tmp_path, transforms(**FOCAL))), NAMES)


@pytest.mark.parametrize(
    ("given", "focal"),
    [
        ({"camera_angle_x": math.pi / 2}, (20.0, 20.0)),
        ({"camera_angle_x": math.pi / 2, "camera_angle_y": 2 * math.atan(0.5)}, (20.0, 30.0)),
        ({"camera_angle_x": 1.0, "fl_x": 55.0}, (55.0, 55.0)),
    ],
)
def test_an_angle_of_view_takes_the_place_of_the_focal_length(given, focal, tmp_path):
    (_, camera), *_ = read_cameras(write_json(tmp_path, transforms(**given, **SIZE)))
    assert camera.fx_fy_cx_cy == pytest.approx((*focal, 19.5, 14.5))


def test_poses_are_made_rigid_from_few_digits_three_rows_or_a_scale(tmp_path):
    content = transforms(**FOCAL, **SIZE)
    matrices = [np.array(frame["transform_matrix"]) for frame in content["frames"]]
    matrices[1][:3, :3] *= 1.7
    for frame, matrix in zip(content["frames"], (matrices[0].round(5), matrices[1], matrices[2][:3]), strict=True):
        frame["transform_matrix"] = matrix.tolist()
    for (_, camera), expected in zip(read_cameras(write_json(tmp_path, content)), cameras(), strict=True):
        torch.testing.assert_close(camera.world_from_camera, expected.world_from_camera, rtol=0, atol=2e-5)


@pytest.mark.parametrize("factor", [-1.0, 0.01])
def test_a_projection_has_no_sign_and_no_scale(factor, tmp_path):
    with np.load(write_neus(tmp_path)) as archive:
        changed = {name: archive[name] * factor for name in archive.files if name.startswith("world")}
    assert_same(read_cameras(write_neus(tmp_path, **changed)), [f"image/{k:03d}.png" for k in range(3)])


def frame_change(**change: object) -> dict:
    content = transforms(**FOCAL, **SIZE)
    content["frames"][1].update(change)
    return content


def without(key: str) -> dict:
    content = transforms(**FOCAL, **SIZE)
    for part in (content, content["frames"][1]):
        part.pop(key, None)
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], r"transforms\.json: frames: expected a list"),
        ({"cameras": []}, "frames: expected a list"),
        ({"frames": []}, "frames: expected a list of at least one"),
        ({"frames": ["a"]}, r"frames\[0\]: expected an object"),
        (without("file_path"), r"frames\[1\]\.file_path: None"),
        (without("fl_x"), r"frames\[0\]\.fl_x: missing"),
        (without("w"), r"frames\[0\]\.file_path: no image .*images/0\.png"),
        (without("transform_matrix"), r"frames\[1\]\.transform_matrix: missing"),
        (frame_change(transform_matrix=[[1, 0], [0, 1]]), r"frames\[1\]\.transform_matrix: shape \(2, 2\)"),
        (frame_change(transform_matrix=[[1, 0], [0]]), r"frames\[1\]\.transform_matrix: expected a rigid pose"),
        (frame_change(transform_matrix=np.zeros((4, 4)).tolist()), r"frames\[1\]\.transform_matrix: is singular"),
        (frame_change(transform_matrix=np.diag([1, 1, -1, 1]).tolist()), "transform_matrix: is singular, mirrored"),
        (frame_change(transform_matrix=np.diag([1, 1.1, 1, 1]).tolist()), "transform_matrix: .* oblique"),
        (frame_change(fl_x=-3), r"frames\[1\]\.fl_x: -3; expected more than 0"),
        (frame_change(cx="middle"), r"frames\[1\]\.cx: 'middle'; expected a finite number"),
        (transforms(**SIZE, camera_angle_x=4), r"camera_angle_x: 4; expected radians"),
        (frame_change(w=40.5), r"frames\[1\]\.w: 40\.5; expected whole pixels"),
        (transforms(**FOCAL, **SIZE, camera_model="OPENCV_FISHEYE"), "json: camera_model: 'OPENCV_FISHEYE': no"),
        (transforms(**FOCAL, **SIZE, is_fisheye=True), "is_fisheye: True: no pinhole; undistort"),
    ],
)
def test_what_is_wrong_with_a_transforms_json_is_said_in_one_line(content, message, tmp_path):
    path = write_json(tmp_path, content)
    with refused(path, message):
        read_cameras(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({f"world_mat_{k}": None for k in range(3)}, "world_mat_0: no such array"),
        ({"world_mat_2": None}, "2 world_mat_i, but 3 images in .*image; make them match"),
        ({"world_mat_2": None, "world_mat_3": np.eye(4)}, "world_mat_2: no such array; number them"),
        ({"world_mat_1": np.eye(3)}, r"world_mat_1: float64 of shape \(3, 3\)"),
        ({"world_mat_1": np.full((4, 4), "a")}, "world_mat_1: <U1 of shape"),
        ({"world_mat_1": np.diag([1.0, 1, 0, 1])}, "world_mat_1: .* singular"),
        ({"world_mat_1": np.array([[9.0, 1, 0, 0], [0, 9, 0, 0], [0, 0, 1, 0]])}, "world_mat_1: .* skewed by 1.7"),
    ],
)
def test_what_is_wrong_with_a_neus_file_is_said_in_one_line(changes, message, tmp_path):
    path = write_neus(tmp_path, **changes)
    with refused(path, message):
        read_cameras(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("absent.json", "no such file"),
        ("", r"none of cameras_sphere\.npz, "),
        ("cameras.txt", "unknown extension '.txt'"),
        ("cameras.npz", "damaged or not a NumPy file"),
    ],
)
def test_files_that_cannot_be_read_say_so(tmp_path, name, message):
    if name.startswith("cameras"):
        (tmp_path / name).write_text("1 2 3")
    with refused(tmp_path / name, message):
        read_cameras(tmp_path / name)


def test_images_that_are_missing_or_damaged_are_named(tmp_path):
    path = write_neus(tmp_path)
    image = tmp_path / "image" / "001.png"
    image.write_bytes(b"\x89PNG\r\n\x1a\n damaged")
    with refused(image, "cannot be read as an image"):
        read_cameras(path)
    for image in (tmp_path / "image").iterdir():
        image.unlink()
    with refused(path, "no images"):
        read_cameras(path)
