"""``mplicits fit``: its arguments, those about depth maps among them, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..training.settings import FitConfig, command_line, given_flags, input_error
from .common import (
    Command,
    add_new_run,
    add_settings,
    new_settings,
    positive,
    refuse,
    stoppable,
    tell_budget,
    training,
    whole,
)
from .train import tell_texture

if TYPE_CHECKING:
    from ..fit.depth import DepthInput
    from ..fit.many import FitOutcome
    from ..mesh.finish import FitMesh

__all__ = ["FIT"]

DEPTH_FLAGS = (
    *("intrinsics", "fov", "color", "resize_color", "poses"),
    *("depth_scale", "inverse_depth", "max_depth", "max_points", "smooth_depth"),
)


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    what = (
        "PLY, PCD, E57, OBJ, STL, OFF, XYZ, TXT, ASC, CSV, PTS, NPY, NPZ, LAS or LAZ; a depth map, or a folder of them"
    )
    add("clouds", nargs="+", metavar="CLOUD", help=f"{what}; several clouds get a run each, RUN/NAME")
    add_new_run(parser, "directory of the run, or runs")
    add("--jobs", type=whole(1), metavar="N", help="several clouds: so many at a time; above 1 needs mplicits[ray]")
    what = "then learn the colours, if there are any, and write the mesh (.ply, .obj, .stl, .glb)"
    add("--mesh", type=Path, metavar="FILE", help=what)
    add("--no-colors", action="store_true", help="leave the colours out of --mesh")
    what = "show the growing field in the browser, checkpoint by checkpoint"
    add("--watch", action="store_true", help=what)
    add_settings(parser, FitConfig)
    _depth_arguments(parser)


def _depth_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("depth maps (PNG, TIFF, NPY or NPZ, or a folder of them)").add_argument
    what = "camera JSON (ours, or Open3D's), or four numbers in pixels: FX FY CX CY"
    add("--intrinsics", nargs="+", metavar="FILE|NUMBER", help=what)
    add("--fov", type=positive, metavar="DEGREES", help="vertical angle of view, if no more is known")
    add("--color", type=Path, metavar="FILE|DIR", help="the picture, or a folder of one per depth map")
    add("--resize-color", action="store_true", help="scale pictures to the size of the depth maps")
    add("--poses", type=Path, metavar="FILE", help="of several depth maps: Open3D's trajectory.log, or transforms.json")
    what = "numbers per unit (integers: as the camera says, or 1000; else 1)"
    add("--depth-scale", type=positive, metavar="N", help=what)
    add("--inverse-depth", action="store_true", help="the numbers are disparities: z = scale / number")
    add("--max-depth", "--depth-max", type=positive, metavar="Z", help="drop what is further away than this")
    add("--max-points", type=whole(1), metavar="N", help="thin the cloud to as many (200000)")
    what = "radius of smoothing (as the noise asks for; 0: none)"
    add("--smooth-depth", type=whole(0, 16), metavar="PIXELS", help=what)


def _fit(arguments: argparse.Namespace) -> int:
    config = new_settings(arguments, FitConfig)
    if arguments.mesh is None:
        refuse(arguments, ["no_colors"], "is about --mesh FILE; leave it out, or add that")
    if len(arguments.clouds) > 1 or arguments.jobs is not None:
        return _fit_many(arguments, config)
    return _fit_one(arguments, arguments.clouds[0], config)


def _fit_one(arguments: argparse.Namespace, cloud: str, config: FitConfig | None) -> int:
    from ..fit.depth import fit_depth, trim_suggestion
    from ..fit.train import fit
    from ..training.folder import TEXTURE_FILE, check_new_run, is_fitted, read_record
    from ..training.machine import peak_memory
    from .info import describe

    directory, depth = arguments.out, _depth_input(arguments, cloud)
    # A run that was interrupted after its fit goes on there.
    fitted = arguments.resume and arguments.mesh is not None and is_fitted(directory)
    if not fitted:
        check_new_run(directory, resume=arguments.resume, force=arguments.force)
    columns = read_record(directory)["config"].get("columns") if config is None else config.columns
    mesh = _planned(arguments, Path(cloud) if depth is None else depth, columns)
    then = () if mesh is None else ("--mesh", mesh.out, *["--no-colors"] * arguments.no_colors)
    again = f"to continue: {command_line('fit', cloud, '-o', directory, '--resume', *then)}"
    texture, made, said, started = None, None, list[str](), time.monotonic()
    with _watched(arguments), training(again, quiet=arguments.quiet, board=arguments.tensorboard) as report:
        if not fitted and depth is None:
            fit(cloud, config, out=directory, resume=arguments.resume, progress=report)
        elif not fitted and depth is not None:
            fit_depth(depth, config, out=directory, resume=arguments.resume, progress=report, say=print)
        if mesh is not None:
            texture = mesh.texture(refit=not fitted, progress=report)
            if texture is None or texture.record["finished"]:
                with stoppable(f"fit and texture are finished; {again}", at_any_time=True):
                    made = mesh.extract(say=said.append, progress=report)
    tell_budget(read_record(directory))
    print(describe(directory))
    memory = peak_memory()
    if memory is not None:
        print(f"  peak memory  {memory / 2**20:,.0f} MiB")
    # A depth map shows one side of things; what the fit closes behind it is no part of them.
    trim = [] if depth is None else ["--trim-distance", f"{trim_suggestion(directory):.2g}"]
    if mesh is None:
        print("next:", command_line("mesh", directory, "-o", directory / "mesh.ply", *trim))
        return 0
    if texture is not None:
        tell_texture(directory / TEXTURE_FILE, texture, again)
    assert made is not None
    print("\n".join(said), end="\n" * bool(said))
    facts = [f"{len(made.vertices):,} vertices", f"{len(made.faces):,} faces"]
    facts += ["with colours"] * mesh.colored + ([" ".join(trim)] if trim else [])
    print(f"{mesh.out}: {', '.join(facts)}, {time.monotonic() - started:.1f} s in all")
    return 0


def _watched(arguments: argparse.Namespace) -> AbstractContextManager[object]:
    """The run in the browser while it grows, if that is asked for."""
    if not arguments.watch:
        return nullcontext()
    from ..web.watch import Watcher

    return Watcher(arguments.out, resume=arguments.resume, say=lambda line: print(line, file=sys.stderr))


def _planned(arguments: argparse.Namespace, source: Path | DepthInput, columns: str | None) -> FitMesh | None:
    """The mesh that shall follow, checked; None if there is to be none."""
    if arguments.mesh is None:
        return None
    from ..mesh.finish import plan_mesh

    options = {"colors": not arguments.no_colors, "resume": arguments.resume}
    return plan_mesh(arguments.mesh, arguments.out, source, columns=columns, **options)


def _fit_many(arguments: argparse.Namespace, config: FitConfig | None) -> int:
    """A run for each cloud; a failed one leaves the others alone, and exit code 1."""
    refuse(arguments, ["watch", "tensorboard"], "is for one cloud; fit them one by one, without --jobs")
    refuse(arguments, ["mesh"], "is for one cloud; leave it out, and mesh the runs afterwards")
    for cloud in arguments.clouds:
        if _depth_input(arguments, cloud) is not None:
            raise input_error(f"{cloud}: holds depth maps; fit them on their own, without --jobs")
    from ..fit.many import fit_many, format_fits, plan_fits
    from ..training.jobs import check_jobs

    jobs = arguments.jobs or 1
    check_jobs(jobs)
    planned = plan_fits(arguments.clouds, arguments.out, config, resume=arguments.resume, force=arguments.force)
    again = command_line("fit", *arguments.clouds, "-o", arguments.out, "--jobs", jobs, "--resume")
    quiet = arguments.quiet or jobs > 1
    with training(f"to continue: {again}", quiet=quiet, at_any_time=True) as show:
        outcomes = fit_many(
            planned,
            arguments.out,
            jobs=jobs,
            progress=None if show is None else lambda name, step: show(replace(step, stage=f"{name} {step.stage}")),
            report=None if arguments.quiet or jobs == 1 else _tell_outcome,
        )
    print(format_fits(outcomes))
    return int(any(outcome.error is not None for outcome in outcomes))


def _tell_outcome(outcome: FitOutcome) -> None:
    result = "fitted" if outcome.error is None else outcome.error
    print(f"{outcome.item.cloud}: {result}, after {outcome.seconds:.1f} s", file=sys.stderr)


def _depth_input(arguments: argparse.Namespace, cloud: str) -> DepthInput | None:
    """What the arguments say of depth maps; None if CLOUD is a cloud.

    Raises:
        InputError: there are flags of depth maps, but CLOUD is none.
    """
    from ...datasets import DepthSettings, is_depth_file
    from ...datasets.depth.images import DEPTH_SUFFIXES
    from ..fit.depth import DepthInput

    given = [
        name for name in DEPTH_FLAGS if getattr(arguments, name) is not None and getattr(arguments, name) is not False
    ]
    path = Path(cloud)
    if given and not (path.suffix.lower() in DEPTH_SUFFIXES or path.is_dir()):
        flag, known = given[0].replace("_", "-"), ", ".join(DEPTH_SUFFIXES)
        raise input_error(f"{path}: --{flag} is for depth maps ({known}, or a folder of them), not for clouds")
    inside = path.is_dir() and any(is_depth_file(file) for file in path.iterdir())
    if not given and not inside and not (path.suffix and is_depth_file(path)):
        return None
    if arguments.fov is not None and arguments.intrinsics:
        raise input_error("--fov: does not go with --intrinsics; leave out one of them")
    return DepthInput(
        depth=path,
        scale=arguments.depth_scale,
        inverse=arguments.inverse_depth,
        settings=DepthSettings(smoothing=arguments.smooth_depth, **given_flags(arguments, DepthSettings)),
        **given_flags(arguments, DepthInput),
    )


FIT = Command(
    "fit a multiscale SDF to a point cloud or depth maps",
    """  mplicits fit scan.ply -o runs/scan
  mplicits fit scan.ply -o runs/scan --mesh scan_mesh.ply
  mplicits fit scan.ply -o runs/quick --preset fast
  mplicits fit scan.ply -o runs/scan --resume
  mplicits fit bunny.ply spot.ply sword.ply -o runs --jobs 2
  mplicits fit scan.xyz -o runs/mine --normals estimate --time-budget 120 --steps 2000 1000 1000
  mplicits fit depth.png --intrinsics camera.json --color color.png -o runs/room --mesh room.glb
  mplicits fit depth/ --intrinsics camera.json --color color/ --poses trajectory.log -o runs/room""",
    _arguments,
    _fit,
    "Fit a multiscale SDF to a point cloud, or to depth maps. RUN will hold field.safetensors and run.json. Of several "
    "clouds, each gets a run in RUN, named as the cloud.",
)
