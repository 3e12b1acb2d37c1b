"""Posed photographs: ``find-cameras``, ``find-points``, ``check-cameras``, and ``scene`` to try things on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args, get_type_hints

from ..training.settings import ReconstructConfig, command_line, input_error
from .common import Command, add_flags, check_output, picture_size, positive, refuse, training, whole, write_json

if TYPE_CHECKING:
    from ...datasets.views.poses.colmap_process import Found


def _find_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("photos", metavar="PHOTOS", help="a folder of photographs, or a film")
    add_flags(parser, "--out", metavar="PROJECT", help="folder of the COLMAP project; an interrupted one is continued")
    what = "of a film: the sharpest frames of so many stretches (100)"
    parser.add_argument("--frames", type=whole(3, 10_000), default=100, metavar="N", help=what)
    what = "whether all photographs were taken with one lens, or each has its own (auto: one, where sizes are alike)"
    parser.add_argument("--lens", choices=("auto", "one", "each"), default="auto", help=what)
    add_flags(parser, "--json", "--quiet")


def _find_cameras(arguments: argparse.Namespace) -> int:
    from ...datasets.views.poses.find_cameras import find_cameras

    find = partial(find_cameras, frames=arguments.frames, lens=arguments.lens)
    return _find(arguments, arguments.photos, find, command_line("check-cameras", arguments.out, "-o", "cameras.glb"))


def _find(arguments: argparse.Namespace, photos: str, find: Callable[..., Found], following: str) -> int:
    """Find cameras or points and tell of them."""
    from ..reconstruct.check import colmap_report

    with training("the same command continues", quiet=arguments.quiet, at_any_time=True) as report:
        found = find(photos, arguments.out, report=colmap_report(report))
    tell_found(found)
    print("next:", following)
    known = {name: value for name, value in asdict(found).items() if value is not None}
    write_json(arguments.json, known | {"project": str(arguments.out)})
    return 0


def tell_found(found: Found) -> None:
    """Print what was found, and warn on stderr."""
    from ..reconstruct.hull import named

    how = f"{found.points:,} points that {found.photographs} photographs show"
    if found.left_out is not None:
        placed = found.photographs - len(found.left_out)
        how = f"{placed} of {found.photographs} photographs placed by {found.points:,} points that are"
    print(f"{found.project}: {how}{',' * (found.left_out is None)} seen {found.error:.2f} pixels off")
    if found.left_out:
        what = f"not placed: {named(found.left_out)}; too little in them is in others too, or they are blurred"
        print(f"warning: {what}", file=sys.stderr)
    if found.points < 100:
        what = f"{found.points} points are few: cameras may be wrong; see `mplicits check-cameras`"
        print(f"warning: {what}", file=sys.stderr)


FIND_CAMERAS = Command(
    "find the cameras of photographs, or of a film, with COLMAP",
    """  mplicits find-cameras photos -o project
  mplicits find-cameras walk_around.mp4 -o project --frames 150""",
    _find_arguments,
    _find_cameras,
    "Find where photographs were taken, and with which lens, by structure from motion: COLMAP's, through pycolmap "
    "(pip install 'mplicits[poses]'). The project is read by all commands that take posed photographs; `mplicits "
    "reconstruct --poses colmap` does both.",
)


def _points_arguments(parser: argparse.ArgumentParser) -> None:
    what = "photographs with cameras: NeuS's, nerfstudio's, Blender's or COLMAP's folder or file"
    parser.add_argument("data", metavar="DATA", help=what)
    add_flags(parser, "--out", metavar="PROJECT", help="folder of the COLMAP project; an interrupted one is continued")
    add_flags(parser, "--json", "--quiet")


def _find_points(arguments: argparse.Namespace) -> int:
    from ...datasets.views.poses.find_points import find_points

    return _find(arguments, arguments.data, find_points, command_line("reconstruct", arguments.out, "-o", "RUN"))


FIND_POINTS = Command(
    "triangulate sparse points of photographs whose cameras are known, with COLMAP",
    """  mplicits find-points data/dtu_scan24 -o project
  mplicits find-points lego/transforms_train.json -o project --quiet""",
    _points_arguments,
    _find_points,
    "Find points of the surface that several photographs show, with the cameras as they are: COLMAP's, through "
    "pycolmap (pip install 'mplicits[poses]'). The project has the photographs without lens distortion, the cameras "
    "and the points, which `mplicits reconstruct` then holds on to.",
)


def _check_arguments(parser: argparse.ArgumentParser) -> None:
    what = (
        "folder or file: cameras_sphere.npz with image/ and mask/, transforms.json, or COLMAP's sparse/0 with images/"
    )
    parser.add_argument("data", metavar="DATA", help=what)
    add_flags(parser, "--out", required=False, help=".glb or .ply: the cameras, to look at")
    what = "folder with a depth map for each photograph; by default those that the data set names"
    parser.add_argument("--depth-maps", type=Path, metavar="FOLDER", help=what)
    what = "what they hold, as for reconstruct; only metric ones are held against each other (metric)"
    kinds: tuple[str, ...] = get_args(get_type_hints(ReconstructConfig)["depth_kind"])
    parser.add_argument("--depth-kind", choices=kinds, default="metric", metavar="KIND", help=what)
    what = "numbers of the depth maps per unit of the cameras (1000 for integers, else 1)"
    parser.add_argument("--depth-scale", type=positive, metavar="X", help=what)
    what = "go on where fewer than half of the photographs have a camera, and without those that are missing"
    parser.add_argument("--allow-missing", action="store_true", help=what)
    add_flags(parser, "--json")


def _check_cameras(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (".glb", ".ply"))
    from ...datasets.views.formats.shots import DepthSource
    from ..reconstruct.check import check_files

    depths = DepthSource(arguments.depth_maps, arguments.depth_kind, arguments.depth_scale)
    _, check, text = check_files(arguments.data, arguments.out, depths, allow_missing=arguments.allow_missing)
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
  mplicits check-cameras dtu_scan24 -o cameras.ply --json cameras.json
  mplicits check-cameras photos --depth-maps photos/depths""",
    _check_arguments,
    _check_cameras,
    "Print where the cameras of a data set stand and what they see of the region of interest, warn of what is usually "
    "wrong (conventions, regions, masks), and write the cameras as a mesh in world coordinates.",
)


