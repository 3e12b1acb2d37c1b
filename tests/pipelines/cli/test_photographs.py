"""The commands for photographs: cameras that are found first, and pictures with something wrong."""

import json
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import trimesh
from evolutions import fails
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import read_posed_images
from mplicits.datasets.views.poses.colmap_process import FEATURES, Found
from mplicits.datasets.views.writing import write_colmap
from mplicits.pipelines.cli import main
from mplicits.pipelines.reconstruct import train
from mplicits.pipelines.reconstruct.model import RayPool, SceneModel
from mplicits.pipelines.reconstruct.objective import GraphTrainer, SceneObjective
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.training.cuda_graphs import Recorder, Work
from mplicits.pipelines.training.settings import ReconstructConfig

TINY = (
    "--widths 8 8 --depths 1 1 --color-width 8 --color-depth 1 --color-grid 8 --steps 3 --rays 8 --uniform 8"
    " --importance 2 --texture-steps 0 --march-grid 12 --quiet"
)


THREE_VIEWS = "--views 3 --size 16 --samples 1"


def photographs(folder: Path) -> Path:
    """Four of the painted sphere, with their cameras."""
    write_colmap(folder, render_scene(SCENES["painted-sphere"](), views=4, size=16, samples=1))
    return folder


@pytest.fixture
def finder(monkeypatch) -> list[dict[str, Any]]:
    """In COLMAP's place, a function that has the cameras."""
    calls: list[dict[str, Any]] = []

    def find(source: Path, project: Path, **options: Any) -> Found:
        calls.append({"source": source, "project": project, **options})
        if not project.exists():
            photographs(project)
        options["report"](FEATURES, 1, 4)
        return Found(project, 5, 40, 0.5, ("4.png",))

    monkeypatch.setattr("mplicits.datasets.views.poses.find_cameras.find_cameras", find)
    return calls


def test_cameras_are_found_and_what_is_doubtful_is_said(tmp_path, finder: list[dict[str, Any]], capsys):
    project, said = tmp_path / "project", tmp_path / "said.json"
    assert main(f"find-cameras photos -o {project} --frames 7 --lens each --json {said} --quiet".split()) == 0
    out, err = capsys.readouterr()
    assert f"{project}: 4 of 5 photographs placed by 40 points" in out
    assert "not placed: 4.png" in err
    assert "40 points are few" in err
    assert (finder[0]["frames"], finder[0]["lens"]) == (7, "each")
    assert json.loads(said.read_text())["left_out"] == ["4.png"]


def test_points_are_found_and_few_are_said(tmp_path, monkeypatch, capsys):
    def find(source: Path, project: Path, *, report: Any) -> Found:
        report(FEATURES, 1, 4)
        return Found(Path(project), 4, 40, 0.5)

    photos, project, said = photographs(tmp_path / "photos"), tmp_path / "project", tmp_path / "said.json"
    with monkeypatch.context() as patch:
        patch.setattr("mplicits.datasets.views.poses.find_points.find_points", find)
        assert main(f"find-points {photos} -o {project} --json {said} --quiet".split()) == 0
    out, err = capsys.readouterr()
    assert f"{project}: 40 points that 4 photographs show" in out
    assert "40 points are few" in err
    assert json.loads(said.read_text()) == {"project": str(project), "photographs": 4, "points": 40, "error": 0.5}
    assert "none: no such file" in fails(capsys, f"find-points {tmp_path}/none -o {project} --quiet")


def test_a_reconstruction_begins_with_its_cameras(tmp_path, finder: list[dict[str, Any]], capsys):
    run = tmp_path / "run"
    assert main(f"reconstruct film.mp4 -o {run} --poses colmap {TINY}".split()) == 0
    assert [(str(call["source"]), call["project"]) for call in finder] == [("film.mp4", tmp_path / "run-cameras")]
    assert "4 of 5 photographs placed" in capsys.readouterr().out
    assert json.loads((run / "run.json").read_text())["data"].startswith(str(tmp_path / "run-cameras"))


def test_steps_that_could_not_be_recorded_are_said(tmp_path, monkeypatch, capsys):
    class Refusing(Recorder):
        def record(self, work: Work) -> NoReturn:
            raise RuntimeError("no memory for graphs")

    def on_a_gpu(model: SceneModel, pool: RayPool, config: ReconstructConfig, **others: Any) -> GraphTrainer:
        objective = SceneObjective(model, pool, config, others.pop("measured"))
        return GraphTrainer(objective, recorder=Refusing(), stage="reconstruct", steps=config.steps)

    monkeypatch.setattr(train, "scene_trainer", on_a_gpu)
    project, run = photographs(tmp_path / "project"), tmp_path / "run"
    assert main(f"reconstruct {project} -o {run} {TINY} --start sphere".split()) == 0
    assert "no memory for graphs" in capsys.readouterr().err
    record = json.loads((run / "run.json").read_text())
    assert record["replayed"] == {"recorded": 0, "not_taken": 0, "refused": "no memory for graphs"}


def test_an_interruption_of_the_search_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mplicits.datasets.views.poses.find_cameras.find_cameras", interrupted)
    assert main(f"reconstruct photos -o {tmp_path}/run --poses colmap {TINY}".split()) == 130
    assert "interrupted; the same command continues" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_mesh_is_photographed_where_it_is(tmp_path):
    ball = tmp_path / "ball.obj"
    trimesh.creation.icosphere(3, radius=2.0).apply_translation((10, 20, 30)).export(ball)
    assert main(f"scene {ball} -o {tmp_path}/photos {THREE_VIEWS} --up z --depths".split()) == 0
    images = read_posed_images(tmp_path / "photos")
    # A ball through the vertices of a box around an icosphere is that through its vertices.
    assert images.similarity.center == pytest.approx((10, 20, 30), abs=1e-6)
    assert images.similarity.scale == pytest.approx(2.1, rel=1e-2)
    truth = read_surface(tmp_path / "photos" / "surface.ply")
    assert np.abs(np.linalg.norm(truth.vertices - (10, 20, 30), axis=1) - 2).max() < 1e-5
    assert (tmp_path / "photos" / "depths" / "000.npy").is_file()


@pytest.mark.parametrize(
    ("words", "line"), [("nothing", "nothing: neither a mesh file nor"), ("figure --up z", "--up: goes with a mesh")]
)
def test_what_cannot_be_photographed_is_one_line(tmp_path, capsys, words: str, line: str):
    assert line in fails(capsys, f"scene {words} -o {tmp_path}/photos")
    assert not (tmp_path / "photos").exists()
