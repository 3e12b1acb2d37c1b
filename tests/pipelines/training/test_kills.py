"""Whatever write, sync or rename is the last: the old run, the new run, or one that is resumed to the same bits."""

import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from evolutions import BRIEF, few_points
from faults import KINDS, Faults, Killed
from mplicits.datasets import PointCloud, sample_sphere, write_cloud_ply
from mplicits.neural_fields import InputError, Similarity, Siren, load_field
from mplicits.pipelines.cli.fit import describe
from mplicits.pipelines.evolve.train import evolve
from mplicits.pipelines.fit import fit
from mplicits.pipelines.texture.train import texture_run
from mplicits.pipelines.training import folder as runs
from mplicits.pipelines.training.folder import RunFolder
from mplicits.pipelines.training.settings import FitConfig, TextureConfig
from mplicits.pipelines.training.trainer import Trainer
from safetensors.numpy import save
from safetensors.torch import load_file

HERE = Similarity.identity()
RECORD: dict[str, Any] = {"finished": False, "cloud": "ball.ply", "config": {"width": 8}, "stages": []}


def field(number: int) -> Siren:
    """A field whose bias is its number."""
    made = Siren(4, 1)
    with torch.no_grad():
        made.output.bias.fill_(number)
    return made


def write_run(run: Path, first: int) -> None:
    """Two checkpoints and the end of a run, whose files all hold the number of the step."""
    folder = RunFolder(run)
    with folder.writing():
        for step in (first, first + 1):
            folder.keep_tensors("support.safetensors", {"points": torch.full((2, 3), float(step))})
            folder.save(field(step), HERE, RECORD | {"step": step}, {"a": torch.tensor(step)}, {"step": step})
        folder.keep("cloud.ply", f"{first + 2}".encode())
        folder.finish(field(first + 2), HERE, RECORD | {"finished": True, "step": first + 2})
        runs.write_texture(run, b"colours", {"finished": True}, finished=True)


