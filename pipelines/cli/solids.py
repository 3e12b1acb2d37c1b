"""``mplicits boolean`` and ``mplicits offset``: watertight meshes of fits joined, grown, shrunk and hollowed."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from ..training.settings import given_flags
from .common import Command, add_flags
from .mesh import MESH_FILES, UNITS

if TYPE_CHECKING:
    from ..mesh.solids import Made

PART = "run directory, .safetensors file or closed mesh"


def _common_arguments(parser: argparse.ArgumentParser) -> None:
    add_flags(parser, "--time", "--level")
    add_flags(parser, "--resolution", help="cells per side of the cube around all (256)")
    what = "keep components that no input points support, too"
    parser.add_argument("--keep-unsupported", action="store_true", help=what)
    add_flags(parser, "--up", help="the axis that points up in the input; see `mplicits mesh`")
    what = "of the input, for lengths such as 2mm and for the file; see `mplicits mesh`"
    parser.add_argument("--unit", choices=UNITS, help=what)
    parser.add_argument("--center", action="store_true", help="put the middle of the mesh at the origin")


def _report(arguments: argparse.Namespace, made: Made, started: float) -> None:
    unit = f" {arguments.unit}" if arguments.unit else " input units"
    closed = "closed" if made.closed else "NOT closed"
    print(
        f"{arguments.out}: {len(made.mesh.vertices):,} vertices, {len(made.mesh.faces):,} faces, {closed}, "
        f"volume {made.volume:.6g}{unit}³, in {time.monotonic() - started:.1f} s"
    )


def _boolean_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("parts", nargs="+", metavar="RUN", help=f"two or more, each a {PART}, in the same coordinates")
    which = parser.add_mutually_exclusive_group(required=True)
    for name, what in (
        ("union", "what is in one of them"),
        ("intersection", "what is in all of them"),
        ("difference", "what is in the first and in no other"),
    ):
        which.add_argument(f"--{name}", dest="operation", action="store_const", const=name, help=what)
    add_flags(parser, "--out", help=f"{', '.join(MESH_FILES)}; or .safetensors: the field itself, of runs only")
    what = "blend seams over this length: a number of input units, or 2mm with --unit (0)"
    parser.add_argument("--smooth", default="0", metavar="LENGTH", help=what)
    _common_arguments(parser)


def _boolean(arguments: argparse.Namespace) -> int:
    from ..mesh.solids import SolidOptions, boolean

    started = time.monotonic()
    options = SolidOptions(**given_flags(arguments, SolidOptions))
    made = boolean(arguments.parts, arguments.operation, arguments.out, options, smooth=arguments.smooth, say=print)
    _report(arguments, made, started)
    return 0


BOOLEAN = Command(
    "join fits: union, intersection, difference",
    """  mplicits boolean runs/body runs/arm --union --smooth 2mm --unit m -o statue.ply
  mplicits boolean runs/statue base.stl --difference -o statue.stl
  mplicits boolean runs/body runs/arm --union -o both.safetensors""",
    _boolean_arguments,
    _boolean,
    "Join fits and closed meshes that lie in the same coordinates, and write a watertight mesh.",
)


def _offset_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help=PART)
    what = "how far outwards, negative is inwards: a number of input units, or 2mm with --unit"
    parser.add_argument("--by", required=True, metavar="LENGTH", help=what)
    what = "keep only the wall between the surface and where it goes: --by -2mm hollows, with walls of 2 mm"
    parser.add_argument("--shell", action="store_true", help=what)
    add_flags(parser, "--out", help=", ".join(MESH_FILES))
    _common_arguments(parser)


def _offset(arguments: argparse.Namespace) -> int:
    from ..mesh.solids import SolidOptions, offset

    started = time.monotonic()
    options = SolidOptions(**given_flags(arguments, SolidOptions))
    made = offset(arguments.run, arguments.by, arguments.out, options, shell=arguments.shell, say=print)
    _report(arguments, made, started)
    return 0


OFFSET = Command(
    "grow, shrink or hollow a fit by a length",
    """  mplicits offset runs/scan --by 2mm --unit m -o larger.ply
  mplicits offset runs/scan --by -0.02 --shell -o hollow.stl
  mplicits offset part.stl --by -2mm --shell --unit mm -o hollow.stl""",
    _offset_arguments,
    _offset,
    "Grow or shrink a fit or a closed mesh by a length measured from its surface, or hollow it: a watertight mesh.",
)
