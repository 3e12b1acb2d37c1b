import json
import struct

import cv2
import numpy as np
import pytest
import trimesh
from mplicits.datasets import read_textured, sample_textured
from mplicits.neural_fields import InputError, Mesh, MultiscaleSDF, Plane, Similarity, Sphere
from mplicits.neural_fields.fields.similarity import Placement
from mplicits.neural_fields.meshing.extract import extract_mesh
from mplicits.pipelines.mesh import atlas as unwrap_module
from mplicits.pipelines.mesh.atlas import decimate, from_frame, to_frame, unwrap, vertex_tangents
from mplicits.pipelines.mesh.bake import bake, check_texture_size, textured_mesh
from mplicits.pipelines.mesh.extract import normals_near
from mplicits.pipelines.mesh.files import check_textured_path
from mplicits.pipelines.surface.raster import cover
from mplicits.pipelines.surface.surface import is_closed, read_surface

pytest.importorskip("xatlas", reason="the extra mplicits[texture] is not installed")

UTM = Similarity((512_345.678, 5_403_210.987, 312.5), 40.0)


def painting(points):
    """Colours that change smoothly with position; no two channels alike."""
    return 0.5 + 0.45 * np.sin(np.stack((3 * points[:, 0], 4 * points[:, 1] + 1, 5 * points[:, 2] + 2), axis=1))


def bumpy(points):
    """Normals of the sphere, tilted by up to a third."""
    normals = points / np.linalg.norm(points, axis=1, keepdims=True) + 0.3 * np.sin(5 * points[:, [1, 2, 0]])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def ball(subdivisions=3):
    sphere = trimesh.creation.icosphere(subdivisions)
    return np.asarray(sphere.vertices, np.float64), np.asarray(sphere.faces, np.int64)


@pytest.fixture(scope="module")
def knot():
    """A surface that no chart can hold whole, of 5,000 triangles."""
    field_mesh = trimesh.creation.torus(0.6, 0.25, 60, 42)
    vertices = np.asarray(field_mesh.vertices)
    return vertices * (1 + 0.1 * np.sin(9 * vertices[:, [1]])), np.asarray(field_mesh.faces)


def edges(vertices, faces):
    corners = vertices[faces]
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e5])
def test_unwrap_keeps_every_triangle(knot, scale):
    vertices, faces = knot[0] * scale, knot[1]
    mesh = unwrap(vertices, faces, size=256)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], vertices[faces])  # the same corners in the same order
    assert mesh.uv.min() >= 0
    assert mesh.uv.max() <= 1
    s, t = edges(mesh.uv, mesh.faces)
    area = np.abs(s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0]) / 2
    assert area.min() > 0
    assert 0.3 < area.sum() < 1
    # Charts lie flat: texels are about as dense everywhere.
    density = area / np.linalg.norm(np.cross(*edges(vertices, faces)), axis=1)
    assert np.percentile(density, 99) < 3 * np.percentile(density, 1)


def test_no_two_triangles_share_a_texel(knot):
    mesh = unwrap(*knot, size=256)
    side = 2048
    count = np.zeros(side * side, np.int64)
    for found in cover(mesh.uv * side, mesh.faces, (side, side)):
        np.add.at(count, found.column, 1)
    assert (count == 1).mean() > 0.3
    # Vertices are rounded to float32 within charts of some hundred texels.
    assert (count > 1).sum() < 1e-5 * (count == 1).sum()


@pytest.mark.parametrize("padding", [2, 8])
def test_charts_keep_apart(knot, padding):
    mesh = unwrap(*knot, size=512, padding=padding)
    chart = chart_of(mesh)
    label = np.full(512 * 512, -1)
    for found in cover(mesh.uv * 512 - 0.5, mesh.faces, (512, 512)):
        label[found.column] = chart[found.face]
    label = label.reshape(512, 512)
    reach = np.ones((padding + 1, padding + 1), np.uint8)  # half the padding on each side, and a bit less
    for k in np.unique(chart):
        near = cv2.dilate((label == k).astype(np.uint8), reach) > 0
        assert set(np.unique(label[near])) <= {-1, k}


def chart_of(mesh):
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    size = len(mesh.vertices)
    return connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(size, size)))[1][mesh.faces[:, 0]]


