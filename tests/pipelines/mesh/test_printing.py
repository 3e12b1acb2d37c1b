"""What a printer asks of a mesh, against shapes whose answers are known."""

import math

import numpy as np
import pytest
from mplicits.neural_fields import Box, FunctionField, Mesh, Similarity, Sphere, Torus, Union, extract_mesh
from mplicits.neural_fields.fields.similarity import Placement
from mplicits.pipelines.mesh.printing import format_report, print_report, thickness

# Points are moved to the surface until |f| < 1e-5; then float32, and bisection to a 2^16th of a step.
BOUND = 1.3e-5


def cylinder_distance(points):
    """A capped cylinder around z of radius 0.3 and height 1."""
    radial = points[..., :2].norm(dim=-1) - 0.3
    axial = points[..., 2].abs() - 0.5
    outside = (radial.clamp(min=0) ** 2 + axial.clamp(min=0) ** 2 + 1e-30).sqrt()
    return outside + radial.maximum(axial).clamp(max=0)


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


def test_a_slab_of_known_thickness_in_millimetres():
    """4 cm thick in a field whose unit is 2 m, written as STL: 80 mm."""
    field = Box(half_size=(0.5, 0.4, 0.02))
    mesh = extract_mesh(field, resolution=64)
    report = print_report(mesh, field, Similarity((7.0, 8.0, 9.0), 2.0), Placement("z", "m"), ".stl")
    assert report.unit == "mm"
    assert (report.thinnest, report.thin) == pytest.approx((80, 80), abs=2000 * BOUND)
    assert abs(abs(report.thinnest_at[2] - 9000) - 40) < 1  # on one of the two sides
    np.testing.assert_allclose(report.size, (2000, 1600, 80), rtol=0.04)  # a cell is 64 mm; corners are cut
    assert report.volume == pytest.approx(2000 * 1600 * 80, rel=0.08)
    assert "80 mm at (" in format_report(report)


def test_a_report_without_a_unit_and_of_an_open_mesh():
    field = Sphere(radius=0.5)
    mesh = extract_mesh(field, resolution=32)
    holed = Mesh(mesh.vertices, mesh.faces[5:])
    report = print_report(holed, field, Similarity.identity(), Placement(), ".ply")
    assert report.unit == "input units"
    assert not report.watertight
    assert "(input units)³" in format_report(report)
    assert report.thinnest == pytest.approx(1, abs=BOUND)


def test_volume_parts_and_normals_are_those_of_the_mesh_wherever_it_is():
    field = Union(Sphere(radius=0.5, center=(-0.4, 0, 0)), Sphere(radius=0.1, center=(0.6, 0, 0)))
    mesh = extract_mesh(field, resolution=64)
    far = Similarity((5e6, -4e5, 300.0), 3.0)
    report = print_report(mesh, field, far, Placement(), ".ply")
    assert (report.watertight, report.consistent, report.parts) == (True, True, 2)
    assert report.volume == pytest.approx(27 * 4 / 3 * math.pi * (0.5**3 + 0.1**3), rel=0.01)
    assert report.area == pytest.approx(9 * 4 * math.pi * (0.5**2 + 0.1**2), rel=0.01)
    inside_out = print_report(Mesh(mesh.vertices, mesh.faces[:, ::-1]), field, far, Placement(), ".ply")
    assert not inside_out.consistent
    with pytest.raises(ValueError, match="no faces"):
        print_report(Mesh(mesh.vertices, mesh.faces[:0]), field, far, Placement(), ".ply")
