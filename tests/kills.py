"""Trainings killed (SIGKILL) at random moments, and what is in their folders then: `make kills N=200`.

Each case begins a small training, in an empty folder or with ``--force`` over a finished run, kills it, and looks:
there must be nothing, the old run, the new run, or one that is resumed. Whoever does next what `mplicits info` says, or
types the same command again, must come to the same bits as without the kill. Between kill and resume a second kill may
come. Checkpoints are written at every report, so that most kills hit one that is being written.

Prints a table of cases and outcomes; exit code 1 if one of them is none of these.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from mplicits.neural_fields import InputError, load_field, load_texture
from mplicits.pipelines.cli.entry import main as mplicits
from mplicits.pipelines.cli.fit import describe
from mplicits.pipelines.training.folder import RunFolder, find_field, is_fitted, load_state, read_record
from mplicits.pipelines.training.trainer import Trainer
from safetensors.torch import load_file

sys.path.append(str(Path(__file__).parents[1]))  # where benchmarks are; they are not installed
from benchmarks.cli import main as benchmarks

FIT = (
    "--widths 8 8 --depths 1 1 --omegas 5 10 --steps 40 40 --learning-rates 1e-3 1e-3 --batch 64 --samples 400 "
    "--no-between --hold-out 0 --normals file --device cpu --quiet"
)
EVOLVE = (
    "--kind transport --velocity 0.4 0 0 --widths 8 8 --depths 1 1 --omegas 5 10 --steps 40 40 --learning-rates 1e-3 "
    "1e-3 --data-weights 100 300 --start-steps 20 --batch 64 --samples 400 --frames 2 --resolution 16 "
    "--least-delta 0.05 --device cpu --quiet"
)
TEXTURE = "--width 8 --depth 1 --steps 80 --batch 64 --band-batch 32 --samples 400 --device cpu --quiet"
RECONSTRUCT = (
    "--steps 60 --widths 8 8 --depths 1 1 --omegas 5 10 --texture-steps 20 --test-every 4 --width 24 "
    "--features 4 --color-width 8 --color-depth 1 --color-grid 8 --rays 16 --uniform 8 --importance 4 --device cpu "
    "--quiet"
)
COMMANDS = ("fit", "texture", "reconstruct", "evolve", "bench", "tiles")
FRESH = ("bench", "tiles")  # not begun over a finished run


class Case(NamedTuple):
    """A command, whether it begins over a finished run, and the parts of its time after which it is killed."""

    command: str
    force: bool
    moments: tuple[float, ...]


def words(command: str, place: Path, run: Path, *, resume: bool, force: bool) -> list[str]:
    """What is typed."""
    more = " --resume" if resume else " --force" * force
    line = {
        "fit": f"fit {place}/ball.ply -o {run} " + ("" if resume else FIT),
        "texture": f"texture {run} {place}/ball.ply " + ("" if resume else TEXTURE),
        "reconstruct": f"reconstruct {place}/views -o {run} " + ("" if resume else RECONSTRUCT),
        "evolve": f"evolve -o {run} " + ("" if resume else f"sphere:0.4@-0.2,0,0 {EVOLVE}"),
        "tiles": f"fit {place}/ball.ply -o {run} " + ("" if resume else f"{FIT} --tile-size 1.2"),
        "bench": f"bench fit {place}/sphere.ply -o {run} --resolution 16 --eval-samples 500 "
        + FIT.replace("--quiet", ""),
    }[command]
    return [*line.split(), *("" if command == "bench" else more + " --quiet" * resume).split()]


def begun(line: Sequence[str], said: Path) -> int:
    """Fork a process that runs a command → its number."""
    number = os.fork()
    if number:
        return number
    code = 1
    try:
        file = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        code = benchmarks(line[1:]) if line[0] == "bench" else mplicits(line)
    finally:
        os._exit(code)


def ended(number: int, cpu: float = float("inf")) -> int | None:
    """Wait for a process, but kill it after so many seconds of its own work → its exit code; None if it was killed."""
    while True:
        done, status = os.waitpid(number, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if worked(number) >= cpu:
            os.kill(number, signal.SIGKILL)
            os.waitpid(number, 0)
            return None
        time.sleep(0.002)


def worked(number: int) -> float:
    """Seconds that a process has had of the processor, in steps of a hundredth."""
    with contextlib.suppress(OSError):
        times = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        return (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def prepare(place: Path) -> None:
    """What the commands read, and settings that no flag has: small, so that a case takes a second."""
    from mplicits.datasets import PointCloud
    from mplicits.datasets.clouds.readers.ply import write_cloud_ply
    from mplicits.datasets.synthetic.scenes import SCENES, render_scene
    from mplicits.datasets.views.writing import write_neus
    from mplicits.neural_fields import Sphere, extract_mesh
    from mplicits.pipelines.evolve import checks, problem
    from mplicits.pipelines.mesh.files import write_mesh
    from mplicits.pipelines.reconstruct import train as reconstructing

    rows = np.random.default_rng(0).normal(size=(400, 3))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    write_cloud_ply(place / "ball.ply", PointCloud(rows, rows.astype(np.float32), np.abs(rows).astype(np.float32)))
    write_mesh(place / "sphere.ply", extract_mesh(Sphere(radius=0.5), resolution=12))
    write_neus(place / "views", render_scene(SCENES["painted-sphere"](), views=6, size=12, samples=2))
    problem.END_POINTS, problem.REACH_POINTS, checks.END_RESOLUTION = 500, 100, 16
    reconstructing.FINISH = reconstructing.FinishOptions(texture_samples=500, texture_resolution=24)
    assert Trainer.run.__kwdefaults__ is not None
    Trainer.run.__kwdefaults__["save_every"] = 0.05


def result(command: str, run: Path) -> dict[str, torch.Tensor] | None:
    """What a finished command leaves, to the bit; None where it is not finished."""
    if command == "bench":
        fields = sorted(run.glob("runs/*/field.safetensors"))
        cells = [json.loads(file.read_text()) for file in run.glob("cells/*.json")]
        return load_file(fields[0]) if fields and len(cells) == 1 and is_fitted(fields[0].parent) else None
    if command == "texture":
        texture, state = run / "texture.safetensors", run / "texture.resume.safetensors"
        return load_file(texture) if texture.is_file() and not state.is_file() else None
    if not is_fitted(run):
        return None
    tensors = load_file(run / "field.safetensors")
    for tile in run.glob("tiles/*"):
        tensors |= {f"{tile.name}.{name}": part for name, part in load_file(tile / "field.safetensors").items()}
    if command == "reconstruct" and (run / "texture.safetensors").is_file():
        tensors |= {f"texture.{name}": part for name, part in load_file(run / "texture.safetensors").items()}
    return tensors


def is_same(one: dict[str, torch.Tensor] | None, other: dict[str, torch.Tensor] | None) -> bool:
    """To the bit."""
    if one is None or other is None:
        return False
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def check_whole(run: Path) -> None:
    """That what lies in a run directory is of one run, and can be told about."""
    record = read_record(run)
    saved = load_field(find_field(run))
    assert saved.metadata["run"]["generation"] == record["generation"], "field and record are of two runs"
    if (run / "support.safetensors").is_file():
        about = load_state(run, name="support.safetensors")[1]
        assert about["generation"] == record["generation"], "support and record are of two runs"
    if (run / "texture.safetensors").is_file():
        load_texture(run / "texture.safetensors", saved.field)
    if not record["finished"] and (run / "resume.safetensors").is_file():
        assert "--resume" in describe(run), "info does not say what to type"


class Trial:
    """One case after the other.

    Args:
        place: folder for all of it.
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        prepare(place)
        self.olds: dict[str, Path] = {}
        self.wanted: dict[str, dict[str, torch.Tensor]] = {}
        self.takes: dict[str, float] = {}
        for command in COMMANDS:
            run = self.fresh(f"whole-{command}", command)
            number = begun(words(command, place, run, resume=False, force=False), place / "said")
            while True:
                done, status = os.waitpid(number, os.WNOHANG)
                if done:
                    break
                self.takes[command] = worked(number)
                time.sleep(0.002)
            said = (place / "said").read_text()
            assert os.waitstatus_to_exitcode(status) == 0, f"{command}: {said}"
            self.olds[command] = run
            found = result(command, run)
            assert found is not None, f"{command}: {said}"
            self.wanted[command] = found

    def fresh(self, name: str, command: str) -> Path:
        """A directory for a run; of a texture with the fit that it is for."""
        run = self.place / name
        if command == "texture":
            shutil.copytree(self.olds["fit"], run)
        return run

    def case(self, number: int, case: Case) -> str:
        """What became of a case: what was found after the kills, and the end of it."""
        command, run = case.command, self.place / f"case-{number}"
        if case.force and command not in FRESH:
            shutil.copytree(self.olds[command], run)
            self.age(command, run)
        else:
            run = self.fresh(f"case-{number}", command)
        old = result(command, run) if case.force and command not in FRESH else None
        found, resume = [], False
        for moment in (*case.moments, None):
            line = words(command, self.place, run, resume=resume, force=case.force and command not in FRESH)
            cpu = float("inf") if moment is None else moment * self.takes[command]
            code = ended(begun(line, self.place / "said"), cpu)
            if code is not None:
                if code != 0:
                    return f"bad: {' '.join(line)} → {code}: {(self.place / 'said').read_text().strip()[-300:]}"
                found.append("ended")
                break
            found.append(self.look(command, run, old))
            if found[-1] == "new run":  # it came to its end, but did not come to say so
                break
            resume = found[-1] == "resumable"
        with contextlib.suppress(FileNotFoundError):
            if not is_same(result(command, run), self.wanted[command]):
                return f"bad: other bits than without the kill, after {', '.join(found)}"
        left = [str(file) for file in run.rglob("*") if file.name.startswith(".")]
        if left:
            return f"bad: left over {left}"
        shutil.rmtree(run)
        return found[0]

    def age(self, command: str, run: Path) -> None:
        """Make of a finished run an older one of other numbers, which is still whole."""
        if command == "texture":
            return
        saved, record = load_field(run / "field.safetensors"), read_record(run)
        with torch.no_grad():
            next(iter(saved.field.parameters())).mul_(0.5)
        folder = RunFolder(run)
        with folder.writing():
            folder.finish(saved.field, saved.similarity, {**record, "generation": "0ld"})

    def look(self, command: str, run: Path, old: dict[str, torch.Tensor] | None) -> str:
        """What a kill has left."""
        if command == "bench":
            runs = list(run.glob("runs/*")) if run.is_dir() else []
            for each in runs:
                if (each / "run.json").is_file() or (each / ".journal").is_file():
                    check_whole(each)
            return "resumable" if any((each / "resume.safetensors").is_file() for each in runs) else "bench"
        if not run.is_dir():
            return "nothing"
        if command == "tiles" and not is_fitted(run):
            return "resumable" if (run / "tiles.json").is_file() else "nothing"
        try:
            find_field(run)
        except InputError:
            return "nothing"
        check_whole(run)
        state = "texture.resume.safetensors" if command == "texture" else "resume.safetensors"
        if (run / state).is_file():
            return "resumable"
        now = result(command, run)
        if old is not None and is_same(now, old):
            return "old run"
        return "new run" if now is not None else "nothing"


