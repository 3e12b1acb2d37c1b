"""What photographs have seen of a surface, against the caps of a sphere; and the mesh without the rest."""

import math
from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets.cameras import look_at
from mplicits.neural_fields import Sphere, Union, extract_mesh, save_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.reconstruct.data.visibility import SeenFrom, seen_points
from mplicits.pipelines.surface.surface import Support, seen_part, thinned

RADIUS, DISTANCE = 0.5, 2.0


def photograph(eye: tuple[float, float, float], *, masked: bool = False) -> SeenFrom:
    """Of the unit sphere; its mask, if it has one, is the left half of the picture."""
    camera = look_at(eye, (0.0, 0.0, 0.0), fov=40, width=160, height=120)
    mask = np.zeros((120, 160), np.float32)
    mask[:, :80] = 1
    return camera, mask if masked else None


def share_seen(views: list[SeenFrom]) -> tuple[float, np.ndarray]:
    """Of the area of the sphere; and the points."""
    field = Sphere(radius=RADIUS)
    points, within = seen_points(field, views)
    assert points.norm(dim=1).numpy() == pytest.approx(RADIUS, abs=2e-3)
    mesh = extract_mesh(field, resolution=64)
    _, missed = seen_part(mesh, Support(points.numpy(), within, seen=True))
    return 1 - missed, points.numpy()


def test_two_cameras_side_by_side_see_a_cap() -> None:
    """From distance d a sphere is seen where its normal is within acos(r / d) of the eye, (1 − r / d) / 2 of it."""
    eyes = [(0.02, 0.0, DISTANCE), (-0.02, 0.0, DISTANCE)]
    share, points = share_seen([photograph(eye) for eye in eyes])
    cap = (1 - RADIUS / DISTANCE) / 2
    # The rim: two pixels' width, of 40° / 120 at 1.5 to 2, and as much again by which the points end before it, and the
    # places in which views are counted; of a circle around a sphere, in units of its area.
    pixel = 2 * 2 * math.tan(math.radians(20)) / 120 * DISTANCE
    rim = 2 * math.pi * RADIUS * (pixel + 1 / 32) / (4 * math.pi * RADIUS**2)
    assert share == pytest.approx(cap, abs=rim)
    assert (points[:, 2] > RADIUS * RADIUS / DISTANCE - 1 / 32).all()


def test_what_one_camera_sees_alone_is_not_seen() -> None:
    ahead, behind = (0.0, 0.0, DISTANCE), (0.0, 0.0, -DISTANCE)
    _, points = share_seen([photograph(ahead), photograph((0.05, 0.0, DISTANCE)), photograph(behind)])
    assert (points[:, 2] > 0).all()
    _, points = share_seen([photograph(ahead)])  # but a single one is all that there is
    assert len(points) > 100


def test_pictures_of_few_pixels_meet_in_places_as_wide_as_those() -> None:
    few = [look_at((x, 0.0, DISTANCE), (0.0, 0.0, 0.0), fov=40, width=8, height=8) for x in (0.1, -0.1)]
    points, within = seen_points(Sphere(radius=RADIUS), [(camera, None) for camera in few])
    # A pixel at the nearest point and at the rim, twice, of 40° / 8: the diagonal of a place is longer than the shift
    # between the two pictures, so that most of their pixels share one.
    nearest, rim = DISTANCE - RADIUS, math.sqrt(DISTANCE**2 - RADIUS**2)
    pixel = 2 * 2 * math.tan(math.radians(20)) / 8
    assert pixel * nearest < within < 1.1 * pixel * rim
    assert len(points) > 8


def test_masks_say_what_of_it_is_the_object() -> None:
    eyes = [(0.02, 0.0, DISTANCE), (-0.02, 0.0, DISTANCE)]
    _, points = share_seen([photograph(eye, masked=True) for eye in eyes])
    # One half of what is in the picture, but for the cameras' distance: the middle of each sees 0.02 · r / d to a side.
    assert max((points[:, 0] > -0.02).mean(), (points[:, 0] < 0.02).mean()) == 1
    assert np.abs(points[:, 0]).max() > 0.4


def test_nothing_in_view_is_nothing_seen() -> None:
    aside = look_at((50.0, 0.0, 0.0), (100.0, 0.0, 0.0), fov=20, width=16, height=12)
    points, _ = seen_points(Sphere(radius=RADIUS), [(aside, None), (aside, None)])
    assert len(points) == 0


def test_the_part_that_was_seen() -> None:
    two = Union(Sphere(radius=0.2, center=(0.5, 0.0, 0.0)), Sphere(radius=0.2, center=(-0.5, 0.0, 0.0)))
    mesh = extract_mesh(two, resolution=64)
    right = mesh.vertices[mesh.vertices[:, 0] > 0].astype(np.float64)
    kept = thinned(right, seen_within=0.01)
    support = Support(kept["points"].double().numpy(), float(kept["seen_within"]), seen=True)
    part, missed = seen_part(mesh, support)
    assert part is not None
    assert missed == pytest.approx(0.5, abs=1e-3)
    assert (part.vertices[:, 0] > 0).all()
    assert len(part.faces) == len(mesh.faces) // 2
    assert seen_part(mesh, support._replace(points=np.array([[0.0, 0.0, 0.9]])))[0] is None


def test_other_runs_do_not_know(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_field(tmp_path / "field.safetensors", Sphere(radius=RADIUS))
    assert main(["mesh", str(tmp_path), "-o", str(tmp_path / "a.ply"), "--seen"]) == 2
    assert "--seen: " in capsys.readouterr().err
