"""``mplicits import`` and ``export``: models of the paper's own code."""

from __future__ import annotations

import argparse
import sys

from ..training.settings import command_line, input_error
from .common import Command, add_flags, positive


def _import_arguments(parser: argparse.ArgumentParser) -> None:
    what = "a folder with coarse/best.pth, medium/best.pth, fine/best.pth; or .pth files, coarse to fine"
    parser.add_argument("paths", nargs="+", metavar="MODEL", help=what)
    add_flags(parser, "--out", metavar="RUN", help="directory of the run")
    what = "the points it was trained on, in its coordinates: band widths by Eq. 5, and blobs left out of meshes"
    parser.add_argument("--cloud", metavar="FILE", help=what)
    what = "half-widths of the bands, one less than levels; the paper's code has 0.1 0.06 where it fixes them"
    parser.add_argument("--deltas", nargs="+", type=positive, metavar="D", help=what)
    what = "the frequency by which its code multiplies outside of the weights; 30 in other SIREN code (1)"
    parser.add_argument("--w0", type=positive, default=1.0, metavar="W", help=what)
    parser.add_argument("--negate", action="store_true", help="change the sign: its distances are positive inside")
    parser.add_argument("--force", action="store_true", help="overwrite the run in RUN")


def _import(arguments: argparse.Namespace) -> int:
    from ..fit.official import import_official
    from ..training.folder import check_new_run

    out = check_new_run(arguments.out, resume=False, force=arguments.force)
    options = {name: getattr(arguments, name) for name in ("w0", "cloud", "deltas", "negate")}
    run = import_official(arguments.paths, out, **options)
    sizes = " ▷ ".join(f"({level.width}, {level.depth})" for level in run.field.levels)
    bands = "".join(f", δ = {delta:.4g}" for delta in run.field.deltas.tolist())
    print(f"{out}: {sizes}, {run.record['parameters']:,} parameters{bands}")
    if run.record["inside_out"]:
        print("warning: distances are negative far away; with --negate they are negative inside", file=sys.stderr)
    print(f"mesh it with: {command_line('mesh', out, '-o', f'{out.name}.ply', '--resolution', 512)}")
    return 0


IMPORT = Command(
    "make a run of a model of the paper's own code, or of another SIREN",
    """  mplicits import results/armadillo -o runs/armadillo --cloud data/normalized_sphere/input/armadillo.ply
  mplicits import results/armadillo -o runs/armadillo --deltas 0.1 0.06
  mplicits import siren.pth -o runs/siren --w0 30""",
    _import_arguments,
    _import,
    "Read the state dicts of a model of dsilvavinicius/m-plicits, or of one plain SIREN, into a run that all commands "
    "take.",
)


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    add_flags(parser, "run")
    add_flags(parser, "--out", metavar="DIR", help="the folder to write")
    what = "official: .pth files of the paper's code, and .bin and .exp of its renderer"
    parser.add_argument("--format", choices=("official",), default="official", help=what)
    add_flags(parser, "--up", default="y")
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty")


def _export(arguments: argparse.Namespace) -> int:
    from ...neural_fields.backend.files import check_place
    from ..fit.official import export_official

    out = arguments.out
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not arguments.force)):
        raise input_error(f"{out}: exists and is no empty folder; --force writes into it, or choose another -o")
    check_place(out)
    experiment, flags = export_official(arguments.run, out, up=arguments.up)
    print(f"{out}: state dicts of the paper's code, and {experiment.name} for its renderer")
    where = f"data/{out.name}/{experiment.name}"
    print(f"with this folder in its data folder: MIP-plicitsRenderer.exe -experiment_file={where} {flags}")
    return 0


EXPORT = Command(
    "write a run for the paper's own code and its renderer",
    "  mplicits export runs/scan --format official -o results/scan",
    _export_arguments,
    _export,
    "Write the levels of a run as the state dicts of dsilvavinicius/m-plicits, and as the files of its renderer.",
)
