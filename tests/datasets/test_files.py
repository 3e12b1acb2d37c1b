"""Files are opened in one way: what they hold comes back as stored, and what is wrong with them is one line."""

import os
import struct

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
from mplicits.datasets import files, read_cloud, read_depth
from mplicits.datasets.files import read_arrays, read_image, read_json, read_rgb
from mplicits.neural_fields.backend.files import files_in
from refusals import refused

RGBA = np.random.default_rng(0).integers(0, 256, (3, 5, 4)).astype(np.uint8)


HUGE = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 10_000, 10_000, 16, 0, 0, 0, 0)


def stored(extension, image):
    return cv2.imencode(extension, image)[1].tobytes()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("extension", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_images_keep_their_bits_and_channels(kind, extension, channels):
    values = RGBA.astype(kind) * (257 if kind is np.uint16 else 1)
    expected = values[..., 0] if channels == 1 else values[..., :channels]
    blue_first = expected if channels == 1 else values[..., [2, 1, 0, 3][:channels]]
    found = files.decode_image(stored(extension, blue_first))
    assert found.dtype == kind
    assert np.array_equal(found, expected)
    rgb, alpha = files.rgb_and_alpha(found)
    assert np.array_equal(rgb, np.repeat(values[..., :1], 3, axis=2) if channels == 1 else values[..., :3])
    assert alpha is None if channels < 4 else np.array_equal(alpha, values[..., 3])
    assert np.abs(files.unit_range(rgb) - rgb / np.iinfo(kind).max).max() < 1e-7


def test_bytes_are_rounded_to_the_nearest_and_clamped():
    numbers = np.array([-0.5, 0.0, 0.4999 / 255, 0.5001 / 255, 1.0, 2.0])
    assert files.to_bytes(numbers).tolist() == [0, 0, 0, 1, 255, 255]
    assert files.to_bytes(np.array([0, 128, 129, 65535], np.uint16)).tolist() == [0, 0, 1, 255]
    every = np.arange(256, dtype=np.uint8)
    assert files.to_bytes(every) is every
    assert np.array_equal(files.to_bytes(files.unit_range(every)), every)


def test_what_opencv_does_not_know_pillow_may(tmp_path):
    iio.imwrite(tmp_path / "a.tga", RGBA[..., :3])
    assert np.array_equal(read_rgb(tmp_path / "a.tga")[0], RGBA[..., :3])


def test_floating_point_images_are_no_pictures_of_8_or_16_bits(tmp_path):
    values = np.array([[-1.0, 0.25], [0.5, 3.0]], np.float32)
    (tmp_path / "a.tif").write_bytes(stored(".tif", values))
    assert np.array_equal(read_image(tmp_path / "a.tif"), values)
    assert np.array_equal(files.unit_range(values), values.clip(0, 1))
    with refused(tmp_path / "a.tif", r"float32 of shape \(2, 2\)"):
        read_rgb(tmp_path / "a.tif")


def test_arrays_by_name_or_alone(tmp_path):
    np.save(tmp_path / "a.npy", RGBA)
    assert np.array_equal(read_arrays(tmp_path / "a.npy"), RGBA)
    np.savez(tmp_path / "b.npz", one=RGBA, two=np.array([None]))
    assert list(read_arrays(tmp_path / "b.npz", lambda names: [names[0]])) == ["one"]
    with refused(tmp_path / "b.npz", "two: holds Python objects"):
        read_arrays(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (read_json, None, "no such file; check the path"),
        (read_json, b"{", "is not JSON"),
        (read_json, b"\xff\xfe", "is not JSON"),
        (read_arrays, None, "no such file; check the path"),
        (read_arrays, b"nothing", "damaged or not a NumPy file"),
        (read_arrays, b"PK\x03\x04 broken", "damaged or not a NumPy file"),
        (read_image, None, "no such file; check the path"),
        (read_image, b"", "cannot be decoded as an image"),
        (read_image, b"\x89PNG\r\n\x1a\n", "cannot be decoded as an image"),
        pytest.param(read_image, HUGE + bytes(100_000), "10000 × 10000 pixels", id="claims too many pixels"),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_file(tmp_path, read, content, message):
    path = tmp_path / "file"
    if content is not None:
        path.write_bytes(content)
    with refused(path, message):
        read(path)


def test_names_are_in_natural_order(tmp_path):
    for name in ("10.png", "2.png", "01.png", "a10.png", "a9.png", ".3.png", "4.txt"):
        (tmp_path / name).touch()
    assert [file.name for file in files_in(tmp_path, (".png",))] == ["01.png", "2.png", "10.png", "a9.png", "a10.png"]


@pytest.mark.parametrize("read", [read_json, read_arrays, read_image, read_cloud, read_depth])
@pytest.mark.parametrize("kind", ["pipe", "device", "long name", "folder"])
def test_what_is_no_file_is_one_line(tmp_path, read, kind):
    suffix = ".ply" if read is read_cloud else ".png"
    path = tmp_path / (300 * "x" if kind == "long name" else "a")
    path = path.with_name(path.name + suffix)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    with refused(path, "is a pipe or a device|cannot be read|is a directory"):
        read(path)


def test_archives_of_a_version_to_come(tmp_path):
    np.savez(tmp_path / "a.npz", points=RGBA)
    data = (tmp_path / "a.npz").read_bytes()
    at = data.find(b"PK\x01\x02")
    (tmp_path / "a.npz").write_bytes(data[: at + 6] + struct.pack("<H", 99) + data[at + 8 :])
    with refused(tmp_path / "a.npz", "damaged or not a NumPy file"):
        read_arrays(tmp_path / "a.npz")


@pytest.mark.parametrize("value", [True, "1", None, float("nan"), float("inf"), [1.0]])
def test_numbers_of_json_are_finite(value):
    assert files.finite_number(3, "a.json: fx") == 3.0
    with refused("a.json: fx: ", "finite number"):
        files.finite_number(value, "a.json: fx")
