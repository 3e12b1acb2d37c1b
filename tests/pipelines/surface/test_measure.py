"""Figures between surfaces, checked where the exact answer is known."""

import math

import numpy as np
import pytest
import trimesh
from mplicits.neural_fields import InputError, Mesh, Similarity
from mplicits.pipelines.surface import measure
from mplicits.pipelines.surface.measure import evaluate_files, evaluate_surfaces, overlap
from mplicits.pipelines.surface.raster import cover
from mplicits.pipelines.surface.surface import components, is_closed, read_surface, sample_points


def surface(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))


def sphere(radius: float = 1.0, subdivisions: int = 5) -> Mesh:
    return surface(trimesh.creation.icosphere(subdivisions, radius=radius))


def box(size: tuple[float, float, float] = (1.0, 1.0, 1.0), at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    return surface(trimesh.creation.box(size).apply_translation(at))


def square(height: float, *, side: float = 1.0) -> Mesh:
    corners = [(0.0, 0.0, height), (side, 0.0, height), (side, 1.0, height), (0.0, 1.0, height)]
    return Mesh(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]))


def joined(first: Mesh, second: Mesh) -> Mesh:
    vertices = np.concatenate((first.vertices, second.vertices))
    return Mesh(vertices, np.concatenate((first.faces, second.faces + len(first.vertices))))


def without_face(shape: Mesh, index: int = 0) -> Mesh:
    return Mesh(shape.vertices, np.delete(shape.faces, index, axis=0))


def test_concentric_spheres_have_the_exact_distances():
    inner, outer = 0.9, 1.0
    metrics = evaluate_surfaces(sphere(inner), sphere(outer), samples=20_000, columns=128)
    gap = (outer - inner) ** 2
    spacing = 4 * math.pi / 20_000  # mean squared distance to the nearest of 20 K samples is below this
    assert (metrics.accuracy, metrics.completeness) == pytest.approx((gap, gap), abs=spacing)
    assert metrics.chamfer == metrics.accuracy + metrics.completeness
    assert metrics.hausdorff == pytest.approx(gap, abs=25 * spacing)
    assert metrics.hausdorff > metrics.accuracy
    assert metrics.iou == pytest.approx((inner / outer) ** 3, abs=1e-3)
    assert metrics.normal_consistency == pytest.approx(1, abs=2e-3)
    assert (metrics.f_score, metrics.shell_iou) == (0, 0)
    assert (metrics.components, metrics.closed, metrics.notes) == (1, True, ())


def test_a_mesh_against_itself_scores_the_floor_and_no_less():
    shape = sphere(3.0)
    metrics = evaluate_surfaces(shape, shape, samples=20_000, columns=128)
    assert metrics.chamfer == pytest.approx(metrics.chamfer_floor, rel=0.1)
    # Of a uniform sampling with density ρ, the mean squared distance to the nearest sample is 1 / (π ρ), each way.
    assert metrics.chamfer_floor == pytest.approx(2 * 4 * math.pi / (math.pi * 20_000), rel=0.1)
    assert metrics.iou == 1
    within = 1 - math.exp(-20_000 / (4 * math.pi) * math.pi * metrics.threshold**2)  # some sample that near
    assert metrics.f_score == pytest.approx(within, abs=0.02)
    assert metrics.scale == pytest.approx(3.0)


def test_the_floor_does_not_depend_on_the_mesh():
    a = evaluate_surfaces(sphere(0.9, 3), box(), samples=2_000, columns=32)
    b = evaluate_surfaces(box(at=(0.3, 0, 0)), box(), samples=2_000, columns=32)
    assert a.chamfer_floor == b.chamfer_floor
    assert a.chamfer != b.chamfer


def test_figures_do_not_change_with_the_units_and_the_place_of_the_input():
    shapes = sphere(0.9, 3), sphere(1.0, 3)
    far = Similarity((-4e5, -5.2e6, -120.0), 1 / 40)
    here = evaluate_surfaces(*shapes, samples=2_000, columns=64)
    there = evaluate_surfaces(*(shape.moved(far) for shape in shapes), samples=2_000, columns=64)
    expected = (here.chamfer, here.iou, 40 * here.mean_distance)
    assert (there.chamfer, there.iou, there.mean_distance) == pytest.approx(expected, rel=1e-6)


def test_parallel_squares_are_as_far_apart_as_their_gap():
    metrics = evaluate_surfaces(square(0.5), square(0.0), samples=20_000, columns=32)
    radius = math.sqrt(0.5)
    assert metrics.scale == pytest.approx(radius)
    assert metrics.chamfer == pytest.approx(2 * (0.5 / radius) ** 2, rel=1e-3)
    assert metrics.mean_distance == pytest.approx(0.5, rel=1e-3)
    assert metrics.iou is None
    assert "not closed" in metrics.notes[0]


