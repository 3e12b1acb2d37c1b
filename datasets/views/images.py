"""Posed photographs: pictures, the pinhole cameras that took them, and where the object is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError, Similarity
from ..cameras import Camera
from ..files import readable
from .formats.colmap import find_models, read_colmap_points
from .formats.depth_maps import DepthMap, DepthSource, find_depth_maps, read_depth_map
from .formats.neus import read_neus_sphere
from .formats.reading import find_source, read_shots
from .formats.shots import Shot, list_images
from .pictures import read_mask, read_picture, resample, shrink, undistort, undistorted_camera
from .region import region_from_cameras, region_from_masks, region_from_points

__all__ = ["PosedImage", "PosedImages", "read_posed_images"]

Float32 = NDArray[np.float32]

OPAQUE = 0.999  # what is left of 1 after resampling


@dataclass(frozen=True, eq=False)
class PosedImage:
    """A picture without lens distortion, and its camera.

    Attributes:
        name: of its file, as the data set has it.
        camera: a pinhole of the picture's size.
        color: ``(H, W, 3)`` display RGB in [0, 1]; not multiplied by the mask.
        mask: ``(H, W)`` how much of the pixel is object, in [0, 1]; None where nobody said.
        depth: the depths that it shows, in pixels of their own; None where nobody measured.
    """

    name: str
    camera: Camera
    color: NDArray[np.float32]
    mask: NDArray[np.float32] | None
    depth: DepthMap | None = None


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Views of one object, and where it is.

    Attributes:
        views: at least one.
        similarity: from world coordinates to the unit sphere around the region of interest.
        region: where that came from, in words.
        points: ``(P, 3)`` sparse points of the surface in world coordinates, or None.
        source: the file that the cameras were read from; for COLMAP the folder of the model.
        observations: ``(K, 2)`` which view saw which point: their numbers; None where nobody said.
        reading: one line about which photographs have a camera.
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
    """Read photographs, their cameras, masks and depth maps, and find out where the object is.

    Lens distortion is taken out of the pictures, and the cameras are those of the new pictures. Where a picture is
    larger or smaller than its file of cameras says, both sides by one factor, the camera follows. A picture's mask is
    the file that goes with it, or its transparency; masks that are white in all views are none.

    Args:
        path: a file or folder that `read_cameras` knows: NeuS (with ``image`` and ``mask`` beside cameras_sphere.npz),
            transforms.json, COLMAP (``sparse/0`` with ``images`` beside it).
        width: pictures that are wider are shrunk to this, in pixels, in linear light; none is enlarged.
        region: the sphere around the object. By default that of ``scale_mat_i``, of the masks' visual hull, of the
            sparse points, or that which the cameras look at: the first that there is.
        depths: where depth maps are, and what they hold; by default those that a transforms.json names
            (``depth_file_path``, ``depth_path``), in the units of the cameras.
        allow_missing: whether to go on where fewer than half of the photographs have a camera, and without the
            cameras whose photograph, mask or depth map is missing.

    Raises:
        InputError: a file is missing or damaged, a picture and its camera, mask or depth map do not go together, a
            lens cannot be undistorted, or nothing says where the object is.
        ValueError: ``width`` is not positive.

    Example:
        >>> read_posed_images("photos")
        Traceback (most recent call last):
        ...
        mplicits.neural_fields.backend.errors.InputError: photos: no such file; check the path
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
    neus = source.suffix.lower() == ".npz"
    sphere = read_neus_sphere(source) if neus else None
    points, observations = (read_colmap_points(source) if source.is_dir() else None) or (None, None)
    maps = find_depth_maps(shots, depths)
    shots = [replace(shot, depth=path) for shot, path in zip(shots, maps, strict=True)]
    whole = [not _missing(shot) for shot in shots]
    if not allow_missing:
        _check_files(shots)
    reading = _counted(source, shots, sum(whole), allow_missing=allow_missing)
    if not all(whole):
        shots = [shot for shot, kept in zip(shots, whole, strict=True) if kept]
        if observations is not None:
            observations = observations[np.array(whole)[observations[:, 0]]]
            observations[:, 0] = (np.cumsum(whole) - 1)[observations[:, 0]]
    views = tuple(_view(shot, width, depths) for shot in shots)
    if all(view.mask is None or view.mask.min() > OPAQUE for view in views):
        views = tuple(replace(view, mask=None) for view in views)  # white masks in all views say nothing
    if region is not None:
        similarity, words = region, "given"
    elif sphere is not None:
        similarity, words = sphere, f"scale_mat_i of {source.name}"
    else:
        similarity, words = _find_region(views, points, source)
    return PosedImages(views, similarity, words, points, source, observations, reading)


