"""Depth maps, pictures, lenses and poses from files: what was written comes back, and mistakes give one line."""

import json

import cv2
import numpy as np
import pytest
from mplicits.datasets import DepthCamera, is_depth_file, look_at, read_color, read_depth, read_intrinsics, read_poses
from mplicits.datasets.depth.images import fit_color
from refusals import refused
from scipy.spatial.transform import Rotation

OURS = {"width": 8, "height": 6, "fx": 10.0, "fy": 11.0, "cx": 3.5, "cy": 2.25}
LENS = DepthCamera(160, 120, 130.0, 128.0, 81.5, 57.0, (-0.28, 0.09, 1e-3, -7e-4, -0.01))


@pytest.fixture
def steps():
    """Millimetres; the first two pixels have no reading."""
    values = np.random.default_rng(1).integers(400, 9000, (6, 8)).astype(np.uint16)
    values[0, :2] = 0
    return values


def write(path, values):
    """Write an array, bytes, text or JSON → the path."""
    path.parent.mkdir(exist_ok=True)
    if isinstance(values, bytes):
        path.write_bytes(values)
    elif not isinstance(values, np.ndarray):
        path.write_text(values if isinstance(values, str) else json.dumps(values))
    elif path.suffix == ".npy":
        np.save(path, values)
    else:
        assert cv2.imwrite(str(path), values)
    return path


def same(read, expected):
    assert read.dtype == np.float64
    assert np.array_equal(np.isnan(read), np.isnan(expected))
    assert np.nanmax(np.abs(read / expected - 1)) < 1e-12


def with_holes(values):
    return np.where(values > 0, values.astype(np.float64), np.nan)


@pytest.mark.parametrize("name", ["depth.png", "depth.tif", "depth.tiff", "depth.npy", "DEPTH.PNG"])
@pytest.mark.parametrize(("scale", "camera", "divisor"), [(None, None, 1000), (None, 5000, 5000), (250, 5000, 250)])
def test_integers_are_steps_of_a_unit(tmp_path, steps, name, scale, camera, divisor):
    path = write(tmp_path / name, steps)
    same(read_depth(path, scale=scale, integer_scale=camera), with_holes(steps) / divisor)


@pytest.mark.parametrize("name", ["depth.tif", "depth.npy"])
def test_floats_are_units(tmp_path, steps, name):
    values = (steps / 1000).astype(np.float32)
    values[1, 1], values[2, 2], values[3, 3], values[4, 4] = np.nan, np.inf, -1, -np.inf
    expected = with_holes(values)
    expected[2, 2] = np.nan
    path = write(tmp_path / name, values)
    same(read_depth(path, integer_scale=5000), expected)
    same(read_depth(path, scale=2), expected / 2)


def test_disparities_are_inverse_depths(tmp_path, steps):
    path = write(tmp_path / "disparity.npy", steps.astype(np.float32))
    same(read_depth(path, inverse=True), 1 / with_holes(steps))
    same(read_depth(path, inverse=True, scale=500, integer_scale=7), 500 / with_holes(steps))


def test_archives_and_single_channels(tmp_path, steps):
    np.savez(tmp_path / "a.npz", depth=steps[None] / 1000.0, confidence=steps)
    np.savez(tmp_path / "b.npz", steps[..., None] / 1000.0)
    for name in ("a.npz", "b.npz"):
        same(read_depth(tmp_path / name), with_holes(steps) / 1000)
    np.savez(tmp_path / "c.npz", near=steps, far=steps)
    with refused(tmp_path / "c.npz", "near, far"):
        read_depth(tmp_path / "c.npz")


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("a.png", np.full((6, 8), 200, np.uint8), "8 bits per pixel cannot hold depths"),
        ("a.png", np.full((6, 8, 3), 200, np.uint16), "of one channel, not a colour picture"),
        ("a.png", np.zeros((6, 8), np.uint16), "no pixel has a positive depth"),
        ("a.npy", np.zeros(5), "of one channel"),
        ("a.npy", np.full((6, 8), "x"), "expected numbers"),
        ("a.npy", np.full((6, 8), np.nan), "no pixel has a positive depth"),
        ("none.png", None, "no such file"),
        ("none.npy", None, "no such file"),
        ("damaged.png", b"no image at all", "export it again"),
        ("damaged.npy", b"no image at all", "export it again"),
        ("damaged.npz", b"no image at all", "export it again"),
        ("empty.tif", b"", "export it again"),
        ("a.exr", None, "unknown extension '.exr'"),
    ],
)
def test_what_is_no_depth_map(tmp_path, name, values, message):
    path = tmp_path / name if values is None else write(tmp_path / name, values)
    with refused(path, message):
        read_depth(path)