def test_decimation_keeps_shape_and_place():
    mesh = extract_mesh(Sphere(radius=0.7, center=(0.1, 0.0, 0.0)), resolution=48)
    vertices, faces = decimate(mesh.vertices + 1000.0, mesh.faces, 1000)
    assert 900 < len(faces) <= 1000
    assert set(np.unique(faces)) == set(range(len(vertices)))
    radius = np.linalg.norm(vertices - 1000 - (0.1, 0, 0), axis=1)
    assert np.abs(radius - 0.7).max() < 0.005
    assert is_closed(Mesh(vertices, faces))
    facing = np.cross(*edges(vertices, faces))
    assert ((vertices[faces].mean(axis=1) - (1000.1, 1000, 1000)) * facing).sum(axis=1).min() > 0
    same, kept = decimate(mesh.vertices, mesh.faces, len(mesh.faces))
    np.testing.assert_array_equal(same, mesh.vertices)
    np.testing.assert_array_equal(kept, mesh.faces)


# Tangent frames


def test_tangents_of_a_plane_are_those_of_its_texture():
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0), indexing="ij"), axis=-1).reshape(-1, 2)
    corner = (np.arange(3)[:, None] * 4 + np.arange(3)).ravel()
    halves = ((corner, corner + 4, corner + 5), (corner, corner + 5, corner + 1))
    faces = np.concatenate([np.stack(half, axis=1) for half in halves])
    vertices = np.concatenate((grid, np.zeros((16, 1))), axis=1)
    up = np.tile((0.0, 0.0, 1.0), (16, 1))
    # (u, v) = (y, -x) turns the texture, (u, v) = (y, x) mirrors it as well.
    turned = vertex_tangents(vertices, faces, np.stack((grid[:, 1], -grid[:, 0]), axis=1), up)
    np.testing.assert_allclose(turned, np.tile((0, 1, 0, 1), (16, 1)), atol=1e-12)
    mirrored = vertex_tangents(vertices, faces, np.stack((grid[:, 1], grid[:, 0]), axis=1), up)
    np.testing.assert_allclose(mirrored, np.tile((0, 1, 0, -1), (16, 1)), atol=1e-12)


def test_bitangents_point_to_where_v_grows(knot):
    mesh = unwrap(*knot, size=256)
    across = np.cross(mesh.normals, mesh.tangents[:, :3]) * mesh.tangents[:, 3:]
    np.testing.assert_allclose(np.linalg.norm(mesh.tangents[:, :3], axis=1), 1, atol=1e-9)
    assert np.abs((mesh.normals * mesh.tangents[:, :3]).sum(axis=1)).max() < 1e-9
    for k in range(3):
        here, there = mesh.faces[:, k], mesh.faces[:, (k + 1) % 3]
        step, change = mesh.vertices[there] - mesh.vertices[here], mesh.uv[there] - mesh.uv[here]
        for axis, direction in ((0, mesh.tangents[here, :3]), (1, across[here])):
            rate = (step * direction).sum(axis=1) * change[:, axis]
            steep = np.abs(change[:, axis]) > 0.5 * np.linalg.norm(change, axis=1)
            assert (rate[steep] > 0).mean() > 0.999


def test_frames_are_inverted_exactly():
    rng = np.random.default_rng(0)
    normals, directions = rng.normal(size=(2, 50, 3))
    tangents = np.concatenate((rng.normal(size=(50, 3)), rng.choice([-1.0, 1.0], (50, 1))), axis=1)
    there = to_frame(directions, normals, tangents)
    np.testing.assert_allclose(from_frame(there, normals, tangents), directions, atol=1e-9)
    flat = to_frame(normals, normals, tangents) / np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(flat, np.tile((0, 0, 1), (50, 1)), atol=1e-9)


