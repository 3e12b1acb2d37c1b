"""What a training keeps in its run directory, and what it finds again."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from mplicits.neural_fields import InputError, Similarity, Siren, load_field, save_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.training import folder as runs
from mplicits.pipelines.training.folder import RunFolder
from mplicits.pipelines.training.settings import FitConfig, TextureConfig
from safetensors.torch import save_file

BALL, HERE = Siren(8, 1), Similarity((1.0, 2.0, 3.0), 4.0)
RECORD = {"finished": False, "config": {"width": 8}, "checks": {"ends": []}}


def kept(path: Path) -> RunFolder:
    """A run that was interrupted."""
    folder = RunFolder(path)
    with folder.writing():
        folder.save(BALL, HERE, RECORD, {"network.a": torch.arange(3)}, {"fingerprint": "f", "stages": [1]})
    return folder


def names(path: Path) -> list[str]:
    return sorted(file.name for file in path.iterdir() if file.name != "run.lock")


def test_a_checkpoint_is_a_usable_field_and_what_a_resumed_run_finds(tmp_path: Path) -> None:
    kept(tmp_path / "run")
    assert names(tmp_path / "run") == ["field.safetensors", "resume.safetensors", "run.json"]
    _, similarity, metadata = load_field(tmp_path / "run" / "field.safetensors")
    assert similarity == HERE
    record = runs.read_record(tmp_path / "run")
    short = {"generation": record["generation"], "finished": False, "config": {"width": 8}}
    assert metadata["run"] == short  # figures are in the record alone
    assert set(record.pop("files")) == {"field.safetensors"}
    assert record == short | RECORD
    assert not runs.is_fitted(tmp_path / "run")
    again = RunFolder(tmp_path / "run", resume=True)
    assert again.config(TextureConfig, TextureConfig(width=9)) == TextureConfig(width=8)
    with again.writing():
        tensors, progress = again.restore("f", "other data")
    assert tensors["network.a"].tolist() == [0, 1, 2]
    about = {"config": {"width": 8}, "generation": record["generation"]}
    assert progress == {"fingerprint": "f", "stages": [1], **about}
    with pytest.raises(InputError, match=r"^other data, or leave out --resume and choose a new -o$"):
        again.restore("g", "other data")


def test_a_finished_run_has_nothing_to_resume(tmp_path: Path) -> None:
    folder = kept(tmp_path)
    folder.finish(BALL, HERE, RECORD | {"finished": True})
    assert names(tmp_path) == ["field.safetensors", "run.json"]
    assert runs.is_fitted(tmp_path)
    with pytest.raises(InputError, match="is finished, so there is nothing to resume"):
        runs.check_new_run(tmp_path, resume=True, force=False)
    with pytest.raises(InputError, match="nothing to resume"):
        RunFolder(tmp_path, resume=True).restore("f", "")


def test_an_old_run_stays_until_the_first_checkpoint_of_the_new_one(tmp_path: Path) -> None:
    kept(tmp_path)
    old = runs.read_record(tmp_path)
    others = ("support.safetensors", "texture.safetensors", "texture.resume.safetensors", "held_out.png", "mesh.ply")
    for name in others:
        (tmp_path / name).touch()
    new = RunFolder(tmp_path)
    with new.writing("held_out.png"):
        assert len(names(tmp_path)) == 3 + len(others)
        assert runs.find_field(tmp_path).is_file()
        assert runs.read_record(tmp_path) == old
        new.keep_tensors("support.safetensors", {"points": torch.zeros(2, 3)})
        new.save(BALL, HERE, RECORD, {}, {})
    assert names(tmp_path) == ["field.safetensors", "mesh.ply", "resume.safetensors", "run.json", "support.safetensors"]
    record = runs.read_record(tmp_path)
    assert record["generation"] != old["generation"]
    assert runs.load_state(tmp_path, name="support.safetensors")[1] == {"generation": record["generation"]}


def test_what_came_before_the_first_checkpoint_is_nothing_that_could_be_lost(tmp_path: Path) -> None:
    with RunFolder(tmp_path).writing():
        for name in (".journal.4194305.partial", ".field.4194305.partial.safetensors", "merged_cloud.npz"):
            (tmp_path / name).write_bytes(b"half")  # of a process number that no machine gives
    assert runs.check_new_run(tmp_path, resume=False, force=False) == tmp_path
    with pytest.raises(InputError, match="holds no interrupted run, so there is nothing to resume; leave out --resume"):
        runs.check_new_run(tmp_path, resume=True, force=False)
    with pytest.raises(InputError, match=r"not a run directory .* make one with `mplicits fit"):
        runs.find_field(tmp_path)
    with RunFolder(tmp_path).writing():
        assert names(tmp_path) == ["merged_cloud.npz"]


def test_files_of_two_runs_are_refused(tmp_path: Path) -> None:
    for name in ("a", "b"):
        kept(tmp_path / name)
    shutil.copy(tmp_path / "a" / "resume.safetensors", tmp_path / "b")
    with pytest.raises(InputError, match=r"b: run\.json and resume\.safetensors are of two runs; begin again with --f"):
        RunFolder(tmp_path / "b", resume=True).config(TextureConfig, None)
    save_field(tmp_path / "a" / "field.safetensors", Siren(8, 2))
    with pytest.raises(InputError, match=r"a: field\.safetensors is damaged, or not the one that run\.json"):
        runs.find_field(tmp_path / "a")
    assert runs.find_field(tmp_path / "a" / "field.safetensors").is_file()  # whoever names it may have it


@pytest.mark.parametrize("name", ["field.safetensors", "resume.safetensors"])
def test_inverted_bytes_are_found(tmp_path: Path, name: str) -> None:
    kept(tmp_path)
    content = bytearray((tmp_path / name).read_bytes())
    content[-1] ^= 0x01
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"damaged .*numbers are not those that were written"):
        load_field(tmp_path / name) if name == "field.safetensors" else runs.load_state(tmp_path)


def test_settings_that_were_edited_are_refused_but_for_those_that_may_change(tmp_path: Path) -> None:
    kept(tmp_path)
    record = runs.read_record(tmp_path)
    for name, value in (("device", "cpu"), ("time_budget", 3.0)):
        record["config"][name] = value
    (tmp_path / "run.json").write_text(json.dumps(record))
    config = RunFolder(tmp_path, resume=True).config(TextureConfig, None)
    assert (config.device, config.time_budget, config.width) == ("cpu", 3.0, 8)
    for name, value in (("width", 9), ("seed", 1)):
        changed = record | {"config": record["config"] | {name: value}}
        (tmp_path / "run.json").write_text(json.dumps(changed))
        with pytest.raises(InputError, match=rf"run\.json: says {name} {value}, but the run began with .* put it back"):
            RunFolder(tmp_path, resume=True).config(TextureConfig, None)


def test_runs_of_before_are_read_and_resumed(tmp_path: Path) -> None:
    """What was written without generation, digests and checksums."""
    save_field(tmp_path / "field.safetensors", BALL, similarity=HERE, metadata={"run": RECORD})
    (tmp_path / "run.json").write_text(json.dumps(RECORD))
    progress = json.dumps({"fingerprint": "f"})
    save_file({"a": torch.arange(3)}, tmp_path / "resume.safetensors", metadata={"progress": progress})
    assert load_field(runs.find_field(tmp_path)).similarity == HERE
    folder = RunFolder(tmp_path, resume=True)
    assert folder.config(TextureConfig, None).width == 8
    with folder.writing():
        assert folder.restore("f", "")[0]["a"].tolist() == [0, 1, 2]
        folder.save(BALL, HERE, RECORD, {}, {"fingerprint": "f"})
    assert RunFolder(tmp_path, resume=True).config(TextureConfig, None).width == 8
    assert "generation" in runs.read_record(tmp_path)


def test_a_run_that_came_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    slow = RunFolder(tmp_path)
    kept(tmp_path)
    with pytest.raises(InputError, match="another run was written there meanwhile"), slow.writing():
        pytest.fail("both would have been written")


def test_colours_never_stay_beside_a_new_field(tmp_path: Path) -> None:
    folder = kept(tmp_path)
    runs.write_texture(tmp_path, b"colours", {"finished": True}, finished=True)
    record = runs.read_record(tmp_path)
    assert record["texture"] == {"finished": True}
    folder.finish(BALL, HERE, RECORD | {"finished": True})
    assert names(tmp_path) == ["field.safetensors", "run.json"]


def test_without_a_directory_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = RunFolder(None)
    assert folder.config(FitConfig, None) == FitConfig()
    with folder.writing():
        folder.save(BALL, HERE, RECORD, {}, {})
        folder.finish(BALL, HERE, RECORD)
    assert names(tmp_path) == []
    with pytest.raises(InputError, match="resume: needs the run directory"):
        RunFolder(None, resume=True)


def test_missing_folders_above_a_run_are_made(tmp_path: Path) -> None:
    path = tmp_path / "runs" / "today" / "ball"
    assert runs.check_new_run(path, resume=False, force=False) == path
    assert names(tmp_path) == []  # asking makes nothing
    kept(path)
    assert runs.read_record(path)["config"] == RECORD["config"]
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="file is no folder; choose another place"):
        runs.check_new_run(tmp_path / "file" / "ball", resume=False, force=False)


def test_the_cloud_of_a_run_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its own path when the run is moved, and by the way from the run when both are."""
    scans, field = tmp_path / "a" / "scans", tmp_path / "a" / "runs" / "ball" / "field.safetensors"
    for folder in (scans, field.parent, tmp_path / "elsewhere"):
        folder.mkdir(parents=True)
    (scans / "ball.ply").write_text("points")
    monkeypatch.chdir(scans)
    named = {"run": runs.named_cloud("ball.ply", field.parent)}
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert runs.fitted_cloud(field, named, remedy="") == scans / "ball.ply"
    assert runs.fitted_cloud(tmp_path / "field.safetensors", named, remedy="") == scans / "ball.ply"  # moved alone
    shutil.move(tmp_path / "a", tmp_path / "b")
    moved = tmp_path / "b" / "runs" / "ball" / "field.safetensors"
    assert runs.fitted_cloud(moved, named, remedy="").samefile(tmp_path / "b" / "scans" / "ball.ply")
    with pytest.raises(InputError, match=r"its cloud .*ball\.ply is not to be found; name it$"):
        runs.fitted_cloud(field, named, remedy="name it")


