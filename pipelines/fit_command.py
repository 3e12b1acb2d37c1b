"""``mplicits fit``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from .command import Command
from .config import input_error
from .fit_depth_flags import add_depth_flags, depth_input
from .fit_settings import add_fit_settings, fit_settings, were_given
from .texture_command import tell_texture

if TYPE_CHECKING:
    from .fit_depth import DepthInput
    from .fit_mesh import FitMesh

__all__ = ["COMMAND"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    what = "PLY, OBJ, STL, OFF, XYZ, TXT, CSV, NPY, NPZ, LAS or LAZ file; a depth map, or a folder of them"
    parser.add_argument("cloud", metavar="CLOUD", help=what)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="RUN", help="directory of the run")
    parser.add_argument(
        "--mesh",
        type=Path,
        metavar="FILE",
        help="then learn the colours, if there are any, and write the mesh (.ply, .obj, .stl, .glb)",
    )
    parser.add_argument("--no-colors", action="store_true", help="leave the colours out of --mesh")
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--resume", action="store_true", help="continue the interrupted run in RUN, with its settings")
    begin.add_argument("--force", action="store_true", help="overwrite the run in RUN")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    add_fit_settings(parser)
    add_depth_flags(parser)


def _fit(arguments: argparse.Namespace) -> int:
    if arguments.resume and were_given(arguments):
        raise input_error("--resume: continues with the run's own settings; leave out --preset, --config and the rest")
    if arguments.no_colors and arguments.mesh is None:
        raise input_error("--no-colors: is about --mesh FILE; leave it out, or add that")
    config = None if arguments.resume else fit_settings(arguments)
    from .fit import Interrupted, fit
    from .fit_depth import fit_depth, trim_suggestion
    from .fit_mesh import is_fitted
    from .info import describe
    from .progress_bar import progress_bars
    from .runs import check_new_run

    directory, depth = arguments.out, depth_input(arguments)
    # A run that was interrupted after its fit goes on there.
    fitted = arguments.resume and arguments.mesh is not None and is_fitted(directory)
    if not fitted:
        check_new_run(directory, resume=arguments.resume, force=arguments.force)
    mesh = _planned(arguments, depth)
    if arguments.force:
        _forget(directory)
    again = f"to continue: mplicits fit {arguments.cloud} -o {directory} --resume"
    if mesh is not None:
        again += f" --mesh {mesh.out}" + " --no-colors" * arguments.no_colors
    texture = None
    try:
        with nullcontext() if arguments.quiet else progress_bars() as report:
            if not fitted and depth is None:
                fit(arguments.cloud, config, out=directory, resume=arguments.resume, progress=report)
            elif not fitted and depth is not None:
                fit_depth(depth, config, out=directory, resume=arguments.resume, progress=report, say=print)
            if mesh is not None:
                texture = mesh.texture(refit=not fitted, progress=report)
    except Interrupted:
        print(f"interrupted; {again}", file=sys.stderr)
        return 130
    print(describe(directory))
    # A depth map shows one side of things; what the fit closes behind it is no part of them.
    trim = "" if depth is None else f" --trim-distance {trim_suggestion(directory):.2g}"
    if mesh is None:
        print(f"next: mplicits mesh {directory} -o {directory / 'mesh.ply'}{trim}")
        return 0
    if texture is not None:
        from .texture import TEXTURE_FILE

        tell_texture(directory / TEXTURE_FILE, texture)
        if not texture.record["finished"]:
            print(f"interrupted; the texture holds what was learnt so far; {again}", file=sys.stderr)
            return 130
    started = time.monotonic()
    try:
        made = mesh.extract()
    except KeyboardInterrupt:
        print(f"interrupted; fit and texture are finished; {again}", file=sys.stderr)
        return 130
    facts = [f"{len(made.vertices):,} vertices", f"{len(made.faces):,} faces"]
    facts += ["with colours"] * mesh.colored + ([trim.strip()] if trim else [])
    print(f"{mesh.out}: {', '.join(facts)}, in {time.monotonic() - started:.1f} s")
    return 0


def _planned(arguments: argparse.Namespace, depth: DepthInput | None) -> FitMesh | None:
    """The mesh that shall follow, checked; None if there is to be none."""
    if arguments.mesh is None:
        return None
    from .fit_mesh import plan_mesh

    source = Path(arguments.cloud) if depth is None else depth
    return plan_mesh(arguments.mesh, arguments.out, source, colors=not arguments.no_colors, resume=arguments.resume)


def _forget(directory: Path) -> None:
    """Remove what must not be resumed into the new run, nor colour it."""
    from .fit_state import STATE_FILE
    from .texture import TEXTURE_FILE
    from .texture_state import texture_state_file

    texture = directory / TEXTURE_FILE
    for path in (directory / STATE_FILE, texture, texture_state_file(texture)):
        path.unlink(missing_ok=True)


COMMAND = Command(
    "fit a multiscale SDF to a point cloud or depth maps",
    """  mplicits fit scan.ply -o runs/scan
  mplicits fit scan.ply -o runs/scan --mesh scan_mesh.ply
  mplicits fit scan.ply -o runs/quick --preset fast
  mplicits fit scan.ply -o runs/scan --resume
  mplicits fit scan.xyz -o runs/mine --normals estimate --time-budget 120 --steps 2000 1000 1000
  mplicits fit depth.png --intrinsics camera.json --color color.png -o runs/room --mesh room.glb
  mplicits fit depth/ --intrinsics camera.json --color color/ --poses trajectory.log -o runs/room""",
    _arguments,
    _fit,
    "Fit a multiscale SDF to a point cloud, or to depth maps. RUN will hold field.safetensors and run.json.",
)
