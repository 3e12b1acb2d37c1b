"""One writer at a time: who holds a lock is named, and the dead hold nothing."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from mplicits.neural_fields import InputError
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.training import lock
from mplicits.pipelines.training.folder import check_new_run
from mplicits.pipelines.training.lock import Holder, check_unlocked, lock_file, locked


def hold(target: Path, **changed: object) -> Path:
    """A lock that somebody else holds."""
    file = lock_file(target)
    file.write_text(json.dumps({"pid": os.getppid(), "host": Holder.this_process().host, "since": "noon"} | changed))
    return file


def ended() -> int:
    """The number of a process that is no more."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    return process.pid


def test_a_lock_lasts_as_long_as_its_block_and_names_its_holder(tmp_path: Path) -> None:
    file, us = tmp_path / "run.lock", f"process {os.getpid()} on {Holder.this_process().host} since "
    with locked(tmp_path):
        assert json.loads(file.read_text())["pid"] == os.getpid()
        message = rf"^{re.escape(f'{tmp_path}: is being written by {us}')}[^\n]*run\.lock[^\n]*$"
        with pytest.raises(InputError, match=message), locked(tmp_path):
            pytest.fail("two writers")
    assert not file.exists()
    check_unlocked(tmp_path)


def broken(target: Path) -> None:
    with locked(target):
        raise RuntimeError


def test_what_fails_leaves_no_lock(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        broken(tmp_path)
    assert not lock_file(tmp_path).exists()


@pytest.mark.parametrize("command", ["fit CLOUD -o RUN", "fit CLOUD -o RUN --force", "evolve -o RUN --resume"])
def test_a_second_writer_is_told_in_one_line_and_ends_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    cloud, run = tmp_path / "ball.xyz", tmp_path / "run"
    cloud.write_text("0 0 1 0 0 1\n" * 9)
    run.mkdir()
    with locked(run):
        assert main(command.replace("CLOUD", str(cloud)).replace("RUN", str(run)).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{run}: is being written by process {os.getpid()} on " in line


def test_the_lock_of_a_file_lies_beside_it(tmp_path: Path) -> None:
    with locked(tmp_path / "other.safetensors"), locked(tmp_path):
        assert sorted(path.name for path in tmp_path.iterdir()) == ["other.lock", "run.lock"]


@pytest.mark.parametrize("stays", [{}, {"host": "elsewhere"}])
def test_the_lock_of_the_living_and_of_other_machines_is_kept(tmp_path: Path, stays: dict[str, object]) -> None:
    file = hold(tmp_path, **stays)
    for again in (
        lambda: check_unlocked(tmp_path),
        lambda: check_new_run(tmp_path, resume=False, force=True),
        lambda: check_new_run(tmp_path, resume=True, force=False),
    ):
        with pytest.raises(InputError, match="is being written by process"):
            again()
    assert file.exists()


def test_the_lock_of_the_dead_is_taken_over(tmp_path: Path) -> None:
    file = hold(tmp_path, pid=ended())
    check_new_run(tmp_path, resume=False, force=False)  # and is nothing that could be lost
    with locked(tmp_path):
        assert json.loads(file.read_text())["pid"] == os.getpid()
    assert not file.exists()


@pytest.mark.parametrize("text", ["", "[]", '{"pid": "x"}'])
def test_a_lock_that_names_nobody_is_taken_over(tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "FILLED_WITHIN", 0.1)
    lock_file(tmp_path).write_text(text)
    with locked(tmp_path):
        pass


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"other\.lock: cannot be written"), locked(tmp_path / "absent" / "other.ply"):
        pytest.fail("nothing can be written there")