# Baking


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_baked_colours_are_read_back(tmp_path, suffix):
    vertices, faces = ball()
    path = tmp_path / f"a ball{suffix}"
    told = []
    source = Mesh(0.5 * vertices, faces.astype(np.int32))
    written = textured_mesh(path, source, UTM, painting, bumpy, size=512, progress=lambda *stage: told.append(stage))
    assert told[0] == ("unwrap", 0, 1)
    assert told[-1] == ("bake", len(faces), len(faces))
    mesh = read_textured(path)
    assert mesh.image.shape == (512, 512, 3)
    cloud = sample_textured(mesh, 20_000, seed=0)
    unit = UTM.to_unit(cloud.points)
    assert np.abs(np.linalg.norm(unit, axis=1) - 0.5).max() < 0.01  # in place, to a float32 of the ball
    error = np.abs(cloud.colors - painting(unit))
    texel = np.sqrt(np.linalg.norm(np.cross(*edges(0.5 * vertices, faces)), axis=1).sum() / 2 / (0.5 * 512**2))
    assert error.mean() < 0.002  # half a byte, and what is interpolated
    assert error.max() < 2 * texel * 0.45 * 5 + 1 / 255  # two texels, at the steepest
    assert len(read_surface(path).faces) == len(faces)
    assert len(written.faces) == len(faces)


def test_a_baked_mesh_is_placed_for_other_programs(tmp_path):
    """Upright, in metres, at the origin; read back where it was, if there is a node to say so."""
    vertices, faces = ball()
    source = Mesh(vertices * (0.2, 0.3, 0.5), faces.astype(np.int32))
    placement = Placement("z", "cm", center=True)
    for name in ("ball.glb", "ball.obj"):
        textured_mesh(tmp_path / name, source, UTM, painting, None, size=64, placement=placement)
        seen = trimesh.load_mesh(tmp_path / name)
        np.testing.assert_allclose(seen.extents, np.array([0.4, 1.0, 0.6]) * UTM.scale / 100, rtol=1e-5)
        assert np.abs(seen.bounds.sum(axis=0)).max() < 1e-6
        assert seen.volume > 0
    back = UTM.to_unit(read_surface(tmp_path / "ball.glb").vertices)
    np.testing.assert_allclose(np.ptp(back, axis=0), [0.4, 0.6, 1.0], rtol=1e-5)
    assert np.abs(back.mean(axis=0)).max() < 0.05


def test_gutter_holds_the_nearest_colour():
    def two_halves(points):
        return np.where(points[:, :1] > 0, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))

    image = bake(unwrap(*ball(1), size=128), two_halves, None, size=128).color
    assert {tuple(color) for color in image.reshape(-1, 3).tolist()} == {(255, 0, 0), (0, 0, 255)}


