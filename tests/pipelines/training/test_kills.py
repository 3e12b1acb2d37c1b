"""Whatever write, sync or rename is the last: the old run, the new run, or one that is resumed to the same bits."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from evolutions import BRIEF, few_points
from faults import KINDS, Faults, Killed
from mplicits.datasets import PointCloud
from mplicits.neural_fields import InputError, Similarity, Siren, load_field
from mplicits.pipelines.cli.fit import describe
from mplicits.pipelines.evolve.train import evolve
from mplicits.pipelines.fit import fit
from mplicits.pipelines.texture.train import texture_run
from mplicits.pipelines.training.folder import (
    RunFolder,
    check_new_run,
    find_field,
    is_fitted,
    load_state,
    read_record,
    write_texture,
)
from mplicits.pipelines.training.settings import FitConfig, TextureConfig
from mplicits.pipelines.training.trainer import Trainer
from safetensors.numpy import save

HERE = Similarity.identity()
RECORD: dict[str, Any] = {"finished": False, "cloud": "ball.ply", "config": {"width": 8}, "stages": []}


def field(number: int) -> Siren:
    """A field that says which it is."""
    made = Siren(4, 1)
    with torch.no_grad():
        made.output.bias.fill_(number)
    return made


def number_of(run: Path) -> int:
    made = load_field(find_field(run)).field
    assert isinstance(made, Siren)
    return int(made.output.bias)


def write_run(run: Path, first: int, *, resume: bool = False) -> None:
    """Two checkpoints and the end of a run, whose files all say the number of the step."""
    folder = RunFolder(run, resume=resume)
    with folder.writing():
        for step in (first, first + 1):
            folder.keep_tensors("support.safetensors", {"points": torch.full((2, 3), float(step))})
            folder.save(field(step), HERE, RECORD | {"step": step}, {"a": torch.tensor(step)}, {"step": step})
        folder.keep("cloud.ply", f"{first + 2}".encode())
        folder.finish(field(first + 2), HERE, RECORD | {"finished": True, "step": first + 2})
        write_texture(run, b"colours", {"finished": True}, finished=True)


def check_one_run(run: Path) -> int | None:
    """That all files are of one step of one run → that step; None where there is no run."""
    if not (run / "run.json").is_file() and not (run / ".journal").is_file():
        check_new_run(run, resume=False, force=False)  # nothing that could be lost
        return None
    step = number_of(run)
    record = read_record(run)
    assert record["step"] == step
    assert load_field(find_field(run)).metadata["run"]["generation"] == record["generation"]
    support, about = load_state(run, name="support.safetensors")
    assert about["generation"] == record["generation"]
    assert float(support["points"][0, 0]) == min(step, step // 10 * 10 + 1)
    assert is_fitted(run) == record["finished"] == (step % 10 == 2)
    if record["finished"]:
        assert not (run / "resume.safetensors").exists()
        assert (run / "cloud.ply").read_text() == f"{step}"
    else:
        tensors, progress = load_state(run)
        assert int(tensors["a"]) == progress["step"] == step
        assert progress["generation"] == record["generation"]
        assert check_new_run(run, resume=True, force=False) == run
        assert f"unfinished: mplicits fit ball.ply -o {run} --resume" in describe(run)
    if (run / "texture.safetensors").exists():
        assert record["texture"]["finished"]
        assert step % 10 == 2
    return step


def operations(run: Path, first: int) -> int:
    with Faults().injected() as faults:
        write_run(run, first)
    return faults.count


@pytest.fixture(autouse=True)
def _quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is on the disk is read back from memory here, so nobody needs to wait for it."""
    monkeypatch.setattr(os, "fsync", lambda _: None)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)])
