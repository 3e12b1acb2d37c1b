"""Writers of posed images in the layouts of NeuS, nerfstudio and COLMAP; a folder appears when it is complete.

Images are PNG files of 8 bits, numbered from 000 in the order of the views. Depth maps are NPY files in ``depths/``.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...neural_fields import InputError
from ...neural_fields.backend.files import check_place
from ..cameras import Camera
from .images import PosedImage, PosedImages

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

PINHOLE = 1  # COLMAP's number for the model with fx, fy, cx, cy
GREY = 128  # the colour of sparse points, whose own colour is unknown
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's axes (y up, z backward) to OpenCV's, and back


def check_new_folder(path: str | Path) -> Path:
    """The path, if a new folder can be made there or an empty one is there; else an InputError."""
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; name a folder that does not exist yet")
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: is not empty; name a folder that does not exist yet")
    check_place(path)
    return path


def write_neus(folder: str | Path, images: PosedImages) -> None:
    """Write ``cameras_sphere.npz``, ``image/`` and ``mask/``, as NeuS has them.

    ``world_mat_i`` projects world points onto pixels (centres at whole numbers), ``scale_mat_i`` maps the unit sphere
    onto the region of interest. An image without a mask gets a full one.

    Raises:
        InputError: the folder is not new, or cannot be written.
    """
    with _new_folder(folder, images) as partial:
        scale = np.diag([images.similarity.scale] * 3 + [1.0])
        scale[:3, 3] = images.similarity.center
        matrices: dict[str, Any] = {}
        for index, (name, view) in enumerate(_numbered(images)):
            matrices[f"world_mat_{index}"] = _projection(view.camera)
            matrices[f"scale_mat_{index}"] = scale
            color, mask = view.color_bytes, view.mask_bytes
            _write_png(partial / "image" / name, color)
            _write_png(partial / "mask" / name, np.full_like(color[..., 0], 255) if mask is None else mask)
        np.savez(partial / "cameras_sphere.npz", **matrices)


def write_transforms(folder: str | Path, images: PosedImages) -> None:
    """Write ``transforms.json`` and ``images/``, as nerfstudio and instant-ngp read them.

    Poses are in OpenGL's convention, and ``cx``, ``cy`` count from the image's corner. Masks become the alpha channel
    (straight). Every frame has its own intrinsics; ``camera_angle_x`` at the top is that of the first.

    Raises:
        InputError: the folder is not new, or cannot be written.
    """
    with _new_folder(folder, images) as partial:
        frames = []
        for name, view in _numbered(images):
            _write_png(partial / "images" / name, _with_alpha(view))
            fx, fy, cx, cy = view.camera.fx_fy_cx_cy
            size = {"w": view.camera.width, "h": view.camera.height}
            lens = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
            pose = (view.camera.world_from_camera.numpy() @ OPENGL).tolist()
            frame: dict[str, Any] = {"file_path": f"images/{name}", **size, **lens, "transform_matrix": pose}
            if view.depth is not None:
                frame["depth_file_path"] = _depth_file(name).as_posix()
            frames.append(frame)
        angle = 2 * math.atan(frames[0]["w"] / 2 / frames[0]["fl_x"])
        content = {"camera_model": "PINHOLE", "camera_angle_x": angle, "frames": frames}
        (partial / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def write_colmap(folder: str | Path, images: PosedImages, *, form: Literal["text", "binary"] = "binary") -> None:
    """Write ``images/`` and a sparse model in ``sparse/0``, as COLMAP writes them.

    Cameras are PINHOLE, one for each distinct lens. Masks become the alpha channel (straight). Observations of sparse
    points are written at the places to which the points project.

    Raises:
        InputError: the folder is not new, or cannot be written.
    """
    with _new_folder(folder, images) as partial:
        named = list(_numbered(images))
        for name, view in named:
            _write_png(partial / "images" / name, _with_alpha(view))
        lenses = list(dict.fromkeys(_lens(view.camera) for _, view in named))
        number = {lens: k for k, lens in enumerate(lenses, 1)}
        places = [(name, number[_lens(view.camera)], *_pose(view.camera)) for name, view in named]
        points = np.empty((0, 3)) if images.points is None else images.points
        model = partial / "sparse" / "0"
        model.mkdir(parents=True)
        {"text": _write_text, "binary": _write_binary}[form](model, lenses, places, points, _observations(images))


_Lens = tuple[int, int, float, float, float, float]
_Place = tuple[str, int, list[float], list[float]]


class _Observations(NamedTuple):
    """The sparse points that each view shows; ``(K,)`` each, view by view, numbers from 0."""

    view: Int64
    point: Int64
    pixel: Float64  # (K, 2) in the view's image, from its corner
    order: Int64  # number among the points of the view

    def of_view(self, view: int) -> list[tuple[float, float, int]]:
        """Places x, y in the image of a view, each with the number of the point, from 1."""
        rows = self.view == view
        pairs = zip(self.pixel[rows].tolist(), self.point[rows].tolist(), strict=True)
        return [(*pixel, point + 1) for pixel, point in pairs]

    def tracks(self, points: int) -> list[list[int]]:
        """For each point the views that show it, from 1, each followed by the order there."""
        found: list[list[int]] = [[] for _ in range(points)]
        for view, point, order in zip(self.view.tolist(), self.point.tolist(), self.order.tolist(), strict=True):
            found[point] += [view + 1, order]
        return found


def _observations(images: PosedImages) -> _Observations:
    seen = np.empty((0, 2), np.int64) if images.observations is None else images.observations
    view, point = seen[np.argsort(seen[:, 0], kind="stable")].T
    pixel = np.empty((len(view), 2))
    for number in np.unique(view):
        rows = view == number
        assert images.points is not None
        pixel[rows] = images.views[number].camera.in_view(images.points[point[rows]])[0] + 0.5
    return _Observations(view, point, pixel, np.arange(len(view)) - np.searchsorted(view, view))


def _write_text(model: Path, lenses: list[_Lens], places: list[_Place], points: Float64, seen: _Observations) -> None:
    cameras = [f"{k} PINHOLE {w} {h} {_words(lens)}" for k, (w, h, *lens) in enumerate(lenses, 1)]
    images = []
    for k, (name, lens, q, t) in enumerate(places, 1):
        marks = " ".join(f"{x!r} {y!r} {point}" for x, y, point in seen.of_view(k - 1))
        images.append(f"{k} {_words(q)} {_words(t)} {lens} {name}\n{marks}")
    cloud = [
        " ".join((f"{k} {_words(point)} {GREY} {GREY} {GREY} 0", *map(str, track)))
        for k, (point, track) in enumerate(zip(points.tolist(), seen.tracks(len(points)), strict=True), 1)
    ]
    heads = {
        "cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
        "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of POINTS2D[] (X Y POINT3D_ID)",
        "points3D": "POINT3D_ID X Y Z R G B ERROR TRACK[] (IMAGE_ID POINT2D_IDX)",
    }
    for (name, head), lines in zip(heads.items(), (cameras, images, cloud), strict=True):
        text = "\n".join([f"# {head}", *lines]) + "\n"
        (model / f"{name}.txt").write_text(text, encoding="utf-8")


def _write_binary(model: Path, lenses: list[_Lens], places: list[_Place], points: Float64, seen: _Observations) -> None:
    count = struct.Struct("<Q").pack
    cameras = [struct.pack("<iiQQ4d", k, PINHOLE, *lens) for k, lens in enumerate(lenses, 1)]
    images = []
    for k, (name, lens, q, t) in enumerate(places, 1):
        marks = [struct.pack("<ddq", *mark) for mark in seen.of_view(k - 1)]
        head = struct.pack("<i7di", k, *q, *t, lens) + name.encode() + b"\0"
        images.append(head + count(len(marks)) + b"".join(marks))
    cloud = [
        struct.pack("<Q3d3BdQ", k, *point, GREY, GREY, GREY, 0.0, len(track) // 2)
        + struct.pack(f"<{len(track)}I", *track)
        for k, (point, track) in enumerate(zip(points.tolist(), seen.tracks(len(points)), strict=True), 1)
    ]
    for name, records in (("cameras", cameras), ("images", images), ("points3D", cloud)):
        (model / f"{name}.bin").write_bytes(count(len(records)) + b"".join(records))


def _lens(camera: Camera) -> _Lens:
    """Width, height, fx, fy, cx, cy of COLMAP, whose first pixel has its centre at (0.5, 0.5)."""
    fx, fy, cx, cy = camera.fx_fy_cx_cy
    return camera.width, camera.height, fx, fy, cx + 0.5, cy + 0.5


def _pose(camera: Camera) -> tuple[list[float], list[float]]:
    """Quaternion w, x, y, z and translation of COLMAP, from the world to the camera."""
    camera_from_world = np.linalg.inv(camera.world_from_camera.numpy())
    x, y, z, w = Rotation.from_matrix(camera_from_world[:3, :3]).as_quat(canonical=True).tolist()
    return [w, x, y, z], camera_from_world[:3, 3].tolist()


def _projection(camera: Camera) -> Float64:
    """``K [R | t]`` with a fourth row (0, 0, 0, 1)."""
    calibration = np.eye(4)
    calibration[:3, :3] = camera.intrinsics.numpy()
    return calibration @ np.linalg.inv(camera.world_from_camera.numpy())


def _words(numbers: list[float]) -> str:
    return " ".join(repr(number) for number in numbers)  # the shortest text that reads back as the same number


def _numbered(images: PosedImages) -> Iterator[tuple[str, PosedImage]]:
    """The views with the names of their files, which sort in the order of the views."""
    digits = max(3, len(str(len(images.views) - 1)))
    return ((f"{index:0{digits}d}.png", view) for index, view in enumerate(images.views))


def _with_alpha(view: PosedImage) -> NDArray[np.uint8]:
    color, mask = view.color_bytes, view.mask_bytes
    return color if mask is None else np.dstack((color, mask))


def _write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    import imageio.v3 as iio  # here: loading it takes a fifth of a second

    path.parent.mkdir(exist_ok=True)
    iio.imwrite(path, pixels)


def _depth_file(name: str) -> Path:
    """The depth map of an image, relative to the folder of the data set."""
    return Path("depths", name).with_suffix(".npy")


@contextmanager
def _new_folder(folder: str | Path, images: PosedImages) -> Iterator[Path]:
    """A folder beside the target that takes its name when all is written; depth maps are in it."""
    folder = check_new_folder(folder)
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        for name, view in _numbered(images):
            if view.depth is not None:
                (partial / _depth_file(name)).parent.mkdir(exist_ok=True)
                np.save(partial / _depth_file(name), view.depth.numbers)
        yield partial
        if folder.is_dir():
            folder.rmdir()
        partial.replace(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another place") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
