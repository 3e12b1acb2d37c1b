"""Every command that a reader may copy runs: in the order of its page, in an empty folder, at the smallest setting.

Files that a line reads are made by `STAND_INS`; `SMALLEST` adds flags to a line, `SMALLER` replaces values of flags.
"""

import dataclasses
import functools
import json
import re
import shlex
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from evolutions import few_points
from mplicits import datasets
from mplicits.datasets import PointCloud, sample_torus, simulate_scan, write_cloud_ply
from mplicits.datasets.synthetic.scenes import scene_mesh
from mplicits.neural_fields import Similarity, Sphere, Torus, extract_mesh
from mplicits.pipelines.cli import main
from mplicits.pipelines.fit.official import export_official
from mplicits.pipelines.mesh import finish
from mplicits.pipelines.mesh.extract import MeshOptions
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.render import draw
from mplicits.pipelines.texture import transport
from mplicits.pipelines.training.settings import TextureConfig
from mplicits.pipelines.web import export
from reconstructions import small_reconstructions

from benchmarks.cli.entry import BENCHMARKS

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FIT = (
    "--widths 16 16 16 --depths 1 1 1 --omegas 5 10 20 --steps 60 5 5 --learning-rates 1e-2 1e-3 1e-3"
    " --batch 128 --samples 500"
)
EVOLVE = (
    "--widths 16 16 --depths 1 1 --omegas 5 10 --steps 20 10 --learning-rates 5e-3 1e-3 --data-weights 100 300"
    " --start-steps 60 --batch 128 --samples 500 --frames 2 --resolution 16 --least-delta 0.1 --motion-steps 3"
)
FEW = "{widths: [16], depths: [1], omegas: [5], steps: [20], learning_rates: [1.0e-2], batch: 128, samples: 500}"
RECONSTRUCT = (
    "--widths 16 16 --depths 1 1 --color-width 16 --color-depth 1 --color-grid 8 --steps 3 --rays 16 --uniform 8"
    " --importance 4 --texture-steps 2 --width 16 --march-grid 12"
)
TEXTURE = "--width 16 --depth 1 --steps 5 --batch 64 --band-batch 64 --samples 500"
SMALLEST = {  # by what a line begins with, or holds
    "mplicits fit *": f"{FIT} --quiet",
    "mplicits texture *": f"{TEXTURE} --quiet",
    "mplicits evolve *": f"{EVOLVE} --quiet",
    "mplicits evolve *.ply *": "--fits few.yaml",
    "mplicits reconstruct *": f"{RECONSTRUCT} --quiet",
    "mplicits mesh *": "--resolution 24",
    "mplicits render *": "--size 24 --samples 1",
    "mplicits render * -o around.mp4*": "--frames 3",
    "mplicits slice *": "--size 64",
    "mplicits animate *": "--frames 3",
    "mplicits animate *.mp4*": "--size 24 --samples 1",
    "mplicits animate *.png*": "--size 24 --samples 1",
    "mplicits evaluate *": "--samples 500",
    "mplicits boolean *": "--resolution 24",
    "mplicits offset *": "--resolution 24",
    "mplicits offset * --shell *": "--by -0.25",  # more than two of these cells
    "mplicits scene *": "--views 3 --size 16 --samples 1",
    "mplicits scene * -o photos *": "--views 12",  # two of them see the same place
    "python -m benchmarks reconstruct *": f"{RECONSTRUCT} --views 4 --size 16 --test-every 2 --test-views 1"
    " --no-equal-time --resolution 16 --eval-samples 500",
    "python -m benchmarks reconstruct * --geometry-only *": "--rates 1e-3 --seeds 2 --geometries neus",
    "python -m benchmarks paper *": "--preset smoke --table comparison --methods ours --jobs 1",
    "python -m benchmarks srb *": f"{FIT} --resolution 16 --eval-samples 500",
}
SMALLER = {"--frames": "2", "--texture": "64", "--jobs": "1"}
# Flags that name what a command writes.
WRITTEN = ("-o", "--out", "--mesh", "--json", "--page")


