"""The flags of ``mplicits fit`` that are about depth maps."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .command import positive, whole
from .run.config import input_error

if TYPE_CHECKING:
    from .fit.depth import DepthInput

__all__ = ["add_depth_flags", "depth_input"]


def add_depth_flags(parser: argparse.ArgumentParser) -> None:
    """Add them, in a group of their own."""
    add = parser.add_argument_group("depth maps (PNG, TIFF, NPY or NPZ, or a folder of them)").add_argument
    add(
        "--intrinsics",
        nargs="+",
        metavar="FILE|NUMBER",
        help="camera JSON (ours, or Open3D's), or four numbers in pixels: FX FY CX CY",
    )
    add("--fov", type=positive, metavar="DEGREES", help="vertical angle of view, if no more is known")
    add("--color", type=Path, metavar="FILE|DIR", help="the picture, or a folder of one per depth map")
    add("--resize-color", action="store_true", help="scale pictures to the size of the depth maps")
    add("--poses", type=Path, metavar="FILE", help="of several depth maps: Open3D's trajectory.log, or transforms.json")
    add(
        "--depth-scale",
        type=positive,
        metavar="N",
        help="numbers per unit (integers: as the camera says, or 1000; else 1)",
    )
    add("--inverse-depth", action="store_true", help="the numbers are disparities: z = scale / number")
    add("--max-depth", type=positive, metavar="Z", help="drop what is further away than this")
    add("--max-points", type=whole(1), metavar="N", help="thin the cloud to as many (200000)")
    add(
        "--smooth-depth",
        type=whole(0, 16),
        metavar="PIXELS",
        help="radius of smoothing (as the noise asks for; 0: none)",
    )


def depth_input(arguments: argparse.Namespace) -> DepthInput | None:
    """What the arguments say of depth maps; None if CLOUD is a cloud.

    Raises:
        InputError: there are flags of depth maps, but CLOUD is none.
    """
    flags = {
        "--intrinsics": arguments.intrinsics,
        "--fov": arguments.fov,
        "--color": arguments.color,
        "--resize-color": arguments.resize_color,
        "--poses": arguments.poses,
        "--depth-scale": arguments.depth_scale,
        "--inverse-depth": arguments.inverse_depth,
        "--max-depth": arguments.max_depth,
        "--max-points": arguments.max_points,
        "--smooth-depth": arguments.smooth_depth is not None,
    }
    given = [flag for flag, value in flags.items() if value]
    path = Path(arguments.cloud)
    from ..datasets import DepthSettings, is_depth_file
    from ..datasets.depth.images import DEPTH_SUFFIXES

    named_so = path.suffix.lower() in DEPTH_SUFFIXES or path.is_dir()
    if given and not named_so:
        known = ", ".join(DEPTH_SUFFIXES)
        raise input_error(f"{path}: {given[0]} is for depth maps ({known}, or a folder of them), not for clouds")
    inside = path.is_dir() and any(is_depth_file(file) for file in path.iterdir())
    if not given and not inside and not (path.suffix and is_depth_file(path)):
        return None
    if arguments.fov is not None and arguments.intrinsics:
        raise input_error("--fov: does not go with --intrinsics; leave out one of them")
    from .fit.depth import DepthInput

    return DepthInput(
        depth=path,
        intrinsics=tuple(arguments.intrinsics or ()),
        fov=arguments.fov,
        color=arguments.color,
        poses=arguments.poses,
        scale=arguments.depth_scale,
        inverse=arguments.inverse_depth,
        resize_color=arguments.resize_color,
        settings=DepthSettings(
            max_depth=arguments.max_depth,
            smoothing=arguments.smooth_depth,
            **({} if arguments.max_points is None else {"max_points": arguments.max_points}),
        ),
    )
