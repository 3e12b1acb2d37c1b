"""Posed images out, in the layouts that NeuS, nerfstudio and COLMAP read: the inverses of our readers.

Images are PNG files of 8 bits, numbered from 000 in the order of the views. A folder appears under its name only
when it is complete.
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
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...neural_fields import InputError
from ...neural_fields.files import check_place
from ..cameras import Camera
from .images import PosedImage, PosedImages

__all__ = ["check_new_folder", "write_colmap", "write_neus", "write_transforms"]

Float64 = NDArray[np.float64]

PINHOLE = 1  # COLMAP's number for the model with fx, fy, cx, cy
GREY = 128  # the colour of sparse points, of which only the place is known
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's axes (y up, z backward) to OpenCV's, and back


def check_new_folder(path: str | Path) -> Path:
    """Whether a folder can be made at ``path``, to be asked before any long work.

    Raises:
        InputError: something stands there already (an empty folder may), or none can be made (`check_place`).
    """
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
    with _new_folder(folder) as partial:
        scale = np.diag([images.similarity.scale] * 3 + [1.0])
        scale[:3, 3] = images.similarity.center
        matrices: dict[str, Any] = {}
        for index, (name, view) in enumerate(_numbered(images)):
            matrices[f"world_mat_{index}"] = _projection(view.camera)
            matrices[f"scale_mat_{index}"] = scale
            mask = np.ones(view.color.shape[:2], np.float32) if view.mask is None else view.mask
            _write_png(partial / "image" / name, _bytes(view.color))
            _write_png(partial / "mask" / name, _bytes(mask))
        np.savez(partial / "cameras_sphere.npz", **matrices)


def write_transforms(folder: str | Path, images: PosedImages) -> None:
    """Write ``transforms.json`` and ``images/``, as nerfstudio and instant-ngp read them.

    Poses are in OpenGL's convention and ``cx``, ``cy`` count from the image's corner. Masks become the alpha channel
    (straight). Every frame has its own intrinsics; ``camera_angle_x`` of the first stands at the top, for readers of
    Blender's dialect.

    Raises:
        InputError: the folder is not new, or cannot be written.
    """
    with _new_folder(folder) as partial:
        frames = []
        for name, view in _numbered(images):
            _write_png(partial / "images" / name, _with_alpha(view))
            fx, fy, cx, cy = view.camera.fx_fy_cx_cy
            size = {"w": view.camera.width, "h": view.camera.height}
            lens = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5}
            pose = (view.camera.world_from_camera.numpy() @ OPENGL).tolist()
            frames.append({"file_path": f"images/{name}", **size, **lens, "transform_matrix": pose})
        angle = 2 * math.atan(frames[0]["w"] / 2 / frames[0]["fl_x"])
        content = {"camera_model": "PINHOLE", "camera_angle_x": angle, "frames": frames}
        (partial / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def write_colmap(folder: str | Path, images: PosedImages, *, form: Literal["text", "binary"] = "binary") -> None:
    """Write ``images/`` and a sparse model in ``sparse/0``, as COLMAP writes them.

    Cameras are PINHOLE, one for each distinct lens. Masks become the alpha channel (straight). The sparse points have
    no observations, because which views see them is not known.

    Raises:
        InputError: the folder is not new, or cannot be written.
    """
    with _new_folder(folder) as partial:
        named = list(_numbered(images))
        for name, view in named:
            _write_png(partial / "images" / name, _with_alpha(view))
        lenses = list(dict.fromkeys(_lens(view.camera) for _, view in named))
        number = {lens: k for k, lens in enumerate(lenses, 1)}
        places = [(name, number[_lens(view.camera)], *_pose(view.camera)) for name, view in named]
        points = np.empty((0, 3)) if images.points is None else images.points
        model = partial / "sparse" / "0"
        model.mkdir(parents=True)
        {"text": _write_text, "binary": _write_binary}[form](model, lenses, places, points)


_Lens = tuple[int, int, float, float, float, float]
_Place = tuple[str, int, list[float], list[float]]


def _write_text(model: Path, lenses: list[_Lens], places: list[_Place], points: Float64) -> None:
    cameras = [f"{k} PINHOLE {w} {h} {_words(lens)}" for k, (w, h, *lens) in enumerate(lenses, 1)]
    # The second line of each image lists its observations: none.
    images = [f"{k} {_words(q)} {_words(t)} {lens} {name}\n" for k, (name, lens, q, t) in enumerate(places, 1)]
    cloud = [f"{k} {_words(point)} {GREY} {GREY} {GREY} 0" for k, point in enumerate(points.tolist(), 1)]
    heads = {
        "cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
        "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of POINTS2D[] (X Y POINT3D_ID)",
        "points3D": "POINT3D_ID X Y Z R G B ERROR TRACK[] (IMAGE_ID POINT2D_IDX)",
    }
    for (name, head), lines in zip(heads.items(), (cameras, images, cloud), strict=True):
        text = "\n".join([f"# {head}", *lines]) + "\n"
        (model / f"{name}.txt").write_text(text, encoding="utf-8")


def _write_binary(model: Path, lenses: list[_Lens], places: list[_Place], points: Float64) -> None:
    count = struct.Struct("<Q").pack
    cameras = [struct.pack("<iiQQ4d", k, PINHOLE, *lens) for k, lens in enumerate(lenses, 1)]
    images = [
        struct.pack("<i7di", k, *q, *t, lens) + name.encode() + b"\0" + count(0)
        for k, (name, lens, q, t) in enumerate(places, 1)
    ]
    row = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    cloud = np.zeros(len(points), row)
    cloud["id"], cloud["xyz"], cloud["rgb"] = np.arange(1, len(points) + 1), points, GREY
    (model / "cameras.bin").write_bytes(count(len(cameras)) + b"".join(cameras))
    (model / "images.bin").write_bytes(count(len(images)) + b"".join(images))
    (model / "points3D.bin").write_bytes(count(len(cloud)) + cloud.tobytes())


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
    """The views with the names of their files; as text, the names are in the order of the views."""
    digits = max(3, len(str(len(images.views) - 1)))
    return ((f"{index:0{digits}d}.png", view) for index, view in enumerate(images.views))


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(255 * values.clip(0, 1)).astype(np.uint8)


def _with_alpha(view: PosedImage) -> NDArray[np.uint8]:
    return _bytes(view.color if view.mask is None else np.concatenate((view.color, view.mask[..., None]), axis=-1))


def _write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    import imageio.v3 as iio  # here: loading it takes a fifth of a second

    path.parent.mkdir(exist_ok=True)
    iio.imwrite(path, pixels)


@contextmanager
def _new_folder(folder: str | Path) -> Iterator[Path]:
    """A folder beside the target that takes its name when all is written."""
    folder = check_new_folder(folder)
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        if folder.is_dir():
            folder.rmdir()
        partial.replace(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another place") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