def shell_lines(page: Path) -> list[str]:
    blocks = re.findall(r"^```sh\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = (line.partition("  #")[0].strip() for block in blocks for line in block.splitlines())
    return [line for line in lines if line]


def smallest(line: str) -> list[str]:
    words = shlex.split(line.removeprefix("python -m "))
    small = [SMALLER.get(before, word) for before, word in zip(["", *words[:-1]], words, strict=True)]
    return [*small[1:], *(flag for begin, flags in SMALLEST.items() if fnmatch(line, begin) for flag in flags.split())]


def read_by(line: str) -> list[str]:
    """The words of a line that may be files or folders that it reads."""
    words = shlex.split(line)
    return [word.rstrip("/") for before, word in pairwise(words) if before not in WRITTEN and not word.startswith("-")]


def a_cloud(path: Path) -> None:
    cloud = sample_torus(400)
    write_cloud_ply(path, PointCloud(cloud.points, cloud.normals, np.abs(cloud.points).astype(np.float32)))


def arrays(path: Path) -> None:
    cloud = sample_torus(400)
    np.savez(path, points=cloud.points, normals=cloud.normals)


def a_mesh(path: Path) -> None:
    write_mesh(path, extract_mesh(Torus(major=0.5, minor=0.2), resolution=24), Similarity.identity())


def views(path: Path, *, form: str = "transforms", count: int = 4) -> None:
    small = ("--views", count, "--size", 16, "--samples", 1, "--depths")
    quietly("scene", "painted-sphere", "-o", path, "--format", form, *small)


def cameras(path: Path) -> None:
    views(path.parent / "viewed", count=14)  # docs/pictures.md uses number 12
    shutil.copy(path.parent / "viewed" / path.name, path)


def scans_with_truth(path: Path) -> None:
    cloud = sample_torus(400)
    for folder in ("scans", "ground_truth"):
        (path / folder).mkdir(parents=True)
        np.save(path / folder / "anchor.npy", np.concatenate((cloud.points, cloud.normals), axis=1))


def a_run(path: Path) -> None:
    a_cloud(path.parent / "fitted.ply")
    quietly("fit", path.parent / "fitted.ply", "-o", path, *FIT.split(), "--quiet")
    quietly("texture", path, path.parent / "fitted.ply", *TEXTURE.split(), "--quiet")


def a_motion(path: Path) -> None:
    """A ball that moves a little, so that its mesh can be followed."""
    how = ("--kind", "transport", "--velocity", 0.1, 0, 0, *EVOLVE.split(), "--start-steps", 200, "--steps", 100, 10)
    quietly("evolve", "sphere:0.5", "-o", path, *how, "--quiet")


def depth_maps(path: Path) -> None:
    """Two looks at a ball of radius 1, three units away, from its two sides: depths, pictures, camera and poses."""
    focal, (height, width) = 60.0, (36, 48)
    across, down = np.meshgrid(np.arange(width) - 23.5, np.arange(height) - 17.5)
    slope = (across**2 + down**2) / focal**2 + 1  # |(x, y, 1)|² of the ray with z = 1
    inside = 9 - slope * 8  # of z² slope - 6 z + 8 = 0
    depth = np.where(inside > 0, (3 - np.sqrt(inside.clip(0))) / slope, 0)
    steps, picture = np.rint(depth * 1000).astype(np.uint16), np.full((height, width, 3), (40, 100, 200), np.uint8)
    lens = {"width": width, "height": height, "fx": focal, "fy": focal, "cx": 23.5, "cy": 17.5, "depth_scale": 1000}
    turned = np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 6], [0, 0, 0, 1]])
    lines = []
    for index, pose in enumerate((np.eye(4), turned)):
        for kind, image in (("depth", steps), ("color", picture)):
            (path.parent / kind).mkdir(exist_ok=True)
            cv2.imwrite(str(path.parent / kind / f"{index}.png"), image)
            cv2.imwrite(str(path.parent / f"{kind}.png"), image)
        lines += [f"{index} {index} {index + 1}", *(" ".join(map(repr, map(float, row))) for row in pose)]
    (path.parent / "trajectory.log").write_text("\n".join(lines))
    (path.parent / "camera.json").write_text(json.dumps(lens))


def an_official_model(path: Path) -> None:
    a_run(path.parent / "made")
    export_official(path.parent / "made", path)


def a_siren(path: Path) -> None:
    torch.save(torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Linear(8, 1)).state_dict(), path)


STAND_INS: dict[str, Callable[[Path], None]] = {
    **dict.fromkeys(("*scan.ply", "scans/*.ply", "ten_million.ply", "survey.ply"), a_cloud),
    "*.ply": a_mesh,
    "*.npz": arrays,
    "results/*": an_official_model,
    "*.pth": a_siren,
    "meshes": lambda path: a_mesh(path / "torus.ply"),
    **dict.fromkeys(("runs/morph", "runs/turn"), a_motion),
    **dict.fromkeys(("runs/*", "demo/run"), a_run),
    "photos": functools.partial(views, count=12),  # three of which are apart by so much that no two share a place
    "srb": scans_with_truth,
    "lego": views,
    "project": functools.partial(views, form="colmap", count=6),
    "dtu_*": functools.partial(views, form="neus"),
    "transforms.json": cameras,
    "photos/transforms.json": lambda path: views(path.parent),
    **dict.fromkeys(("depth.png", "color.png", "depth", "color", "camera.json", "trajectory.log"), depth_maps),
}