def test_a_cloud_that_is_no_file_keeps_its_name(tmp_path: Path) -> None:
    named = runs.named_cloud("torus", tmp_path)
    assert named == {"cloud": "torus"}
    with pytest.raises(InputError, match="its cloud torus is not to be found"):
        runs.fitted_cloud(tmp_path / "field.safetensors", {"run": named}, remedy="name it")
    with pytest.raises(InputError, match="was not fitted to a cloud; name one"):
        runs.fitted_cloud(tmp_path / "field.safetensors", {"run": {}}, remedy="name one")


@pytest.mark.parametrize("text", ["{", "[]", json.dumps({"finished": True}), json.dumps({"config": 3})])
def test_a_damaged_record_is_an_input_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=r"run\.json: damaged"):
        runs.read_record(tmp_path)


def test_torchrun_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="torchrun: a training runs in one process"):
        runs.check_new_run(tmp_path / "run", resume=False, force=False)


def test_a_lock_lasts_as_long_as_its_block(tmp_path: Path) -> None:
    with runs.locked(tmp_path):
        for again in (
            lambda: runs.check_unlocked(tmp_path),
            lambda: runs.check_new_run(tmp_path, resume=False, force=True),
            lambda: runs.check_new_run(tmp_path, resume=True, force=False),
        ):
            with pytest.raises(InputError, match=r"is being written by another process; [^\n]*$"):
                again()
    runs.check_unlocked(tmp_path)
    assert runs.check_new_run(tmp_path, resume=False, force=False) == tmp_path  # a lock is nothing that could be lost


