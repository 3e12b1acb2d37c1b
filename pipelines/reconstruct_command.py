"""``mplicits reconstruct``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from pathlib import Path

from .command import Command
from .run.config import add_config_flags, given_flags, input_error, load_config, preset_names
from .run.settings import ReconstructConfig

__all__ = ["COMMAND"]

MESH_FILE = "mesh.ply"


def _arguments(parser: argparse.ArgumentParser) -> None:
    what = (
        "directory of NeuS/DTU (cameras_sphere.npz), nerfstudio or Blender (transforms.json), or COLMAP; or that file"
    )
    parser.add_argument("data", metavar="DATA", help=what)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="RUN", help="directory of the run")
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--resume", action="store_true", help="continue the interrupted run in RUN, with its settings")
    begin.add_argument("--force", action="store_true", help="overwrite the run in RUN")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    source = parser.add_mutually_exclusive_group()
    names = ", ".join(preset_names("reconstruct"))
    source.add_argument("--preset", metavar="NAME", help=f"one of {names} (default: default)")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(parser, ReconstructConfig)


def _reconstruct(arguments: argparse.Namespace) -> int:
    flags, preset = given_flags(arguments, ReconstructConfig), arguments.config or arguments.preset
    if arguments.resume and (flags or preset):
        raise input_error("--resume: continues with the run's own settings; leave out --preset, --config and the rest")
    config = (
        None if arguments.resume else load_config(ReconstructConfig, preset or "default", flags, thing="reconstruct")
    )
    from .mesh.extract import mesh_run
    from .reconstruct.train import HELD_OUT_FILE, reconstruct
    from .run.folder import check_new_run
    from .run.progress import progress_bars
    from .run.trainer import Interrupted

    directory = check_new_run(arguments.out, resume=arguments.resume, force=arguments.force)
    try:
        with nullcontext() if arguments.quiet else progress_bars() as report:
            run = reconstruct(arguments.data, config, out=directory, resume=arguments.resume, progress=report)
    except Interrupted:
        print(
            f"interrupted; to continue: mplicits reconstruct {arguments.data} -o {directory} --resume", file=sys.stderr
        )
        return 130
    mesh = mesh_run(directory, directory / MESH_FILE)
    views, held_out = run.record["views"], run.record["held_out"]
    print(
        f"{run.record['data']}: {views['trained']} views, {run.record['steps']:,} steps in "
        f"{run.record['training_seconds']:.0f} s"
    )
    if held_out:
        print(
            f"{views['held_out']} held-out views: PSNR {held_out['psnr']:.2f} dB, SSIM {held_out['ssim']:.3f} "
            f"({directory / HELD_OUT_FILE})"
        )
    print(f"{directory / MESH_FILE}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces")
    print(f"next: mplicits view {directory}")
    return 0


COMMAND = Command(
    "train a surface and its colours on posed photographs",
    """  mplicits reconstruct data/dtu_scan24 -o runs/scan24 --preset fast
  mplicits reconstruct fox/transforms.json -o runs/fox --width 200 --time-budget 1800
  mplicits reconstruct colmap_project -o runs/statue --geometry neus""",
    _arguments,
    _reconstruct,
    "Train a surface and its colours on posed photographs. RUN then holds the field, its texture, a coloured mesh in "
    "world coordinates and pictures of the views that were held out.",
)
