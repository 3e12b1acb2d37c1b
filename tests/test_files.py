"""Files are written whole or not at all, whatever writes them, and a full disk is one clear line."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets import PointCloud
from mplicits.datasets.clouds.readers.ply import write_cloud_ply
from mplicits.neural_fields import InputError, Siren, Sphere, extract_mesh, save_field
from mplicits.neural_fields.backend.files import check_place, whole_file, write_whole
from mplicits.pipelines.cli.common import write_json
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.render.picture import write_picture
from mplicits.pipelines.training.folder import save_state

WRITERS: dict[str, Callable[[Path], None]] = {
    "cloud.ply": lambda path: write_cloud_ply(path, PointCloud(np.ones((5, 3)))),
    "figures.json": lambda path: write_json(path, {"one": 1}),
    "field.safetensors": lambda path: save_field(path, Siren(8, 1)),
    **dict.fromkeys(("m.glb", "m.obj", "m.ply"), lambda path: write_mesh(path, extract_mesh(Sphere(), resolution=8))),
    **dict.fromkeys(("picture.jpg", "picture.png"), lambda path: write_picture(path, np.zeros((9, 8, 3), np.uint8))),
    "state.safetensors": lambda path: save_state(path, {}, {"step": 1}),
    "text.txt": lambda path: write_whole(path, "text\r\n"),
}


def test_the_name_comes_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.b.txt"
    path.write_text("older")
    with whole_file(path) as partial:
        assert (partial.parent, partial.suffix, partial.name[0]) == (tmp_path, ".txt", ".")
        partial.write_text("new")
        assert path.read_text() == "older"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", WRITERS)
def test_missing_folders_are_made(tmp_path: Path, name: str) -> None:
    path = tmp_path / "not" / "there" / name
    check_place(path)
    assert list(tmp_path.iterdir()) == []  # asking makes nothing
    WRITERS[name](path)
    assert list(path.parent.iterdir()) == [path]
    assert path.stat().st_size > 0


def test_a_file_is_no_folder_to_write_in(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "lost").symlink_to(tmp_path / "nowhere")
    for above in ("file", "lost"):
        with pytest.raises(InputError, match=rf"a\.txt: .*{above} is no folder"):
            check_place(tmp_path / above / "deeper" / "a.txt")
        with pytest.raises(InputError, match=r"a\.txt: cannot be written"):
            write_whole(tmp_path / above / "a.txt", "text")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="who runs this may write everywhere")
def test_a_folder_that_may_not_be_written(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(InputError, match="closed may not be written; choose another place"):
        check_place(closed / "deeper" / "a.txt")


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_leaves_the_older_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("older")

    def write() -> None:
        with whole_file(path) as partial:
            partial.write_text("new")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "older"
    assert list(tmp_path.iterdir()) == [path]


def test_line_ends_stay_as_they_are(tmp_path: Path) -> None:
    write_whole(tmp_path / "a.txt", "é\r\n\n")
    assert (tmp_path / "a.txt").read_bytes() == b"\xc3\xa9\r\n\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this machine")
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line_and_loses_nothing(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"older")
    (tmp_path / f".{path.stem}.{os.getpid()}.partial{path.suffix}").symlink_to("/dev/full")
    with pytest.raises(InputError, match=rf"{name}: cannot be written \(No space left on device\); choose another"):
        WRITERS[name](path)
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]
