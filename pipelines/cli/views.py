"""``mplicits check-cameras`` and ``mplicits scene``: posed photographs looked at, and exact ones to try things on."""

from __future__ import annotations

import argparse
import sys

from .common import Command, add_flags, check_output, whole, write_json

__all__ = ["CHECK_CAMERAS", "SCENE"]


def _check_arguments(parser: argparse.ArgumentParser) -> None:
    what = (
        "folder or file: cameras_sphere.npz with image/ and mask/, transforms.json, or COLMAP's sparse/0 with images/"
    )
    parser.add_argument("data", metavar="DATA", help=what)
    add_flags(parser, "--out", required=False, help=".glb or .ply: the cameras, to look at")
    add_flags(parser, "--json")


def _check_cameras(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (".glb", ".ply"))
    from ..reconstruct.check import check_files

    _, check, text = check_files(arguments.data, arguments.out)
    print(text)
    if arguments.out is not None:
        print(f"{arguments.out}: frustums from violet (first) to yellow (last), the region's sphere, the world's axes")
    for warning in check.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    write_json(arguments.json, check.record())
    return 0


CHECK_CAMERAS = Command(
    "look at the cameras of posed photographs, and check them",
    """  mplicits check-cameras photos
  mplicits check-cameras photos/transforms.json -o cameras.glb
  mplicits check-cameras dtu_scan24 -o cameras.ply --json cameras.json""",
    _check_arguments,
    _check_cameras,
    "Print where the cameras of a data set stand and what they see of the region of interest, warn of what is usually "
    "wrong (conventions, regions, masks), and write the cameras as a mesh in world coordinates.",
)


SCENE_NAMES = ("painted-sphere", "striped-torus", "figure", "statue")
FORMATS = ("neus", "transforms", "colmap", "colmap-text")
TRUTH = "surface.ply"


def _scene_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", choices=SCENE_NAMES, help=", ".join(SCENE_NAMES))
    add_flags(parser, "--out", metavar="DIR", help="a folder that is not there yet")
    what = "neus (cameras_sphere.npz), transforms (.json of nerfstudio), colmap or colmap-text (neus)"
    parser.add_argument("--format", choices=FORMATS, default="neus", metavar="FORMAT", help=what)
    parser.add_argument("--views", type=whole(1, 10_000), default=24, metavar="N", help="how many images (24)")
    parser.add_argument("--size", type=whole(8, 4096), default=64, metavar="N", help="images of N × N pixels (64)")
    add_flags(parser, "--samples", type=whole(1, 16), default=3, help="rays per pixel and direction (3)")
    what = "light the shape by a fixed lamp, instead of the bare paint"
    parser.add_argument("--shaded", action="store_true", help=what)
    add_flags(parser, "--seed", help="of the cameras (0)")


def _scene(arguments: argparse.Namespace) -> int:
    from ...datasets.synthetic.scenes import SCENES, render_scene, scene_mesh
    from ...datasets.views.writing import check_new_folder, write_colmap, write_neus, write_transforms
    from ..mesh.files import write_mesh
    from ..run.progress import counter_bar

    folder = check_new_folder(arguments.out)
    scene = SCENES[arguments.name]()
    with counter_bar("render") as progress:
        images = render_scene(
            scene,
            arguments.views,
            arguments.size,
            seed=arguments.seed,
            samples=arguments.samples,
            shaded=arguments.shaded,
            progress=progress,
        )
    if arguments.format == "neus":
        write_neus(folder, images)
    elif arguments.format == "transforms":
        write_transforms(folder, images)
    else:
        write_colmap(folder, images, form="text" if arguments.format == "colmap-text" else "binary")
    write_mesh(folder / TRUTH, scene_mesh(scene))
    print(f"{folder}: {arguments.views} views of {arguments.size} × {arguments.size} pixels; the truth is {TRUTH}")
    print(f"next: mplicits check-cameras {folder} -o cameras.glb")
    return 0


SCENE = Command(
    "write posed images of an exact synthetic scene",
    """  mplicits scene painted-sphere -o sphere
  mplicits scene figure -o figure --format transforms --views 40 --size 200
  mplicits scene statue -o statue --format colmap --shaded""",
    _scene_arguments,
    _scene,
    "Draw a shape whose surface and colours are known in closed form from cameras all around it, and write images, "
    "masks and cameras as a data set, with the true surface beside them.",
)
