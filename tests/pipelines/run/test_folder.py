"""What a training keeps in its run directory, and what it finds again."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from mplicits.neural_fields import InputError, Similarity, Siren, load_field
from mplicits.pipelines.run.folder import (
    RunFolder,
    check_new_run,
    fitted_cloud,
    is_fitted,
    named_cloud,
    read_record,
)
from mplicits.pipelines.run.settings import FitConfig, TextureConfig

BALL, HERE = Siren(8, 1), Similarity((1.0, 2.0, 3.0), 4.0)
RECORD = {"finished": False, "config": {"width": 8}, "checks": {"ends": []}}


def kept(path: Path) -> RunFolder:
    """A run that was interrupted."""
    folder = RunFolder(path)
    with folder.writing():
        folder.begin(RECORD)
        folder.save(BALL, HERE, RECORD, {"network.a": torch.arange(3)}, {"fingerprint": "f", "stages": [1]})
    return folder


def names(path: Path) -> list[str]:
    return sorted(file.name for file in path.iterdir())


def test_a_checkpoint_is_a_usable_field_and_what_a_resumed_run_finds(tmp_path: Path) -> None:
    kept(tmp_path / "run")
    assert names(tmp_path / "run") == ["field.safetensors", "resume.safetensors", "run.json"]
    _, similarity, metadata = load_field(tmp_path / "run" / "field.safetensors")
    assert similarity == HERE
    assert metadata["run"] == {"finished": False, "config": {"width": 8}}  # figures are in the record alone
    assert read_record(tmp_path / "run") == RECORD
    assert not is_fitted(tmp_path / "run")
    again = RunFolder(tmp_path / "run", resume=True)
    assert again.config(TextureConfig, TextureConfig(width=9)) == TextureConfig(width=8)
    with again.writing():
        tensors, progress = again.restore("f", "other data")
    assert tensors["network.a"].tolist() == [0, 1, 2]
    assert progress == {"fingerprint": "f", "stages": [1]}
    with pytest.raises(InputError, match=r"^other data, or leave out --resume and choose a new -o$"):
        again.restore("g", "other data")


def test_a_finished_run_has_nothing_to_resume(tmp_path: Path) -> None:
    folder = kept(tmp_path)
    folder.finish(BALL, HERE, RECORD | {"finished": True})
    assert names(tmp_path) == ["field.safetensors", "run.json"]
    assert is_fitted(tmp_path)
    with pytest.raises(InputError, match="is finished, so there is nothing to resume"):
        check_new_run(tmp_path, resume=True, force=False)
    with pytest.raises(InputError, match="nothing to resume"):
        RunFolder(tmp_path, resume=True).restore("f", "")


def test_a_new_run_forgets_what_would_be_taken_for_its_own(tmp_path: Path) -> None:
    kept(tmp_path)
    for name in ("texture.safetensors", "texture.resume.safetensors", "held_out.png", "mesh.ply"):
        (tmp_path / name).touch()
    with RunFolder(tmp_path, resume=True).writing("held_out.png"):
        assert len(names(tmp_path)) == 8
    with RunFolder(tmp_path).writing("held_out.png"):
        assert names(tmp_path) == ["field.safetensors", "mesh.ply", "run.json", "run.lock"]


def test_without_a_directory_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = RunFolder(None)
    assert folder.config(FitConfig, None) == FitConfig()
    with folder.writing():
        folder.begin(RECORD)
        folder.save(BALL, HERE, RECORD, {}, {})
        folder.finish(BALL, HERE, RECORD)
    assert names(tmp_path) == []
    with pytest.raises(InputError, match="resume: needs the run directory"):
        RunFolder(None, resume=True)


def test_missing_folders_above_a_run_are_made(tmp_path: Path) -> None:
    path = tmp_path / "runs" / "today" / "ball"
    assert check_new_run(path, resume=False, force=False) == path
    assert names(tmp_path) == []  # asking makes nothing
    kept(path)
    assert read_record(path) == RECORD
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="file is no folder; choose another place"):
        check_new_run(tmp_path / "file" / "ball", resume=False, force=False)


def test_the_cloud_of_a_run_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its own path when the run is moved, and by the way from the run when both are."""
    scans, field = tmp_path / "a" / "scans", tmp_path / "a" / "runs" / "ball" / "field.safetensors"
    for folder in (scans, field.parent, tmp_path / "elsewhere"):
        folder.mkdir(parents=True)
    (scans / "ball.ply").write_text("points")
    monkeypatch.chdir(scans)
    named = {"run": named_cloud("ball.ply", field.parent)}
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert fitted_cloud(field, named, remedy="") == scans / "ball.ply"
    assert fitted_cloud(tmp_path / "field.safetensors", named, remedy="") == scans / "ball.ply"  # moved alone
    shutil.move(tmp_path / "a", tmp_path / "b")
    moved = tmp_path / "b" / "runs" / "ball" / "field.safetensors"
    assert fitted_cloud(moved, named, remedy="").samefile(tmp_path / "b" / "scans" / "ball.ply")
    with pytest.raises(InputError, match=r"its cloud .*ball\.ply is not to be found; name it$"):
        fitted_cloud(field, named, remedy="name it")


def test_a_cloud_that_is_no_file_keeps_its_name(tmp_path: Path) -> None:
    named = named_cloud("torus", tmp_path)
    assert named == {"cloud": "torus"}
    with pytest.raises(InputError, match="its cloud torus is not to be found"):
        fitted_cloud(tmp_path / "field.safetensors", {"run": named}, remedy="name it")
    with pytest.raises(InputError, match="was not fitted to a cloud; name one"):
        fitted_cloud(tmp_path / "field.safetensors", {"run": {}}, remedy="name one")


@pytest.mark.parametrize("text", ["{", "[]", json.dumps({"finished": True}), json.dumps({"config": 3})])
def test_a_damaged_record_is_an_input_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=r"run\.json: damaged"):
        read_record(tmp_path)