def test_a_scale_of_zero_is_refused(tmp_path, steps):
    with pytest.raises(ValueError, match="scale=0"):
        read_depth(write(tmp_path / "a.png", steps), scale=0)


@pytest.mark.parametrize("largest", [65535, np.iinfo(np.int32).max, 65.535, 65504.0, 1e10, np.inf])
def test_the_largest_number_is_no_reading(tmp_path, largest):
    """As sensors and renderers write it where there is nothing; but of inverse depths it is the nearest."""
    kind = np.int32 if isinstance(largest, int) else np.float32
    values = np.full((6, 8), 2, kind)
    values[:, :3] = largest
    path = write(tmp_path / "a.npy", values)
    assert (np.isnan(read_depth(path)) == (values == largest)).all()
    if np.isfinite(largest):
        assert np.isfinite(read_depth(path, inverse=True)).all()
        assert np.isfinite(read_depth(path, saturates=False)).all()


def test_tables_of_points_are_no_depth_maps(tmp_path):
    for name, shape, expected in (("a", (9, 16), True), ("b", (9, 4), False), ("d", (1, 6, 8), True)):
        assert is_depth_file(write(tmp_path / f"{name}.npy", np.ones(shape))) == expected
    np.savez(tmp_path / "points.npz", points=np.ones((9, 3)))
    np.savez(tmp_path / "depth.npz", depth=np.ones((9, 3)))
    write(tmp_path / "damaged.npy", b"?")
    for name, expected in (("points.npz", False), ("depth.npz", True), ("damaged.npy", False)):
        assert is_depth_file(tmp_path / name) == expected
    assert is_depth_file("scan.TIFF")
    assert not is_depth_file("scan.ply")


def test_pictures_are_rgb(tmp_path):
    rgb = np.random.default_rng(2).integers(0, 256, (4, 5, 3)).astype(np.uint8)
    for kind, factor in ((np.uint8, 1), (np.uint16, 257)):
        stored = rgb[..., ::-1].astype(kind) * factor
        assert np.array_equal(read_color(write(tmp_path / "rgb.png", stored)), rgb)
    for name, values, message in (("a.tif", np.ones((4, 5), np.float32), "float32"), ("a.npy", rgb, "extension")):
        with refused(tmp_path / name, message):
            read_color(write(tmp_path / name, values))


def test_pictures_of_another_size():
    # Half of the light of white is 188 on the display, not 128: the mean of black and white, in linear light.
    checker = np.zeros((8, 12, 3), np.uint8)
    checker[::2, ::2] = checker[1::2, 1::2] = 255
    assert fit_color(checker, (12, 8), source="c.png") is checker
    assert np.unique(fit_color(checker, (6, 4), source="c.png", resize=True)).tolist() == [188]
    for size, resize, message in (((6, 4), False, "12 × 8 .*6 × 4; .*--resize-color"), ((8, 8), True, "registered")):
        with refused("c.png", message):
            fit_color(checker, size, source="c.png", resize=resize)


ROWS = [10, 0, 3.5, 0, 11, 2.25, 0, 0, 1]
COLUMNS = [10, 0, 0, 0, 11, 0, 3.5, 2.25, 1]
ROS = """image_width: 8
image_height: 6
camera_name: depth
distortion_model: plumb_bob
camera_matrix:
  rows: 3
  cols: 3
  data: [10, 0, 3.5, 0, 11, 2.25, 0, 0, 1]
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, 0, 0, -0.2, 0]
"""
OPENCV = """%YAML:1.0
---
image_width: 8
image_height: 6
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 10., 0., 3.5, 0., 11., 2.25, 0., 0., 1. ]
"""
OPEN3D = {"class_name": "PinholeCameraParameters", "intrinsic": {"width": 8, "height": 6, "intrinsic_matrix": COLUMNS}}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("camera.json", OURS | {"k4": 0, "note": "x"}),
        ("Open3D.json", {"width": 8, "height": 6, "intrinsic_matrix": COLUMNS}),
        ("Open3D.json", OPEN3D | {"extrinsic": np.eye(4).ravel().tolist()}),
        ("Record3D.json", {"w": 8, "h": 6, "K": COLUMNS, "fps": 30}),
        ("Polycam.json", OURS | {"t_00": 1.0, "blur_score": 2.0}),
        ("ROS.json", {"width": 8, "height": 6, "K": ROWS, "D": [0] * 5}),
        ("rows.json", {"width": 8, "height": 6, "camera_matrix": [ROWS[:3], ROWS[3:6], ROWS[6:]]}),
        ("ROS.yaml", ROS),
        ("OpenCV.yml", OPENCV),
        ("K.txt", "10 0 3.5\n0 11 2.25\n0 0 1\n"),
        ("NumPy.txt", "[[10.0, 0, 3.5],\n [0, 11, 2.25],\n [0, 0, 1]]\n"),
        ("intrinsic_depth.txt", "10 0 3.5 0\n0 11 2.25 0\n0 0 1 0\n0 0 0 1\n"),
        ("four.txt", "# fx fy cx cy\n10, 11, 3.5, 2.25\n"),
    ],
)
def test_intrinsics_of_other_programs(tmp_path, name, content):
    distortion = (0.1, 0.0, 0.0, -0.2, 0.0) if name == "ROS.yaml" else (0.0,) * 5
    lens = read_intrinsics(write(tmp_path / name, content), size=(8, 6))
    assert lens == DepthCamera(8, 6, 10.0, 11.0, 3.5, 2.25, distortion)


