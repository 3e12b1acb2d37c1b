"""The cameras of ``mplicits render``: around the shape, or those of posed images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ..datasets.cameras import Camera, turntable
from ..datasets.views.reading import read_cameras
from ..neural_fields import InputError, Similarity

__all__ = ["Orbit", "choose_frame", "orbit_cameras", "posed_cameras"]

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Orbit:
    """A camera on a sphere around the shape; see `datasets.cameras.orbit` for what the numbers mean."""

    azimuth: float = 30.0
    elevation: float = 15.0
    up: str = "y"
    fov: float = 25.0
    zoom: float = 1.0


def orbit_cameras(outline: Float64, orbit: Orbit, *, size: tuple[int, int], frames: int) -> list[Camera]:
    """Cameras once around the points ``outline`` ``(N, 3)``, all at one distance.

    Raises:
        ValueError: an argument is out of its range, or all points are the same.
    """
    return turntable(outline, frames, width=size[0], height=size[1], **vars(orbit))


def posed_cameras(
    file: str | Path, frame: str | None, similarity: Similarity, *, width: int | None, film: bool
) -> list[Camera]:
    """The cameras of a file, in unit-sphere coordinates.

    Args:
        file: transforms.json or cameras_sphere.npz.
        frame: which camera, see `choose_frame`; for a film None, which means all of them.
        similarity: from the file's coordinates, which are those of the input.
        width: of the pictures, in pixels; the height follows. By default that of the images.
        film: whether a film is made.

    Raises:
        InputError: the file cannot be read, has no such frame, or its images are not of one size.
    """
    named = read_cameras(file)
    if film and frame is not None:
        raise InputError("--frame: a film goes through all the cameras; leave it out, or write a picture (.png)")
    chosen = named if film else [choose_frame(file, named, frame)]
    cameras = [_scaled(camera, width).moved(similarity) for _, camera in chosen]
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        shown = ", ".join(f"{width}×{height}" for width, height in sizes[:3])
        raise InputError(f"{file}: the images have {len(sizes)} sizes ({shown}); a film needs one; choose a --frame")
    return cameras


def choose_frame(file: str | Path, named: Sequence[tuple[str, Camera]], frame: str | None) -> tuple[str, Camera]:
    """One of the cameras: by name, with or without folder and extension, or by index from 0; the only one by None.

    Raises:
        InputError: there is none of that name, or there are several.
    """
    names = [name for name, _ in named]
    some = f"has {len(names)} cameras, {names[0]} to {names[-1]}"
    if frame is None:
        if len(named) > 1:
            raise InputError(f"{file}: {some}; choose one with --frame NAME or an index from 0")
        return named[0]
    for key in (str, lambda name: PurePosixPath(name).name, lambda name: PurePosixPath(name).stem):
        found = [pair for pair in named if key(pair[0]) == frame]
        if len(found) == 1:
            return found[0]
    if frame.isdecimal() and int(frame) < len(named):
        return named[int(frame)]
    raise InputError(f"--frame {frame}: {file} {some}; none, or more than one, is called that")


def _scaled(camera: Camera, width: int | None) -> Camera:
    if width is None:
        return camera
    return camera.resized(width, max(1, round(camera.height * width / camera.width)))
