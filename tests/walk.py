"""What a command walks through: the files of this project in the order entered, and how often it goes up again.

    python tests/walk.py                 # the four walks of docs/architecture.md, at tiny settings
    python tests/walk.py rays photograph

A *stay* is one way into a file: from the file that calls, counted once however often it is taken, and not on the way
back. A *climb* is a stay in a room above the one that calls, such as a trainer that tells a command how far
it is. What runs on import is not counted.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import CodeType, FrameType

import mplicits.neural_fields
import torch
from mplicits.datasets import sample_torus, write_cloud_ply
from mplicits.neural_fields import MultiscaleSDF
from mplicits.pipelines.cli import main as mplicits_command
from test_layout import ROOMS, ROOT, room

HOME = Path(mplicits.neural_fields.__file__).parents[1]
FIT = "--steps 2 2 2 --samples 500 --batch 64 --widths 16 16 16 --depths 1 1 1 --quiet"
RECONSTRUCT = "--steps 4 --rays 16 --uniform 8 --importance 4 --widths 16 16 --depths 1 1 --texture-steps 2 --quiet"


@dataclass(frozen=True)
class Stay:
    """One way into a file; ``caller`` is None where a walk begins. Paths are those of the repository."""

    caller: Path | None
    file: Path

    @property
    def climbs(self) -> bool:
        """Whether the room entered is above the one that it is entered from."""
        return self.caller is not None and _floor(self.file) > _floor(self.caller)


def walk(run: Callable[[], object]) -> list[Stay]:
    """Every stay of a run, in the order of the first time."""
    stays: dict[Stay, None] = {}

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event != "call" or (file := _place(frame.f_code)) is None:
            return
        frames = list(_callers(frame))
        stay = Stay(_place(frames[0].f_code) if frames else None, file)
        if stay.caller == file or stay in stays:
            return
        if all(each.f_code.co_name != "<module>" for each in (frame, *frames)):
            stays[stay] = None

    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        run()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(stays)


def _callers(frame: FrameType) -> Iterator[FrameType]:
    """The frames of this project that a frame was called from, the nearest first."""
    above = frame.f_back
    while above is not None:
        if _place(above.f_code) is not None:
            yield above
        above = above.f_back


@cache
def _place(code: CodeType) -> Path | None:
    """The file of this project that a piece of code is in, as a path of the repository."""
    if code.co_qualname == "uncompiled.<locals>.call":  # a wrapper of methods of other files
        return None
    path = Path(code.co_filename)
    inside = path.relative_to(HOME) if path.is_relative_to(HOME) else Path()
    return ROOT / inside if inside.parts[:1] and inside.parts[0] in ("neural_fields", "datasets", "pipelines") else None


@cache
def _floor(path: Path) -> int:
    return ROOMS.index(top_room(path))


def top_room(path: Path) -> str:
    """The room of a file, the sub-packages of neural_fields counted as one."""
    return "neural_fields" if path.is_relative_to(ROOT / "neural_fields") else room(path)


def report(name: str, stays: list[Stay]) -> str:
    """The files with what they are entered from, and the count of everything."""
    first = {stay.file: stay for stay in reversed(stays)}
    files = list(dict.fromkeys(stay.file for stay in stays))
    climbs = [stay for stay in stays if stay.climbs]
    lines = [f"{name}: {len({top_room(file) for file in files})} rooms, {len(files)} files, {len(stays)} stays, "]
    lines[0] += f"{len(climbs)} climbs"
    lines += [f"  {_said(file)}  from {_said(first[file].caller)}" for file in files]
    return "\n".join([*lines, *(f"  climb: {_said(stay.caller)} → {_said(stay.file)}" for stay in climbs)])


def _said(path: Path | None) -> str:
    return "outside" if path is None else path.relative_to(ROOT).as_posix()


def _command(line: str) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        if code := mplicits_command(line.split()):
            raise SystemExit(code)


def _cloud() -> list[Stay]:
    write_cloud_ply("scan.ply", sample_torus(400))
    return walk(
        lambda: (_command(f"fit scan.ply -o cloud {FIT}"), _command("mesh cloud -o scan_mesh.ply --resolution 16"))
    )


def _rays() -> list[Stay]:
    write_cloud_ply("scan.ply", sample_torus(400))
    _command(f"fit scan.ply -o rays {FIT}")
    return walk(lambda: _command("render rays -o scan.png --size 32"))


def _photograph() -> list[Stay]:
    _command("scene painted-sphere -o photos --views 4 --size 16")
    return walk(lambda: _command(f"reconstruct photos -o statue {RECONSTRUCT}"))


def _jet() -> list[Stay]:
    sdf = MultiscaleSDF.from_widths([(8, 1), (8, 1), (8, 1)], omegas=[10, 20, 30], deltas=[1.0, 1.0])
    return walk(lambda: sdf.jet(torch.zeros(5, 3)))


WALKS = {"cloud": _cloud, "rays": _rays, "photograph": _photograph, "jet": _jet}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walks", nargs="*", metavar="WALK", default=list(WALKS), help=", ".join(WALKS))
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for chosen in parser.parse_args().walks:
            print(report(chosen, WALKS[chosen]()))
