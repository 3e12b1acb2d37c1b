"""Jobs of the paper's tables: keys, damage, running each once, and going on after failures."""

import dataclasses
import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from benches import Exact
from mplicits.datasets import read_cloud
from mplicits.neural_fields import InputError, Sphere
from mplicits.pipelines.training.trainer import Interrupted
from refusals import refused

from benchmarks.harness.jobs import Registry, key_of, make_folder, read_record, record_file
from benchmarks.harness.run import run_job, run_pending
from benchmarks.paper.bench import find_shapes
from benchmarks.paper.jobs import Input, PaperJob, TableSpec, jobs_of
from benchmarks.paper.judge import damaged_cloud, oriented_cloud
from benchmarks.paper.methods import REGISTRY
from benchmarks.paper.ours import FromRecipe, Ours
from benchmarks.paper.recipe import Output, Recipe


@pytest.fixture
def out(tmp_path: Path) -> Path:
    make_folder(tmp_path / "bench")
    return tmp_path / "bench"


def test_keys_are_of_contents_and_settings(ball: Path, tmp_path: Path) -> None:
    copy = tmp_path / "elsewhere.ply"
    copy.write_bytes(ball.read_bytes())
    job = PaperJob(ball, "ours", "smoke")
    key = key_of(job, {"a": 1})
    assert key == key_of(job, {"a": 1}) == key_of(PaperJob(copy, "ours", "smoke"), {"a": 1})
    assert len(key) == 12
    changes = {"method": "idf", "preset": "cpu", "seed": 1, "noise": 0.01, "outliers": 0.01, "flipped": 0.01}
    changes |= {"overrides": (("steps", (1, 2)),), "reference": copy}
    others = [key_of(dataclasses.replace(job, **{name: value}), {"a": 1}) for name, value in changes.items()]
    assert len({key, *others, key_of(job, {"a": 2})}) == len(others) + 2
    copy.write_bytes(ball.read_bytes() + b"\n")
    assert key_of(PaperJob(copy, "ours", "smoke"), {"a": 1}) != key


def test_settings_of_ours_are_in_the_key_but_not_the_device(ball: Path) -> None:
    ours = Ours()
    plain = PaperJob(ball, "ours", "smoke")
    settings = ours.settings(plain)["fit"]
    assert "device" not in settings
    changed = ours.settings(dataclasses.replace(plain, overrides=(("epsilon", 0.5),)))["fit"]
    assert changed == settings | {"epsilon": 0.5}
    assert REGISTRY.key(plain) != REGISTRY.key(dataclasses.replace(plain, preset="cpu"))


def test_damage(ball: Path, tmp_path: Path) -> None:
    clean = read_cloud(ball)
    count = len(clean)
    job = PaperJob(ball, "x", "smoke", noise=0.01, outliers=0.05, flipped=0.1)
    cloud, again, other = (damaged_cloud(dataclasses.replace(job, seed=seed)) for seed in (0, 0, 1))
    assert len(cloud) == count + round(0.05 * count)
    moved = np.linalg.norm(cloud.points[:count] - [5.0, 0.0, -1.0], axis=1) - 14
    diagonal = 28 * 3**0.5
    assert 0.9 * 0.01 * diagonal < abs(moved).max() < 0.01 * diagonal + 0.03
    against = (cloud.normals[:count] * clean.normals).sum(axis=1) < 0
    assert against.sum() == round(0.1 * count)
    assert (cloud.normals == again.normals).all()
    assert (cloud.normals != other.normals).any()
    assert len(oriented_cloud(job)) == len(cloud)  # no stray is dropped here
    np.savetxt(tmp_path / "bare.xyz", clean.points)
    with pytest.raises(InputError, match="has no normals for noise"):
        damaged_cloud(dataclasses.replace(job, shape=tmp_path / "bare.xyz"))
    with pytest.raises(ValueError, match=r"fraction=1\.5"):
        damaged_cloud(dataclasses.replace(job, flipped=1.5))


