"""``Shot``, a photograph as a file of cameras describes it, and the ``DepthMap`` that goes with a photograph."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ....neural_fields.backend.files import files_in
from ...cameras import Camera
from ...depth.cleaning import edge_pixels
from ...depth.images import DEPTH_SUFFIXES, read_depth

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".heic", ".heif")
JUMP = 0.02  # relative steps between neighbours that are no edge, whatever is on either side

DepthKind = Literal["metric", "relative", "disparity"]


@dataclass(frozen=True, eq=False)
class Shot:
    """One photograph as a file of cameras describes it; the photograph itself is not read."""

    name: str  # of the image, as the file has it
    placed: Camera | None  # with its lens; None where the file has no finite pose for it
    image: Path  # where the photograph should be
    mask: Path | None
    named: str  # file and record, as the beginning of a message
    depth: Path | None = None
    depth_scale: float | None = None  # steps per unit of an integer depth map, if the file gives it; see `read_depth`

    def camera_for(self, file: Path, width: int, height: int) -> Camera:
        """Its camera for the picture or depth map ``file``: often the size is that of the original photographs."""
        camera = self.placed
        assert camera is not None, self.named
        if not camera.fits(width, height):
            sizes = f"{width} × {height} pixels, but its camera has {camera.width} × {camera.height}"
            raise InputError(f"{self.named}: {file} has {sizes}; turn, crop or export it as the photograph was")
        return camera.resized(width, height)


@dataclass(frozen=True)
class DepthSource:
    """Where the depth maps of photographs are, and what their numbers mean.

    Attributes:
        folder: with a file for each photograph, of its name but for the extension (16-bit PNG, TIFF, NPY, NPZ); None
            takes the files that the data set names.
        kind: what the map's numbers m are. Metric: depths z along the axis of view, in the units of the cameras.
            Relative: z = a m + b with an unknown scale a > 0 and shift b for each photograph. Disparity: 1 / z =
            a m + b.
        scale: numbers in the files per unit; see `read_depth`.
    """

    folder: Path | None = None
    kind: DepthKind = "metric"
    scale: float | None = None


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depths that a photograph shows, in pixels of their own."""

    numbers: NDArray[np.float32]  # (H, W); NaN where the depth is unknown, or near and far meet in a pixel
    camera: Camera  # of the map's size, where the photograph was taken, with the lens of the file
    kind: DepthKind
    source: Path


def list_images(folder: Path) -> list[Path]:
    """The images of a folder in the order of their names, without hidden files; none if there is no such folder."""
    return files_in(folder, IMAGE_SUFFIXES) if folder.is_dir() else []


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, from the header alone."""
    import imageio.v3 as iio  # here, because most files of cameras hold the size

    try:
        shape = iio.improps(path, plugin="pillow").shape
    except (OSError, ValueError, SyntaxError) as error:  # Pillow's PNG reader raises SyntaxError
        raise InputError(f"{path}: cannot be read as an image; export it again") from error
    return int(shape[1]), int(shape[0])


def find_depth_maps(shots: list[Shot], source: DepthSource) -> list[Path | None]:
    """The file of each photograph's depth map, or None; files that the data set names may be missing."""
    if (folder := source.folder) is None:
        return [shot.depth for shot in shots]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; it should hold a depth map for each photograph")
    found: list[Path | None] = []
    for shot in shots:
        places = (folder / shot.name, folder / Path(shot.name).name)
        files = (place.with_suffix(suffix) for place in places for suffix in DEPTH_SUFFIXES)
        found.append(next((file for file in files if file.is_file()), None))
    if not any(found):
        first = f"{Path(shots[0].name).stem}.png, .tif, .npy or .npz for {shots[0].name}"
        raise InputError(f"{folder}: no depth map in it has the name of a photograph; expected {first}")
    return found


def read_depth_map(path: Path, shot: Shot, source: DepthSource) -> DepthMap:
    """The depth map of a photograph; it may have other pixels, as long as both show the same view.

    Of metric maps the pixels at depth edges are left out: sensors mix near and far there.
    """
    depth = read_depth(path, scale=source.scale, integer_scale=shot.depth_scale, saturates=source.kind == "metric")
    height, width = depth.shape
    camera = shot.camera_for(path, width, height)
    if source.kind == "metric":
        edges = edge_pixels(depth, pixel_angle=1 / camera.fx_fy_cx_cy[0], jump=JUMP)
        depth = np.where(edges, np.nan, depth)
    return DepthMap(depth.astype(np.float32), camera, source.kind, path)
