"""The commands that train, but for ``fit``: ``mplicits texture``, ``reconstruct`` and ``evolve``."""

from __future__ import annotations

import argparse
import sys
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..training.settings import (
    EvolveConfig,
    FitConfig,
    ReconstructConfig,
    TextureConfig,
    command_line,
    given_flags,
    input_error,
    load_config,
)
from .common import (
    Command,
    Stopped,
    add_begin,
    add_flags,
    add_new_run,
    add_settings,
    check_output,
    new_settings,
    refuse,
    stoppable,
    tell_budget,
    training,
)
from .views import tell_found

if TYPE_CHECKING:
    from ..texture.train import FittedTexture


def _texture_arguments(parser: argparse.ArgumentParser) -> None:
    add_flags(parser, "run", "--level")
    what = "points with colours (PLY, NPZ, LAS, ...), or a mesh with a texture or vertex colours (OBJ, GLB, PLY)"
    parser.add_argument("source", metavar="CLOUD|MESH", help=what)
    add_flags(parser, "--out", required=False, help=".safetensors (default: texture.safetensors beside the field)")
    add_begin(parser, "continue an interrupted training, with its settings", "replace a texture that is there already")
    add_settings(parser, TextureConfig)


def _texture(arguments: argparse.Namespace) -> int:
    if arguments.resume:
        refuse(arguments, ["level"], "--resume continues with its own; leave it out")
    config = new_settings(arguments, TextureConfig)
    check_output(arguments.out, (".safetensors",))
    from ..texture.train import texture_run
    from ..training.folder import TEXTURE_FILE, find_field

    field = find_field(arguments.run)
    target = arguments.out or field.with_name(TEXTURE_FILE)
    if target.exists() and target.samefile(field):
        raise input_error(f"{target}: is the field itself; name another -o")
    _check_state(target, resume=arguments.resume, force=arguments.force)
    with training(quiet=arguments.quiet) as report:
        fitted = texture_run(
            arguments.run,
            arguments.source,
            config,
            out=arguments.out,
            level=arguments.level,
            resume=arguments.resume,
            progress=report,
        )
    where = () if arguments.out is None else ("-o", arguments.out)
    again = command_line("texture", arguments.run, arguments.source, *where, "--resume")
    tell_texture(target, fitted, f"to continue: {again}")
    return 0


def _check_state(target: Path, *, resume: bool, force: bool) -> None:
    """Refuse what would lose a texture or a training, or resume where there is nothing to resume."""
    from ..training.folder import texture_state_file

    state = texture_state_file(target)
    if resume and not state.is_file():
        reason = "is finished" if target.exists() else "was not begun"
        raise input_error(f"{target}: {reason}, so there is nothing to resume; leave out --resume")
    if (target.exists() or state.is_file()) and not (resume or force):
        found = f"{target}: exists;" if target.exists() else f"{state}: an interrupted training;"
        hint = " --resume continues it," if state.is_file() else ""
        raise input_error(f"{found}{hint} --force replaces it, or choose another -o")


def tell_texture(target: Path, fitted: FittedTexture, again: str) -> None:
    """Print what was trained and how many points were left out; raise `Stopped` with ``again`` if it is unfinished."""
    record, config = fitted.record, fitted.record["config"]
    tell_budget(record, "the texture ")
    if record["left_out"]:
        everything = record["points"] + record["left_out"]
        print(
            f"warning: {record['left_out']:,} of {everything:,} points lie outside the band (--delta), left out",
            file=sys.stderr,
        )
    seconds = record["sampling_seconds"] + record["training_seconds"]
    print(
        f"{target}: ({config['width']}, {config['depth']}), {record['parameters']:,} parameters, "
        f"{record['steps']:,} steps in {seconds:.1f} s; {record['psnr_at_points']:.1f} dB at the points"
    )
    if not record["finished"]:
        raise Stopped(f"interrupted; the texture holds what was learnt so far; {again}")


TEXTURE = Command(
    "train the colours of a fit from a coloured cloud or a textured mesh",
    """  mplicits texture runs/scan scan.ply
  mplicits texture runs/spot spot.obj
  mplicits texture runs/spot spot.glb --preset fast --force
  mplicits texture runs/scan scan.ply --resume
  mplicits texture runs/scan scan.ply -o other.safetensors --omega 40 --time-budget 30""",
    _texture_arguments,
    _texture,
    "Train a texture field in the band around the surface of a run. It is written to texture.safetensors in RUN. "
    "The colours must be in the coordinates of the points that were fitted.",
)