def test_a_record_is_measured_kept_and_not_made_again(ball: Path, out: Path) -> None:
    exact = Exact()
    methods = Registry((exact,))
    job = PaperJob(ball, "exact", "smoke")
    record_file(out, methods.key(job)).write_text("{")  # damaged: it is made again
    record = run_job(job, out, methods)
    key = record["key"]
    assert json.loads(record_file(out, key).read_text()) == record == run_job(job, out, methods)
    assert exact.runs == 1
    (output,) = record["outputs"]
    assert record["deltas"] == [0.25]
    assert output["chamfer"] < 1.5 * output["chamfer_floor"]
    assert output["iou"] > 0.97
    assert output["rays_per_second"] > 0
    assert (output["parameters"], output["train_seconds"], output["components"]) == (1, 2.0, 1)
    vertices = read_cloud(out / "meshes" / f"{key}-exact.ply").points
    assert abs(np.linalg.norm(vertices - [5.0, 0.0, -1.0], axis=1) - 14).max() < 0.02
    assert (out / "pictures" / f"{key}-exact.png").stat().st_size > 1000


def test_no_surface_is_a_result(ball: Path, out: Path) -> None:
    methods = Registry((Exact(radius=1.9),))  # all of the box is inside
    (output,) = run_job(PaperJob(ball, "exact", "smoke"), out, methods)["outputs"]
    assert output["chamfer"] is None
    assert "iou" not in output


def test_a_failure_stops_nothing_and_is_tried_again(ball: Path, out: Path) -> None:
    good, bad = Exact("good"), Exact("bad", radius=None)
    methods = Registry((good, bad))
    jobs = [PaperJob(ball, "bad", "smoke"), PaperJob(ball, "good", "smoke")]
    ran = run_pending(jobs, out, methods, say=lambda _: None)
    assert list(ran.records) == jobs[1:]
    assert ran.failures == {jobs[0]: "RuntimeError: no luck"}
    key = methods.key(jobs[0])
    assert json.loads(record_file(out, key).read_text())["error"] == "no luck"
    assert read_record(out, key) is None

    bad.radius = 0.7
    again = run_pending(jobs, out, methods, say=lambda _: None)
    assert (good.runs, bad.runs) == (1, 2)
    assert list(again.records) == jobs
    assert not again.failures


def test_what_is_not_installed_is_left_out(ball: Path, out: Path) -> None:
    class Absent(Exact):
        def missing(self):
            return "needs pip install something"

    absent, lines = Absent("absent"), []
    ran = run_pending([PaperJob(ball, "absent", "smoke")], out, Registry((absent,)), say=lines.append)
    assert (ran.records, ran.failures, ran.lacking) == ({}, {}, {"absent": "needs pip install something"})
    assert "absent" in lines[0]
    assert absent.runs == 0


@pytest.mark.parametrize("reason", [KeyboardInterrupt(), Interrupted(None)])
def test_ctrl_c_keeps_what_is_finished(ball: Path, out: Path, reason: BaseException) -> None:
    class Stopped(Exact):
        def run(self, job, context):
            raise reason

    good, stopped = Exact("good"), Stopped("stopped")
    methods = Registry((good, stopped))
    jobs = [PaperJob(ball, "good", "smoke"), PaperJob(ball, "stopped", "smoke")]
    with pytest.raises(type(reason)):
        run_pending(jobs, out, methods, say=lambda _: None)
    assert read_record(out, methods.key(jobs[0])) is not None
    assert not record_file(out, methods.key(jobs[1])).exists()


def test_recipes_learn_from_the_unit_sphere(ball: Path, out: Path, monkeypatch) -> None:
    class Known(Recipe):
        name, source, differs = "known", "s", "d"
        presets: ClassVar = {"smoke": "tiny"}

        def learn(self, cloud, settings, *, seed, device, progress):
            assert settings == "tiny"
            radii = np.linalg.norm(cloud.points, axis=1)
            assert abs(radii - 1).max() < 0.01
            return (Output("Known", Sphere(radius=0.999), -1, 4),), 17

    methods = Registry((FromRecipe(Known()),))
    record = run_job(PaperJob(ball, "known", "smoke", seed=2), out, methods)
    (output,) = record["outputs"]
    assert output["chamfer"] < 1.5 * output["chamfer_floor"]
    assert record["details"] == {"steps": 17}
    assert record["method"] == {"source": "s", "differs": "d"}
    # Another size or schedule makes another job.
    monkeypatch.setattr(Known, "presets", {"smoke": "larger"})
    assert methods.key(PaperJob(ball, "known", "smoke", seed=2)) != record["key"]