def check_one_run(run: Path) -> int | None:
    """That all files are of one step of one run → that step; None where there is no run."""
    if not (run / "run.json").is_file() and not (run / ".journal").is_file():
        runs.check_new_run(run, resume=False, force=False)  # nothing that could be lost
        return None
    step = int(load_field(runs.find_field(run)).field.output.bias)
    record = runs.read_record(run)
    assert record["step"] == step
    assert load_field(runs.find_field(run)).metadata["run"]["generation"] == record["generation"]
    support, about = runs.load_state(run, name="support.safetensors")
    assert about["generation"] == record["generation"]
    assert float(support["points"][0, 0]) == min(step, step // 10 * 10 + 1)
    assert runs.is_fitted(run) == record["finished"] == (step % 10 == 2)
    if record["finished"]:
        assert not (run / "resume.safetensors").exists()
        assert (run / "cloud.ply").read_text() == f"{step}"
    else:
        tensors, progress = runs.load_state(run)
        assert int(tensors["a"]) == progress["step"] == step
        assert progress["generation"] == record["generation"]
        assert runs.check_new_run(run, resume=True, force=False) == run
        assert f"unfinished: mplicits fit ball.ply -o {run} --resume" in describe(run)
    if (run / "texture.safetensors").exists():
        assert record["texture"]["finished"]
        assert step % 10 == 2
    return step


@pytest.fixture(autouse=True)
def _quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are read back from memory here, so that nothing needs to be on the disk."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)])
def test_every_operation_may_be_the_last(tmp_path: Path, every: int, force: bool, kind: str) -> None:
    """Old is 0 to 2, new 10 to 12: never a mixture, and what a run came to is never lost."""
    whole, seen = tmp_path / "whole", set()
    write_run(whole, 0)
    shutil.copytree(whole, tmp_path / "counted")
    with Faults().injected() as faults:
        write_run(tmp_path / "counted", 10)
    for at in range(0, faults.count, every):
        run = tmp_path / f"{at}"
        if force:
            shutil.copytree(whole, run)
        with Faults(at, kind).injected(), pytest.raises((Killed, InputError)) as raised:
            write_run(run, 10)
        if kind == "full":
            assert re.fullmatch(rf"(?=.*{run}).*No space left.*", str(raised.value))
        step = check_one_run(run)
        assert step in ((2, 10, 11, 12) if force else (None, 10, 11, 12))
        seen.add(step)
        write_run(run, 20)  # whoever comes next finds a folder that can be written
        assert check_one_run(run) == 22
        assert [file.name for file in run.iterdir() if file.name.startswith(".")] == []
    assert seen >= ({2, 10, 11, 12} if force else {None, 10, 11, 12})


@pytest.mark.parametrize("name", ["../mine", "sub/mine"])
def test_a_journal_reaches_nothing_outside(tmp_path: Path, name: str) -> None:
    run = tmp_path / "run"
    write_run(run, 0)
    (tmp_path / "mine").touch()
    for contents, remove in (({name: np.zeros(3, np.uint8)}, []), ({}, [name])):
        (run / ".journal").write_bytes(save(contents, {"remove": json.dumps(remove)}))
        with pytest.raises(InputError, match=r"\.journal: damaged .* outside"):
            write_run(run, 10)
    assert (tmp_path / "mine").read_bytes() == b""


LEVELS = {"widths": (8, 8), "depths": (1, 1), "omegas": (5.0, 10.0), "steps": (3, 3), "learning_rates": (1e-3, 1e-3)}
FIT = FitConfig(**LEVELS, batch=64, samples=400, between=False, hold_out=0.0, normals="file")
COLOUR = TextureConfig(width=8, depth=1, steps=4, batch=64, band_batch=32, samples=200)


def ball(*, colors: bool = False) -> PointCloud:
    cloud = sample_sphere(300, radius=1.0)
    return replace(cloud, colors=np.abs(cloud.normals) if colors else None)


def _fit(run: Path, resume: bool) -> None:
    fit(ball(), FIT, out=run, resume=resume)


def _evolve(run: Path, resume: bool) -> None:
    evolve(replace(BRIEF, steps=(2, 2), start_steps=2, batch=32, samples=100, frames=2), out=run, resume=resume)


def _texture(run: Path, resume: bool) -> None:
    if not (run / "field.safetensors").exists():
        shutil.copytree(run.parent / "fitted", run, dirs_exist_ok=True)
    texture_run(run, run.parent / "colours.ply", COLOUR, resume=resume)


@pytest.mark.parametrize(
    ("begin", "stops"), [(_fit, 2), (_texture, 2), pytest.param(_evolve, 5, marks=pytest.mark.slow)]
)
def test_a_training_killed_at_any_operation_ends_with_the_same_bits(
    begin: Callable[[Path, bool], None], stops: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few_points(monkeypatch)
    monkeypatch.setitem(Trainer.run.__kwdefaults__, "save_every", 0.0)  # every step is a checkpoint
    result, state = "field.safetensors", "resume.safetensors"
    if begin is _texture:
        result, state = "texture.safetensors", "texture.resume.safetensors"
        fit(ball(), FIT, out=tmp_path / "fitted")
        write_cloud_ply(tmp_path / "colours.ply", ball(colors=True))
    with Faults().injected() as faults:
        begin(tmp_path / "whole", False)
    wanted = load_file(tmp_path / "whole" / result)
    for at in range(7, faults.count, max(1, faults.count // stops)):
        run = tmp_path / f"{at}"
        with Faults(at).injected(), pytest.raises(Killed):
            begin(run, False)
        runs.is_fitted(run)  # recovers
        if (run / state).is_file() or not (run / result).is_file():
            begin(run, (run / state).is_file())
        torch.testing.assert_close(load_file(run / result), wanted, rtol=0, atol=0)