def test_distortion_and_scale_of_our_intrinsics(tmp_path):
    path = write(tmp_path / "camera.json", OURS | {"depth_scale": 5000, "k1": 0.1, "p2": -0.2})
    assert read_intrinsics(path) == DepthCamera(8, 6, 10.0, 11.0, 3.5, 2.25, (0.1, 0.0, 0.0, -0.2, 0.0), 5000.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({k: v for k, v in OURS.items() if k not in ("fx", "cy")}, "fx, cy: missing"),
        (OURS | {"fx": "10"}, "fx: '10'"),
        (OURS | {"fx": -10}, "fx=-10.0"),
        (OURS | {"width": 8.5}, "width: 8.5"),
        (OURS | {"k5": 0.1}, "k5: lenses"),
        (OURS | {"depth_scale": 0}, "depth_scale=0.0"),
        ({"width": 8, "height": 6, "K": [10, 0.5, 3.5, 0, 11, 2.25, 0, 0, 1]}, "K: .*expected fx 0 cx"),
        ({"width": 8, "height": 6, "intrinsic_matrix": [[10, 0, 3.5]]}, "intrinsic_matrix: .*expected fx 0 cx"),
        ({"width": 8, "height": 6, "K": ROWS, "D": [0.1], "distortion_model": "fisheye"}, "distortion_model: fisheye"),
        ([1, 2], "--intrinsics FX FY CX CY"),
    ],
)
def test_bad_intrinsics(tmp_path, content, message):
    path = write(tmp_path / "camera.json", content)
    with refused(path, message):
        read_intrinsics(path)


def test_lenses_from_an_angle_or_a_camera():
    lens = DepthCamera.from_fov(90.0, 9, 5)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx((2.5, 2.5, 4, 2))
    assert DepthCamera.from_camera(look_at((0, 0, 4), (0, 0, 0), fov=90.0, width=9, height=5)) == lens


def test_distortion_is_undone_and_is_that_of_opencv():
    depth = np.random.default_rng(3).uniform(1, 3, (120, 160))
    points = LENS.unproject(depth).reshape(-1, 3)
    camera = LENS.at(np.eye(4))
    pixels, _, inside = camera.in_view(points)
    assert inside.all()
    assert np.abs(pixels.reshape(120, 160, 2) - np.dstack(np.meshgrid(np.arange(160), np.arange(120)))).max() < 1e-8
    theirs, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.intrinsics.numpy(), np.array(LENS.distortion)
    )
    assert np.abs(pixels - theirs[:, 0]).max() < 1e-8
    straight = DepthCamera(160, 120, LENS.fx, LENS.fy, LENS.cx, LENS.cy).unproject(depth).reshape(-1, 3)
    assert np.abs(points - straight).max() > 0.05  # so that the test would notice a lens left out