def _missing(shot: Shot) -> bool:
    return any(file is not None and not file.is_file() for file in (shot.image, shot.mask, shot.depth))


def _counted(source: Path, shots: Sequence[Shot], placed: int, *, allow_missing: bool) -> str:
    """One line about how many photographs there are, and how many of them have a camera.

    Raises:
        InputError: fewer than half, or none.
    """
    photographs = len({shot.image for shot in shots})
    folders = {shot.image.parent for shot in shots}
    if source.is_dir() or source.name == "transforms.json":  # others hold a choice on purpose: training views, say
        kinds = {shot.image.suffix.lower() for shot in shots}
        listed = {file for folder in folders for file in list_images(folder) if file.suffix.lower() in kinds}
        extras = {file for shot in shots for file in (shot.mask, shot.depth) if file is not None}
        photographs = len((listed - extras) | {shot.image for shot in shots})
    reading = f"{placed} of {photographs} photographs have a camera"
    if source.is_dir() and len(models := find_models(source.parent.parent)) > 1 and source in models:
        reading += f" in sparse/{source.name}, the largest of {len(models)} models"
    if not placed or (2 * placed < photographs and not allow_missing):
        fix = "find the others' cameras, or go on with --allow-missing" if placed else "add the photographs"
        raise InputError(f"{source}: only {reading}; {fix}")
    return reading


def _check_files(shots: Sequence[Shot]) -> None:
    """Say before any long work what is missing."""
    fixes = {
        "image": "add it, or leave that camera out: --allow-missing",
        "mask": "add it, or leave all masks out",
        "depth": "add it, or leave all depth maps out",
    }
    for kind, fix in fixes.items():
        files = [(shot, file) for shot in shots if (file := getattr(shot, kind)) is not None]
        missing = [(shot, file) for shot, file in files if not file.is_file()]
        if missing:
            shot, file = missing[0]
            more = f" ({len(missing)} of {len(files)} are missing)" if len(missing) > 1 else ""
            raise InputError(f"{shot.named}: no {kind} {file}{more}; {fix}")


def _view(shot: Shot, width: int | None, depths: DepthSource) -> PosedImage:
    color, mask = read_picture(shot.image)
    see_through = mask is not None  # then what is not object has no colour of its own
    camera = _fitted(shot, color.shape[1], color.shape[0])
    if shot.mask is not None:
        mask, see_through = read_mask(shot.mask), False
        if mask.shape != color.shape[:2]:
            sizes = [f"{shape[1]} × {shape[0]}" for shape in (mask.shape, color.shape)]
            raise InputError(f"{shot.mask}: {sizes[0]} pixels, but {shot.image} has {sizes[1]}; make them match")
    try:
        pinhole = undistorted_camera(camera)
    except ValueError as error:
        raise InputError(f"{shot.named}: {error}; check the coefficients, or undistort the images") from error
    steps: list[Callable[[Float32], Float32]] = []
    if pinhole is not camera:
        steps.append(partial(undistort, camera=camera, pinhole=pinhole))
    if width is not None and width < camera.width:
        pinhole = pinhole.resized(width, max(1, round(camera.height * width / camera.width)))
        steps.append(partial(shrink, width=pinhole.width, height=pinhole.height))
    for step in steps:
        if see_through:
            color, mask = resample(color, mask, step)
        else:
            color, mask = resample(color, None, step)[0], mask if mask is None else step(mask)
    depth = None if shot.depth is None else read_depth_map(shot.depth, shot, depths)
    return PosedImage(shot.name, pinhole, color, mask, depth)


def _fitted(shot: Shot, width: int, height: int) -> Camera:
    """The camera for the picture that is there: files often keep the size of the original photographs."""
    camera = shot.camera
    if not camera.fits(width, height):
        sizes = f"{width} × {height} pixels, but its camera has {camera.width} × {camera.height}"
        raise InputError(f"{shot.named}: {shot.image} has {sizes}; turn, crop or export it as it was")
    same = (camera.width, camera.height) == (width, height)
    return camera if same else camera.resized(width, height)


def _find_region(
    views: Sequence[PosedImage], points: NDArray[np.float64] | None, source: Path
) -> tuple[Similarity, str]:
    """The first of masks, sparse points and cameras that says where the object is, and which it was."""
    cameras = [view.camera for view in views]
    masks = [view.mask for view in views if view.mask is not None]
    tries: list[tuple[str, Callable[[], Similarity]]] = []
    if len(masks) == len(views):
        tries.append(("visual hull of the masks", lambda: region_from_masks(cameras, masks)))
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
