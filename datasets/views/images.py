"""Posed photographs: pictures and masks without lens distortion, their cameras, and the region of the object.

The readers do not apply EXIF orientations: the cameras of all formats belong to the pixels as stored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError, Similarity
from ...neural_fields.backend.arrays import Float32
from ...neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from ..cameras import Camera, Float64, intrinsics
from ..files import read_rgb, readable, to_bytes, unit_range
from .formats.colmap import find_model, find_models, read_colmap, read_colmap_points
from .formats.neus import read_neus, read_neus_sphere
from .formats.shots import DepthMap, DepthSource, Shot, find_depth_maps, list_images, read_depth_map
from .formats.transforms import read_transforms
from .region import region_from_cameras, region_from_masks, region_from_points

OBJECT = 0.5  # a pixel of a mask with a larger share of object counts as object
FILES = ("cameras_sphere.npz", "transforms.json", "transforms_train.json")  # looked for in a folder, in this order
OPAQUE = 0.999  # an opacity of 1 after resampling
EXACT = 0.01  # pixels that distorting an undistorted point may miss it by

N = TypeVar("N", NDArray[np.float32], NDArray[np.float32] | None)


class UnitRange(Generic[N]):
    """An array that reads as float32 in [0, 1]; floating-point numbers that 8 bits hold as well are kept in these."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type) -> N:
        kept = instance.__dict__[self.name]  # of the class an AttributeError: a field without a default
        return cast(N, kept if kept is None else unit_range(kept))

    def __set__(self, instance: Any, numbers: N | NDArray[np.integer]) -> None:
        if numbers is not None and numbers.dtype.kind == "f":
            small = to_bytes(numbers)
            numbers = small if np.array_equal(unit_range(small), numbers) else numbers
        instance.__dict__[self.name] = numbers


