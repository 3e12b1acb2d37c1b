"""COLMAP's sparse models, text and binary, by its documentation ("Output Format").

World to camera is ``R(q) x + t`` in OpenCV's axes. Pixels count from the image's corner: half a pixel is taken off.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ....neural_fields import InputError
from ....neural_fields.backend.arrays import Int64
from ....neural_fields.backend.files import natural
from ...cameras import Camera, Float64, intrinsics
from .shots import IMAGE_SUFFIXES, Shot

MODELS = {  # name: number of parameters; the order is that of the binary files' numbers
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
}
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
PINHOLES = (*ONE_FOCAL, "PINHOLE", "OPENCV", "FULL_OPENCV")
IMAGE_FOLDERS = ("images", "image")
MASK_FOLDERS = ("masks", "mask")


@dataclass(frozen=True)
class _Lens:
    model: str
    width: int
    height: int
    numbers: tuple[float, ...]


@dataclass(frozen=True)
class _Pose:
    number: int
    name: str
    quaternion: tuple[float, ...]  # w, x, y, z
    shift: tuple[float, ...]
    lens: int


def find_model(folder: Path) -> Path | None:
    """The model with most photographs of ``sparse/*``, or ``sparse`` or the folder itself; None where there is none."""
    return max(find_models(folder), key=_count_images, default=None)  # of equal ones the first


def find_models(folder: Path) -> list[Path]:
    """The models in ``sparse/*``, in natural order; where there are none there, in ``sparse`` or the folder itself."""
    sparse = folder / "sparse"
    numbered = sorted(sparse.iterdir(), key=lambda place: natural(place.name)) if sparse.is_dir() else []
    models = [place for place in numbered if _find(place, "cameras")]
    return models or [place for place in (sparse, folder) if _find(place, "cameras")][:1]


def _count_images(model: Path) -> int:
    """The number of photographs of a model; 0 where it is damaged, which its reader will report."""
    images = _part(model, "images")
    with suppress(InputError):
        return int(_Records(images).take("Q")[0]) if images.suffix == ".bin" else len(_text_poses(images))
    return 0


def read_colmap(model: Path) -> list[Shot]:
    """The cameras of a model, in the order of the images' names.

    Photographs are in ``images`` beside the model, or one or two folders above it. Their masks are in ``masks``, with
    COLMAP's own names (``a.jpg.png``) or those of the photographs with any extension.
    """
    cameras, images = _part(model, "cameras"), _part(model, "images")
    lenses = _binary_lenses(cameras) if cameras.suffix == ".bin" else _text_lenses(cameras)
    poses = _poses(images)
    if (folder := _beside(model, IMAGE_FOLDERS)) is None:
        folder = (model.parent.parent if model.parent.name == "sparse" else model.parent) / IMAGE_FOLDERS[0]
    masks = _beside(model, MASK_FOLDERS)
    shots = []
    for pose in poses:
        named = f"{images}: {pose.name}"
        if pose.lens not in lenses:
            raise InputError(f"{named}: its camera {pose.lens} is not in {cameras.name}; export both again")
        camera = _camera(lenses[pose.lens], pose, f"{cameras}: camera {pose.lens}")
        mask = None if masks is None else _mask(masks, pose.name)
        shots.append(Shot(pose.name, camera, folder / pose.name, mask, named))
    return shots


def read_colmap_points(model: Path) -> tuple[Float64, Int64] | None:
    """The sparse points ``(P, 3)`` of a model, and ``(K, 2)`` numbers of an image and of a point that it shows.

    Images are numbered in the order of `read_colmap`. None if the model has no points.
    """
    if (path := _find(model, "points3D")) is None:
        return None
    points, seen = _binary_points(path) if path.suffix == ".bin" else _text_points(path)
    if not np.isfinite(points).all():
        raise InputError(f"{path}: holds a number that is not finite; export it again")
    if not len(points):
        return None
    # Files number images as they like, and may list some that are not there any more.
    numbers = np.array([pose.number for pose in _poses(_part(model, "images"))])
    order = np.argsort(numbers)
    at = order[np.searchsorted(numbers, seen[:, 0], sorter=order).clip(max=len(order) - 1)]
    return points, np.column_stack((at, seen[:, 1]))[numbers[at] == seen[:, 0]]


def _find(model: Path, kind: str) -> Path | None:
    """The binary file of that kind, or else the text."""
    return next(filter(Path.is_file, (model / f"{kind}.bin", model / f"{kind}.txt")), None)


def _part(model: Path, kind: str) -> Path:
    if (found := _find(model, kind)) is None:
        raise InputError(f"{model}: neither {kind}.bin nor {kind}.txt in it; export the model again")
    return found


def _poses(images: Path) -> list[_Pose]:
    """The poses of the images, in the order of their names."""
    poses = _binary_poses(images) if images.suffix == ".bin" else _text_poses(images)
    if not poses:
        raise InputError(f"{images}: no images; expected at least one that COLMAP registered")
    return sorted(poses, key=lambda pose: natural(pose.name))


def _beside(model: Path, names: tuple[str, ...]) -> Path | None:
    model = model.resolve()
    places = (model, model.parent, model.parent.parent)
    return next((place / name for place in places for name in names if (place / name).is_dir()), None)


def _mask(folder: Path, name: str) -> Path:
    path = folder / name
    files = [path.with_name(path.name + ".png"), *(path.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)]
    return next((file for file in files if file.is_file()), files[0])


def _camera(lens: _Lens, pose: _Pose, named: str) -> Camera | None:
    """A camera with its lens: COLMAP's coefficients are those of OpenCV, in its order. None without a finite pose."""
    if lens.model not in PINHOLES:
        raise InputError(f"{named}: {lens.model}: no pinhole; run colmap image_undistorter and use its output")
    if len(lens.numbers) != MODELS[lens.model]:
        raise InputError(f"{named}: {len(lens.numbers)} numbers; {lens.model} has {MODELS[lens.model]}")
    numbers = lens.numbers[:1] + lens.numbers if lens.model in ONE_FOCAL else lens.numbers
    fx, fy, cx, cy = numbers[:4]
    if not np.isfinite(numbers).all() or min(fx, fy, lens.width, lens.height) <= 0:
        expected = "expected finite numbers, and sizes and focal lengths above 0"
        raise InputError(f"{named}: {lens.width} × {lens.height}, {lens.numbers}; {expected}")
    quaternion, shift = np.array(pose.quaternion), np.array(pose.shift)
    if not (np.isfinite(quaternion).all() and np.isfinite(shift).all() and quaternion.any()):
        return None
    rotation = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()  # camera from world
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ shift
    calibration = intrinsics(fx, fy, cx - 0.5, cy - 0.5)
    return Camera(calibration, torch.from_numpy(matrix), lens.width, lens.height, numbers[4:])


def _lines(path: Path) -> Iterator[str]:
    try:
        yield from (line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    except ValueError as error:
        raise InputError(f"{path}: is not text; export the model again") from error


def _text_lenses(path: Path) -> dict[int, _Lens]:
    lenses = {}
    for words in (line.split() for line in _lines(path) if line.strip()):
        try:
            number, model, width, height, *rest = words
            lenses[int(number)] = _Lens(model, int(width), int(height), tuple(map(float, rest)))
        except ValueError as error:
            expected = "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            raise InputError(f"{path}: {' '.join(words)[:60]!r}: {expected}; export it again") from error
    return lenses


def _text_poses(path: Path) -> list[_Pose]:
    poses, lines = [], _lines(path)
    for line in lines:
        if not line.strip():
            continue
        try:
            number, *numbers, lens, name = line.split(maxsplit=9)
            values = tuple(map(float, numbers))
            if len(values) != 7:
                raise ValueError(f"{len(values)} numbers")
            poses.append(_Pose(int(number), name.strip(), values[:4], values[4:], int(lens)))
        except ValueError as error:
            expected = "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise InputError(f"{path}: {line[:60]!r}: {expected}; export it again") from error
        next(lines, None)  # what the image saw of the points: a line that may be empty
    return poses


def _text_points(path: Path) -> tuple[Float64, Int64]:
    rows = [line.split() for line in _lines(path) if line.strip()]
    tracks = [words[8::2] for words in rows]  # after the error: pairs of image and place in it
    try:
        points = np.array([words[1:4] for words in rows], np.float64).reshape(-1, 3)
        images = np.array([image for track in tracks for image in track], np.int64)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: expected POINT3D_ID X Y Z and more on each line; export it again") from error
    return points, _observations(images, tracks)


def _observations(images: Int64, tracks: Sequence[Sized]) -> Int64:
    """``(K, 2)`` numbers of an image and of a point that it shows, one point after the other."""
    return np.column_stack((images, np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])))


class _Records:
    """A binary file, read from front to back."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.place = 0

    def take(self, form: str) -> tuple[int | float, ...]:
        """The next numbers, little-endian and without gaps."""
        start = self.place
        self.skip(struct.calcsize("<" + form))
        return struct.unpack_from("<" + form, self.data, start)

    def array(self, form: str, count: int) -> Int64:
        """The next ``count`` numbers of one kind."""
        start, kind = self.place, np.dtype(form)
        self.skip(count * kind.itemsize)
        return np.frombuffer(self.data, kind, count, start).astype(np.int64)

    def text(self) -> str:
        """The text up to the next zero."""
        start, end = self.place, self.data.find(b"\0", self.place)
        if end < 0:
            raise self.truncated()
        self.place = end + 1
        return self.data[start:end].decode("utf-8", errors="replace")

    def skip(self, count: int) -> None:
        self.place += count
        if self.place > len(self.data):
            raise self.truncated()

    def truncated(self) -> InputError:
        return InputError(f"{self.path}: ends early, after {len(self.data)} bytes; copy or export it again")


def _binary_lenses(path: Path) -> dict[int, _Lens]:
    records, lenses, models = _Records(path), {}, tuple(MODELS)
    for _ in range(int(records.take("Q")[0])):
        number, model, width, height = map(int, records.take("iiQQ"))
        if not 0 <= model < len(models):
            raise InputError(f"{path}: camera {number}: unknown model {model}; run colmap image_undistorter")
        lenses[number] = _Lens(models[model], width, height, records.take(f"{MODELS[models[model]]}d"))
    return lenses


def _binary_poses(path: Path) -> list[_Pose]:
    records, poses = _Records(path), []
    for _ in range(int(records.take("Q")[0])):
        number, *numbers, lens = records.take("I7di")
        name = records.text()
        records.skip(24 * int(records.take("Q")[0]))  # what the image saw of the points
        poses.append(_Pose(int(number), name, tuple(numbers[:4]), tuple(numbers[4:]), int(lens)))
    return poses


def _binary_points(path: Path) -> tuple[Float64, Int64]:
    records, places, tracks = _Records(path), [], []
    for _ in range(int(records.take("Q")[0])):
        *place, seen = records.take("8x3d11xQ")  # its number before, its colour and error after
        places.append(place)
        tracks.append(records.array("<u4", 2 * int(seen))[::2])  # pairs of image and place in it
    images = np.concatenate([np.empty(0, np.int64), *tracks])
    return np.array(places, np.float64).reshape(-1, 3), _observations(images, tracks)