@pytest.mark.parametrize("command", ["fit CLOUD -o RUN", "fit CLOUD -o RUN --force", "evolve -o RUN --resume"])
def test_a_second_writer_is_told_in_one_line_and_ends_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    cloud, run = tmp_path / "ball.xyz", tmp_path / "run"
    cloud.write_text("0 0 1 0 0 1\n" * 9)
    run.mkdir()
    with runs.locked(run):
        assert main(command.replace("CLOUD", str(cloud)).replace("RUN", str(run)).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{run}: is being written by another process" in line


def test_the_lock_of_a_file_lies_beside_it(tmp_path: Path) -> None:
    with runs.locked(tmp_path / "other.safetensors"), runs.locked(tmp_path):
        assert sorted(path.name for path in tmp_path.iterdir()) == ["other.lock", "run.lock"]


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    program = (
        "import pathlib, sys, time\nfrom mplicits.pipelines.training.folder import locked\n"
        "with locked(pathlib.Path(sys.argv[1])):\n print(1, flush=True)\n time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"1\n"
        with pytest.raises(InputError, match="is being written"):
            runs.check_unlocked(tmp_path)
        process.kill()
        process.wait()
    runs.check_unlocked(tmp_path)


def test_locks_of_older_versions_are_nobodys(tmp_path: Path) -> None:
    runs.lock_file(tmp_path).write_text('{"pid": 1, "host": "elsewhere", "since": "noon"}')
    with runs.locked(tmp_path):
        pass


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match=r"other\.lock: cannot be written"),
        runs.locked(tmp_path / "absent" / "other.ply"),
    ):
        pytest.fail("nothing can be written there")
    assert not (tmp_path / "absent").exists()