def _reconstruct_arguments(parser: argparse.ArgumentParser) -> None:
    what = (
        "directory of NeuS/DTU (cameras_sphere.npz), nerfstudio or Blender (transforms.json), or COLMAP; or that file"
    )
    parser.add_argument("data", metavar="DATA", help=what)
    add_new_run(parser)
    what = (
        "colmap: DATA is a folder of photographs, or a film, whose cameras are found first and written to RUN-cameras "
        "(see find-cameras; needs mplicits[poses])"
    )
    parser.add_argument("--poses", choices=("given", "colmap"), default="given", help=what)
    add_settings(parser, ReconstructConfig)


def _reconstruct(arguments: argparse.Namespace) -> int:
    config = new_settings(arguments, ReconstructConfig)
    from ...datasets.views.poses.find_cameras import find_cameras
    from ..mesh.extract import mesh_run
    from ..reconstruct.check import colmap_report
    from ..reconstruct.train import HELD_OUT_FILE, MESH_FILE, reconstruct
    from ..training.folder import check_new_run
    from ..training.progress import reported

    directory = check_new_run(arguments.out, resume=arguments.resume, force=arguments.force)
    data = arguments.data
    with training(quiet=arguments.quiet, board=arguments.tensorboard) as report:
        if arguments.poses == "colmap":
            data = directory.with_name(f"{directory.name}-cameras")
            with stoppable("the same command continues", at_any_time=True):
                found = find_cameras(arguments.data, data, report=colmap_report(report))
            tell_found(found)
        with stoppable(f"to continue: {command_line('reconstruct', data, '-o', directory, '--resume')}"):
            run = reconstruct(data, config, out=directory, resume=arguments.resume, progress=report)
        with reported(report, "mesh"):
            lines: list[str] = []
            mesh = mesh_run(directory, directory / MESH_FILE, say=lines.append)
    tell_budget(run.record)
    _tell_left_out(run.record)
    if refused := run.record.get("replayed", {}).get("refused"):
        print(f"warning: steps were done one operation at a time, for want of CUDA graphs ({refused})", file=sys.stderr)
    views, held_out = run.record["views"], run.record["held_out"]
    print(
        f"{run.record['data']}: {views['trained']} views, {run.record['steps']:,} steps in "
        f"{run.record['training_seconds']:.0f} s"
    )
    if held_out:
        print(
            f"{len(held_out['views'])} held-out views: PSNR {held_out['psnr']:.2f} dB, SSIM {held_out['ssim']:.3f} "
            f"({directory / HELD_OUT_FILE})"
        )
    print(run.record["reading"])
    print(f"{directory / MESH_FILE}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces")
    print("".join(f"  {line}\n" for line in lines) + f"next: {command_line('view', directory)}")
    return 0


def _tell_left_out(record: dict[str, Any]) -> None:
    """Warn, on stderr, of photographs, and parts of them, that were not trained on."""
    from ..reconstruct.hull import named

    odd, torn = record.get("left_out", []), record.get("mask_holes", {})
    trained = record["views"]["trained"]
    if odd:
        count = f"{len(odd)} of {trained + len(odd)}"
        print(f"warning: {count} silhouettes contradict the others; left out: {named(odd)}", file=sys.stderr)
    if torn:
        what = f"{len(torn)} of {trained} masks have a hole where all others see object"
        print(f"warning: {what}; its pixels are left out: {named([*torn])}", file=sys.stderr)


RECONSTRUCT = Command(
    "train a surface and its colours on posed photographs",
    """  mplicits reconstruct data/dtu_scan24 -o runs/scan24 --preset fast
  mplicits reconstruct fox/transforms.json -o runs/fox --width 200 --time-budget 1800
  mplicits reconstruct colmap_project -o runs/statue --geometry neus
  mplicits reconstruct walk_around.mp4 -o runs/chair --poses colmap""",
    _reconstruct_arguments,
    _reconstruct,
    "Train a surface and its colours on posed photographs. RUN then holds the field, its texture, a coloured mesh in "
    "world coordinates and pictures of the views that were held out.",
)


def _evolve_arguments(parser: argparse.ArgumentParser) -> None:
    what = (
        "runs or .safetensors files of `mplicits fit`, clouds or meshes, which are fitted first, exact shapes such as "
        "sphere:0.4@0.2,0,0, or one YAML file"
    )
    parser.add_argument("inputs", nargs="*", metavar="SHAPE|CONFIG", help=what)
    fits = "settings of the fits of clouds and meshes, a preset of `mplicits fit` or a YAML file (default: fast)"
    parser.add_argument("--fits", metavar="NAME|FILE", default="fast", help=fits)
    add_new_run(parser)
    add_settings(parser, EvolveConfig)


