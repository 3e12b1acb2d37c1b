"""``mplicits COMMAND …``: the table of all commands, and the short ones: info, doctor, sample, demo.

Commands import torch and the like when they run, never for help or a mistake in the arguments.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ..training.settings import FitConfig, command_line, given_flags, input_error
from .common import Command, Program, add_flags, add_settings, between, check_output, read_settings
from .draw import ANIMATE, RENDER, SLICE, VIEW
from .fit import FIT, describe
from .mesh import BOOLEAN, EVALUATE, MESH, OFFSET
from .official import EXPORT, IMPORT
from .train import EVOLVE, RECONSTRUCT, TEXTURE
from .views import CHECK_CAMERAS, FIND_CAMERAS, FIND_POINTS, SCENE
from .web import WEB

OVERVIEW = """usage: mplicits COMMAND [arguments]

Fit a multiscale neural signed distance field to a point cloud, draw it, mesh it, and measure the result.

commands:
{commands}

examples:
  mplicits sample -o scan.ply                       write the bundled scan of a statue
  mplicits fit scan.ply -o runs/statue              fit it (under two minutes on two cores)
  mplicits render runs/statue -o statue.png --up z  draw it; turntable.mp4 goes around it
  mplicits mesh runs/statue -o statue.ply --resolution 512
  mplicits evaluate statue.ply reference.ply

`mplicits COMMAND --help` says more about each; `mplicits --version` prints the version."""


LENGTHS = {  # faults of a scan that are lengths, and what each is
    "noise": "standard deviation of the ranges, along the rays (0.096)",
    "isotropic_noise": "standard deviation of each coordinate of each point (0)",
    "quantise": "ranges are rounded to multiples of this (0)",
    "misalign": "registration error: how far each scan is shifted along each axis, and turned as well (0)",
}
DEMO_PRESET = "fast"  # with all that the demo does beside the fit, about two minutes on two cores


def _info_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="RUN|FILE", help="a run, a .safetensors file, a mesh or a cloud")


def _info(arguments: argparse.Namespace) -> int:
    print(describe(arguments.path))
    return 0


def _doctor(_arguments: argparse.Namespace) -> int:
    from .doctor import examine, format_findings

    findings = examine()
    print(format_findings(findings))
    return int(any(finding.level == "error" for finding in findings))


def _sample_arguments(parser: argparse.ArgumentParser) -> None:
    add_flags(parser, "--out", help="a .ply file to write")
    add_flags(parser, "--seed", help="of the scanners' noise (0)")
    faults = parser.add_argument_group("faults of the scan; lengths in mm, or with a unit: 0.2mm, 20um")
    for name, about in LENGTHS.items():
        faults.add_argument(f"--{name.replace('_', '-')}", metavar="LENGTH", help=about)
    what = "share of the readings beside a jump in depth that lie in the air between its two sides, from 0 to 1 (0)"
    faults.add_argument("--smear", type=between(0, 1), metavar="SHARE", help=what)
    what = "how many times as dense the points are on one side as on the other (1)"
    faults.add_argument("--uneven", type=between(1, 1e6), metavar="FACTOR", help=what)


def _sample(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (".ply",))
    given = any(getattr(arguments, name) is not None for name in (*LENGTHS, "smear", "uneven"))
    options = _faults(arguments) if given else {}
    from ...datasets import statue_scan, write_cloud_ply
    from ..training.progress import counter_bar

    with counter_bar("scan") as progress:
        cloud = statue_scan(seed=arguments.seed, progress=progress, **options)
    write_cloud_ply(arguments.out, cloud)
    print(f"{arguments.out}: {len(cloud):,} points; fit it with: {command_line('fit', arguments.out, '-o', 'RUN')}")
    return 0


def _faults(arguments: argparse.Namespace) -> dict[str, Any]:
    """The arguments of `statue_scan` for the faults given by flags, in units of the statue."""
    from ...datasets import STATUE_PLACEMENT, ScanFaults
    from ..mesh.solids import length_in

    given: dict[str, float] = {}
    for name in LENGTHS:
        text, flag = getattr(arguments, name), f"--{name.replace('_', '-')}"
        if text is not None:
            length = length_in(text, "mm", flag)
            if length < 0:
                raise input_error(f"{flag} {text}: expected a length ≥ 0")
            given[name.removesuffix("_noise")] = length / STATUE_PLACEMENT.scale
    noise = {"noise": given.pop("noise")} if "noise" in given else {}
    return {**noise, "faults": ScanFaults(**{**given_flags(arguments, ScanFaults), **given})}


def _demo_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cloud", nargs="?", metavar="CLOUD", help="any cloud (default: the bundled statue scan)")
    add_flags(parser, "--out", required=False, default=Path("demo"), metavar="DIR", help="directory (demo)")
    add_flags(parser, "--resolution", default=320, help="of the meshes (320)")
    add_flags(parser, "--up", help="the axis that points up in the picture")
    add_settings(parser, FitConfig, default=DEMO_PRESET)


def _demo(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig, default=DEMO_PRESET)
    from .demo import demo

    return demo(arguments.cloud, arguments.out, config=config, up=arguments.up, resolution=arguments.resolution)


COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "fit": FIT,
        "mesh": MESH,
        "boolean": BOOLEAN,
        "offset": OFFSET,
        "import": IMPORT,
        "export": EXPORT,
        "texture": TEXTURE,
        "reconstruct": RECONSTRUCT,
        "evolve": EVOLVE,
        "animate": ANIMATE,
        "render": RENDER,
        "slice": SLICE,
        "view": VIEW,
        "web": WEB,
        "find-cameras": FIND_CAMERAS,
        "find-points": FIND_POINTS,
        "check-cameras": CHECK_CAMERAS,
        "evaluate": EVALUATE,
        "info": Command(
            "say what a run, a checkpoint, a mesh or a cloud is",
            "  mplicits info runs/scan\n  mplicits info scan.ply",
            _info_arguments,
            _info,
        ),
        "doctor": Command(
            "check this installation and measure this machine", "  mplicits doctor", lambda _parser: None, _doctor
        ),
        "sample": Command(
            "write the bundled scan of a statue",
            "  mplicits sample -o scan.ply\n  mplicits sample -o worse.ply --noise 0.5mm --misalign 1mm --smear 0.3",
            _sample_arguments,
            _sample,
        ),
        "scene": SCENE,
        "demo": Command(
            "fit, mesh and draw the bundled scan, or any cloud",
            "  mplicits demo\n  mplicits demo scan.ply -o demo-scan --up z",
            _demo_arguments,
            _demo,
            "Fit a cloud, write mesh.ply, mesh.glb and picture.png, and say how near the result is.",
        ),
    }
)

MPLICITS = Program("mplicits", COMMANDS, OVERVIEW)
main = MPLICITS.main
"""Run one command of ``mplicits``; see `Program.main`."""