@dataclass(frozen=True, eq=False)
class PosedImage:
    """A picture without lens distortion, and its camera.

    Attributes:
        name: of its file, as the data set has it.
        camera: a pinhole of the picture's size.
        color: ``(H, W, 3)`` display RGB in [0, 1]; not multiplied by the mask.
        mask: ``(H, W)`` the share of each pixel that is object, in [0, 1]; None if unknown.
        depth: the measured depths, in pixels of their own; None if there are none.
    """

    name: str
    camera: Camera
    color: UnitRange[Float32] = UnitRange()
    mask: UnitRange[Float32 | None] = UnitRange()
    depth: DepthMap | None = None

    @property
    def color_bytes(self) -> NDArray[np.uint8]:
        """Colours ``(H, W, 3)`` in 8 bits, not copied where they are kept so."""
        return to_bytes(vars(self)["color"])

    @property
    def mask_bytes(self) -> NDArray[np.uint8] | None:
        """The mask ``(H, W)`` in 8 bits, not copied where it is kept so."""
        mask = vars(self)["mask"]
        return None if mask is None else to_bytes(mask)


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Views of one object, and where it is.

    Attributes:
        views: at least one.
        similarity: from world coordinates to the unit sphere around the region of interest.
        region: the source of the similarity, in words.
        points: ``(P, 3)`` sparse points of the surface in world coordinates, or None.
        source: the file that the cameras were read from; for COLMAP the folder of the model.
        observations: ``(K, 2)`` numbers of a view and of a point that it shows; None if unknown.
        reading: one line about the photographs that have a camera.
    """

    views: tuple[PosedImage, ...]
    similarity: Similarity
    region: str
    points: NDArray[np.float64] | None
    source: Path
    observations: NDArray[np.int64] | None = None
    reading: str = ""


def read_posed_images(
    path: str | Path,
    *,
    width: int | None = None,
    region: Similarity | None = None,
    depths: DepthSource | None = None,
    allow_missing: bool = False,
) -> PosedImages:
    """Read photographs, their cameras, masks and depth maps, and find the region of the object.

    Photographs without a finite pose are left out, and counted in ``reading``.
    Lens distortion is taken out of the pictures, and the cameras are those of the new pictures. If a picture is larger
    or smaller than its file of cameras says, both sides by one factor, its camera is resized. A picture's mask is the
    file that goes with it, or its transparency. Masks that are white in all views are ignored.

    Args:
        path: a file or folder that `read_cameras` knows: NeuS (with ``image`` and ``mask`` beside cameras_sphere.npz),
            transforms.json, COLMAP (``sparse/0`` with ``images`` beside it).
        width: wider pictures are shrunk to this width in pixels, in linear light.
        region: the sphere around the object. By default that of ``scale_mat_i``, of the masks' visual hull, of the
            sparse points, or that which the cameras look at: the first that there is.
        depths: the depth maps; by default those that a transforms.json names (``depth_file_path``, ``depth_path``), in
            the units of the cameras.
        allow_missing: whether to accept that fewer than half of the photographs have a camera, and to leave out cameras
            whose photograph, mask or depth map is missing.

    Raises:
        InputError: a file is missing or damaged, a picture and its camera, mask or depth map do not go together, a
            lens cannot be undistorted, or the region cannot be found.
        ValueError: ``width`` is not positive.
    """
    if width is not None and width < 1:
        raise ValueError(f"width={width}: expected at least one pixel")
    source = find_source(path)
    with readable(source):
        return _posed(source, width, region, depths or DepthSource(), allow_missing=allow_missing)


def _posed(
    source: Path, width: int | None, region: Similarity | None, depths: DepthSource, *, allow_missing: bool
) -> PosedImages:
    shots = read_shots(source)
    sphere = read_neus_sphere(source) if source.suffix.lower() == ".npz" else None
    points, observations = (read_colmap_points(source) if source.is_dir() else None) or (None, None)
    shots = [replace(shot, depth=path) for shot, path in zip(shots, find_depth_maps(shots, depths), strict=True)]
    files = [[file for file in (shot.image, shot.mask, shot.depth) if file is not None] for shot in shots]
    whole = [shot.placed is not None and all(map(Path.is_file, own)) for shot, own in zip(shots, files, strict=True)]
    if not allow_missing:
        _check_files([shot for shot in shots if shot.placed is not None])
    reading = _counted(source, shots, sum(whole), allow_missing=allow_missing)
    if not all(whole):
        shots = [shot for shot, kept in zip(shots, whole, strict=True) if kept]
        if observations is not None:
            observations = observations[np.array(whole)[observations[:, 0]]]
            observations[:, 0] = (np.cumsum(whole) - 1)[observations[:, 0]]
    views = tuple(_view(shot, width, depths) for shot in shots)
    if all(view.mask is None or view.mask.min() > OPAQUE for view in views):
        views = tuple(view if view.mask is None else replace(view, mask=None) for view in views)  # white in all views
    if region is not None:
        similarity, words = region, "given"
    elif sphere is not None:
        similarity, words = sphere, f"scale_mat_i of {source.name}"
    else:
        similarity, words = _find_region(views, points, source)
    return PosedImages(views, similarity, words, points, source, observations, reading)


def _counted(source: Path, shots: Sequence[Shot], placed: int, *, allow_missing: bool) -> str:
    """One line: the number of photographs, and of those that have a camera; an InputError if these are too few."""
    photographs = len({shot.image for shot in shots})
    folders = {shot.image.parent for shot in shots}
    if source.is_dir() or source.name == "transforms.json":  # other files may hold a choice, such as training views
        kinds = {shot.image.suffix.lower() for shot in shots}
        listed = {file for folder in folders for file in list_images(folder) if file.suffix.lower() in kinds}
        extras = {file for shot in shots for file in (shot.mask, shot.depth) if file is not None}
        photographs = len((listed - extras) | {shot.image for shot in shots})
    reading = f"{placed} of {photographs} photographs have a camera"
    if lost := sum(shot.placed is None for shot in shots):
        reading += f" (the poses of {lost} are not finite)"
    if source.is_dir() and len(models := find_models(source.parent.parent)) > 1 and source in models:
        reading += f" in sparse/{source.name}, the largest of {len(models)} models"
    if not placed or (2 * placed < photographs and not allow_missing):
        fix = "find the cameras again" if lost else "add the photographs"
        fix = "find the others' cameras, or go on with --allow-missing" if placed else fix
        raise InputError(f"{source}: only {reading}; {fix}")
    return reading


def _check_files(shots: Sequence[Shot]) -> None:
    """Refuse missing files before any long work."""
    fixes = {
        "image": "add it, or leave that camera out: --allow-missing",
        "mask": "add it, or leave all masks out",
        "depth": "add it, or leave all depth maps out",
    }
    for kind, fix in fixes.items():
        files = [(shot, file) for shot in shots if (file := getattr(shot, kind)) is not None]
        if missing := [(shot, file) for shot, file in files if not file.is_file()]:
            shot, file = missing[0]
            more = f" ({len(missing)} of {len(files)} are missing)" if len(missing) > 1 else ""
            raise InputError(f"{shot.named}: no {kind} {file}{more}; {fix}")


def _view(shot: Shot, width: int | None, depths: DepthSource) -> PosedImage:
    color, mask = read_rgb(shot.image)
    see_through = mask is not None  # then what is not object has no colour of its own
    camera = shot.camera_for(shot.image, color.shape[1], color.shape[0])
    if shot.mask is not None:
        mask, see_through = read_mask(shot.mask), False
        if mask.shape != color.shape[:2]:
            sizes = [f"{shape[1]} × {shape[0]}" for shape in (mask.shape, color.shape)]
            raise InputError(f"{shot.mask}: {sizes[0]} pixels, but {shot.image} has {sizes[1]}; make them match")
    try:
        pinhole = undistorted_camera(camera)
    except ValueError as error:
        raise InputError(f"{shot.named}: {error}; check the coefficients, or undistort the images") from error
    whole = pinhole
    if width is not None and width < camera.width:
        pinhole = pinhole.resized(width, max(1, round(camera.height * width / camera.width)))

    def change(image: Float32) -> Float32:
        image = image if whole is camera else undistort(image, camera, whole)
        return image if pinhole is whole else shrink(image, pinhole.width, pinhole.height)

    if pinhole is not camera:
        share = None if mask is None else unit_range(mask)
        color, opacity = resample(color, share if see_through else None, change)
        share = opacity if share is None or see_through else change(share)
        color, mask = to_bytes(color), None if share is None else to_bytes(share)
    depth = None if shot.depth is None else read_depth_map(shot.depth, shot, depths)
    return PosedImage(shot.name, pinhole, color, mask, depth)


def _find_region(
    views: Sequence[PosedImage], points: NDArray[np.float64] | None, source: Path
) -> tuple[Similarity, str]:
    """The region from masks, sparse points or cameras, the first that succeeds, and its source in words."""
    cameras = [view.camera for view in views]
    solid = [view.mask > OBJECT for view in views if view.mask is not None]
    tries: list[tuple[str, Callable[[], Similarity]]] = []
    if len(solid) == len(views):
        tries.append(("visual hull of the masks", lambda: region_from_masks(cameras, solid)))
    if points is not None:
        tries.append(("sparse points", lambda: region_from_points(points, cameras)))
    tries.append(("what the cameras look at", lambda: region_from_cameras(cameras)))
    refused: list[str] = []
    for words, attempt in tries:
        try:
            return attempt(), "; ".join((words, *(f"not {reason}" for reason in refused)))
        except ValueError as error:
            if str(error) not in refused:  # the others may begin with the last one
                refused.append(str(error))
    fix = "take more views, from other sides, or give it: scale_mat_i of NeuS's files, or region= in Python"
    raise InputError(f"{source}: region: not found ({'; '.join(refused)}); {fix}")


def read_cameras(path: str | Path) -> list[tuple[str, Camera]]:
    """Read the cameras of posed images, with the images' names, in the file's own world coordinates.

    Lens distortion is ignored: the cameras are those of undistorted images. `read_posed_images` undistorts both.
    Photographs whose pose is not finite, as trackers write it where they lost the camera, are left out.

    - ``*.json``: transforms.json of nerfstudio, instant-ngp and the Blender scenes of NeRF. ``transform_matrix`` is
      the pose in OpenGL's convention (x right, y up, z backward) and becomes OpenCV's. The focal length is ``fl_x``,
      ``fl_y`` or ``camera_angle_x``; ``cx`` and ``cy`` count from the image's corner, so half a pixel is taken off; all
      may stand at the top or in a frame. Without ``w`` and ``h`` the size is that of the image.
    - ``*.npz``: NeuS and IDR; ``world_mat_i`` projects onto pixels and is decomposed. The i-th image in name order of
      the folder ``image`` beside the file gives name and size.

    In a folder the first of cameras_sphere.npz, transforms.json and transforms_train.json is read. Otherwise it is a
    COLMAP model, text or binary: the largest in ``sparse/*``, or that in ``sparse`` or the folder itself.

    Raises:
        InputError: the file is missing, damaged or of another kind, or a camera in it is impossible.
    """
    source = find_source(path)
    placed = [(shot.name, shot.placed.pinhole()) for shot in read_shots(source) if shot.placed is not None]
    if not placed:
        raise InputError(f"{source}: no pose in it is finite; find the cameras again")
    return placed


def find_source(path: str | Path) -> Path:
    """The file of cameras of a path: itself, or what is found in the folder; for COLMAP the model's folder."""
    path = Path(path)
    if path.is_dir():
        found = next((path / name for name in FILES if (path / name).is_file()), None) or find_model(path)
        if found is None:
            raise InputError(f"{path}: none of {', '.join(FILES)} or a COLMAP model (sparse/*) in it; name the file")
        return found
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    if path.suffix.lower() not in (".json", ".npz"):
        known = "cameras are read from .json, .npz and the folders of COLMAP models"
        raise InputError(f"{path}: unknown extension {path.suffix!r}; {known}")
    return path


def read_shots(source: Path) -> list[Shot]:
    """The photographs of what `find_source` found."""
    with readable(source):
        if source.is_dir():
            return read_colmap(source)
        return read_neus(source) if source.suffix.lower() == ".npz" else read_transforms(source)


def read_mask(path: Path) -> NDArray[np.uint8]:
    """A mask of any bit depth, grey or RGB → ``(H, W)``: 255 where it is more than half of white, else 0.

    In a file whose largest number is 1, white is 1.
    """
    image = reduce(np.maximum, np.moveaxis(read_rgb(path)[0], 2, 0))
    white = 1 if image.max() <= 1 else np.iinfo(image.dtype).max
    return 255 * (image > white / 2).astype(np.uint8)


def resample(
    color: NDArray[Any], alpha: Float32 | None, change: Callable[[Float32], Float32]
) -> tuple[Float32, Float32 | None]:
    """Average pixels in linear light, weighted by opacity if there is any → display RGB and opacity of the new picture.

    ``color`` is float32 or of a file. ``change`` makes of an image ``(H, W, C)`` another, each of whose pixels is a
    weighted average.
    """
    by_level = color.dtype == np.uint8  # then the light of 256 levels is that of all pixels
    light = srgb_to_linear(unit_range(np.arange(256, dtype=np.uint8) if by_level else color))
    light = light[color] if by_level else light
    if alpha is None:
        return linear_to_srgb(change(light).clip(0, 1)).astype(np.float32), None
    changed = change(np.dstack((light * alpha[..., None], alpha)))
    opacity = changed[..., 3]
    mean = changed[..., :3] / np.where(opacity > 0, opacity, 1)[..., None]
    return linear_to_srgb(mean.clip(0, 1)).astype(np.float32), opacity.clip(0, 1)


def shrink(image: Float32, width: int, height: int) -> Float32:
    """A smaller picture ``(height, width, ...)``, averaged over the areas of its pixels."""
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def undistorted_camera(camera: Camera) -> Camera:
    """The pinhole at the same place, with as many pixels, every one covered by the distorted image.

    Its image is the largest rectangle, in the plane at depth 1, with none of the distorted image's border inside it. A
    ValueError is raised if the distortion folds the image over.
    """
    if not camera.distortion:
        return camera
    across, down = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    right, bottom = np.float64(camera.width - 1), np.float64(camera.height - 1)
    x0, x1 = (_border(camera, np.broadcast_to(x, down.shape), down)[:, 0] for x in (0 * right, right))
    y0, y1 = (_border(camera, across, np.broadcast_to(y, across.shape))[:, 1] for y in (0 * bottom, bottom))
    (left, width), (top, height) = (x0.max(), x1.min() - x0.max()), (y0.max(), y1.min() - y0.max())
    if not (width > 0 and height > 0):
        raise ValueError(f"distortion={camera.distortion}: leaves nothing of the image")
    fx, fy = right / width, bottom / height
    pinhole = replace(camera, intrinsics=intrinsics(fx, fy, -fx * left, -fy * top), distortion=())
    x, y = _maps(camera, pinhole)
    # Where neighbours change places, two directions share a pixel.
    if np.diff(x, axis=1).min() <= 0 or np.diff(y, axis=0).min() <= 0:
        raise ValueError(f"distortion={camera.distortion}: folds the image over")
    return pinhole


def undistort(image: Float32, camera: Camera, pinhole: Camera) -> Float32:
    """The image of ``pinhole``, interpolated linearly from the distorted ``image`` ``(H, W)`` or ``(H, W, C)``."""
    x, y = _maps(camera, pinhole)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _maps(camera: Camera, pinhole: Camera) -> tuple[Float32, Float32]:
    """The places x and y in the distorted picture of the pinhole's pixels, ``(H, W)`` each."""
    size, target = (pinhole.width, pinhole.height), pinhole.intrinsics.numpy()
    x, y = cv2.initUndistortRectifyMap(*camera.for_opencv, np.eye(3), target, size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def _border(camera: Camera, x: Float64, y: Float64) -> Float64:
    """The slopes ``(N, 2)`` at pixels x, y ``(N,)``; a ValueError if they do not lead back to the pixels."""
    pixels = np.stack((x, y), axis=1)
    slopes = camera.slopes_at(pixels)
    if not np.abs(camera.pixels_at(slopes) - pixels).max() < EXACT:
        raise ValueError(f"distortion={camera.distortion}: cannot be undone at the image's border")
    return slopes
