"""``mplicits fit`` of depth maps: which files belong together, and the cloud that they make."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from ...datasets import (
    DepthCamera,
    DepthReport,
    DepthSettings,
    PointCloud,
    RgbdFrame,
    fuse_frames,
    read_cloud,
    read_depth,
    read_frame,
    read_intrinsics,
    read_poses,
    write_cloud_ply,
)
from ...datasets.depth.frame import PosedFrame
from ...datasets.depth.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from ...neural_fields import InputError
from ...neural_fields.backend.devices import choose_device
from ...neural_fields.backend.files import files_in, partial_of
from ..surface.surface import support_radius
from ..training.folder import CLOUD_FILE, kept_cloud, read_record
from ..training.result import Run
from ..training.settings import FitConfig
from ..training.trainer import Report
from .train import fit, fit_file

T = TypeVar("T")


@dataclass(frozen=True)
class DepthInput:
    """Depth maps with their camera, colours and poses."""

    depth: Path  # one depth map, or a folder of them in order of their names
    intrinsics: tuple[str, ...] = ()  # a JSON file, or fx, fy, cx, cy in pixels
    fov: float | None = None  # full vertical angle of view in degrees, without intrinsics
    color: Path | None = None  # a picture, or a folder of as many as there are depth maps
    poses: Path | None = None  # trajectory.log or transforms.json
    scale: float | None = None  # numbers in the depth files per unit
    inverse: bool = False  # whether the files hold inverse depths
    resize_color: bool = False  # whether pictures of another size are scaled
    settings: DepthSettings = field(default_factory=DepthSettings)  # of the cleaning


def depth_cloud(source: DepthInput) -> tuple[PointCloud, DepthReport]:
    """Read, clean and join depth maps."""
    files = _Files(source)
    cloud, facts = fuse_frames(files, source.settings)
    return cloud, dataclasses.replace(facts, lost=files.lost)


class _Files:
    """The frames of a `DepthInput`: files are matched at once, and each is read in its turn."""

    def __init__(self, source: DepthInput) -> None:
        self.source = source
        files = _files(source.depth, DEPTH_SUFFIXES, "depth maps")
        own: list[PosedFrame] = [(None, np.eye(4), None)]
        poses = own if source.poses is None else read_poses(source.poses)
        if source.poses is None and len(files) > 1:
            raise InputError(
                f"{source.depth}: {len(files)} depth maps, but no poses to join them by; give --poses trajectory.log "
                "or transforms.json, or name one depth map"
            )
        trouble = f"{source.poses}: {len(poses)} poses, but {len(files)} depth maps in {source.depth}"
        posed = _in_order_of(files, poses, [name for name, _, _ in poses], trouble)
        colors: list[Path | None] = [None] * len(files)
        if source.color is not None:
            pictures = _files(source.color, COLOR_SUFFIXES, "pictures")
            trouble = f"{source.color}: {len(pictures)} pictures, but {len(files)} depth maps; make their names match"
            colors = [*_in_order_of(files, pictures, [picture.name for picture in pictures], trouble)]
        kept = [k for k, (_, pose, _) in enumerate(posed) if np.isfinite(pose).all()]
        self.lost = len(files) - len(kept)
        if not kept:
            raise InputError(f"{source.poses}: all {len(files)} poses are lost (not finite); track the cameras again")
        files, posed, colors = [files[k] for k in kept], [posed[k] for k in kept], [colors[k] for k in kept]
        cameras = _cameras(files, posed, source)
        self.parts = list(zip(files, cameras, colors, (pose for _, pose, _ in posed), strict=True))

    def __iter__(self) -> Iterator[RgbdFrame]:
        source = self.source
        for file, camera, color, pose in self.parts:
            yield read_frame(
                file,
                camera,
                color=color,
                world_from_camera=pose,
                scale=source.scale,
                inverse=source.inverse,
                resize_color=source.resize_color,
            )


def fit_depth(
    source: DepthInput,
    config: FitConfig | None,
    *,
    out: Path,
    resume: bool = False,
    progress: Report | None = None,
    say: Callable[[str], None] | None = None,
) -> Run:
    """Fit depth maps: make their cloud, keep it as ``cloud.ply`` in the run's directory, and `fit` that.

    Normals are those of the depth maps, which face the camera, unless the configuration says otherwise. A resumed run
    does not read the depth maps again. ``say`` is called with a few lines about the cloud before the training.
    """
    if resume:
        return fit(kept_cloud(out), config, out=out, resume=True, progress=progress)
    config = config or FitConfig()
    choose_device(config.device)  # before the directory is made
    cloud, facts = depth_cloud(source)
    if say is not None:
        say(facts.summary())
    if config.normals == "auto":
        config = dataclasses.replace(config, normals="file")
    made = partial_of(out / CLOUD_FILE)  # an older cloud stays until the first checkpoint
    try:
        write_cloud_ply(made, cloud)
        return fit_file(made, config, out=out, keep=CLOUD_FILE, progress=progress)
    finally:
        made.unlink(missing_ok=True)


def trim_suggestion(run: Path) -> float:
    """A distance for ``mplicits mesh --trim-distance`` that cuts the closing of an open surface off.

    No holes appear between points, and no inexact fit is cut away; see `support_radius`.
    """
    error = read_record(run)["stages"][-1]["rms_at_points"]
    return support_radius(read_cloud(run / CLOUD_FILE).points, error=error)


def _files(path: Path, suffixes: tuple[str, ...], what: str) -> list[Path]:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    if not path.is_dir():
        return [path]
    files = files_in(path, suffixes)
    if not files:
        raise InputError(f"{path}: no {what} in it; they end in {', '.join(suffixes)}")
    return files


def _in_order_of(files: list[Path], items: list[T], names: list[str | None], trouble: str) -> list[T]:
    """The item of each file: by the stem of its name where all match, by the nearest time, or by order."""
    named = {_stem(name): item for name, item in zip(names, items, strict=True) if name is not None}
    if all(file.stem in named for file in files):
        return [named[file.stem] for file in files]
    times, wanted = _seconds(list(named)), _seconds([file.stem for file in files])
    if times is not None and wanted is not None and (times % 1 != 0).any():
        nearest = np.abs(wanted[:, None] - times).argmin(axis=1)
        if (np.abs(times[nearest] - wanted) <= 0.02).all():  # seconds, as the TUM benchmark's own tool matches them
            found = list(named.values())
            return [found[k] for k in nearest]
    if len(items) != len(files):
        raise InputError(trouble)
    return items


def _stem(name: str) -> str:
    """The stem of a file name; a time, which has digits after a point, has no extension."""
    path = Path(name)
    return path.stem if path.suffix.lower() in {*DEPTH_SUFFIXES, *COLOR_SUFFIXES} else path.name


def _seconds(names: list[str]) -> np.ndarray | None:
    """Names that are times ``(N,)``; None where one is none."""
    try:
        return np.array([float(name) for name in names]) if names else None
    except ValueError:
        return None


def _cameras(files: list[Path], posed: list[PosedFrame], source: DepthInput) -> list[DepthCamera]:
    """The lens of each depth map; the user's arguments take precedence over the file of poses."""
    if len(source.intrinsics) == 1:
        height, width = read_depth(files[0], inverse=source.inverse).shape
        return [read_intrinsics(source.intrinsics[0], size=(width, height))] * len(files)
    lenses = [lens for _, _, lens in posed if lens is not None]
    if not source.intrinsics and source.fov is None and len(lenses) == len(files):
        return lenses
    height, width = read_depth(files[0], inverse=source.inverse).shape
    if source.fov is not None:
        if not 0 < source.fov < 180:
            raise InputError(f"--fov {source.fov:g}: expected degrees between 0 and 180")
        return [DepthCamera.from_fov(source.fov, width, height)] * len(files)
    if not source.intrinsics:
        raise InputError(
            f"{source.depth}: a depth map needs its camera; give --intrinsics camera.json, --intrinsics FX FY CX CY, "
            "or roughly --fov DEGREES"
        )
    try:
        fx, fy, cx, cy = (float(number) for number in source.intrinsics)
        return [DepthCamera(width, height, fx, fy, cx, cy)] * len(files)
    except ValueError as error:
        given = " ".join(source.intrinsics)
        raise InputError(f"--intrinsics {given}: expected a JSON file, or FX FY CX CY in pixels ({error})") from error
