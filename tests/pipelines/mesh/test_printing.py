"""What a printer asks of a mesh, against shapes whose answers are known."""

import math

import numpy as np
import pytest
import trimesh
from mplicits.neural_fields import Box, FunctionField, Mesh, Similarity, Sphere, Torus, extract_mesh
from mplicits.neural_fields.meshing.placement import Placement
from mplicits.pipelines.mesh.printing import format_report, overhang, print_report, shells, thickness
from mplicits.pipelines.surface.surface import Surface

# Points are moved to the surface until |f| < 1e-5; then float32, and bisection to a 2^16th of a step.
BOUND = 1.3e-5


def surface(mesh):
    return Surface(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def cylinder_distance(points):
    """A capped cylinder around z of radius 0.3 and height 1."""
    radial = points[..., :2].norm(dim=-1) - 0.3
    axial = points[..., 2].abs() - 0.5
    outside = (radial.clamp(min=0) ** 2 + axial.clamp(min=0) ** 2 + 1e-30).sqrt()
    return outside + radial.maximum(axial).clamp(max=0)


# --- shells ------------------------------------------------------------------------------------------


def test_a_box_has_its_volume_and_area():
    found = shells(surface(trimesh.creation.box((2.0, 3.0, 4.0))))
    assert found.volume == pytest.approx(24, rel=1e-12)
    assert found.area == pytest.approx(52, rel=1e-12)
    assert (found.parts, found.cavities, found.open_edges, found.turned_edges) == (1, 0, 0, 0)
    assert found.watertight


def test_parts_hollows_and_holes_are_counted():
    outer, other = trimesh.creation.box((2, 2, 2)), trimesh.creation.box((1, 1, 1)).apply_translation((9, 0, 0))
    hollow = trimesh.creation.box((1, 1, 1))
    hollow.invert()
    whole = surface(trimesh.util.concatenate([outer, other, hollow]))
    found = shells(whole)
    assert (found.parts, found.cavities) == (2, 1)
    assert found.volume == pytest.approx(8 + 1 - 1)
    holed = shells(Surface(whole.vertices, whole.faces[1:]))  # a triangle is missing: three edges are open
    assert (holed.open_edges, holed.watertight, holed.turned_edges) == (3, False, 0)
    turned = whole.faces.copy()
    turned[0] = turned[0, ::-1]
    contradicted = shells(Surface(whole.vertices, turned))
    assert (contradicted.open_edges, contradicted.turned_edges) == (3, 3)
    with pytest.raises(ValueError, match="no faces"):
        shells(Surface(whole.vertices, whole.faces[:0]))


def test_volume_is_exact_far_from_the_origin():
    far = trimesh.creation.box((2.0, 3.0, 4.0)).apply_translation((5e6, -4e5, 300))
    assert shells(surface(far)).volume == pytest.approx(24, rel=1e-8)  # coordinates have 1e-9 left


# --- thickness ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "points", "expected"),
    [
        (Sphere(radius=0.5), [[0.3, 0.4, 0.0], [0.0, 0.0, 0.5]], [1.0, 1.0]),
        (Box(half_size=(0.6, 0.5, 0.02)), [[0.1, 0.2, 0.02], [0.6, 0.1, 0.0], [0.599, 0.0, 0.02]], [0.04, 1.2, 0.04]),
        (Torus(major=0.5, minor=0.1), [[0.6, 0.0, 0.0], [0.5, 0.0, 0.1]], [0.2, 0.2]),
        (
            FunctionField(cylinder_distance),
            [[0.3, 0.0, 0.1], [0.0, 0.1, 0.5], [0.2, 0.2236068, 0.499]],
            [0.6, 1.0, 0.6],
        ),
    ],
)
def test_thickness_is_straight_through(field, points, expected):
    points = np.array(points)
    np.testing.assert_allclose(thickness(field, points).depth, expected, atol=BOUND)


