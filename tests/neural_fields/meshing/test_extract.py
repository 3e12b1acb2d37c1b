import itertools
import math

import numpy as np
import pytest
import torch
from closed import assert_closed, directed_edges
from fields import Scaled
from mplicits.neural_fields import Box, Capsule, FunctionField, Jet, MultiscaleSDF, Plane, Siren, Sphere, Torus, Union
from mplicits.neural_fields.fields.field import OneLevelField
from mplicits.neural_fields.meshing._cells import CORNERS, Lattice
from mplicits.neural_fields.meshing.extract import Mesh, NoSurfaceError, extract_mesh, map_normals

UNIT = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class Tabulated(OneLevelField):
    """Values at the points of a lattice over UNIT."""

    def __init__(self, values):
        super().__init__()
        self.register_buffer("table", values)

    def value(self, x, *, level=-1):
        self.resolve_level(level)
        cells = torch.tensor(self.table.shape) - 1
        i, j, k = ((x + 1) / 2 * cells).round().long().unbind(-1)
        return self.table[i.clamp(0, cells[0]), j.clamp(0, cells[1]), k.clamp(0, cells[2])]

    def jet(self, x, *, level=-1):
        value = self.value(x, level=level)
        return Jet(torch.zeros_like(value), torch.ones_like(x), x.new_empty((*x.shape[:-1], 0)))


def assert_clean(mesh: Mesh):
    """Shared vertices are merged, all are used, and no face is degenerate."""
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert np.array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    p = mesh.vertices[mesh.faces]
    assert np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).min() > 0


def volume(mesh: Mesh):
    p = mesh.vertices[mesh.faces]
    return (np.cross(p[:, 0], p[:, 1]) * p[:, 2]).sum() / 6


def euler(mesh: Mesh):
    return len(mesh.vertices) - len(directed_edges(mesh)[0]) // 2 + len(mesh.faces)


def dense_values(field, resolution, bounds, level=-1):
    lattice = Lattice.over(bounds, resolution)
    index = np.stack(np.indices([n + 1 for n in lattice.shape]), -1)
    x = torch.from_numpy(lattice.positions(index.reshape(-1, 3))).to(field.like)
    return field.value(x, level=level).reshape(index.shape[:-1]).numpy()


def crossings(values):
    """How many cells of a dense grid have corners of both signs, and how many of its edges."""
    inside = values < 0
    i, j, k = np.array(inside.shape) - 1
    corners = [inside[a : i + a, b : j + b, c : k + c] for a, b, c in CORNERS]
    cells = int((np.any(corners, axis=0) & ~np.all(corners, axis=0)).sum())
    return cells, sum(int((np.diff(inside.astype(np.int8), axis=axis) != 0).sum()) for axis in range(3))


SMALL = Sphere(radius=0.3, center=(-0.5, 0, 0))
SHAPES = {
    "sphere": (Sphere(radius=0.7), 4 / 3 * math.pi * 0.7**3, 2),
    "torus": (Torus(major=0.5, minor=0.2), 2 * math.pi**2 * 0.5 * 0.2**2, 0),
    "box": (Box(half_size=(0.4, 0.3, 0.5)), 8 * 0.4 * 0.3 * 0.5, 2),
    "capsule": (Capsule(radius=0.2), math.pi * 0.2**2 * 0.8 + 4 / 3 * math.pi * 0.2**3, 2),
    "two": (Union(SMALL, Box(half_size=(0.2,) * 3, center=(0.5, 0.1, 0))), 4 / 3 * math.pi * 0.3**3 + 0.4**3, 4),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("resolution", [32, 63, 100])
def test_shapes_are_closed_outward_and_on_the_surface(name, resolution):
    field, expected, characteristic = SHAPES[name]
    mesh = extract_mesh(field, resolution=resolution)
    step = 2.04 / resolution
    assert_closed(mesh)
    assert_clean(mesh)
    assert volume(mesh) == pytest.approx(expected, rel=0.15 if resolution == 32 else 0.06)
    assert euler(mesh) == characteristic
    distance = field.value(torch.from_numpy(mesh.vertices)).abs().numpy()
    # Across the corners and edges of a box a lattice edge can run obliquely; half a cell is the certain bound.
    assert distance.max() < (0.05 if name in ("sphere", "capsule", "torus") else 0.5) * step
    assert np.median(distance) < 1e-3 * step


def test_volume_converges_quadratically():
    errors = [volume(extract_mesh(Sphere(radius=0.7), resolution=n)) - SHAPES["sphere"][1] for n in (32, 64, 128)]
    assert [errors[0] / errors[1], errors[1] / errors[2]] == pytest.approx([4, 4], rel=0.15)


def test_normals_are_the_gradient():
    mesh = extract_mesh(Sphere(radius=0.6, center=(0.1, 0.0, -0.1)), resolution=48)
    radial = mesh.vertices - [0.1, 0.0, -0.1]
    assert mesh.normals.dtype == np.float32
    assert np.abs(mesh.normals - radial / 0.6).max() < 5e-3
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-6
    p = mesh.vertices[mesh.faces]
    facing = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert ((facing * mesh.normals[mesh.faces[:, 0]]).sum(axis=1) > 0).all()


def test_normals_of_a_finer_level_on_a_coarse_mesh():
    torch.manual_seed(0)
    field = MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0, output_gain=0.1)], [0.2]).double()
    coarse = extract_mesh(field, resolution=24, level=0)
    mapped = map_normals(coarse, field, level=1, batch=100)
    assert mapped.vertices is coarse.vertices
    assert mapped.normals.dtype == np.float32
    gradient = field.jet(torch.from_numpy(coarse.vertices), level=1).gradient
    expected = torch.nn.functional.normalize(gradient, dim=-1).detach().numpy()
    np.testing.assert_allclose(mapped.normals, expected, atol=1e-6)
    assert np.abs(mapped.normals - coarse.normals).max() > 0.03
    np.testing.assert_allclose(map_normals(coarse, field, level=0).normals, coarse.normals, atol=0.01)