def quietly(*words: object) -> None:
    assert main([str(word) for word in words]) == 0


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], None]:
    """Make what a line reads under a name, unless it is there; what takes a training is made once and copied."""
    store = tmp_path_factory.mktemp("store")

    def put(name: str) -> None:
        path = Path(name)
        make = next((make for pattern, make in STAND_INS.items() if fnmatch(name, pattern)), None)
        if make is None or path.exists():
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        if make not in (a_run, a_motion):
            make(path)
            return
        kept = store / make.__name__
        if not kept.exists():
            make(kept)
        shutil.copytree(kept, path)

    return put


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """What has no flag: the bundled scan, checks, texture and mesh of ``fit --mesh``; and Ctrl-C ends ``view``."""
    few_points(monkeypatch)
    small_reconstructions(monkeypatch)
    scan = functools.partial(simulate_scan, Sphere(radius=0.7), scanners=3, resolution=24, colors=np.abs)
    monkeypatch.setattr(datasets, "statue_scan", scan)
    monkeypatch.setitem(scene_mesh.__kwdefaults__, "resolution", 48)
    # A motion of thirty steps starts anywhere.
    monkeypatch.setattr(transport, "TRANSPORT", dataclasses.replace(transport.TRANSPORT, astray=1.0))
    for module in (draw, export):
        monkeypatch.setattr(module, "FRAME_RESOLUTION", 24)
    texture = TextureConfig(width=16, depth=1, steps=5, batch=64, band_batch=64, samples=500)
    monkeypatch.setattr(finish, "TextureConfig", lambda: texture)
    monkeypatch.setattr(finish, "MeshOptions", functools.partial(MeshOptions, resolution=24))
    wait = threading.Event.wait

    def leave(self: threading.Event, timeout: float | None = None) -> bool:
        if threading.current_thread() is threading.main_thread() and timeout == 3600:
            raise KeyboardInterrupt
        return wait(self, timeout)

    monkeypatch.setattr(threading.Event, "wait", leave)


def reason_to_skip(line: str) -> str | None:
    words = shlex.split(line)
    elsewhere = {  # run by tests of their own, where there is what they need
        "pip": "installs from the network",
        **dict.fromkeys(("ns-train", "ns-mplicits-export"), "tests/pipelines/nerfstudio runs it"),
        "python -m benchmarks.hosts.run": "needs a clone of the host",
    }
    for begin, reason in elsewhere.items():
        if line.startswith(f"{begin} "):
            return reason
    if line.startswith(("mplicits find-cameras ", "mplicits find-points ")) or "--poses colmap" in line:
        return "COLMAP finds nothing in pictures so small; test_find_cameras.py has larger ones"
    for word, module in {"poisson": "pymeshlab", "--texture": "xatlas"}.items():
        if word in words and find_spec(module) is None:
            return f"{module} is not installed"
    return None


def files_of(page: Path) -> Iterator[tuple[str, str]]:
    """(name, content) of the files that a page shows: blocks that begin with their name in a comment."""
    for block in re.findall(r"^```yaml\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        if named := re.match(r"# ([\w.]+)", block):
            yield named[1], block


def is_bench(line: str) -> bool:
    """Whether a line measures something: for developers, and each bench has a test of its own."""
    return line.startswith(f"{BENCHMARKS.name} ")


LONG = ("motion",)  # the page whose lines train the most

LINES = [
    pytest.param(
        page, benches, id=page.stem + "-bench" * benches, marks=[pytest.mark.slow] * (benches or page.stem in LONG)
    )
    for page in PAGES
    for benches in (False, True)
    if any(is_bench(line) is benches for line in shell_lines(page))
]


@pytest.mark.parametrize(("page", "benches"), LINES)
def test_commands_of_a_page_run(page, benches, stand_in, subtests, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("few.yaml").write_text(FEW, encoding="utf-8")
    for name, content in files_of(page):
        Path(name).write_text(content, encoding="utf-8")
    for line in (line for line in shell_lines(page) if is_bench(line) is benches):
        with subtests.test(msg=line):
            if reason := reason_to_skip(line):
                pytest.skip(reason)
            if line.startswith("make "):  # what it would do; the commands themselves are run by other tests
                subprocess.run([*shlex.split(line), "-n"], cwd=ROOT, check=True, capture_output=True)
                continue
            for name in read_by(line):
                stand_in(name)
            capsys.readouterr()
            code = (BENCHMARKS.main if benches else main)(smallest(line))
            assert code == 0, capsys.readouterr().err


def test_no_command_hides_in_a_block_of_another_kind() -> None:
    blocks = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
    for page in PAGES:
        for language, block in blocks.findall(page.read_text(encoding="utf-8")):
            command = re.search(r"^(mplicits|python -m benchmarks) ", block, re.MULTILINE)
            assert language == "sh" or not command, f"{page.name}: call this block sh:\n{block}"
