"""``mplicits mesh`` and ``mplicits evaluate``: a mesh out of a run, and how near a mesh is to a reference."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time

from ..training.settings import given_flags
from .common import Command, add_flags, positive, whole, write_json

MESH_FILES = (".ply", ".obj", ".stl", ".glb")
UNITS = ("um", "mm", "cm", "m", "km", "in", "ft")


def _mesh_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add_flags(parser, "run", "--time", "--level")
    add_flags(parser, "--out", help=", ".join(MESH_FILES))
    add_flags(parser, "--resolution", help="cells per side (256, up to 1024 where parts are thin)")
    add_flags(parser, "--normal-level", help="normals of this level on the mesh (default: of its own)")
    what = "leave out the colours of the run's texture"
    add("--no-colors", dest="colors", action="store_false", help=what)
    what = "unwrap, and bake colours and fine normals into N × N images (.glb, .obj; needs mplicits[texture])"
    add("--texture", type=whole(16, 16384), metavar="N", help=what)
    add("--texture-faces", type=whole(4), metavar="N", help="triangles to keep with --texture (50000)")
    what = "about how many triangles to keep, with the distance to the full mesh stated (needs mplicits[texture])"
    add("--faces", type=whole(4), metavar="N", help=what)
    add("--seen", action="store_true", help="leave out what fewer than two photographs have seen (of reconstruct)")
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
    options = MeshOptions(**given_flags(arguments, MeshOptions))
    if arguments.json and options.report is None and options.texture is None:
        options = dataclasses.replace(options, report=True)
    done = export_run(arguments.run, arguments.out, options, say=print)
    seconds = time.monotonic() - started
    counts = f"{len(done.mesh.vertices):,} vertices, {len(done.mesh.faces):,} faces"
    print(f"{arguments.out}: {counts}, in {seconds:.1f} s")
    if done.printing is not None:
        print(format_report(done.printing))
    write_json(arguments.json, done.record())
    return 0


MESH = Command(
    "extract a mesh from a fit",
    """  mplicits mesh runs/scan -o scan.ply --resolution 512
  mplicits mesh runs/scan -o coarse.obj --level 0
  mplicits mesh runs/scan -o scan.glb --keep-largest --trim-distance 0.01
  mplicits mesh runs/scan -o scan.glb --up z --unit mm --center
  mplicits mesh runs/scan -o small.ply --faces 20000
  mplicits mesh runs/scan -o scan.stl --up z --unit mm --json print.json""",
    _mesh_arguments,
    _mesh,
    "Extract a mesh from a fit, in the coordinates of its input; or upright, in metres and at the origin.",
)


def _evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mesh", metavar="MESH", help="the mesh to judge")
    parser.add_argument("reference", metavar="REFERENCE", help="the true mesh, or a point cloud")
    about = "posed photographs: say, too, how near the mesh is where two of them see the reference"
    parser.add_argument("--photos", metavar="DATA", help=about)
    add_flags(parser, "--samples", type=whole(1), default=500_000, help="on each surface (500000)")
    add_flags(parser, "--seed", help="of the samples (0)")
    add_flags(parser, "--json")


def _evaluate(arguments: argparse.Namespace) -> int:
    from ..surface.measure import evaluate_files, format_metrics, write_metrics

    options = {name: getattr(arguments, name) for name in ("samples", "seed")}
    if arguments.photos is None:
        metrics = evaluate_files(arguments.mesh, arguments.reference, **options)
    else:
        from ...datasets.views.images import read_cameras
        from ..reconstruct.views import count_views
        from ..training.progress import counter_bar

        cameras = [camera for _, camera in read_cameras(arguments.photos)]
        with counter_bar("photographs") as progress:
            view_counts = functools.partial(count_views, cameras, progress=progress)
            metrics = evaluate_files(arguments.mesh, arguments.reference, view_counts=view_counts, **options)
    print(format_metrics(metrics))
    if arguments.json:
        write_metrics(arguments.json, metrics)
    return 0


EVALUATE = Command(
    "measure a mesh against a reference",
    """  mplicits evaluate scan.ply truth.ply
  mplicits evaluate scan.ply points.xyz --samples 100000 --json figures.json
  mplicits evaluate runs/statue/mesh.ply photos/surface.ply --photos photos""",
    _evaluate_arguments,
    _evaluate,
    "Measure a mesh against a mesh or a cloud. Lengths are in units of the reference's bounding sphere.",
)