def test_without_normals_vertices_are_interpolated():
    mesh = extract_mesh(Sphere(radius=0.6), resolution=32, normals=False)
    refined = extract_mesh(Sphere(radius=0.6), resolution=32)
    assert mesh.normals is None
    assert np.array_equal(mesh.faces, refined.faces)
    off = [np.abs(np.linalg.norm(m.vertices, axis=1) - 0.6).max() for m in (mesh, refined)]
    assert 1e-5 < off[0] < 0.05 * 2.04 / 32
    assert off[1] < 0.1 * off[0]


def ripple(amplitude, k):
    return FunctionField(lambda x: amplitude * (k * x).sin().prod(-1))


def rippled(taper):
    return MultiscaleSDF(Sphere(radius=0.6), [ripple(0.02, 12.0), ripple(0.006, 40.0)], [0.05, 0.02], taper=taper)


DENSE = {name: (shape[0], 1.0001, (40, 64, 65)) for name, shape in SHAPES.items()}
DENSE |= {f"rippled {taper}": (rippled(taper), 1.5, (64, 100, 130)) for taper in (0.0, 0.5)}


@pytest.mark.parametrize("name", DENSE)
def test_same_crossings_as_dense_evaluation(name):
    field, lipschitz, resolutions = DENSE[name]
    for resolution, level in itertools.product(resolutions, range(field.num_levels)):
        mesh = extract_mesh(field, resolution=resolution, level=level, lipschitz=lipschitz)
        values = dense_values(field, resolution, ((-1.02,) * 3, (1.02,) * 3), level)
        assert (mesh.stats.cells, len(mesh.vertices)) == crossings(values)
        assert_closed(mesh)
        assert not any(mesh.stats.points[level + 1 :])


def test_evaluations_grow_with_the_surface():
    spent = []
    for resolution in (64, 128, 256):
        mesh = extract_mesh(Torus(), resolution=resolution, normals=False)
        spent.append(sum(mesh.stats.points))
        # All in all, few points for each vertex of the mesh: nothing like the 64³ … 256³ of the box.
        assert spent[-1] < (10 if resolution == 64 else 4) * len(mesh.vertices)
    assert max(spent[1] / spent[0], spent[2] / spent[1]) < 4.5


@pytest.mark.parametrize("seed", range(4))
def test_any_pattern_of_signs_gives_a_closed_surface(seed):
    """Random signs meet all 256 cases and every pair of ambiguous faces."""
    torch.manual_seed(seed)
    table = torch.rand(17, 17, 17) + 0.1
    table[1:-1, 1:-1, 1:-1] *= 2 * torch.randint(2, (15, 15, 15)) - 1
    mesh = extract_mesh(Tabulated(table), resolution=16, bounds=UNIT, lipschitz=100.0)
    assert_closed(mesh)
    assert_clean(mesh)
    assert volume(mesh) > 0