def test_chamfer_and_shell_iou_of_points_by_hand():
    a, b = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 2]])
    assert measure.chamfer(a, b) == ((4 + 5) / 2, 4.0)
    cells = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [1.6, 0.5, 0.5]])
    assert measure.shell_iou(cells, cells[:1], voxel=1.0) == 1 / 2
    assert measure.shell_iou(cells, cells, voxel=0.3) == 1


def test_the_f_score_is_the_harmonic_mean_of_precision_and_recall():
    far = box((0.1, 0.1, 0.1), (3, 0, 0))
    metrics = evaluate_surfaces(joined(box(), far), box(), samples=20_000, threshold=0.05, columns=32)
    precision = 6 / (6 + 6 * 0.01)  # share of the area that lies on the reference; recall is 1
    assert metrics.f_score == pytest.approx(2 * precision / (precision + 1), abs=2e-3)
    assert metrics.components == 2


def test_volume_of_boxes_is_that_of_their_sides():
    volumes = overlap(box(), box(at=(0.5, 0.25, 0.0)), columns=256)
    found = (volumes.first, volumes.intersection, volumes.union)
    assert found == pytest.approx((1, 0.5 * 0.75, 2 - 0.5 * 0.75), rel=0.01)
    assert volumes.broken == 0


@pytest.mark.parametrize("columns", [1, 7, 64, 300])
def test_columns_through_edges_and_vertices_are_never_broken(columns):
    fine = sphere(1.0, 4)
    rounded = Mesh(np.round(fine.vertices * 20) / 20, fine.faces)  # many faces edge-on to the axes, many ties
    assert overlap(rounded, box((2, 2, 2)), columns=columns).broken == 0


def test_overlapping_parts_of_one_mesh_and_bubbles_in_it_are_told_apart():
    twice = joined(box(), box(at=(0.25, 0, 0)))  # wound twice in the middle: still inside
    assert overlap(twice, twice, columns=128).first == pytest.approx(1.25, rel=0.01)
    bubble = box((0.5, 0.5, 0.5))
    hollow = joined(box(), Mesh(bubble.vertices, bubble.faces[:, ::-1]))
    assert overlap(hollow, hollow, columns=128).first == pytest.approx(1 - 0.125, rel=0.01)


def test_a_small_hole_costs_columns_but_not_the_iou():
    holed = without_face(sphere(1.0, 4))
    metrics = evaluate_surfaces(holed, sphere(1.0, 4), samples=1_000, columns=256)
    assert metrics.iou == pytest.approx(1, abs=1e-9)
    assert not metrics.closed
    assert "not closed: the mesh" in metrics.notes[0]


def test_weights_of_columns_are_barycentric():
    xy = np.array([[0.5, 0.5], [8.5, 0.5], [0.5, 8.5]])
    (found,) = cover(xy, np.array([[0, 1, 2]]), (10, 10))
    i, j = found.column // 10, found.column % 10
    np.testing.assert_allclose(found.weights @ xy, np.stack((i, j), axis=1), atol=1e-12)


