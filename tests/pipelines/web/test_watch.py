"""A run that grows is shown from its first checkpoint on, and a training never notices; see also `test_serve`."""

import time
from pathlib import Path

from mplicits.datasets import sample_sphere, write_cloud_ply
from mplicits.neural_fields import load_field, save_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.web.watch import Watcher
from pages import round_field, until

FIT = "--widths 16 --depths 1 --omegas 5 --steps 20 --learning-rates 1e-3 --samples 1000 --quiet"


def checkpoint(run: Path) -> None:
    save_field(run / "field.safetensors", round_field(0.5))


def test_the_page_comes_with_the_first_checkpoint_of_this_run(tmp_path):
    checkpoint(tmp_path)  # another run's, which will be replaced
    said: list[str] = []
    with Watcher(tmp_path, say=said.append, look_every=0.01) as watcher:
        time.sleep(0.1)
        assert watcher.server is None
        checkpoint(tmp_path)
        until(lambda: said)
        assert said == [f"--watch: open {watcher.server.url} in a browser"]
        until(lambda: watcher.shown == 1)


def test_what_fails_is_said_once_and_no_more(tmp_path, monkeypatch):
    def fail(*_: object, **__: object) -> object:
        raise RuntimeError("no such screen")

    monkeypatch.setattr("mplicits.pipelines.web.watch.PageServer", fail)
    said: list[str] = []
    with Watcher(tmp_path, say=said.append, look_every=0.01):
        checkpoint(tmp_path)
        until(lambda: bool(said))
    assert said == ["--watch: ended (no such screen)"]


def test_a_fit_is_watched(tmp_path, capsys):
    write_cloud_ply(tmp_path / "ball.ply", sample_sphere(500))
    runs = [tmp_path / "plain", tmp_path / "watched"]
    for run, watch in zip(runs, ("", "--watch"), strict=True):
        assert main(f"fit {tmp_path}/ball.ply -o {run} {FIT} {watch}".split()) == 0
    capsys.readouterr()
    plain, watched = (load_field(run / "field.safetensors").field.state_dict() for run in runs)
    assert all(bool((plain[name] == watched[name]).all()) for name in plain)
