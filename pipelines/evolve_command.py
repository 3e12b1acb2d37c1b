"""``mplicits evolve``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from .command import Command
from .run.config import add_config_flags, given_flags, input_error, load_config, preset_names
from .run.settings import EvolveConfig

__all__ = ["COMMAND"]

CONFIG_SUFFIXES = (".yaml", ".yml")


def _arguments(parser: argparse.ArgumentParser) -> None:
    what = "runs or .safetensors files of `mplicits fit`, exact shapes such as sphere:0.4@0.2,0,0, or one YAML file"
    parser.add_argument("inputs", nargs="*", metavar="SHAPE|CONFIG", help=what)
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="RUN", help="directory of the run")
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--resume", action="store_true", help="continue the interrupted run in RUN, with its settings")
    begin.add_argument("--force", action="store_true", help="overwrite the run in RUN")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    source = parser.add_mutually_exclusive_group()
    names = ", ".join(preset_names("evolve"))
    source.add_argument("--preset", metavar="NAME", help=f"one of {names} (default: default)")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(parser, EvolveConfig)


def _evolve(arguments: argparse.Namespace) -> int:
    config = _settings(arguments)
    from .evolve.train import evolve
    from .run.folder import check_new_run
    from .run.progress import progress_bars
    from .run.trainer import Interrupted

    directory = check_new_run(arguments.out, resume=arguments.resume, force=arguments.force)
    try:
        with nullcontext() if arguments.quiet else progress_bars() as report:
            run = evolve(config, out=directory, resume=arguments.resume, progress=report)
    except Interrupted:
        print(f"interrupted; to continue: mplicits evolve -o {directory} --resume", file=sys.stderr)
        return 130
    _tell(run.record)
    print(f"{directory}: field.safetensors, run.json")
    return 0


def _settings(arguments: argparse.Namespace) -> EvolveConfig:
    """What the arguments say; of a resumed run its own settings are read later."""
    flags, preset = given_flags(arguments, EvolveConfig), arguments.config or arguments.preset
    if arguments.resume:
        if flags or preset or arguments.inputs:
            raise input_error("--resume: continues with the run's own shapes and settings; leave out all others")
        return EvolveConfig()
    inputs = arguments.inputs
    if inputs and inputs[0].lower().endswith(CONFIG_SUFFIXES):
        if len(inputs) > 1 or preset:
            raise input_error(f"{inputs[0]}: holds all settings; leave out other inputs, --preset and --config")
        preset, inputs = Path(inputs[0]), []
    if inputs and "shapes" in flags:
        raise input_error("--shapes: the shapes are given already; leave it out")
    if inputs:
        flags["shapes"] = inputs
    config = load_config(EvolveConfig, preset or "default", flags, thing="evolve")
    if not config.shapes:
        raise input_error("no shapes to evolve; give runs of `mplicits fit`, or a CONFIG.yaml with shapes: [...]")
    return config


def _tell(record: dict[str, Any]) -> None:
    """A few lines on what came out."""
    checks = record["checks"]
    steps = sum(stage["steps"] for stage in record["stages"])
    print(f"{record['kind']} of {', '.join(record['shapes'])}: {steps:,} steps in {record['training_seconds']:.0f} s")
    for end in checks["ends"]:
        ratio = "no surface" if end["ratio"] is None else f"Chamfer {end['chamfer']:.2e}, {end['ratio']:.2f} floors"
        print(f"  t = {end['time']:g}, {end['name']}: mean |f| {end['mean_value']:.1e}, {ratio}")
    frames, slopes = checks["frames"], checks["slopes"]
    counts, volumes = ([frame[name] for frame in frames] for name in ("components", "volume"))
    print(f"  {len(frames)} frames: volume {min(volumes):.3g} to {max(volumes):.3g}, components {_runs(counts)}")
    if slopes["mean"] is not None:
        print(f"  |∇f| {slopes['mean']:.3f}, from {slopes['low']:.3f} to {slopes['high']:.3f} at nine of ten points")
    for line in checks["warnings"]:
        print(f"warning: {line}")


def _runs(counts: list[int]) -> str:
    """``2 → 1 → 3``: the numbers, repetitions left out."""
    kept = [count for index, count in enumerate(counts) if index == 0 or count != counts[index - 1]]
    return " → ".join(map(str, kept))


COMMAND = Command(
    "train one surface that moves: morphs, motions, smoothing",
    """  mplicits evolve runs/spot runs/bob -o runs/morph
  mplicits evolve runs/a runs/b runs/c --times 0 0.3 1 --align pca -o runs/morph3
  mplicits evolve runs/spot --kind smooth --alpha 0.01 -o runs/smooth
  mplicits evolve runs/spot --kind transport --angle 3.14 --velocity 0.3 0 0 -o runs/turn
  mplicits evolve scene.yaml -o runs/scene
  mplicits evolve -o runs/morph --resume""",
    _arguments,
    _evolve,
    "Train a field of space and time: a morph between two or more fits, a transport by rigid motions or twists, or "
    "smoothing by mean curvature. RUN will hold field.safetensors and run.json, which says how well the ends are met.",
)