def _evolve(arguments: argparse.Namespace) -> int:
    config, fits = _evolve_settings(arguments), load_config(FitConfig, arguments.fits)
    from ..evolve.scans import fitted_scans, scans_among
    from ..evolve.train import evolve
    from ..training.folder import check_new_run

    directory = check_new_run(arguments.out, resume=arguments.resume, force=arguments.force)
    if scans := {} if arguments.resume else scans_among(config.shapes):
        folder, given = directory.with_name(f"{directory.name}-fits"), config.landmarks
        with training("to continue: the same command", quiet=arguments.quiet) as report:
            config = fitted_scans(config, scans, folder, fits, progress=report)
        print(f"{folder}: the fits of {', '.join(scans)}")
        if config.landmarks != given:
            print("all of them have the same faces: vertices are landmarks (pairs-00.txt and so on, beside the fits)")
    again = f"to continue: {command_line('evolve', '-o', directory, '--resume')}"
    with training(again, quiet=arguments.quiet, board=arguments.tensorboard) as report:
        run = evolve(config, out=directory, resume=arguments.resume, progress=report)
    tell_budget(run.record)
    _tell_evolution(run.record)
    print(f"{directory}: field.safetensors, run.json")
    return 0


def _evolve_settings(arguments: argparse.Namespace) -> EvolveConfig:
    """What the arguments say; of a resumed run its own settings are read later."""
    flags, preset = given_flags(arguments, EvolveConfig), arguments.config or arguments.preset
    if arguments.resume:
        return new_settings(arguments, EvolveConfig, "inputs") or EvolveConfig()
    inputs = arguments.inputs
    if inputs and inputs[0].lower().endswith((".yaml", ".yml")):
        if len(inputs) > 1 or preset:
            raise input_error(f"{inputs[0]}: holds all settings; leave out other inputs, --preset and --config")
        preset, inputs = Path(inputs[0]), []
    if inputs and "shapes" in flags:
        raise input_error("--shapes: the shapes are given already; leave it out")
    if inputs:
        flags["shapes"] = inputs
    config = load_config(EvolveConfig, preset or "default", flags)
    if not config.shapes:
        raise input_error("no shapes to evolve; give runs of `mplicits fit`, or a CONFIG.yaml with shapes: [...]")
    return config


def _tell_evolution(record: dict[str, Any]) -> None:
    """A few lines on what came out."""
    from ..evolve.topology import Topology

    checks = record["checks"]
    steps = sum(stage["steps"] for stage in record["stages"])
    print(f"{record['kind']} of {', '.join(record['shapes'])}: {steps:,} steps in {record['training_seconds']:.0f} s")
    for end in checks["ends"]:
        far = "no surface"
        if end["ratio"] is not None:
            far = f"Chamfer {end['chamfer']:.2e}, {end['ratio']:.2f} times the sampling floor"
        print(f"  t = {end['time']:g}, {end['name']}: mean |f| {end['mean_value']:.1e}, {far}")
    frames, slopes = checks["frames"], checks["slopes"]
    counts, volumes = ([frame[name] for frame in frames] for name in ("components", "volume"))
    runs = " → ".join(str(count) for count, _ in groupby(counts))  # such as 2 → 1 → 3
    print(f"  {len(frames)} frames: volume {min(volumes):.3g} to {max(volumes):.3g}, components {runs}")
    for change in checks["changes"]:
        before, after = (Topology(**change[side]) for side in ("before", "after"))
        print(f"  t = {change['time']:.3f}: {before} → {after}")
    if slopes["mean"] is not None:
        print(f"  |∇f| {slopes['mean']:.3f}, from {slopes['low']:.3f} to {slopes['high']:.3f} at nine of ten points")
    for line in checks["warnings"]:
        print(f"warning: {line}")


EVOLVE = Command(
    "train one surface that moves: morphs, motions, smoothing",
    """  mplicits evolve runs/spot runs/bob -o runs/morph
  mplicits evolve runs/a runs/b runs/c --times 0 0.3 1 --align pca -o runs/morph3
  mplicits evolve runs/spot runs/bob --kind deform -o runs/deform
  mplicits evolve s0.ply s1.ply s2.ply --times 0 0.4 1 --kind deform --align none -o runs/series
  mplicits evolve runs/spot --kind smooth --alpha 0.01 -o runs/smooth
  mplicits evolve runs/spot --kind transport --angle 3.14 --velocity 0.3 0 0 -o runs/turn
  mplicits evolve scene.yaml -o runs/scene
  mplicits evolve -o runs/morph --resume""",
    _evolve_arguments,
    _evolve,
    "Train a field of space and time: a morph or a deformation between two or more fits, a transport by rigid motions "
    "or twists, or smoothing by mean curvature. RUN will hold field.safetensors and run.json, which says how well the "
    "ends are met.",
)