SCENE_NAMES = ("painted-sphere", "striped-torus", "figure", "statue", "corner")
FORMATS = ("neus", "transforms", "colmap")


def _scene_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    what = f"{', '.join(SCENE_NAMES)}; or a mesh, with its texture if an OBJ or glTF file has one"
    add("name", metavar="NAME|MESH", help=what)
    add_flags(parser, "--out", metavar="DIR", help="a folder that is not there yet")
    what = "neus (cameras_sphere.npz), transforms (.json of nerfstudio), or colmap (neus)"
    add("--format", choices=FORMATS, default="neus", metavar="FORMAT", help=what)
    add("--views", type=whole(1, 10_000), default=24, metavar="N", help="how many images (24)")
    add("--size", type=picture_size, default=(64, 64), metavar="N|WxH", help="images of N × N pixels, or of W × H (64)")
    add_flags(parser, "--samples", type=whole(1, 16), default=3, help="rays per pixel and direction (3)")
    add("--shaded", action="store_true", help="light the shape by a fixed lamp, instead of the bare paint")
    add("--glossy", action="store_true", help="let the shape reflect the lamp, in a highlight that moves with the eye")
    what = "write depth maps too, in depths/: what the pixels' centres see, in the units of the cameras"
    add("--depths", action="store_true", help=what)
    add_flags(parser, "--seed", help="of the cameras (0)")
    add("--up", choices=("y", "z"), metavar="{y,z}", help="the axis of a mesh that points up (y)")


def _scene(arguments: argparse.Namespace) -> int:
    from ...datasets.synthetic.scenes import SCENES, render_scene, scene_mesh
    from ...datasets.views.writing import check_new_folder, write_colmap, write_neus, write_transforms
    from ..mesh.files import write_mesh
    from ..render.studio import photograph_mesh, true_mesh
    from ..training.progress import counter_bar

    folder = check_new_folder(arguments.out)
    name, exact = arguments.name, arguments.name in SCENES
    if not exact and not Path(name).exists():
        raise input_error(f"{name}: neither a mesh file nor one of the scenes {', '.join(SCENE_NAMES)}; check the name")
    if exact:
        refuse(arguments, ["up"], f"goes with a mesh; {name} stands as it is, so leave it out")
    given = {flag: getattr(arguments, flag) for flag in ("seed", "samples", "shaded", "glossy", "depths")}
    with counter_bar("render") as progress:
        given |= {"views": arguments.views, "size": arguments.size, "progress": progress}
        if exact:
            scene = SCENES[name]()
            truth, images = scene_mesh(scene), render_scene(scene, **given)
        else:
            truth, images = true_mesh(name), photograph_mesh(name, up=arguments.up or "y", **given)
    writers = {"neus": write_neus, "transforms": write_transforms, "colmap": write_colmap}
    writers[arguments.format](folder, images)
    write_mesh(folder / "surface.ply", truth)
    width, height = arguments.size
    print(f"{folder}: {arguments.views} views of {width} × {height} pixels; the truth is surface.ply")
    print("next:", command_line("check-cameras", folder, "-o", "cameras.glb"))
    return 0


SCENE = Command(
    "write posed images of an exact synthetic scene, or of a mesh",
    """  mplicits scene painted-sphere -o sphere
  mplicits scene figure -o figure --format transforms --views 40 --size 200
  mplicits scene statue -o statue --format colmap --shaded
  mplicits scene corner -o corner --views 49 --size 400x300
  mplicits scene figure -o measured --format transforms --depths
  mplicits scene spot.obj -o spot --format transforms --views 40 --shaded""",
    _scene_arguments,
    _scene,
    "Draw a shape whose surface and colours are known in closed form, or a mesh of your own, from cameras all around "
    "it (of corner, in front), and write images, masks and cameras as a data set, with the true surface beside them. A "
    "mesh without colours is lit clay.",
)