def cases(count: int, seed: int) -> list[Case]:
    """Commands in turn, every other one over an old run; one in five is killed twice."""
    chance = random.Random(seed)
    return [
        Case(
            COMMANDS[number % len(COMMANDS)],
            number // len(COMMANDS) % 2 == 1,
            tuple(chance.random() for _ in range(2 if chance.random() < 0.2 else 1)),
        )
        for number in range(count)
    ]


def main() -> int:
    """Run the cases, and print what became of them."""
    parser = argparse.ArgumentParser(description="Kill trainings, and see what is left.")
    parser.add_argument("--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    counts: Counter[tuple[str, str]] = Counter()
    bad = 0
    with TemporaryDirectory() as place:
        trial = Trial(Path(place))
        for number, case in enumerate(cases(arguments.number, arguments.seed)):
            try:
                outcome = trial.case(number, case)
            except (AssertionError, InputError) as error:
                outcome = f"bad: {error}"
            name = case.command + " --force" * (case.force and case.command not in FRESH)
            if outcome.startswith("bad"):
                bad += 1
                print(f"case {number}, {name}, killed at {case.moments}: {outcome}", flush=True)
                outcome = "bad"
            counts[name, outcome] += 1
    kinds = ("nothing", "old run", "resumable", "new run", "bench", "ended", "bad")
    print("found after the kill".ljust(22), *(kind.rjust(10) for kind in kinds))
    for name in sorted({name for name, _ in counts}):
        print(name.ljust(22), *(f"{counts[name, kind]:10}" for kind in kinds))
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