def test_poisson_on_what_ours_has_smoothed(ball: Path, out: Path) -> None:
    pytest.importorskip("pymeshlab", reason="the extra mplicits[poisson] is not installed")

    def error(name: str) -> float:
        (output,) = run_job(PaperJob(ball, name, "smoke", noise=0.02), out, REGISTRY)["outputs"]
        return output["chamfer"] - output["chamfer_floor"]

    assert 0 < error("poisson-smoothed") < error("poisson") / 3


def test_ours_and_a_finished_fit_that_is_measured_again(ball: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = PaperJob(ball, "ours", "smoke", overrides=(("steps", (120, 20, 20)), ("samples", 5000)))
    record = run_job(job, out, REGISTRY)
    outputs = record["outputs"]
    assert [output["name"] for output in outputs] == ["Ours coarse", "Ours medium", "Ours fine"]
    assert outputs[1]["parameters"] == 2 * outputs[0]["parameters"]
    seconds = [output["train_seconds"] for output in outputs]
    assert 0 < seconds[0] < seconds[1] < seconds[2]
    assert outputs[2]["iou"] > 0.95
    assert len(record["deltas"]) == 2
    (out / "cells" / f"{record['key']}.json").unlink()
    monkeypatch.delattr("benchmarks.shapes.fits.fit")
    again = run_job(job, out, REGISTRY)["outputs"]
    assert [(o["chamfer"], o["train_seconds"]) for o in again] == [(o["chamfer"], o["train_seconds"]) for o in outputs]


def test_jobs_of_a_table(ball: Path) -> None:
    def jobs(shapes, preset):
        return [PaperJob(shape, method, preset) for shape in shapes for method in ("a", "b", "a")]

    spec = TableSpec("t", "l", "s", jobs, lambda _: ())
    other = ball.with_name("scan.npz")
    planned = jobs_of(spec, [Input(ball), Input(other, ball)], "smoke", seed=4)
    assert planned == [
        PaperJob(shape, method, "smoke", seed=4, reference=reference)
        for shape, reference in ((ball, None), (other, ball))
        for method in ("a", "b")
    ]


def test_shapes(ball: Path, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    with refused(folder, "holds no mesh"):
        find_shapes([folder])
    for name in ("b.ply", "a.ply", "._a.ply"):
        (folder / name).write_bytes(ball.read_bytes())
    (folder / "notes.txt").write_text("not a mesh")
    assert find_shapes([folder, ball]) == [Input(folder / "a.ply"), Input(folder / "b.ply"), Input(ball)]
    (tmp_path / "a.ply").write_bytes(ball.read_bytes())
    scan = tmp_path / "scan.xyz"
    np.savetxt(scan, np.random.default_rng(0).random((50, 3)))
    for shapes, reference, message in (
        ([folder, tmp_path / "a.ply"], None, "has the same name"),
        ([tmp_path / "nothing.ply"], None, "no such file"),
        ([scan], None, "give --reference MESH"),
        ([scan], scan, "has no faces.*--reference"),
        ([ball], ball, "leave it out"),
    ):
        with pytest.raises(InputError, match=message):
            find_shapes(shapes, reference=reference)
    assert find_shapes([ball, scan], reference=ball) == [Input(ball), Input(scan, ball)]


def test_keys_are_those_of_folders_written_before(tmp_path: Path) -> None:
    """Finished jobs are found again: computed at commit 9deaa32, but for ours, whose settings have changed since."""
    cloud = tmp_path / "cloud.ply"
    cloud.write_bytes(b"ply\n")
    expected = {"ours": "26a349f159c6", "siren": "99e6b3b4f17f", "bacon": "0d43bf57cf44", "banf": "91e5a59ab74b"}
    assert {name: REGISTRY.key(PaperJob(cloud, name, "cpu")) for name in expected} == expected
