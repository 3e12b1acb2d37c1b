"""``mplicits scene``: exact posed images, to try things on."""

from __future__ import annotations

import argparse
from pathlib import Path

from .command import Command, whole
from .run.progress import counter_bar

__all__ = ["COMMAND"]

SCENE_NAMES = ("painted-sphere", "striped-torus", "figure", "statue")
FORMATS = ("neus", "transforms", "colmap", "colmap-text")
TRUTH = "surface.ply"


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", choices=SCENE_NAMES, help=", ".join(SCENE_NAMES))
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="DIR", help="a folder that is not there yet")
    what = "neus (cameras_sphere.npz), transforms (.json of nerfstudio), colmap or colmap-text (neus)"
    parser.add_argument("--format", choices=FORMATS, default="neus", metavar="FORMAT", help=what)
    parser.add_argument("--views", type=whole(1, 10_000), default=24, metavar="N", help="how many images (24)")
    parser.add_argument("--size", type=whole(8, 4096), default=64, metavar="N", help="images of N × N pixels (64)")
    parser.add_argument("--samples", type=whole(1, 16), default=3, metavar="N", help="rays per pixel and direction (3)")
    parser.add_argument(
        "--shaded", action="store_true", help="light the shape by a fixed lamp, instead of the bare paint"
    )
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of the cameras (0)")


def _scene(arguments: argparse.Namespace) -> int:
    from ..datasets.synthetic.scenes import SCENES, render_scene, scene_mesh
    from ..datasets.views.writing import check_new_folder, write_colmap, write_neus, write_transforms
    from .mesh.files import write_mesh

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


COMMAND = Command(
    "write posed images of an exact synthetic scene",
    """  mplicits scene painted-sphere -o sphere
  mplicits scene figure -o figure --format transforms --views 40 --size 200
  mplicits scene statue -o statue --format colmap --shaded""",
    _arguments,
    _scene,
    "Draw a shape whose surface and colours are known in closed form from cameras all around it, and write images, "
    "masks and cameras as a data set, with the true surface beside them.",
)