def test_every_operation_may_be_the_last(tmp_path: Path, every: int, force: bool, kind: str) -> None:
    """Old is 0 to 2, new 10 to 12: never a mixture, and what a run came to is never lost."""
    whole, seen = tmp_path / "whole", set()
    write_run(whole, 0)
    shutil.copytree(whole, tmp_path / "counted")
    for at in range(0, operations(tmp_path / "counted", 10), every):
        run = tmp_path / f"{at}"
        if force:
            shutil.copytree(whole, run)
        with Faults(at, kind).injected(), pytest.raises((Killed, InputError)) as raised:
            write_run(run, 10)
        if kind == "full":
            assert str(run) in str(raised.value)
            assert "No space left" in str(raised.value)
            assert "\n" not in str(raised.value)
        step = check_one_run(run)
        assert step in ((2, 10, 11, 12) if force else (None, 10, 11, 12))
        seen.add(step)
        write_run(run, 20)  # whoever comes next finds a folder that can be written
        assert check_one_run(run) == 22
        hidden = [file.name for file in run.iterdir() if file.name.startswith(".")]
        assert hidden == []
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


# Trainings, whose steps are all checkpoints


FIT = FitConfig(
    widths=(8, 8),
    depths=(1, 1),
    omegas=(5.0, 10.0),
    steps=(3, 3),
    learning_rates=(1e-3, 1e-3),
    batch=64,
    samples=400,
    between=False,
    hold_out=0.0,
    normals="file",
)
COLOUR = TextureConfig(width=8, depth=1, steps=4, batch=64, band_batch=32, samples=200)


def ball(colors: bool = False) -> PointCloud:
    normals = np.random.default_rng(0).normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(
        normals.copy(),
        normals=normals.astype(np.float32),
        colors=np.abs(normals).astype(np.float32) if colors else None,
        source="ball",
    )


class Training(NamedTuple):
    """A training that can be begun, and resumed; and where what it trains is."""

    begin: Callable[[Path, bool], object]
    result: str
    state: str


def _fit(run: Path, resume: bool) -> None:
    fit(ball(), FIT, out=run, resume=resume)


def _evolve(run: Path, resume: bool) -> None:
    evolve(replace(BRIEF, steps=(2, 2), start_steps=2, batch=32, samples=100, frames=2), out=run, resume=resume)


def _texture(run: Path, resume: bool) -> None:
    if not (run / "field.safetensors").exists():
        shutil.copytree(run.parent / "fitted", run, dirs_exist_ok=True)
    texture_run(run, run.parent / "colours.ply", COLOUR, resume=resume)


TRAININGS = {
    "fit": Training(_fit, "field.safetensors", "resume.safetensors"),
    "evolve": Training(_evolve, "field.safetensors", "resume.safetensors"),
    "texture": Training(_texture, "texture.safetensors", "texture.resume.safetensors"),
}


def bits(file: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    return load_file(file)


@pytest.mark.parametrize("name", ["fit", "texture", pytest.param("evolve", marks=pytest.mark.slow)])
def test_a_training_killed_at_any_operation_ends_with_the_same_bits(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mplicits.datasets.clouds.readers.ply import write_cloud_ply

    few_points(monkeypatch)
    assert Trainer.run.__kwdefaults__ is not None
    monkeypatch.setitem(Trainer.run.__kwdefaults__, "save_every", 0.0)
    training = TRAININGS[name]
    if name == "texture":
        fit(ball(), FIT, out=tmp_path / "fitted")
        write_cloud_ply(tmp_path / "colours.ply", ball(colors=True))
    with Faults().injected() as faults:
        training.begin(tmp_path / "whole", False)
    wanted = bits(tmp_path / "whole" / training.result)
    for at in range(7, faults.count, max(1, faults.count // STOPS[name])):
        run = tmp_path / f"{at}"
        with Faults(at).injected(), pytest.raises(Killed):
            training.begin(run, False)
        find = run / training.state
        is_fitted(run)  # settles
        if find.is_file() or not (run / training.result).is_file():
            training.begin(run, find.is_file())
        found = bits(run / training.result)
        assert found.keys() == wanted.keys()
        assert all(torch.equal(found[key], wanted[key]) for key in wanted), at


STOPS = {"fit": 2, "evolve": 5, "texture": 2}
