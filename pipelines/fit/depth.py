"""``mplicits fit`` of depth maps: which files belong together, and the cloud that they make."""

from __future__ import annotations

import dataclasses
import math
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
    spacing_of,
    write_cloud_ply,
)
from ...datasets.depth.frame import PosedFrame
from ...datasets.depth.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from ...neural_fields import InputError
from ...neural_fields.backend.files import files_in, partial_of
from ..training.folder import CLOUD_FILE, kept_cloud, read_record
from ..training.machine import choose_device
from ..training.trainer import Report
from .train import FitConfig, Run, fit, fit_moved

__all__ = ["DepthInput", "depth_cloud", "fit_depth", "trim_suggestion"]

T = TypeVar("T")


@dataclass(frozen=True)
class DepthInput:
    """Depth maps, and what is known about them.

    Attributes:
        depth: one depth map, or a folder of them, taken in order of their names.
        intrinsics: a JSON file, or four numbers fx, fy, cx, cy; () if there are none.
        fov: full vertical angle of view in degrees, where nothing better is known.
        color: a picture, or a folder of as many as there are depth maps.
        poses: trajectory.log or transforms.json.
        scale: numbers in the depth files per unit.
        inverse: whether they hold inverse depths.
        resize_color: whether pictures of another size are scaled.
        settings: of the cleaning.
    """

    depth: Path
    intrinsics: tuple[str, ...] = ()
    fov: float | None = None
    color: Path | None = None
    poses: Path | None = None
    scale: float | None = None
    inverse: bool = False
    resize_color: bool = False
    settings: DepthSettings = field(default_factory=DepthSettings)


def depth_cloud(source: DepthInput) -> tuple[PointCloud, DepthReport]:
    """Read, clean and join depth maps.

    Raises:
        InputError: a file cannot be read, or they do not fit together.
    """
    return fuse_frames(_Files(source), source.settings)


class _Files:
    """The frames of a `DepthInput`: which files belong together is found at once, each is read when its turn comes."""

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
    """Fit depth maps: make their cloud, keep it as ``cloud.ply`` in the run's directory, and fit that.

    Normals are those of the depth maps, which face the camera: none is turned round, not even in a room seen from
    inside, unless the configuration asks for other normals.

    Args:
        source: the depth maps; not read again where a run is resumed.
        config: settings; the defaults are those of the ``default`` preset.
        out: run directory.
        resume: continue the interrupted run in ``out``.
        progress: called now and then with how far the training is.
        say: called with a few lines about the cloud, before the training.

    Raises:
        InputError: the depth maps cannot be used, or there is nothing to resume.
        Interrupted: see `fit`.
    """
    if resume:
        return fit(kept_cloud(out), config, out=out, resume=True, progress=progress)
    config = config or FitConfig()
    choose_device(config.device)  # or it would fail after the directory has been made
    cloud, facts = depth_cloud(source)
    if say is not None:
        say(facts.summary())
    if config.normals == "auto":
        config = dataclasses.replace(config, normals="file")
    made = partial_of(out / CLOUD_FILE)  # until the first checkpoint, when what was there makes way
    try:
        write_cloud_ply(made, cloud)
        return fit_moved(made, config, out=out, name=CLOUD_FILE, progress=progress)
    finally:
        made.unlink(missing_ok=True)


def trim_suggestion(run: Path) -> float:
    """A distance for ``mplicits mesh --trim-distance`` that cuts off what closes an open surface behind.

    Three times the distance to the nearest neighbour (of 95 % of the points), so that there are no holes between
    points, and three times how far the surface passes by them, square to that: a fit with an error larger than the
    spacing would otherwise be cut away as a whole.
    """
    error = read_record(run)["stages"][-1]["rms_at_points"]
    return 3 * math.hypot(spacing_of(read_cloud(run / CLOUD_FILE).points), error)


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
    """What belongs to each file: by the stem of its name where all fit, by the nearest time, or by order."""
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
    """Of a file's name; a time, which has digits after a point, has no extension."""
    path = Path(name)
    return path.stem if path.suffix.lower() in {*DEPTH_SUFFIXES, *COLOR_SUFFIXES} else path.name


def _seconds(names: list[str]) -> np.ndarray | None:
    """Names that are times ``(N,)``; None where one is none."""
    try:
        return np.array([float(name) for name in names]) if names else None
    except ValueError:
        return None


def _cameras(files: list[Path], posed: list[PosedFrame], source: DepthInput) -> list[DepthCamera]:
    """The lens of each depth map; what the user says comes before what the poses' file says."""
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
