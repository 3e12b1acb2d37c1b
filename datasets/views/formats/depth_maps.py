"""Depth maps that go with photographs: a sensor's, in units of the cameras, or a network's, up to scale and shift."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ...cameras import Camera
from ...depth.cleaning import edge_pixels
from ...depth.images import DEPTH_SUFFIXES, read_depth
from .shots import Shot

__all__ = ["DepthKind", "DepthMap", "DepthSource", "find_depth_maps", "read_depth_map"]

DepthKind = Literal["metric", "relative", "disparity"]

JUMP = 0.02  # relative steps between neighbours that are no edge, whatever is on either side


@dataclass(frozen=True)
class DepthSource:
    """Where the depth maps of photographs are, and what their numbers mean.

    Attributes:
        folder: with a file for each photograph, of its name but for the extension (16-bit PNG, TIFF, NPY, NPZ); None
            takes the files that the data set names, if it does.
        kind: metric: depths z along the axis of view in the units of the cameras; relative: z = a m + b of the map's
            numbers m, with an unknown scale a > 0 and shift b for each photograph; disparity: 1 / z = a m + b.
        scale: numbers in the files per unit; see `read_depth`.
    """

    folder: Path | None = None
    kind: DepthKind = "metric"
    scale: float | None = None


@dataclass(frozen=True, eq=False)
class DepthMap:
    """What is known of the depths that a photograph shows, in pixels of its own.

    Attributes:
        numbers: ``(H, W)`` float32; NaN where nothing is known, or where near and far meet in a pixel.
        camera: of the map's size, where the photograph was taken, with the lens of the file.
        kind: what the numbers mean; see `DepthSource`.
        source: the file.
    """

    numbers: NDArray[np.float32]
    camera: Camera
    kind: DepthKind
    source: Path


def find_depth_maps(shots: list[Shot], source: DepthSource) -> list[Path | None]:
    """The file of each photograph's depth map, or None; whether those that the data set names are there is not said.

    Raises:
        InputError: there is no such folder, or no file in it goes with a photograph.
    """
    folder = source.folder
    if folder is None:
        return [shot.depth for shot in shots]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; it should hold a depth map for each photograph")
    found = [_beside(folder, shot.name) for shot in shots]
    if not any(found):
        first = Path(shots[0].name).stem
        raise InputError(
            f"{folder}: no depth map in it has the name of a photograph; expected {first}.png, .tif, .npy or .npz "
            f"for {shots[0].name}"
        )
    return found


def _beside(folder: Path, name: str) -> Path | None:
    """The file of that name with one of the extensions; in the folder itself, or in one like the photograph's."""
    named = Path(name)
    places = (folder / named, folder / named.name)
    return next(
        (file for at in places for suffix in DEPTH_SUFFIXES if (file := at.with_suffix(suffix)).is_file()), None
    )


def read_depth_map(path: Path, shot: Shot, source: DepthSource) -> DepthMap:
    """Read the depth map of a photograph.

    It may have other pixels than the photograph, as long as both show the same view. Of what a sensor sees on either
    side of an edge in depth the pixels at the edge are left out: they mix near and far.

    Raises:
        InputError: the file is missing, damaged or no depth map, or of another shape than the photograph.
    """
    depth = read_depth(path, scale=source.scale, integer_scale=shot.depth_scale, saturates=source.kind == "metric")
    height, width = depth.shape
    if not shot.camera.fits(width, height):
        size = f"{shot.camera.width} × {shot.camera.height}"
        sizes = f"{width} × {height} pixels, but the camera of {shot.name} has {size}"
        raise InputError(f"{path}: {sizes}; export it in the view of the photograph (registered)")
    camera = shot.camera.resized(width, height)
    if source.kind == "metric":
        edges = edge_pixels(depth, pixel_angle=1 / camera.fx_fy_cx_cy[0], jump=JUMP)
        depth = np.where(edges, np.nan, depth)
    return DepthMap(depth.astype(np.float32), camera, source.kind, path)