POSE = np.eye(4)
POSE[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
POSE[:3, 3] = 1.5, -2, 1e4
QUATERNION = [0, 0, np.sin(0.15), np.cos(0.15)]
OPENGL = POSE @ np.diag([1.0, -1, -1, 1])  # the same pose in axes with y up and z backward


EXTRINSICS = [np.linalg.inv(pose).T.ravel().tolist() for pose in (POSE, np.eye(4))]
RECORD3D = [[*Rotation.from_matrix(OPENGL[:3, :3]).as_quat(), *POSE[:3, 3]], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]


def polycam(pose):
    return OURS | {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}


def text(rows):
    return "".join(" ".join(f"{x:.12g}" for x in row) + "\n" for row in rows)


W_FIRST = f"5.25 {text([[*POSE[:3, 3], *np.roll(QUATERNION, 1)]])}5.5 0 0 0 2 0 0 0\n"


@pytest.mark.parametrize(
    ("files", "names"),
    [
        ({"trajectory.log": f"0 0 2\n{text(POSE)}\n1 1 2\n{text(np.eye(4))}"}, [None, None]),
        ({"tum.txt": f"# timestamp\n5.25 {text([[*POSE[:3, 3], *QUATERNION]])}5.5 0 0 0 0 0 0 2\n"}, ["5.25", "5.5"]),
        ({"tum.txt": f"#timestamp [ns],p_x [m],p_y,p_z,q_w [],q_x,q_y,q_z\n{W_FIRST}"}, ["5.25", "5.5"]),
        ({"kitti.txt": text([POSE[:3].ravel(), np.eye(4)[:3].ravel()])}, [None, None]),
        ({"poses/2.txt": text(POSE), "poses/10.txt": text(np.eye(4)[:3]), "poses/.hidden.txt": "x"}, ["2", "10"]),
        ({"open3d.json": {"parameters": [{"extrinsic": e} for e in EXTRINSICS]}}, [None, None]),
        ({"metadata": {"K": COLUMNS, "poses": RECORD3D}}, ["0", "1"]),
        ({"cameras/7.json": polycam(OPENGL), "cameras/11.json": polycam(np.diag([1.0, -1, -1, 1]))}, ["7", "11"]),
    ],
    ids=["Open3D log", "TUM", "w first", "KITTI", "folder", "Open3D JSON", "Record3D", "Polycam"],
)
def test_poses_of_other_programs_are_camera_to_world(tmp_path, files, names):
    paths = [write(tmp_path / name, content) for name, content in files.items()]
    found, poses, lenses = zip(*read_poses(paths[0] if paths[0].parent == tmp_path else paths[0].parent), strict=True)
    assert list(found) == names
    assert np.abs(poses[0] - POSE).max() < 1e-8
    assert np.abs(poses[1] - np.eye(4)).max() < 1e-12
    assert np.abs(poses[0][:3, :3].T @ poses[0][:3, :3] - np.eye(3)).max() < 1e-14
    assert lenses == (DepthCamera(**OURS) if names == ["7", "11"] else None,) * 2


LOST = np.full((4, 4), -np.inf)  # as ScanNet writes it


def frame(pose):
    return {"file_path": "a.png", "transform_matrix": pose.tolist()}


@pytest.mark.parametrize(
    "files",
    [
        {"poses/0.txt": text(LOST), "poses/1.txt": text(POSE)},
        {"poses/0.txt": text([*LOST[:3], [0, 0, 0, 1]]), "poses/1.txt": text(POSE)},
        {"a.log": f"0 0 1\n{text(LOST)}\n1 1 1\n{text(POSE)}"},
        {"kitti.txt": text([np.full(12, np.nan), POSE[:3].ravel()])},
        {"tum.txt": text([[0, *[np.nan] * 7], [1, *POSE[:3, 3], *QUATERNION]])},
        {"metadata": {"poses": [[np.nan] * 7, RECORD3D[0]]}},
        {"transforms.json": {"w": 8, "h": 6, "fl_x": 9, "frames": [frame(LOST), frame(OPENGL)]}},
    ],
    ids=["ScanNet", "with a last row", "Open3D log", "KITTI", "TUM", "Record3D", "transforms"],
)
def test_lost_frames_have_no_pose(tmp_path, files):
    paths = [write(tmp_path / name, content) for name, content in files.items()]
    (_, lost, _), (_, found, _) = read_poses(paths[0] if len(paths) == 1 else paths[0].parent)
    assert np.isnan(lost).all()
    assert np.abs(found - POSE).max() < 1e-8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 1\n1 0 0 0\n0 1 0 0\n", "3 lines of .* numbers; no poses"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 x\n0 0 0 1\n", "no poses in it; .*could not convert"),
        ("", "0 lines"),
        ("1 0 0 0 0 0 0 0\n", "frame 0: .*expected a rigid pose"),
        ("0 0 1\n2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "frame 0: .*expected a rigid pose"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "frame 0: .*expected a rigid pose"),
        ("0 0 1\n1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "frame 0: .*expected a rigid pose"),
    ],
)
def test_bad_trajectories(tmp_path, text, message):
    path = write(tmp_path / "trajectory.log", text)
    with refused(path, message):
        read_poses(path)


def test_poses_with_names_and_lenses(tmp_path):
    frame = {"file_path": "images/b.png", "transform_matrix": np.diag([1.0, -1, -1, 1]).tolist()}
    content = {"w": 8, "h": 6, "fl_x": 10, "cx": 4, "cy": 3, "frames": [frame]}
    ((name, pose, lens),) = read_poses(write(tmp_path / "transforms.json", content))
    assert name == "images/b.png"
    assert np.abs(pose - np.eye(4)).max() < 1e-12  # OpenGL's axes became OpenCV's
    assert lens == DepthCamera(8, 6, 10.0, 10.0, 3.5, 2.5)
    with refused(tmp_path / "none.log", "no such file"):
        read_poses(tmp_path / "none.log")
