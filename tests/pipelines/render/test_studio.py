"""Photographs of a mesh: those of the exact scene that it was made of, in the coordinates of its file."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mplicits.datasets.synthetic.scenes import SCENES, render_scene, scene_mesh
from mplicits.neural_fields import Mesh, Similarity
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.render.rasterise import read_painted
from mplicits.pipelines.render.studio import CLAY, photograph_mesh, true_mesh

WORLD = Similarity((400_000.0, 5_600_000.0, 90.0), 30.0)  # map coordinates, in metres
RADIUS, CELLS = 0.6, 96
# Chords of the triangles of marching cubes are a cell's diagonal long at most, and this far under the sphere.
SAGITTA = 3 * (2 * 1.02 * RADIUS / CELLS) ** 2 / (8 * RADIUS)

QUAD = """mtllib quad.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl painted
f 1/1 2/2 3/3 4/4
"""


@pytest.fixture
def ball(tmp_path) -> Path:
    """The painted sphere as a mesh, somewhere on a map."""
    file = tmp_path / "ball.ply"
    write_mesh(file, scene_mesh(SCENES["painted-sphere"](), resolution=CELLS), WORLD)
    return file


@pytest.fixture
def quad(tmp_path) -> Path:
    """A square of two by two with an image of a blue half on the left and a yellow one on the right."""
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, :4], image[:, 4:] = (200, 40, 20), (10, 220, 240)  # BGR
    (tmp_path / "quad.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (tmp_path / "quad.mtl").write_text("newmtl painted\nmap_Kd quad.png\n")
    (tmp_path / "quad.obj").write_text(QUAD)
    return tmp_path / "quad.obj"


@pytest.mark.parametrize("shaded", [False, True])
def test_a_mesh_is_photographed_as_the_scene_that_it_was_made_of(ball: Path, shaded: bool):
    exact = render_scene(SCENES["painted-sphere"](), views=3, size=32, shaded=shaded, depths=True)
    drawn = photograph_mesh(ball, 3, 32, shaded=shaded, depths=True)
    assert [view.name for view in drawn.views] == [view.name for view in exact.views]
    for mine, theirs in zip(drawn.views, exact.views, strict=True):
        there = mine.camera.moved(WORLD)
        # The cameras stand around the mesh's box, whose sides are off by the sagitta at most.
        assert np.abs(there.eye.numpy() - theirs.camera.eye.numpy()).max() < 10 * SAGITTA
        both = (mine.mask == 1) & (theirs.mask == 1)
        assert both.sum() > 200
        assert np.abs(mine.mask - theirs.mask).mean() < 0.01
        # Paint changes by 9 · 0.4 · (1 + 5 · 4 / 9) in a unit at most, and a normal turns by a chord's half angle.
        assert np.abs(mine.color - theirs.color)[both].max() < 0.06
        assert not mine.color[mine.mask == 0].any()
        assert mine.depth is not None
        seen = np.isfinite(mine.depth.numbers) & np.isfinite(theirs.depth.numbers)
        off = np.abs(mine.depth.numbers / WORLD.scale - theirs.depth.numbers)[seen]
        assert np.median(off) < 20 * SAGITTA
    assert np.abs(np.array(drawn.similarity.center) - WORLD.center).max() < WORLD.scale * SAGITTA
    assert drawn.similarity.scale == pytest.approx(1.05 * RADIUS * WORLD.scale, rel=1e-2)


def test_sparse_points_are_of_the_surface_and_seen_from_its_front(ball: Path):
    drawn = photograph_mesh(ball, 4, 96, samples=1)
    points = WORLD.to_unit(drawn.points)
    radius = np.linalg.norm(points, axis=1)
    assert RADIUS - 2 * SAGITTA < radius.min() <= radius.max() < RADIUS + SAGITTA
    eyes = np.stack([view.camera.moved(WORLD).eye.numpy() for view in drawn.views])
    # A sphere's point p is in sight of e where ⟨p, e⟩ > r². At the rim a pixel of 1 / 44 of the radius covers
    # acos(1 − 1 / 44) = 12°, in which ⟨n, e⟩ falls by 0.5.
    facing = (points / radius[:, None]) @ eyes.T - radius[:, None]  # (P, V): 0 at the rim
    seen = np.zeros(facing.shape, bool)
    seen[drawn.observations[:, 1], drawn.observations[:, 0]] = True
    assert seen[facing > 0.6].all()
    assert not seen[facing < -0.6].any()


def test_an_image_over_a_mesh_is_in_its_photographs(quad: Path):
    drawn = photograph_mesh(quad, 6, 48, samples=1, seed=3)
    for view in drawn.views:
        row, column = np.nonzero(view.mask == 1)
        eye, rays = view.camera.rays()
        along = -eye[2] / rays[row, column, 2]
        x = (eye[0] + along * rays[row, column, 0]).numpy()
        # Texels are a quarter wide, mixed with their neighbours, and the image repeats.
        left, right = (x > -0.8) & (x < -0.2), (x > 0.2) & (x < 0.8)
        for side, color in ((left, (20, 40, 200)), (right, (240, 220, 10))):
            assert np.abs(view.color[row, column][side] - np.array(color) / 255).max(initial=0) < 1e-5
        assert left.any()
        assert right.any()


def test_what_has_no_colours_is_lit_clay(tmp_path):
    write_mesh(tmp_path / "bare.ply", replace(scene_mesh(SCENES["painted-sphere"](), resolution=48), colors=None))
    (view,) = photograph_mesh(tmp_path / "bare.ply", 1, 32).views
    shades = view.color[view.mask == 1]
    assert np.ptp(shades, axis=1).max() < 1e-6
    assert shades.max() <= CLAY + 1e-6
    assert np.ptp(shades[:, 0]) > 0.1


def test_materials_that_are_missing_are_left_out(quad: Path):
    quad.with_suffix(".png").unlink()
    mesh = read_painted(quad)
    assert isinstance(mesh, Mesh)
    assert len(mesh.faces) == 2
    assert len(true_mesh(quad).faces) == 2
