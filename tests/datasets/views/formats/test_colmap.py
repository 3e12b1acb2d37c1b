"""COLMAP models: text and binary give the cameras and points that were written; what is damaged says so."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from mplicits.datasets import Camera, look_at, read_cameras
from mplicits.datasets.views.formats.colmap import MODELS, read_colmap, read_colmap_points
from photographs import colmap_pose, same_cameras
from refusals import refused

WIDTH, HEIGHT = 40, 30
NAMES = ("b side.jpg", "a.jpg", "sub/c.jpg")
POINTS = np.array([[0.5, -1.25, 3.0], [1e6, 2.0, 0.125], [-0.3, 0.2, 0.1]])
ONE, TWO = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
NUMBERS = {"f": 55.0, "fx": 55.0, "fy": 53.0, "cx": 19.0, "cy": 16.75}
LENSES = {
    "SIMPLE_PINHOLE": (ONE, ()),
    "PINHOLE": (TWO, ()),
    "SIMPLE_RADIAL": (ONE, (0.1,)),
    "RADIAL": (ONE, (0.1, -0.2)),
    "OPENCV": (TWO, (0.1, -0.2, 0.01, 0.02)),
    "FULL_OPENCV": (TWO, (0.1, -0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6)),
}


def cameras(model: str = "PINHOLE") -> dict[str, Camera]:
    fy = 53.0 if "fy" in LENSES[model][0] else 55.0
    intrinsics = torch.tensor([[55.0, 0, 18.5], [0, fy, 16.25], [0, 0, 1]], dtype=torch.float64)
    views = [look_at((3 - k, 0.5 * k, 2 + k), (0, 0.1, 0), width=WIDTH, height=HEIGHT) for k in range(3)]
    return {n: Camera(intrinsics, v.world_from_camera, WIDTH, HEIGHT) for n, v in zip(NAMES, views, strict=True)}


def poses(model: str) -> dict[str, list[float]]:
    """World to camera: quaternions w, x, y, z, of any length and sign, and shifts."""
    found = {}
    for factor, (name, camera) in zip((1.0, -1.0, 2.0), cameras(model).items(), strict=True):
        pose = colmap_pose(camera)
        found[name] = [*(factor * part for part in pose[:4]), *pose[4:]]
    return found


def write_text(folder: Path, model: str = "PINHOLE", **changes: str) -> Path:
    form, distortion = LENSES[model]
    numbers = " ".join(str(number) for number in (*(NUMBERS[key] for key in form), *distortion))
    images = "# Image list\n# two lines each\n"
    for k, (name, pose) in enumerate(poses(model).items()):
        seen = "" if k == 1 else "1.5 2.5 -1 3.0 4.0 7"  # the line of an image without points is empty
        images += f"{k + 5} {' '.join(map(repr, pose))} 3 {name}\n{seen}\n"
    rows = [f"{k} {x!r} {y!r} {z!r} 9 9 9 0.5 5 0 6 1" for k, (x, y, z) in enumerate(POINTS.tolist())]
    files = {
        "cameras": f"# Camera list\n3 {model} {WIDTH} {HEIGHT} {numbers}\n",
        "images": images,
        "points3D": "# 3D point list\n" + "\n".join(rows) + "\n",
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in {**files, **changes}.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def write_binary(folder: Path, model: str = "PINHOLE") -> Path:
    form, distortion = LENSES[model]
    numbers = [*(NUMBERS[key] for key in form), *distortion]
    lens = struct.pack("<iiQQ", 3, list(MODELS).index(model), WIDTH, HEIGHT)
    images = struct.pack("<Q", len(NAMES))
    for k, (name, pose) in enumerate(poses(model).items()):
        images += struct.pack("<I7di", k + 5, *pose, 3) + name.encode() + b"\0"
        images += struct.pack("<Q", k) + k * struct.pack("<ddq", 1.5, 2.5, -1)
    points = struct.pack("<Q", len(POINTS))
    for k, point in enumerate(POINTS):
        points += struct.pack("<Q3d3BdQ", k, *point, 9, 9, 9, 0.5, k) + k * struct.pack("<II", 5, 0)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + lens + struct.pack(f"<{len(numbers)}d", *numbers))
    (folder / "images.bin").write_bytes(images)
    (folder / "points3D.bin").write_bytes(points)
    return folder


WRITERS = (write_text, write_binary)


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("model", LENSES)
def test_every_model_gives_its_cameras_in_the_order_of_names(model, write, tmp_path):
    shots = read_colmap(write(tmp_path, model))
    assert [shot.name for shot in shots] == sorted(NAMES)
    same_cameras([shot.placed for shot in shots], [cameras(model)[name] for name in sorted(NAMES)])
    assert all(shot.placed.distortion == LENSES[model][1] for shot in shots)


@pytest.mark.parametrize("write", WRITERS)
def test_points_keep_all_their_digits_and_say_which_images_saw_them(write, tmp_path):
    found = read_colmap_points(write(tmp_path))
    np.testing.assert_array_equal(found[0], POINTS)
    # Images 5, 6 and 7 are b, a and c, whose order by name is a, b, c. The text says 5 and 6 of every point, the binary
    # file 5 of the second and twice of the third.
    expected = [[1, 0], [0, 0], [1, 1], [0, 1], [1, 2], [0, 2]] if write is write_text else [[1, 1], [1, 2], [1, 2]]
    assert found[1].tolist() == expected


def test_images_that_are_not_in_the_model_saw_nothing(tmp_path):
    rows = "1 0 0 0 9 9 9 0.5 4 0 6 1 99 3\n2 1 0 0 9 9 9 0.5\n"
    assert read_colmap_points(write_text(tmp_path, points3D=rows))[1].tolist() == [[0, 0]]


def test_a_model_without_points_has_none(tmp_path):
    assert read_colmap_points(write_text(tmp_path, points3D="# 3D point list\n")) is None
    (tmp_path / "points3D.txt").unlink()
    assert read_colmap_points(tmp_path) is None
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    assert read_colmap_points(tmp_path) is None


@pytest.mark.parametrize("place", ["sparse/10", "sparse", "."])
@pytest.mark.parametrize("write", WRITERS)
def test_the_model_with_most_photographs_is_found_where_colmap_leaves_it(place, write, tmp_path):
    write(tmp_path / place)
    if place == "sparse/10":
        write_text(tmp_path / "sparse" / "2", images="1 1 0 0 0 0 0 0 3 a.jpg\n\n")  # of one photograph
    for folder in (tmp_path, tmp_path / place):
        assert [name for name, _ in read_cameras(folder)] == sorted(NAMES)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_images_and_masks_are_found_beside_the_model(place, tmp_path):
    for name in ("images/x", "masks/x"):
        (tmp_path / name).parent.mkdir()
    (tmp_path / "masks" / "a.jpg.png").touch()
    (tmp_path / "masks" / "b side.png").touch()
    shots = read_colmap(write_text(tmp_path / place))
    assert [shot.image for shot in shots] == [tmp_path / "images" / name for name in sorted(NAMES)]
    masks = [shot.mask for shot in shots]
    assert masks == [tmp_path / "masks" / name for name in ("a.jpg.png", "b side.png", "sub/c.jpg.png")]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": "3 PINHOLE 40 30 55 53 19\n"}, r"cameras\.txt: camera 3: 3 numbers; PINHOLE has 4"),
        ({"cameras": "3 PINHOLE 40\n"}, r"cameras\.txt: '3 PINHOLE 40': expected CAMERA_ID MODEL"),
        ({"cameras": "3 PINHOLE 40 30 55 x 19 16\n"}, r"cameras\.txt: '3 PINHOLE 40 30 55 x 19 16': expected CAMERA"),
        ({"cameras": "3 PINHOLE 40 30 nan 53 19 16\n"}, r"camera 3: 40 × 30, \(nan, .*; expected finite numbers"),
        ({"cameras": "3 PINHOLE 40 30 55 -53 19 16\n"}, r"camera 3: .*; expected finite numbers, and sizes"),
        ({"cameras": "3 PINHOLE 0 30 55 53 19 16\n"}, r"camera 3: 0 × 30.*; expected finite numbers, and sizes"),
        ({"cameras": "3 OPENCV_FISHEYE 40 30 55 53 19 16 0 0 0 0\n"}, "OPENCV_FISHEYE: no pinhole; run colmap"),
        ({"cameras": "3 BRAND_NEW 40 30 55\n"}, r"camera 3: BRAND_NEW: no pinhole; run colmap"),
        ({"cameras": "4 PINHOLE 40 30 55 53 19 16\n"}, r"images\.txt: a\.jpg: its camera 3 is not in cameras\.txt"),
        ({"images": "# nothing\n"}, r"images\.txt: no images; expected at least one"),
        ({"images": "5 1 0 0 0 0 0 1 3\n\n"}, r"images\.txt: '5 1 0 .*: expected IMAGE_ID QW"),
        ({"images": "5 1 0 x 0 0 0 1 3 a.jpg\n\n"}, r"images\.txt: '5 1 0 x .*: expected IMAGE_ID QW"),
        ({"points3D": "1 0 0\n"}, r"points3D\.txt: expected POINT3D_ID X Y Z"),
        ({"points3D": "1 0 0 x 9 9 9 0.5\n"}, r"points3D\.txt: expected POINT3D_ID X Y Z"),
        ({"points3D": "1 0 0 0 9 9 9 0.5 x 0\n"}, r"points3D\.txt: expected POINT3D_ID X Y Z"),
        ({"points3D": f"1 0 0 0 9 9 9 0.5 {10**30} 0\n"}, r"points3D\.txt: expected POINT3D_ID X Y Z"),
        ({"points3D": "1 0 0 nan 9 9 9 0.5\n"}, r"points3D\.txt: holds a number that is not finite"),
    ],
)
def test_what_is_wrong_with_a_text_model_is_said_in_one_line(changes, message, tmp_path):
    read = read_colmap_points if "points3D" in changes else read_colmap
    folder = write_text(tmp_path, **changes)
    with refused(folder, message):
        read(folder)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_binary_file_cut_anywhere_ends_early(file, tmp_path):
    path = write_binary(tmp_path) / file
    data = path.read_bytes()
    read = read_colmap_points if file == "points3D.bin" else read_colmap
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with refused(path, f"ends early, after {length} bytes"):
            read(tmp_path)


def test_an_unknown_number_of_a_model_is_said(tmp_path):
    path = write_binary(tmp_path) / "cameras.bin"
    data = path.read_bytes()
    path.write_bytes(data[:12] + struct.pack("<i", 99) + data[16:])
    with refused(path, "camera 3: unknown model 99"):
        read_colmap(tmp_path)


def test_files_that_are_missing_or_no_text_are_named(tmp_path):
    folder = write_text(tmp_path)
    (folder / "cameras.txt").write_bytes(b"\xff\xfe\x00")
    with refused(folder / "cameras.txt", "is not text"):
        read_cameras(folder)
    write_text(tmp_path)
    (folder / "images.txt").unlink()
    with refused(folder, r"neither images\.bin nor images\.txt"):
        read_cameras(folder)