@pytest.mark.parametrize("places", ["anywhere", "columns", "far", "in line"])
def test_columns_are_those_that_a_test_of_all_finds(places):
    """Between the two edges that a line crosses lies every column that the test of all three sides would take."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(-5, 40, (60, 2))
    if places == "columns":
        xy = np.round(2 * xy) / 2
    elif places == "far":
        xy *= rng.choice([1, 1e5, 1e9], (60, 1))
    elif places == "in line":
        xy[:, 1] = 3 * xy[:, 0] + rng.uniform(-1e-14, 1e-14, 60)
    faces = np.stack([rng.permutation(60)[:3] for _ in range(80)])
    parts = list(cover(xy, faces, (32, 40)))
    found = {(f, c, s) for part in parts for f, c, s in zip(part.face, part.column, part.sign, strict=True)}

    i, j = np.meshgrid(np.arange(32), np.arange(40), indexing="ij")
    expected = set()
    for number, face in enumerate(faces):
        left = []
        for a, b in zip(face, np.roll(face, -1), strict=True):
            first, along = xy[min(a, b)], xy[max(a, b)] - xy[min(a, b)]
            left.append((along[0] * (j - first[1]) - along[1] * (i - first[0]) > 0) == (a < b))
        low, high = xy[face].min(axis=0), xy[face].max(axis=0)
        box = (low[0] <= i) & (i <= high[0]) & (low[1] <= j) & (j <= high[1])
        for sign, hit in ((1, np.all(left, axis=0)), (-1, ~np.any(left, axis=0))):
            expected |= {(number, c, sign) for c in np.flatnonzero(hit & box)}
    assert found == expected
    assert len(expected) > 20 or places == "in line"


def test_components_and_closedness():
    two = joined(box(), box(at=(3, 0, 0)))
    assert components(two) == 2
    assert is_closed(two)
    assert not is_closed(without_face(two))
    soup = Mesh(two.vertices[two.faces].reshape(-1, 3), np.arange(3 * len(two.faces)).reshape(-1, 3))
    assert components(soup) == 2
    assert is_closed(soup)
    assert len(soup.merged.vertices) == 16
    assert not is_closed(Mesh(two.vertices, np.concatenate((two.faces[:1, ::-1], two.faces[1:]))))


def test_samples_are_uniform_by_area():
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [4, 1, 0], [0, 1, 0], [1, 0, 0]])
    uneven = Mesh(corners, np.array([[0, 4, 3], [4, 1, 2], [4, 2, 3]], np.int64))
    points, normals = sample_points(uneven, 100_000, np.random.default_rng(0))
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=(8, 4), range=((0, 4), (0, 1)))
    assert abs(counts / 100_000 * 32 - 1).max() < 0.1
    np.testing.assert_array_equal(normals, np.broadcast_to([0.0, 0, 1], normals.shape))


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off", "glb"])
def test_meshes_are_read_whole_from_every_kind_of_file(tmp_path, suffix):
    shape = box()
    trimesh.Trimesh(shape.vertices, shape.faces, process=False).export(tmp_path / f"box.{suffix}")
    read = read_surface(tmp_path / f"box.{suffix}")
    assert len(read.faces) == 12
    assert components(read) == 1
    assert is_closed(read)
    assert overlap(read, shape, columns=64).intersection == pytest.approx(1, rel=0.02)


def test_a_cloud_may_be_the_reference_but_not_the_mesh(tmp_path):
    mesh, cloud = tmp_path / "mesh.ply", tmp_path / "cloud.xyz"
    shape = sphere(1.0, 4)
    trimesh.Trimesh(shape.vertices, shape.faces, process=False).export(mesh)
    np.savetxt(cloud, sample_points(shape, 5_000, np.random.default_rng(0))[0])
    metrics = evaluate_files(mesh, cloud, samples=2_000)
    assert (metrics.chamfer_floor, metrics.iou, metrics.normal_consistency) == (None, None, None)
    assert metrics.chamfer < 0.01
    with pytest.raises(InputError, match="holds points but no faces"):
        evaluate_files(cloud, mesh)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.ply", None, "no such file"),
        ("broken.ply", b"ply\nformat nonsense", "end_header is missing"),
        ("broken.glb", b"not a glb at all", "cannot be read as a GLB mesh"),
        ("index.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "index.obj"),
        ("point.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "all vertices coincide"),
        ("nan.off", b"OFF\n3 1 0\n0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n", "not a finite number"),
    ],
)
def test_unusable_files_are_one_line(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_surface(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)


def test_what_no_photograph_sees_does_not_count():
    """Half of a square is missing, and no photograph has seen that half."""

    truth, half, counted = square(3.0), square(3.0, side=0.5), []

    def view_counts(mesh: Mesh, points: np.ndarray) -> np.ndarray:
        assert mesh is truth
        counted.append(points)
        return np.where(points[:, 0] < 0.49, 1, 0)

    metrics = evaluate_surfaces(half, truth, samples=4000, view_counts=view_counts)
    assert np.allclose(counted[0][:, 2], 3.0)  # in the reference's own coordinates
    assert metrics.visible.share == pytest.approx(0.49, abs=0.03)
    # The missing half is up to 1/2 away, in units of the square's radius 1/√2: half has a mean of 2 (1/2)² / 3.
    assert metrics.completeness == pytest.approx(0.5 * 0.5**2 / 3 * 2, rel=0.1)
    # Samples of half a square are twice as dense as those of a whole one, so both are within two of its floors.
    found, floors = metrics.visible.distances, metrics.visible.floors
    assert found.accuracy < 1.5 * floors.accuracy
    assert found.completeness < 1.5 * floors.completeness
    assert found.overall == pytest.approx((found.accuracy + found.completeness) / 2)
    whole = evaluate_surfaces(half, truth, samples=4000, view_counts=lambda _, points: np.ones(len(points), int))
    # Where one photograph sees the rest too: its mean distance is 1/4, in the square's own units.
    assert whole.visible.share == 1
    assert whole.visible.distances.completeness == pytest.approx(0.5 * 0.25, rel=0.1)
    unseen = evaluate_surfaces(half, truth, samples=100, view_counts=lambda _, points: np.zeros(len(points), int))
    assert unseen.visible.distances == measure.Distances(None, None, None)
    assert "where a photograph sees" in measure.format_metrics(metrics)
    with pytest.raises(ValueError, match="view_counts"):
        evaluate_surfaces(truth, Mesh(truth.vertices, truth.faces[:0]), samples=10, view_counts=view_counts)
