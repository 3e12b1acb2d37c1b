"""A run that grows is shown checkpoint by checkpoint, to who looks; a training never notices."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mplicits.datasets import sample_sphere, write_cloud_ply
from mplicits.neural_fields import MultiscaleSDF, Similarity, Siren, Sphere, load_field, save_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.viewer.server import Viewer
from mplicits.pipelines.viewer.watch import Watcher

PATIENCE = 60.0  # seconds: a busy machine is slow to serve


def checkpoint(run: Path, *, levels: int) -> None:
    field = MultiscaleSDF(Sphere(radius=0.5), [Siren(8, 1, omega=5.0) for _ in range(levels - 1)], [0.1] * (levels - 1))
    save_field(run / "field.safetensors", field, similarity=Similarity.identity())


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_each_checkpoint_is_shown_to_who_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser")
    checkpoint(tmp_path, levels=1)  # another run's, which will be replaced
    said: list[str] = []
    looking = [0]
    monkeypatch.setattr(Viewer, "num_clients", property(lambda _: looking[0]))
    with Watcher(tmp_path, say=said.append, look_every=0.01) as watcher:
        time.sleep(0.1)
        assert watcher.viewer is None
        checkpoint(tmp_path, levels=1)
        until(lambda: watcher.shown == 1)
        viewer = watcher.viewer
        assert viewer is not None
        until(lambda: said == [f"--watch: open {viewer.url} in a browser"])
        checkpoint(tmp_path, levels=2)
        time.sleep(0.1)
        assert watcher.shown == 1  # nobody looks
        looking[0] = 1
        until(lambda: watcher.shown == 2)
        time.sleep(0.1)
        assert watcher.shown == 2  # once
    assert len(said) == 1


def test_what_fails_is_said_once_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser")

    def fail(*_: object, **__: object) -> object:
        raise RuntimeError("no such screen")

    monkeypatch.setattr("mplicits.pipelines.viewer.watch.open_run", fail)
    said: list[str] = []
    with Watcher(tmp_path, say=said.append, look_every=0.01):
        checkpoint(tmp_path, levels=1)
        until(lambda: bool(said))
    assert said == ["--watch: ended (no such screen)"]


def test_a_fit_is_watched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With nobody connected, and with the same result."""
    pytest.importorskip("viser")
    write_cloud_ply(tmp_path / "ball.ply", sample_sphere(500))
    flags = [
        "--widths",
        "16",
        "--depths",
        "1",
        "--omegas",
        "5",
        "--steps",
        "20",
        "--learning-rates",
        "1e-3",
        "--samples",
        "1000",
        "--quiet",
    ]
    runs = [tmp_path / "plain", tmp_path / "watched"]
    for run, watch in zip(runs, ([], ["--watch"]), strict=True):
        assert main(["fit", str(tmp_path / "ball.ply"), "-o", str(run), *flags, *watch]) == 0
    capsys.readouterr()
    plain, watched = (load_field(run / "field.safetensors").field.state_dict() for run in runs)
    assert all(bool((plain[name] == watched[name]).all()) for name in plain)


def test_without_viser_nothing_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_cloud_ply(tmp_path / "ball.ply", sample_sphere(100))
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["fit", str(tmp_path / "ball.ply"), "-o", str(tmp_path / "run"), "--watch"]) == 2
    assert capsys.readouterr().err == "mplicits: error: the viewer needs viser; pip install mplicits[view]\n"
    assert not (tmp_path / "run").exists()
