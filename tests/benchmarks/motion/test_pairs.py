"""Motions between meshes: what moves rigidly has no jumps, what is torn has, and bad input is named."""

import dataclasses
from pathlib import Path

import pytest
from evolutions import QUICK, few_points
from mplicits.neural_fields import Box, Moving, RigidMotion, Similarity, Sphere, extract_mesh
from mplicits.neural_fields.spacetime.flow import Solver
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.pipelines.evolve import deform
from mplicits.pipelines.evolve.shapes import read_shape
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.render.draw import Orbit, orbit_cameras
from mplicits.pipelines.texture import transport

from benchmarks.harness.report import as_text
from benchmarks.motion import motion, pairs
from benchmarks.motion.motion import BLEND
from benchmarks.motion.pairs import PairBench, color_jumps, measure_pair

RESOLUTION = 24
TURN = RigidMotion(axis=(0.0, 1.0, 0.0), angle=1.0)


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    few_points(monkeypatch)
    monkeypatch.setattr(pairs, "PIXELS", 48)
    monkeypatch.setattr(pairs, "TILE", 32)
    coarse = dataclasses.replace(transport.TRANSPORT, carried=12, spread=12, step=0.25)
    monkeypatch.setattr(transport, "TRANSPORT", coarse)
    monkeypatch.setattr(motion, "CARRY", Solver(method="rk4", step=0.25))


def test_a_rigid_motion_has_no_jumps(tmp_path: Path):
    field, sheet = Moving(Box(half_size=(0.5, 0.3, 0.4)), TURN), tmp_path / "sheet.png"
    row = measure_pair("a", "turn", field, (0.0, 0.5, 1.0), velocity=TURN.velocity, resolution=RESOLUTION, sheet=sheet)
    # Distances between points stay, and a blend of two paints is no steeper than the steeper one; but where it is
    # steepest need not be in view at the ends.
    assert max(row.jumps[0], row.jumps[-1]) == 1
    assert max(row.jumps) < 1.5
    assert (row.calm, row.cracked, row.components, row.holes) == (1, (0, 0, 0), (1, 1, 1), (0, 0, 0))
    # A lattice that is turned against a box cuts its edges off: by half a cell, 1/24, at the most, of 0.6.
    assert row.volumes == pytest.approx([0.48] * 3, rel=0.1)
    assert sheet.stat().st_size > 500


def test_steps_are_those_of_the_places_at_the_start():
    mesh = extract_mesh(Sphere(radius=0.5), resolution=RESOLUTION)
    (camera,) = orbit_cameras(mesh.vertices, Orbit(), size=(48, 48), frames=1)
    still = color_jumps(mesh, lambda points: points, camera)
    assert len(still) > 500
    assert color_jumps(mesh, lambda points: 3 * points, camera) == pytest.approx(3 * still, rel=1e-5)  # float32
    steps = color_jumps(mesh, lambda points: points + (points[:, 1:2] > 0), camera)
    # A row of pixels crosses y = 0: each neighbour there steps by √3, less the little that lies between them.
    across = steps > 1.5
    assert 10 < across.sum() < 100
    assert steps[~across] == pytest.approx(still[~across], rel=1e-4)


def test_colours_that_cannot_be_carried_are_none(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pairs, "carried_points", lambda *_: None)
    monkeypatch.setattr(pairs, "_carried", lambda _transported, time: None if time else lambda points: points)
    field = Keyframes([0.0, 1.0], [Sphere(radius=0.5), Sphere(radius=0.4)])
    row = measure_pair("a", "blend", field, (0.0, 1.0), resolution=RESOLUTION)
    assert (row.calm, row.jumps, row.cracked) == (None, (1.0, None), (0.0, None))


def test_meshes_are_fitted_and_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    files = []
    for name, size in (("flat", (0.6, 0.2, 0.5)), ("tall", (0.3, 0.6, 0.3))):
        files.append(tmp_path / f"{name}.ply")
        write_mesh(files[-1], extract_mesh(Box(half_size=size), resolution=16), Similarity.identity())
    monkeypatch.setattr(pairs, "kept_fit", lambda *_, **__: None)
    boxes = {"flat": "box:0.6,0.2,0.5", "tall": "box:0.3,0.6,0.3"}
    monkeypatch.setattr(pairs, "read_shape", lambda home: read_shape(boxes[Path(home).name.partition("-")[0]]))
    fewer = dataclasses.replace(deform.MOTION, pool=500, matched=100, guided=32, loose=32, regular=64, steps=2)
    monkeypatch.setattr(deform, "MOTION", fewer)
    few = {"motion_steps": 3, "motion_width": 8, "steps": (5,), "samples": 200, "start_steps": 5, "batch": 64}
    config = dataclasses.replace(QUICK, **few, frames=2, resolution=16)
    sizes = {"moments": 2, "resolution": 16, "pictures": tmp_path / "sheets"}
    bench = PairBench(pairs=((files[0], files[1]),), config=config, kinds=("deform",), **sizes)
    rows = bench.rows(tmp_path)
    assert [(row.pair, row.method) for row in rows] == [("flat to tall", BLEND), ("flat to tall", "deform")]
    assert rows[1].seconds > rows[0].seconds == 0
    text = "\n".join(as_text(table) for table in bench.tables(rows, sgemm=1e9))
    for part in ("flat to tall, deform", "stretch < 4, %", "flat to tall, deform, 1.000"):
        assert part in text
    names = {path.name for path in (tmp_path / "sheets").iterdir()}
    assert names == {"flat-tall-blend-of-distances.png", "flat-tall-deform.png"}
    # A cell is an eighth: edges of the box are cut off by half of it at most.
    assert rows[0].volumes == pytest.approx([8 * 0.6 * 0.2 * 0.5, 8 * 0.3 * 0.6 * 0.3], rel=0.2)
