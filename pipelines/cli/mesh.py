"""The commands about meshes: ``mplicits mesh``, ``evaluate``, ``boolean`` and ``offset``."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..training.settings import given_flags
from .common import Command, add_flags, positive, refuse, stoppable, whole, write_json

if TYPE_CHECKING:
    from ..mesh.solids import Made

MESH_FILES = (".ply", ".obj", ".stl", ".glb")
UNITS = ("um", "mm", "cm", "m", "km", "in", "ft")


def _mesh_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add_flags(parser, "run", "--time", "--level")
    add_flags(parser, "--out", help=f"{', '.join(MESH_FILES)}; with --format 3dtiles a folder")
    what = "3dtiles: 3D Tiles 1.1, a folder of tiles at several steps of detail, for web viewers such as Cesium"
    add("--format", choices=("3dtiles",), help=what)
    what = "extract and write cube by cube, for a surface that is too large for memory (.ply)"
    add("--in-parts", action="store_true", help=what)
    what = "coordinate system of the input, for 3D Tiles: EPSG:NUMBER or WKT (default: that of a LAS or LAZ file)"
    add("--crs", metavar="NAME", help=what)
    add_flags(parser, "--resolution", help="cells per side (256, up to 1024 where parts are thin)")
    add_flags(parser, "--normal-level", help="normals of this level on the mesh (default: of its own)")
    add("--no-colors", dest="colors", action="store_false", help="leave out the colours of the run's texture")
    what = "unwrap, and bake colours and fine normals into N × N images (.glb, .obj; needs mplicits[texture])"
    add("--texture", type=whole(16, 16384), metavar="N", help=what)
    add("--texture-faces", type=whole(4), metavar="N", help="triangles to keep with --texture (50000)")
    what = "about how many triangles to keep, with the distance to the full mesh stated (needs mplicits[texture])"
    add("--faces", type=whole(4), metavar="N", help=what)
    add("--seen", action="store_true", help="leave out what is visible in fewer than two photographs (of reconstruct)")
    add("--keep-unsupported", action="store_true", help="keep components that no input points support, too")
    add("--keep-largest", action="store_true", help="keep only the component of largest area")
    what = "drop faces further than D (input units) from the points: holes stay holes"
    add("--trim-distance", type=positive, metavar="D", help=what)
    add("--cloud", metavar="FILE", help="the points for --trim-distance (default: those of the fit)")
    what = "the axis that points up in the input: a GLB is turned y-up (default: y), others are turned if this is given"
    add_flags(parser, "--up", help=what)
    what = "of the input: a GLB is in metres (default: m), others are scaled (STL to mm, else to m) if this is given"
    add("--unit", choices=UNITS, help=what)
    add("--center", action="store_true", help="put the middle of the mesh at the origin")
    what = "look at it as a printer would: closed, parts, volume, thinnest part (default: for .stl)"
    add("--report", action=argparse.BooleanOptionalAction, help=what)
    add_flags(parser, "--json", help="write the figures as JSON (implies --report)")


def _mesh(arguments: argparse.Namespace) -> int:
    from ..mesh.extract import MeshOptions, export_run
    from ..mesh.printing import format_report

    started = time.monotonic()
    if arguments.format is not None or arguments.in_parts:
        return _scene(arguments, started)
    refuse(arguments, ["crs"], "goes with --format 3dtiles; add it, or leave this out")
    options = MeshOptions(**given_flags(arguments, MeshOptions))
    if arguments.json and options.report is None and options.texture is None:
        options = dataclasses.replace(options, report=True)
    done = export_run(arguments.run, arguments.out, options, say=print)
    counts = f"{len(done.mesh.vertices):,} vertices, {len(done.mesh.faces):,} faces"
    print(f"{arguments.out}: {counts}, in {time.monotonic() - started:.1f} s")
    if done.printing is not None:
        print(format_report(done.printing))
    write_json(arguments.json, done.record())
    return 0


def _scene(arguments: argparse.Namespace, started: float) -> int:
    from ..mesh.extract import MeshOptions
    from ..mesh.scene import SceneOptions, ply_of_run, scene_of_run
    from ..training.progress import progress_bars

    flag = "--in-parts" if arguments.in_parts else "--format 3dtiles"
    others = MeshOptions.__dataclass_fields__.keys() - SceneOptions.__dataclass_fields__.keys()
    others |= {"crs", "format"} if arguments.in_parts else set()
    refuse(arguments, sorted(others), f"does not go with {flag}; leave it out")
    about = (arguments.run, arguments.out, SceneOptions(**given_flags(arguments, SceneOptions)))
    kept = "the same command goes on from the parts that it has"
    with stoppable(kept, at_any_time=True), progress_bars(counting=True) as report:
        if arguments.in_parts:
            vertices, faces = ply_of_run(*about, say=print, report=report)
            made: dict[str, Any] = {"vertices": vertices, "faces": faces}
            line = f": {vertices:,} vertices, {faces:,} faces"
        else:
            scene = scene_of_run(*about, say=print, report=report)
            made = scene._asdict()
            line = (
                f"/tileset.json: {scene.tiles:,} tiles in {scene.steps} steps of detail, the coarsest within "
                f"{scene.error:.3g} m, the finest of {scene.faces:,} faces"
            )
    print(f"{arguments.out}{line}, in {time.monotonic() - started:.1f} s")
    write_json(arguments.json, made)
    return 0


MESH = Command(
    "extract a mesh from a fit",
    """  mplicits mesh runs/scan -o scan_mesh.ply --resolution 512
  mplicits mesh runs/scan -o coarse.obj --level 0
  mplicits mesh runs/scan -o scan.glb --keep-largest --trim-distance 0.01
  mplicits mesh runs/scan -o scan.glb --up z --unit mm --center
  mplicits mesh runs/scan -o small.ply --faces 20000
  mplicits mesh runs/scan -o scan.stl --up z --unit mm --json print.json
  mplicits mesh runs/city -o city --format 3dtiles --resolution 2048""",
    _mesh_arguments,
    _mesh,
    "Extract a mesh from a fit, in the coordinates of its input; or upright, in metres and at the origin.",
)


def _evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mesh", metavar="MESH", help="the mesh to judge")
    parser.add_argument("reference", metavar="REFERENCE", help="the true mesh, or a point cloud")
    about = "posed photographs: measure, too, where they see the reference (in their masks), as DTU does"
    parser.add_argument("--photos", metavar="DATA", help=about)
    add_flags(parser, "--samples", type=whole(1), default=500_000, help="on each surface (500000)")
    add_flags(parser, "--seed", help="of the samples (0)")
    add_flags(parser, "--json")


def _evaluate(arguments: argparse.Namespace) -> int:
    from ..surface.measure import evaluate_files, format_metrics

    options = {name: getattr(arguments, name) for name in ("samples", "seed")}
    if arguments.photos is None:
        metrics = evaluate_files(arguments.mesh, arguments.reference, **options)
    else:
        from ...datasets.views.images import read_posed_images
        from ..reconstruct.views import count_views
        from ..training.progress import counter_bar

        views = [(view.camera, view.mask_bytes) for view in read_posed_images(arguments.photos).views]
        with counter_bar("photographs") as progress:
            view_counts = functools.partial(count_views, views, progress=progress)
            metrics = evaluate_files(arguments.mesh, arguments.reference, view_counts=view_counts, **options)
    print(format_metrics(metrics))
    write_json(arguments.json, dataclasses.asdict(metrics))
    return 0


EVALUATE = Command(
    "measure a mesh against a reference",
    """  mplicits evaluate scan_mesh.ply truth.ply
  mplicits evaluate scan_mesh.ply points.xyz --samples 100000 --json figures.json
  mplicits evaluate runs/statue/mesh.ply photos/surface.ply --photos photos""",
    _evaluate_arguments,
    _evaluate,
    "Measure a mesh against a mesh or a cloud. Lengths are in units of the reference's bounding sphere.",
)


PART = "run directory, .safetensors file or closed mesh"


def _common_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add_flags(parser, "--time", "--level")
    add_flags(parser, "--resolution", help="cells per side of the cube around all (256)")
    add("--keep-unsupported", action="store_true", help="keep components that no input points support, too")
    add_flags(parser, "--up", help="the axis that points up in the input; see `mplicits mesh`")
    add("--unit", choices=UNITS, help="of the input, for lengths such as 2mm and for the file; see `mplicits mesh`")
    add("--center", action="store_true", help="put the middle of the mesh at the origin")


def _make_solid(arguments: argparse.Namespace, make: Callable[..., Made]) -> int:
    """Make the solid, which says what was removed, and print its figures."""
    from ..mesh.solids import SolidOptions

    started = time.monotonic()
    made = make(arguments.out, SolidOptions(**given_flags(arguments, SolidOptions)), say=print)
    unit = f" {arguments.unit}" if arguments.unit else " input units"
    closed = "closed" if made.closed else "NOT closed"
    print(
        f"{arguments.out}: {len(made.mesh.vertices):,} vertices, {len(made.mesh.faces):,} faces, {closed}, "
        f"volume {made.volume:.6g}{unit}³, in {time.monotonic() - started:.1f} s"
    )
    return 0


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
    from ..mesh.solids import boolean

    parts, operation = arguments.parts, arguments.operation
    return _make_solid(arguments, functools.partial(boolean, parts, operation, smooth=arguments.smooth))


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
    from ..mesh.solids import offset

    return _make_solid(arguments, functools.partial(offset, arguments.run, arguments.by, shell=arguments.shell))


OFFSET = Command(
    "grow, shrink or hollow a fit by a length",
    """  mplicits offset runs/scan --by 2mm --unit mm -o larger.ply
  mplicits offset runs/scan --by -0.02 -o smaller.ply
  mplicits offset part.stl --by -2mm --shell --unit mm -o hollow.stl""",
    _offset_arguments,
    _offset,
    "Grow or shrink a fit or a closed mesh by a length measured from its surface, or hollow it: a watertight mesh.",
)