def test_values_of_exactly_zero_leave_no_crack_and_no_sliver():
    """Faces of the box lie exactly on lattice planes: whole sheets of points have f = 0."""
    mesh = extract_mesh(Box(half_size=(0.5, 0.25, 0.75)), resolution=16, bounds=UNIT)
    assert_closed(mesh)
    assert_clean(mesh)
    assert np.abs(mesh.vertices).max(axis=0) == pytest.approx([0.5, 0.25, 0.75], abs=2e-3 * 2 / 16)
    padded = torch.ones(11, 11, 11)
    padded[1:-1, 1:-1, 1:-1] = torch.randint(-1, 2, (9, 9, 9))
    random = extract_mesh(Tabulated(padded), resolution=10, bounds=UNIT, lipschitz=100.0)
    assert_closed(random)
    assert_clean(random)


def test_thin_parts_are_kept():
    plate = Box(half_size=(0.6, 0.6, 0.012))
    wire = Capsule(start=(-0.7, 0.0, 0.5), end=(0.7, 0.1, 0.55), radius=0.015)
    mesh = extract_mesh(Union(plate, wire), resolution=128)
    assert_closed(mesh)
    assert euler(mesh) == 4
    assert np.abs(mesh.vertices[:, 0]).max() > 0.7


def test_surface_steeper_than_the_bound_is_still_closed():
    mesh = extract_mesh(Scaled(Torus(), 3.0), resolution=64, lipschitz=1.0)
    assert_closed(mesh)
    assert euler(mesh) == 0
    assert len(mesh.vertices) == len(extract_mesh(Torus(), resolution=64).vertices)


def test_surface_leaving_the_box_is_open_there_only():
    bounds = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    mesh = extract_mesh(Plane(normal=(0.1, 0.2, 1.0), offset=0.03), resolution=20, bounds=bounds)
    a, b = directed_edges(mesh)
    count = len(mesh.vertices)
    rim = ~np.isin(a * count + b, b * count + a)
    assert rim.any()
    assert (np.abs(mesh.vertices[a[rim]]).max(axis=1) > 0.5 - 1e-9).all()
    assert np.abs(mesh.vertices).max() <= 0.5 + 1e-9


def test_box_of_unequal_sides():
    bounds = ((-0.3, -0.7, -0.5), (0.4, 0.6, 0.35))
    mesh = extract_mesh(Sphere(radius=0.25), resolution=50, bounds=bounds)
    assert_closed(mesh)
    assert volume(mesh) == pytest.approx(4 / 3 * math.pi * 0.25**3, rel=0.02)


def test_float64_field_is_exact_to_float64():
    mesh = extract_mesh(Plane(normal=(0, 0, 1), offset=0.1).double(), resolution=16, bounds=UNIT)
    assert np.abs(mesh.vertices[:, 2] - 0.1).max() < 1e-15


def test_batches_do_not_change_the_mesh():
    whole, parts = (extract_mesh(SHAPES["two"][0], resolution=48, batch=batch) for batch in (2**20, 1000))
    assert np.array_equal(whole.faces, parts.faces)
    assert np.abs(whole.vertices - parts.vertices).max() < 1e-6
    assert whole.stats.points == parts.stats.points


def test_not_finite_is_an_error():
    table = torch.ones(17, 17, 17)
    table[3, 4, 5] = -1.0
    table[4, 4, 5] = torch.nan
    with pytest.raises(ValueError, match="not finite at 1 of"):
        extract_mesh(Tabulated(table), resolution=16, bounds=UNIT, lipschitz=100.0)


FAR = Sphere(radius=0.2, center=(5.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("field", "words"), [(FAR, "positive"), (Scaled(FAR, -1.0), "negative"), (Sphere(radius=0.004), "no surface")]
)
def test_no_surface_says_where_the_signs_are(field, words):
    with pytest.raises(NoSurfaceError, match=words) as error:
        extract_mesh(field, resolution=33)
    assert "\n" not in str(error.value)


def test_progress_is_told_every_batch():
    told = []
    extract_mesh(Sphere(), resolution=64, batch=5000, progress=lambda *what: told.append(what))
    assert all(0 < done <= total for _, done, total in told)
    assert {"corners", "crossings", "normals"} <= {stage for stage, _, _ in told}


@pytest.mark.slow
def test_2048_fits_in_memory():
    mesh = extract_mesh(Sphere(radius=0.5), resolution=2048, normals=False)
    assert_closed(mesh)
