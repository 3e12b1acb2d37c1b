import dataclasses

import numpy as np
import pytest
import trimesh
from mplicits.datasets import read_cloud
from mplicits.neural_fields import Box, InputError, Similarity, WorldField
from mplicits.neural_fields.fields.similarity import FRAMES, METRES, Placement
from mplicits.pipelines.cli.mesh import MESH_FILES, UNITS
from mplicits.pipelines.surface.surface import read_surface

EPS32 = 2.0**-24  # relative error of a number rounded to float32
EPS64 = 2.0**-53
# A field's unit is 400 input units; its box is 0.2 × 0.4 × 0.8 field units wide, z the longest.
SIZES = np.array([80.0, 160.0, 320.0])
NEAR = Similarity((1200.0, -500.0, 300.0), 400.0)
FAR = Similarity((512_345.678, 5_403_210.987, 312.5), 400.0)


def tower(similarity):
    """A standing box, in input coordinates."""
    field = Box(half_size=(0.1, 0.2, 0.4))
    mesh = WorldField(field, similarity).mesh(32)
    colors = np.linspace(0, 1, 3 * len(mesh.vertices)).reshape(-1, 3).astype(np.float32)
    return dataclasses.replace(mesh, colors=colors)


@pytest.fixture(scope="module", params=[NEAR, FAR], ids=["near", "far"])
def mesh(request):
    return tower(request.param)


def test_trimesh_gets_every_vertex_face_normal_and_colour(mesh):
    other = mesh.to_trimesh()
    assert isinstance(other, trimesh.Trimesh)
    np.testing.assert_array_equal(other.vertices, mesh.vertices)
    np.testing.assert_array_equal(other.faces, mesh.faces)
    assert np.abs(other.vertex_normals - mesh.normals).max() < 2 * EPS32
    assert np.abs(other.visual.vertex_colors[:, :3] / 255 - mesh.colors).max() <= 0.5 / 255 + EPS32
    assert other.is_watertight
    bare = dataclasses.replace(mesh, normals=None, colors=None).to_trimesh()
    np.testing.assert_array_equal(bare.vertices, mesh.vertices)
    assert bare.visual.kind is None


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_export_keeps_coordinates_colours_and_far_digits(mesh, suffix, tmp_path):
    path = tmp_path / f"mesh{suffix}"
    mesh.export(path)
    back = read_surface(path)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    bound = EPS32 * np.abs(mesh.vertices).max()  # one rounding; OBJ's nine digits are finer
    if np.abs(mesh.vertices).max() > 1e5:
        # Doubles in PLY, fifteen digits in OBJ; a GLB rounds offsets from the middle.
        bound = {".ply": 0.0, ".obj": 5e-15 * 5.5e6, ".glb": EPS32 * 320 + 2 * EPS64 * 5.5e6}[suffix]
    assert np.abs(back.vertices - mesh.vertices).max() <= bound
    assert np.abs(back.colors - mesh.colors).max() < 0.51 / 255
    if suffix == ".ply":
        np.testing.assert_array_equal(read_cloud(path).normals, mesh.normals)


def test_export_refuses_before_it_writes(mesh, tmp_path):
    empty = dataclasses.replace(mesh, faces=mesh.faces[:0])
    for refused, name, options, error, words in (
        (mesh, "mesh.xyz", {}, InputError, "unknown mesh format"),
        (mesh, "mesh.glb", {"unit": "ell"}, ValueError, "unit='ell'"),
        (mesh, "mesh.glb", {"up": "x"}, ValueError, "up='x'"),
        (empty, "mesh.ply", {}, ValueError, "no faces"),
    ):
        with pytest.raises(error, match=words):
            refused.export(tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_stl_far_away_is_refused_unless_it_is_centred(tmp_path):
    mesh = tower(FAR)
    with pytest.raises(InputError, match=r"--center"):
        mesh.export(tmp_path / "mesh.stl")
    mesh.export(tmp_path / "mesh.stl", center=True)
    np.testing.assert_allclose(trimesh.load_mesh(tmp_path / "mesh.stl").extents, SIZES, rtol=1e-3)


@pytest.mark.parametrize("similarity", [NEAR, FAR], ids=["near", "far"])
def test_a_glb_is_upright_in_metres_and_centred_in_its_scene(similarity, tmp_path):
    """As trimesh reads it."""
    mesh = tower(similarity)
    path = tmp_path / "mesh.glb"
    mesh.export(path, up="z", unit="mm", center=True)
    seen = trimesh.load_mesh(path)
    expected = (mesh.vertices - (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2) / 1000
    expected = expected[:, [0, 2, 1]] * (1, 1, -1)  # z-up → y-up: x stays to the right, y went away from the viewer
    # Offsets of up to 160 units in float32, and the middle's own rounding.
    assert np.abs(seen.vertices - expected).max() < (EPS32 * 160 + 4 * EPS64 * 5.5e6) / 1000
    np.testing.assert_allclose(seen.extents, SIZES[[0, 2, 1]] / 1000, rtol=1e-3)
    assert seen.volume > 0  # turned, not mirrored
    # Our own reader gives the input's coordinates, whatever the scene shows.
    assert np.abs(read_surface(path).vertices - mesh.vertices).max() < EPS32 * 160 + 4 * EPS64 * 5.5e6


@pytest.mark.parametrize(
    ("suffix", "given", "sizes"),
    [
        (".stl", {"unit": "cm"}, SIZES * 10),  # slicers: millimetres
        (".stl", {"up": "y"}, SIZES[[0, 2, 1]]),  # and z-up
        (".stl", {"up": "z"}, SIZES),
        (".ply", {"unit": "mm", "up": "y"}, SIZES[[0, 2, 1]] / 1000),
        (".obj", {"unit": "in"}, SIZES * 0.0254),
        (".obj", {"up": "z"}, SIZES[[0, 2, 1]]),
        (".obj", {}, SIZES),
        (".glb", {}, SIZES),
        (".PLY", {}, SIZES),
    ],
)
def test_files_change_only_as_asked(suffix, given, sizes, tmp_path):
    mesh = tower(NEAR)
    mesh.export(tmp_path / f"mesh{suffix}", **given)
    seen = trimesh.load_mesh(tmp_path / f"mesh{suffix}", process=False)
    # The corners of the box are cut by a cell, 0.064 of a field unit, at most.
    np.testing.assert_allclose(seen.extents, sizes, rtol=0.05)
    assert trimesh.load_mesh(tmp_path / f"mesh{suffix}").volume > 0
    if given:
        assert Placement(**given).describe(suffix) is not None
    else:
        assert suffix == ".glb" or Placement().describe(suffix) is None
        np.testing.assert_allclose(seen.bounds, mesh.to_trimesh().bounds, rtol=1e-6)


def test_the_command_line_has_the_same_formats_and_units():
    assert set(MESH_FILES) == set(FRAMES)
    assert set(UNITS) == set(METRES)


def test_normals_turn_with_the_mesh(tmp_path):
    mesh = tower(NEAR)
    mesh.export(tmp_path / "mesh.ply", up="y")
    turned = mesh.normals[:, [0, 2, 1]] * (1, -1, 1)  # y-up → z-up: (x, y, z) → (x, −z, y)
    np.testing.assert_array_equal(read_cloud(tmp_path / "mesh.ply").normals, turned)