def test_what_is_thinner_than_the_first_step_is_found_and_what_has_no_other_side_is_not():
    thin = Box(half_size=(0.5, 0.5, 2e-4))  # 4e-4 thick; the first step is 1e-3
    np.testing.assert_allclose(thickness(thin, np.array([[0.0, 0.0, 2e-4]])).depth, 4e-4, atol=BOUND)
    half_space = FunctionField(lambda points: points[..., 2])
    assert thickness(half_space, np.array([[0.1, 0.0, 0.0]])).depth[0] == math.inf
    nothing = FunctionField(lambda points: 1 + 0 * points[..., 2] + (points**2).sum(dim=-1))
    assert np.isnan(thickness(nothing, np.array([[0.1, 0.0, 0.0]])).depth[0])


# --- overhang ----------------------------------------------------------------------------------------


def test_overhang_of_a_table():
    """A plate of 4 × 2 at a height of 3, on a leg of 1 × 1: all but the leg's square hangs over."""
    leg = trimesh.creation.box(bounds=[(0, 0, 0), (1, 1, 3)])
    plate = trimesh.creation.box(bounds=[(-1, 0, 3), (3, 2, 3.5)])
    area, volume = overhang(surface(trimesh.util.concatenate([leg, plate])), 2)
    assert area == pytest.approx(8)  # two solids that touch: the leg's own square counts as under the plate
    assert volume == pytest.approx(8 * 3)
    assert overhang(surface(leg), 2) == (0.0, 0.0)  # what stands on the plate hangs over nothing


def test_overhang_begins_at_45_degrees():
    """Square funnels, upside-down pyramids: walls of slope 1.1 stand, of slope 0.9 hang over."""
    for slope, hangs in ((1.1, False), (0.9, True)):
        corners = [(0, 0, 0), (1, 1, slope), (-1, 1, slope), (-1, -1, slope), (1, -1, slope)]
        faces = [(0, 2, 1), (0, 3, 2), (0, 4, 3), (0, 1, 4), (1, 2, 3), (1, 3, 4)]
        cone = Surface(np.array(corners, np.float64) + np.array([0, 0, 1.0]), np.array(faces))
        base = trimesh.creation.box(bounds=[(-0.1, -0.1, 0), (0.1, 0.1, 1)])
        both = trimesh.util.concatenate([trimesh.Trimesh(cone.vertices, cone.faces, process=False), base])
        area, volume = overhang(surface(both), 2)
        assert (area > 0) == hangs
        if hangs:  # the walls: 4 m² seen from below, at heights from 1 to 1.9, on average 1 + 0.9 · 2/3
            assert area == pytest.approx(4 * math.hypot(1, slope))
            assert volume == pytest.approx(4 * (1 + 0.9 * 2 / 3))


# --- the report --------------------------------------------------------------------------------------


def test_a_slab_of_known_thickness_in_millimetres():
    """4 cm thick in a field whose unit is 2 m, written as STL: 80 mm."""
    field = Box(half_size=(0.5, 0.4, 0.02))
    mesh = extract_mesh(field, resolution=64)
    report = print_report(mesh, field, Similarity((7.0, 8.0, 9.0), 2.0), Placement("z", "m"), ".stl")
    assert report.unit == "mm"
    assert report.thinnest == pytest.approx(80, abs=2000 * BOUND)
    assert report.thin == pytest.approx(80, abs=2000 * BOUND)
    assert report.thinnest_at is not None
    assert abs(abs(report.thinnest_at[2] - 9000) - 40) < 1  # on one of the two sides
    np.testing.assert_allclose(report.size, (2000, 1600, 80), rtol=0.04)  # a cell is 64 mm; corners are cut
    assert report.shells.volume == pytest.approx(2000 * 1600 * 80, rel=0.08)
    text = format_report(report)
    assert "80 mm at (" in text
    assert "mm³" in text
    assert "agree, and point outward" in text


def test_a_report_without_a_unit_and_of_an_open_mesh():
    field = Sphere(radius=0.5)
    mesh = extract_mesh(field, resolution=32)
    holed = Mesh(mesh.vertices, mesh.faces[5:])
    report = print_report(holed, field, Similarity.identity(), Placement(), ".ply")
    assert report.unit == "input units"
    assert not report.shells.watertight
    text = format_report(report)
    assert "NO: " in text
    assert "not to be trusted" in text
    assert "(input units)³" in text
    assert report.thinnest == pytest.approx(1, abs=BOUND)
