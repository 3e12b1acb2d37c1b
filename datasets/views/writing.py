"""Writers of posed images in the layouts of NeuS, nerfstudio and COLMAP; a folder appears when it is complete.

Images are PNG files of 8 bits, numbered from 000 in the order of the views. Depth maps are NPY files in ``depths/``.
"""

from __future__ import annotations

import json
import math
import shutil
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...neural_fields import InputError
from ...neural_fields.backend.files import check_place, partial_of
from ..cameras import OPENGL, Camera
from .images import PosedImage, PosedImages

PINHOLE = 1  # COLMAP's number for the model with fx, fy, cx, cy
GREY = 128  # the colour of sparse points, whose own colour is unknown


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
            calibration = np.eye(4)  # K [R | t], with a fourth row (0, 0, 0, 1)
            calibration[:3, :3] = view.camera.intrinsics.numpy()
            matrices[f"world_mat_{index}"] = calibration @ np.linalg.inv(view.camera.world_from_camera.numpy())
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


def write_colmap(folder: str | Path, images: PosedImages) -> None:
    """Write ``images/`` and a binary sparse model in ``sparse/0``, as COLMAP writes them.

    Cameras are PINHOLE, one for each distinct lens. Masks become the alpha channel (straight). Observations of sparse
    points are written at the places to which the points project.

    Raises:
        InputError: the folder is not new, or cannot be written.
    """
    with _new_folder(folder, images) as partial:
        for name, view in _numbered(images):
            _write_png(partial / "images" / name, _with_alpha(view))
        model = partial / "sparse" / "0"
        model.mkdir(parents=True)
        _write_model(model, images)


def _write_model(model: Path, images: PosedImages) -> None:
    """Write the three files of a COLMAP model, in which cameras, images and points are numbered from 1."""
    count = struct.Struct("<Q").pack
    lenses = list(dict.fromkeys(_lens(view.camera) for view in images.views))
    cameras = [struct.pack("<iiQQ4d", k, PINHOLE, *lens) for k, lens in enumerate(lenses, 1)]
    points = np.empty((0, 3)) if images.points is None else images.points
    seen = np.empty((0, 2), np.int64) if images.observations is None else images.observations
    tracks: list[list[int]] = [[] for _ in points]  # the views that show a point, each with its place among their marks
    shots = []
    for k, (name, view) in enumerate(_numbered(images), 1):
        shown = seen[seen[:, 0] == k - 1, 1].tolist()
        pixels = view.camera.in_view(points[shown])[0] + 0.5  # from the image's corner
        marks = [struct.pack("<ddq", *pixel, point + 1) for pixel, point in zip(pixels, shown, strict=True)]
        for place, point in enumerate(shown):
            tracks[point] += [k, place]
        head = struct.pack("<i7di", k, *_pose(view.camera), lenses.index(_lens(view.camera)) + 1)
        shots.append(head + name.encode() + b"\0" + count(len(marks)) + b"".join(marks))
    cloud = [
        struct.pack("<Q3d3BdQ", k, *point, GREY, GREY, GREY, 0.0, len(track) // 2)
        + struct.pack(f"<{len(track)}I", *track)
        for k, (point, track) in enumerate(zip(points.tolist(), tracks, strict=True), 1)
    ]
    for name, records in (("cameras", cameras), ("images", shots), ("points3D", cloud)):
        (model / f"{name}.bin").write_bytes(count(len(records)) + b"".join(records))


def _lens(camera: Camera) -> tuple[int, int, float, float, float, float]:
    """Width, height, fx, fy, cx, cy of COLMAP, whose first pixel has its centre at (0.5, 0.5)."""
    fx, fy, cx, cy = camera.fx_fy_cx_cy
    return camera.width, camera.height, fx, fy, cx + 0.5, cy + 0.5


def _pose(camera: Camera) -> list[float]:
    """Quaternion w, x, y, z and translation of COLMAP, from the world to the camera."""
    camera_from_world = np.linalg.inv(camera.world_from_camera.numpy())
    x, y, z, w = Rotation.from_matrix(camera_from_world[:3, :3]).as_quat(canonical=True).tolist()
    return [w, x, y, z, *camera_from_world[:3, 3].tolist()]


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
    partial = partial_of(folder)
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
