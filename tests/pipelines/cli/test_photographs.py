"""The commands for photographs: cameras that are found first, and pictures with something wrong."""

import json
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
import pytest
import trimesh
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import read_posed_images
from mplicits.datasets.views.poses.colmap_process import FEATURES
from mplicits.datasets.views.poses.find_cameras import FoundCameras
from mplicits.datasets.views.poses.find_points import FoundPoints
from mplicits.datasets.views.writing import write_colmap
from mplicits.pipelines.cli import main
from mplicits.pipelines.reconstruct import train
from mplicits.pipelines.reconstruct.model import RayPool, SceneModel
from mplicits.pipelines.reconstruct.objective import ReplayedTrainer, SceneObjective
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.training.replay import Recorder, Work
from mplicits.pipelines.training.settings import ReconstructConfig

TINY = (
    "--widths 8 8 --depths 1 1 --color-width 8 --color-depth 1 --color-grid 8 --steps 3 --rays 8 --uniform 8"
    " --importance 2 --texture-steps 0 --march-grid 12 --quiet"
)


@pytest.fixture
def finder(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """In COLMAP's place somebody who knows the cameras."""
    calls: list[dict[str, Any]] = []

    def find(source: Path, project: Path, **options: Any) -> FoundCameras:
        calls.append({"source": source, "project": project, **options})
        if not project.exists():
            images = render_scene(SCENES["painted-sphere"](), views=4, size=16, samples=1)
            write_colmap(project, images)
        options["report"](FEATURES, 1, 4)
        return FoundCameras(project, 5, ("4.png",), 40, 0.5)

    monkeypatch.setattr("mplicits.datasets.views.poses.find_cameras.find_cameras", find)
    return calls


def test_cameras_are_found_and_what_is_doubtful_is_said(
    tmp_path: Path, finder: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    project, said = tmp_path / "project", tmp_path / "said.json"
    words = ["find-cameras", "photos", "-o", project, "--frames", 7, "--lens", "each", "--json", said, "--quiet"]
    assert main([str(word) for word in words]) == 0
    out, err = capsys.readouterr()
    assert f"{project}: 4 of 5 photographs placed by 40 points that are seen 0.50 pixels off" in out
    assert "not placed: 4.png" in err
    assert "40 points are few" in err
    assert (finder[0]["frames"], finder[0]["lens"]) == (7, "each")
    assert json.loads(said.read_text())["left_out"] == ["4.png"]


def test_points_are_found_and_few_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def find(source: Path, project: Path, *, report: Any) -> FoundPoints:
        report(FEATURES, 1, 4)
        return FoundPoints(Path(project), 4, 40, 0.5)

    photos, project, said = tmp_path / "photos", tmp_path / "project", tmp_path / "said.json"
    write_colmap(photos, render_scene(SCENES["painted-sphere"](), views=4, size=16, samples=1))
    with monkeypatch.context() as patch:
        patch.setattr("mplicits.datasets.views.poses.find_points.find_points", find)
        assert main(["find-points", str(photos), "-o", str(project), "--json", str(said), "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert f"{project}: 40 points that 4 photographs show, seen 0.50 pixels off" in out
    assert "40 points are few" in err
    assert json.loads(said.read_text()) == {"project": str(project), "photographs": 4, "points": 40, "error": 0.5}
    assert main(["find-points", str(tmp_path / "none"), "-o", str(project), "--quiet"]) == 2
    assert "none: no such file; check the path" in capsys.readouterr().err


def test_a_reconstruction_begins_with_its_cameras(
    tmp_path: Path, finder: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main(["reconstruct", "film.mp4", "-o", str(run), "--poses", "colmap", *TINY.split()]) == 0
    assert [(str(call["source"]), call["project"]) for call in finder] == [("film.mp4", tmp_path / "run-cameras")]
    assert "4 of 5 photographs placed" in capsys.readouterr().out
    assert json.loads((run / "run.json").read_text())["data"].startswith(str(tmp_path / "run-cameras"))


def test_steps_that_could_not_be_recorded_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Refusing(Recorder):
        def record(self, work: Work) -> NoReturn:
            raise RuntimeError("no memory for graphs")

    def on_a_gpu(model: SceneModel, pool: RayPool, config: ReconstructConfig, **others: Any) -> ReplayedTrainer:
        objective = SceneObjective(model, pool, config, others.pop("measured"))
        return ReplayedTrainer(objective, recorder=Refusing(), stage="reconstruct", steps=config.steps)

    monkeypatch.setattr(train, "scene_trainer", on_a_gpu)
    project = tmp_path / "project"
    write_colmap(project, render_scene(SCENES["painted-sphere"](), views=4, size=16, samples=1))
    run = tmp_path / "run"
    assert main(["reconstruct", str(project), "-o", str(run), *TINY.split(), "--start", "sphere"]) == 0
    assert (
        "warning: steps were done one operation at a time, for want of CUDA graphs (no memory" in capsys.readouterr()[1]
    )
    record = json.loads((run / "run.json").read_text())
    assert record["replayed"] == {"recorded": 0, "not_taken": 0, "refused": "no memory for graphs"}


def test_an_interruption_of_the_search_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mplicits.datasets.views.poses.find_cameras.find_cameras", interrupted)
    assert main(["reconstruct", "photos", "-o", str(tmp_path / "run"), "--poses", "colmap", *TINY.split()]) == 130
    assert "interrupted; the same command continues" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_scene_has_the_fault_that_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--views", "3", "--size", "16", "--samples", "1"]
    assert main(["scene", "figure", "-o", str(tmp_path / "right"), *small]) == 0
    assert main(["scene", "figure", "-o", str(tmp_path / "wrong"), *small, "--fault", "mirrored"]) == 0
    right, wrong = (
        cv2.imdecode(np.fromfile(tmp_path / name / "image" / "000.png", np.uint8), cv2.IMREAD_COLOR)
        for name in ("right", "wrong")
    )
    assert right is not None
    assert np.array_equal(wrong, right[:, ::-1])
    capsys.readouterr()
    few = ["--views", "2", "--fault", "image"]
    assert main(["scene", "figure", "-o", str(tmp_path / "few"), *few]) == 2
    assert "--views 3 or more" in capsys.readouterr().err


def test_a_mesh_is_photographed_where_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball, small = tmp_path / "ball.obj", ["--views", "3", "--size", "16", "--samples", "1"]
    trimesh.creation.icosphere(3, radius=2.0).apply_translation((10, 20, 30)).export(ball)
    assert main(["scene", str(ball), "-o", str(tmp_path / "photos"), *small, "--up", "z", "--depths"]) == 0
    images = read_posed_images(tmp_path / "photos")
    # A ball through the vertices of a box around an icosphere is that through its vertices.
    assert images.similarity.center == pytest.approx((10, 20, 30), abs=1e-6)
    assert images.similarity.scale == pytest.approx(2.1, rel=1e-2)
    truth = read_surface(tmp_path / "photos" / "surface.ply")
    assert np.abs(np.linalg.norm(truth.vertices - (10, 20, 30), axis=1) - 2).max() < 1e-5
    assert (tmp_path / "photos" / "depths" / "000.npy").is_file()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["nothing"], "nothing: neither a mesh file nor one of the scenes painted-sphere"),
        (["figure", "--up", "z"], "--up: goes with a mesh; figure stands as it is, so leave it out"),
    ],
)
def test_what_cannot_be_photographed_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], line: str
) -> None:
    assert main(["scene", *words, "-o", str(tmp_path / "photos")]) == 2
    assert line in capsys.readouterr().err
    assert not (tmp_path / "photos").exists()
