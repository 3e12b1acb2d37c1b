"""``mplicits check-cameras``: its arguments, and where figures and warnings go."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .command import Command, add_json, check_output, write_json

__all__ = ["COMMAND"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    what = (
        "folder or file: cameras_sphere.npz with image/ and mask/, transforms.json, or COLMAP's sparse/0 with images/"
    )
    parser.add_argument("data", metavar="DATA", help=what)
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help=".glb or .ply: the cameras, to look at")
    add_json(parser)


def _check_cameras(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (".glb", ".ply"))
    check_output(arguments.json, (".json",))
    from .reconstruct.check import check_files

    _, check, text = check_files(arguments.data, arguments.out)
    print(text)
    if arguments.out is not None:
        print(f"{arguments.out}: frustums from violet (first) to yellow (last), the region's sphere, the world's axes")
    for warning in check.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    write_json(arguments.json, check.record())
    return 0


COMMAND = Command(
    "look at the cameras of posed photographs, and check them",
    """  mplicits check-cameras photos
  mplicits check-cameras photos/transforms.json -o cameras.glb
  mplicits check-cameras dtu_scan24 -o cameras.ply --json cameras.json""",
    _arguments,
    _check_cameras,
    "Print where the cameras of a data set stand and what they see of the region of interest, warn of what is usually "
    "wrong (conventions, regions, masks), and write the cameras as a mesh in world coordinates.",
)
