import numpy as np
import pytest
from mplicits.neural_fields import InputError, Sphere, Union
from mplicits.neural_fields.meshing.extract import Mesh, extract_mesh
from mplicits.pipelines.surface import surface
from mplicits.pipelines.surface.surface import drop_unsupported, face_normals, keep_faces, keep_largest, trim_distance


@pytest.fixture(scope="module")
def two():
    small, large = Sphere(radius=0.15, center=(-0.6, 0, 0)), Sphere(radius=0.4, center=(0.3, 0, 0))
    return extract_mesh(Union(small, large), resolution=40)


def test_keep_largest_keeps_the_larger_sphere_whole(two):
    large = keep_largest(two)
    alone = extract_mesh(Sphere(radius=0.4, center=(0.3, 0, 0)), resolution=40)
    assert len(large.faces) == len(alone.faces)
    assert face_normals(large)[1].sum() == pytest.approx(4 * np.pi * 0.16, rel=0.02)
    assert np.abs(np.linalg.norm(large.vertices - [0.3, 0, 0], axis=1) - 0.4).max() < 1e-4
    assert np.abs(large.normals - (large.vertices - [0.3, 0, 0]) / 0.4).max() < 0.02
    assert np.array_equal(np.unique(large.faces), np.arange(len(large.vertices)))


def test_keep_largest_goes_by_area_not_by_count():
    fan = np.array([[5 + 0.1 * np.cos(t), 0.1 * np.sin(t), 0] for t in np.linspace(0, 1, 9)])
    vertices = np.concatenate(([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0]], fan))
    faces = np.array([[0, 1, 2], *[[3, 4 + k, 5 + k] for k in range(8)]], np.int32)
    assert np.array_equal(keep_largest(Mesh(vertices, faces)).vertices, vertices[:3])


def test_keep_faces_carries_normals_and_colors(two):
    colored = Mesh(two.vertices, two.faces, two.normals, np.zeros_like(two.normals))
    kept = keep_faces(colored, np.arange(len(two.faces)) < 5)
    assert len(kept.faces) == 5
    assert len(kept.vertices) == len(kept.normals) == len(kept.colors)
    assert np.array_equal(kept.vertices[kept.faces], two.vertices[two.faces[:5]])


def test_trim_distance_keeps_what_is_near(two):
    trimmed = trim_distance(two, np.array([[0.7, 0.0, 0.0]]), 0.3)
    away = np.linalg.norm(two.vertices - [0.7, 0, 0], axis=1)
    assert len(trimmed.faces) == (away[two.faces] <= 0.3).all(axis=1).sum() > 0
    assert np.linalg.norm(trimmed.vertices - [0.7, 0, 0], axis=1).max() <= 0.3
    assert len(trim_distance(two, two.vertices, 1e-9).faces) == len(two.faces)


def test_trim_distance_never_gives_an_empty_mesh(two):
    with pytest.raises(InputError, match="--trim-distance: none of"):
        trim_distance(two, np.array([[9.0, 9.0, 9.0]]), 0.1)
    with pytest.raises(ValueError, match=r"distance=0\.0"):
        trim_distance(two, two.vertices, 0.0)


def test_voids_are_dropped_and_what_is_solid_or_open_stays(two):
    void = extract_mesh(Sphere(radius=0.2, center=(0.3, 0, 0)), resolution=40)
    count = len(two.vertices)
    both = Mesh(np.concatenate((two.vertices, void.vertices)), np.concatenate((two.faces, void.faces[:, ::-1] + count)))
    solid = surface.without_voids(both)
    assert len(solid.faces) == len(two.faces)
    assert np.array_equal(solid.vertices, two.vertices)
    opened = keep_faces(both, np.arange(len(both.faces)) > len(two.faces))  # the void's wall with one face missing
    assert len(surface.without_voids(opened).faces) == len(void.faces) - 1


def test_the_region_is_the_unit_sphere():
    corner = Sphere(radius=0.2, center=(0.8, 0.8, 0.8))
    mesh = extract_mesh(Union(Sphere(radius=0.5), corner), resolution=32)
    kept = surface.in_region(mesh)
    assert len(kept.faces) < len(mesh.faces)
    assert np.linalg.norm(kept.vertices, axis=1).max() < 0.6
    assert surface.in_region(extract_mesh(corner, resolution=32)) is None


def on_sphere(count, radius, center):
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return center + radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_a_blob_without_points_goes_and_a_second_part_stays(two):
    blob = extract_mesh(Sphere(radius=0.1, center=(0.3, 0.8, 0)), resolution=40)
    count = len(two.vertices)
    mesh = Mesh(np.concatenate((two.vertices, blob.vertices)), np.concatenate((two.faces, blob.faces + count)))
    points = np.concatenate((on_sphere(300, 0.15, [-0.6, 0, 0]), on_sphere(2000, 0.4, [0.3, 0, 0])))
    left = drop_unsupported(mesh, points)
    assert left.dropped == 1
    assert np.array_equal(left.mesh.vertices, two.vertices)
    assert left.area == pytest.approx(face_normals(blob)[1].sum() / face_normals(mesh)[1].sum())
    stray = np.concatenate((points, [[0.3, 0.9, 0.0]]))  # one point on a blob does not make it a part
    assert drop_unsupported(mesh, stray, radius=0.02).dropped == 1
    assert drop_unsupported(mesh, stray).dropped == 1  # although all of it lies near that point
    few = np.concatenate((points, on_sphere(12, 0.1, [0.3, 0.8, 0])))
    assert drop_unsupported(mesh, few).dropped == 0
    whole = drop_unsupported(two, points)
    assert (whole.dropped, whole.mesh is two) == (0, True)


def test_a_part_with_a_few_of_its_sides_measured_stays(two):
    points = on_sphere(4000, 0.4, [0.3, 0, 0])
    seen = points[points[:, 2] > 0.3]  # a cap of an eighth of the area
    left = drop_unsupported(two, seen)
    assert left.dropped == 1
    assert len(left.mesh.faces) == len(keep_largest(two).faces)


def test_points_that_belong_elsewhere_remove_nothing(two):
    assert drop_unsupported(two, np.full((3, 3), 9.0) + np.eye(3)).mesh is two
    with pytest.raises(ValueError, match="points"):
        drop_unsupported(two, np.empty((0, 3)))
    with pytest.raises(ValueError, match="radius"):
        drop_unsupported(two, two.vertices, radius=0.0)


def test_support_radius_holds_spacing_and_error():
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    assert surface.support_radius(grid) == pytest.approx(3.0)
    assert surface.support_radius(grid, error=2.0) == pytest.approx(3 * np.hypot(1.0, 2.0))
