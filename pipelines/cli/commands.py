"""The commands: their arguments, and the few lines each one runs.

Whatever a command needs is imported when it runs; this module itself stays light, because
``mplicits --help`` imports it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from .bench import BENCH_COMMANDS
from .command import Command, add_fit_settings, add_json, check_output, fit_settings, positive, were_given, whole
from .draw import ANIMATE, RENDER, SLICE, VIEW
from .fit import COMMAND as FIT
from .train import EVOLVE, RECONSTRUCT, TEXTURE
from .views import CHECK_CAMERAS, SCENE

__all__ = ["COMMANDS", "Command"]

MESH_FILES = (".ply", ".obj", ".stl", ".glb")
SAMPLES = ("statue",)


def _mesh_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="FILE", help=", ".join(MESH_FILES))
    parser.add_argument("--resolution", type=whole(8, 2048), default=256, metavar="N", help="cells per side (256)")
    parser.add_argument("--time", type=float, metavar="T", help="the moment from 0 to 1, of a run that moves")
    parser.add_argument("--level", type=whole(0), metavar="L", help="0 is the coarsest (default: the finest)")
    parser.add_argument(
        "--normal-level", type=whole(0), metavar="L", help="normals of this level on the mesh (default: of its own)"
    )
    parser.add_argument("--no-colors", action="store_true", help="leave out the colours of the run's texture")
    parser.add_argument(
        "--texture",
        type=whole(16, 16384),
        metavar="N",
        help="unwrap, and bake colours and fine normals into N × N images (.glb, .obj; needs mplicits[texture])",
    )
    parser.add_argument(
        "--texture-faces", type=whole(4), default=50_000, metavar="N", help="triangles to keep with --texture (50000)"
    )
    parser.add_argument(
        "--keep-unsupported", action="store_true", help="keep components that no input points support, too"
    )
    parser.add_argument("--keep-largest", action="store_true", help="keep only the component of largest area")
    parser.add_argument(
        "--trim-distance",
        type=positive,
        metavar="D",
        help="drop faces further than D (input units) from the points: holes stay holes",
    )
    parser.add_argument("--cloud", metavar="FILE", help="the points for --trim-distance (default: those of the fit)")


def _mesh(arguments: argparse.Namespace) -> int:
    from ..mesh.extract import MeshOptions, mesh_run

    started = time.monotonic()
    options = MeshOptions(
        resolution=arguments.resolution,
        time=arguments.time,
        level=arguments.level,
        normal_level=arguments.normal_level,
        colors=not arguments.no_colors,
        texture=arguments.texture,
        texture_faces=arguments.texture_faces,
        keep_unsupported=arguments.keep_unsupported,
        keep_largest=arguments.keep_largest,
        trim_distance=arguments.trim_distance,
        cloud=arguments.cloud,
    )
    mesh = mesh_run(arguments.run, arguments.out, options, say=print)
    seconds = time.monotonic() - started
    print(f"{arguments.out}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces, in {seconds:.1f} s")
    return 0


def _evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mesh", metavar="MESH", help="the mesh to judge")
    parser.add_argument("reference", metavar="REFERENCE", help="the true mesh, or a point cloud")
    parser.add_argument("--samples", type=whole(1), default=500_000, metavar="N", help="on each surface (500000)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of the samples (0)")
    add_json(parser)


def _evaluate(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    from ..surface.measure import evaluate_files, format_metrics, write_metrics

    metrics = evaluate_files(arguments.mesh, arguments.reference, samples=arguments.samples, seed=arguments.seed)
    print(format_metrics(metrics))
    if arguments.json:
        write_metrics(arguments.json, metrics)
    return 0


def _info_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="RUN|FILE", help="a run, a .safetensors file, a mesh or a cloud")


def _info(arguments: argparse.Namespace) -> int:
    from .info import describe

    print(describe(arguments.path))
    return 0


def _doctor(_arguments: argparse.Namespace) -> int:
    from .doctor import examine, format_findings

    findings = examine()
    print(format_findings(findings))
    return int(any(finding.level == "error" for finding in findings))


def _sample_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", nargs="?", choices=SAMPLES, default=SAMPLES[0], help="which one (default: statue)")
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="FILE", help="a .ply file to write")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of the scanners' noise (0)")


def _sample(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (".ply",))
    from ...datasets import statue_scan, write_cloud_ply

    cloud = statue_scan(seed=arguments.seed)
    write_cloud_ply(arguments.out, cloud)
    print(f"{arguments.out}: {len(cloud):,} points; fit it with: mplicits fit {arguments.out} -o RUN")
    return 0


def _demo_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cloud", nargs="?", metavar="CLOUD", help="any cloud (default: the bundled statue scan)")
    parser.add_argument("-o", "--out", type=Path, default=Path("demo"), metavar="DIR", help="directory (demo)")
    parser.add_argument("--resolution", type=whole(8, 2048), default=320, metavar="N", help="of the meshes (320)")
    parser.add_argument("--up", choices=("y", "z"), help="the axis that points up in the picture")
    add_fit_settings(parser)


def _demo(arguments: argparse.Namespace) -> int:
    config = fit_settings(arguments) if were_given(arguments) else None
    from .demo import demo

    return demo(arguments.cloud, arguments.out, config=config, up=arguments.up, resolution=arguments.resolution)


COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "fit": FIT,
        "mesh": Command(
            "extract a mesh from a fit",
            """  mplicits mesh runs/scan -o scan.ply --resolution 512
  mplicits mesh runs/scan -o coarse.obj --level 0
  mplicits mesh runs/scan -o scan.glb --keep-largest --trim-distance 0.01""",
            _mesh_arguments,
            _mesh,
            "Extract a mesh from a fit, in the coordinates of its input.",
        ),
        "texture": TEXTURE,
        "reconstruct": RECONSTRUCT,
        "evolve": EVOLVE,
        "animate": ANIMATE,
        "render": RENDER,
        "slice": SLICE,
        "view": VIEW,
        "check-cameras": CHECK_CAMERAS,
        "evaluate": Command(
            "measure a mesh against a reference",
            """  mplicits evaluate scan.ply truth.ply
  mplicits evaluate scan.ply points.xyz --samples 100000 --json figures.json""",
            _evaluate_arguments,
            _evaluate,
            "Measure a mesh against a mesh or a cloud. Lengths are in units of the reference's bounding sphere.",
        ),
        "info": Command(
            "say what a run, a checkpoint, a mesh or a cloud is",
            "  mplicits info runs/scan\n  mplicits info scan.ply",
            _info_arguments,
            _info,
        ),
        "doctor": Command(
            "check this installation and measure this machine",
            "  mplicits doctor",
            lambda _parser: None,
            _doctor,
        ),
        "sample": Command(
            "write the bundled scan of a statue",
            "  mplicits sample -o scan.ply",
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
        **BENCH_COMMANDS,
    }
)
