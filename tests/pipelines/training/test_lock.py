"""One writer at a time; the lock ends with its process."""

import subprocess
import sys
from pathlib import Path

import pytest
from mplicits.neural_fields import InputError
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.training.folder import check_new_run
from mplicits.pipelines.training.lock import check_unlocked, lock_file, locked


def test_a_lock_lasts_as_long_as_its_block(tmp_path: Path) -> None:
    with locked(tmp_path):
        for again in (
            lambda: check_unlocked(tmp_path),
            lambda: check_new_run(tmp_path, resume=False, force=True),
            lambda: check_new_run(tmp_path, resume=True, force=False),
        ):
            with pytest.raises(InputError, match=r"is being written by another process; [^\n]*$"):
                again()
    check_unlocked(tmp_path)
    assert check_new_run(tmp_path, resume=False, force=False) == tmp_path  # a lock is nothing that could be lost


def broken(target: Path) -> None:
    with locked(target):
        raise RuntimeError


def test_an_error_releases_the_lock(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        broken(tmp_path)
    check_unlocked(tmp_path)


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
    assert f"{run}: is being written by another process" in line


def test_the_lock_of_a_file_lies_beside_it(tmp_path: Path) -> None:
    with locked(tmp_path / "other.safetensors"), locked(tmp_path):
        assert sorted(path.name for path in tmp_path.iterdir()) == ["other.lock", "run.lock"]


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    program = (
        "import pathlib, sys, time\nfrom mplicits.pipelines.training.lock import locked\n"
        "with locked(pathlib.Path(sys.argv[1])):\n print(1, flush=True)\n time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"1\n"
        with pytest.raises(InputError, match="is being written"):
            check_unlocked(tmp_path)
        process.kill()
        process.wait()
    check_unlocked(tmp_path)


def test_locks_of_older_versions_are_nobodys(tmp_path: Path) -> None:
    lock_file(tmp_path).write_text('{"pid": 1, "host": "elsewhere", "since": "noon"}')
    with locked(tmp_path):
        pass


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"other\.lock: cannot be written"), locked(tmp_path / "absent" / "other.ply"):
        pytest.fail("nothing can be written there")
    assert not (tmp_path / "absent").exists()