@pytest.mark.parametrize("subdivisions", [1, 3])
def test_baked_normals_are_those_of_the_surface(subdivisions):
    vertices, faces = ball(subdivisions)
    size = 512
    mesh = unwrap(vertices, faces, size=size)
    assert {-1.0, 1.0} >= set(mesh.tangents[:, 3])

    for truth in (lambda p: 3 * p, bumpy):
        image = bake(mesh, None, truth, size=size).normal
        rng = np.random.default_rng(0)
        face = rng.integers(len(faces), size=5000)
        weights = rng.dirichlet((1, 1, 1), 5000)
        rows = (mesh.uv, mesh.vertices, mesh.normals, mesh.tangents)
        uv, points, normals, tangents = (np.einsum("nk,nkc->nc", weights, row[mesh.faces[face]]) for row in rows)
        column, line = (uv * (size, -size) + (0, size)).astype(np.int64).clip(0, size - 1).T
        stored = image[line, column] / 127.5 - 1
        assert np.abs(np.linalg.norm(stored, axis=1) - 1).max() < 0.02
        found = from_frame(stored, normals, tangents)
        expected = truth(points)
        cosine = (found * expected).sum(axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(expected, axis=1)
        angle = np.degrees(np.arccos(cosine.clip(-1, 1)))
        assert np.median(angle) < 0.5
        assert np.percentile(angle, 99) < (1.0 if truth is not bumpy else 2.0)


def test_normals_of_fine_levels_reach_beyond_their_band():
    """f_1 = |x| − ½ + x₀ in the band: on the circle x₀ = 0 its gradient is the radius plus the first axis."""
    field = MultiscaleSDF(Sphere(radius=0.5), [Plane(normal=(1.0, 0.0, 0.0), offset=0.0)], [0.2])
    angle = np.linspace(0, 6, 50)
    outward = np.stack((np.zeros(50), np.cos(angle), np.sin(angle)), axis=1)
    for radius in (0.45, 0.6, 0.8, 0.95):  # the last two are outside
        fine, coarse = (normals_near(field, radius * outward, level=level) for level in (1, 0))
        np.testing.assert_allclose(fine, outward + np.array([1, 0, 0]), atol=1e-5)
        np.testing.assert_allclose(coarse, outward, atol=1e-6)


def test_normals_of_a_flat_map_are_upright():
    mesh = unwrap(*ball(2), size=64)
    image = bake(mesh, None, lambda points: np.zeros_like(points), size=64).normal
    assert (image == (128, 128, 255)).all()


def test_normals_turned_away_are_laid_down():
    mesh = unwrap(*ball(2), size=64)
    image = bake(mesh, None, lambda points: -points, size=64).normal
    assert image[..., 2].min() >= 128  # still on the front, so that no renderer lights the back


def test_glb_holds_what_gltf_asks_for(tmp_path):
    vertices, faces = ball(2)
    textured_mesh(tmp_path / "ball.glb", Mesh(vertices, faces.astype(np.int32)), UTM, painting, bumpy, size=64)
    data = (tmp_path / "ball.glb").read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    assert struct.unpack("<I", data[8:12])[0] == len(data)
    assert length % 4 == 0
    header, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    assert header["nodes"][0]["translation"] == list(UTM.center)
    assert all(view["byteOffset"] % 4 == 0 for view in header["bufferViews"])
    assert header["buffers"][0]["byteLength"] == len(body)
    material = header["materials"][0]
    for texture, view in ((material["pbrMetallicRoughness"]["baseColorTexture"], -2), (material["normalTexture"], -1)):
        image = header["images"][header["textures"][texture["index"]]["source"]]
        view = header["bufferViews"][image["bufferView"]]
        png = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        assert png[:8] == b"\x89PNG\r\n\x1a\n"
        assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED).shape == (64, 64, 3)
    assert [header["accessors"][k]["type"] for k in range(5)] == ["SCALAR", "VEC3", "VEC3", "VEC4", "VEC2"]
    assert [file.name for file in tmp_path.iterdir()] == ["ball.glb"]


def test_obj_comes_with_its_files(tmp_path):
    vertices, faces = ball(2)
    textured_mesh(tmp_path / "ball.obj", Mesh(vertices, faces.astype(np.int32)), UTM, painting, bumpy, size=64)
    names = {"ball.obj", "ball.mtl", "ball_color.png", "ball_normal.png"}
    assert {file.name for file in tmp_path.iterdir()} == names
    library = (tmp_path / "ball.mtl").read_text()
    assert "map_Kd ball_color.png" in library
    assert "norm ball_normal.png" in library
    assert "map_Bump" not in library  # which most programs take for heights
    # Nothing but normals: no colour is claimed.
    textured_mesh(tmp_path / "bare.obj", Mesh(vertices, faces.astype(np.int32)), UTM, None, bumpy, size=64)
    assert "map_Kd" not in (tmp_path / "bare.mtl").read_text()
    assert not (tmp_path / "bare_color.png").exists()


# Mistakes


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_failure_leaves_the_old_files_and_no_others(tmp_path, monkeypatch, suffix):
    vertices, faces = ball(1)
    path = tmp_path / f"ball{suffix}"
    path.write_text("old")

    def full(self, other):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(path), "replace", full)
    with pytest.raises(InputError, match="No space left on device"):
        textured_mesh(path, Mesh(vertices, faces.astype(np.int32)), UTM, painting, None, size=64)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_bad_requests_are_one_line(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"ball\.ply: textures are written as \.glb or \.obj"):
        check_textured_path(tmp_path / "ball.ply")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"file is no folder; choose another place"):
        check_textured_path(tmp_path / "file" / "ball.glb")
    for size in (0, 8, 20_000):
        with pytest.raises(InputError, match=f"--texture {size}: expected 16 to 16384"):
            check_texture_size(size)
    with pytest.raises(ValueError, match="expected at least one"):
        bake(unwrap(*ball(1), size=64), None, None)
    with pytest.raises(ValueError, match="none of them has an area"):
        unwrap(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)
    with pytest.raises(InputError, match="--texture needs xatlas"):
        unwrap_module.check_tools("--texture", "xatlas")
