import cv2
import numpy as np
import pytest
import trimesh
from glb import glb_parts, view_of
from mplicits.datasets import read_textured, sample_textured
from mplicits.neural_fields import InputError, Mesh, MultiscaleSDF, Plane, Similarity, Sphere
from mplicits.neural_fields.fields.similarity import Placement
from mplicits.pipelines.mesh import atlas as unwrap_module
from mplicits.pipelines.mesh.atlas import frame_axes, unwrap, vertex_tangents
from mplicits.pipelines.mesh.bake import bake, check_texture_size, textured_mesh
from mplicits.pipelines.mesh.extract import normals_near
from mplicits.pipelines.mesh.files import check_textured_path
from mplicits.pipelines.surface.raster import cover
from mplicits.pipelines.surface.surface import read_surface

pytest.importorskip("xatlas", reason="the extra mplicits[texture] is not installed")

UTM = Similarity((512_345.678, 5_403_210.987, 312.5), 40.0)


def ball(subdivisions=3):
    sphere = trimesh.creation.icosphere(subdivisions)
    return np.asarray(sphere.vertices, np.float64), np.asarray(sphere.faces, np.int64)


def ball_mesh(subdivisions=3, radii=1.0):
    vertices, faces = ball(subdivisions)
    return Mesh(vertices * radii, faces.astype(np.int32))


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
    assert 0 <= mesh.uv.min() < mesh.uv.max() <= 1
    area = np.abs(np.linalg.det(np.stack(edges(mesh.uv, mesh.faces), axis=1))) / 2
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
    ends = np.concatenate((mesh.faces[:, :2], mesh.faces[:, 1:]))
    chart = trimesh.graph.connected_component_labels(ends, len(mesh.vertices))[mesh.faces[:, 0]]
    label = np.full(512 * 512, -1)
    for found in cover(mesh.uv * 512 - 0.5, mesh.faces, (512, 512)):
        label[found.column] = chart[found.face]
    label = label.reshape(512, 512)
    reach = np.ones((padding + 1, padding + 1), np.uint8)  # half the padding on each side, and a bit less
    for k in np.unique(chart):
        near = cv2.dilate((label == k).astype(np.uint8), reach) > 0
        assert set(np.unique(label[near])) <= {-1, k}


def test_tangents_of_a_plane_are_those_of_its_texture():
    grid = np.indices((4, 4)).reshape(2, -1).T.astype(float)
    corner = (np.arange(3)[:, None] * 4 + np.arange(3)).ravel()
    halves = ((corner, corner + 4, corner + 5), (corner, corner + 5, corner + 1))
    faces = np.concatenate([np.stack(half, axis=1) for half in halves])
    vertices = np.concatenate((grid, np.zeros((16, 1))), axis=1)
    up = np.tile((0.0, 0.0, 1.0), (16, 1))
    # (u, v) = (y, -x) turns the texture, (u, v) = (y, x) mirrors it as well.
    for sign in (1, -1):
        found = vertex_tangents(vertices, faces, np.stack((grid[:, 1], -sign * grid[:, 0]), axis=1), up)
        np.testing.assert_allclose(found, np.tile((0, 1, 0, sign), (16, 1)), atol=1e-12)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_baked_colours_are_read_back(tmp_path, suffix, painting, bumpy):
    source, path = ball_mesh(radii=0.5), tmp_path / f"a ball{suffix}"
    faces = source.faces
    written = textured_mesh(path, source, UTM, painting, bumpy, size=512)
    mesh = read_textured(path)
    assert mesh.image.shape == (512, 512, 3)
    cloud = sample_textured(mesh, 20_000, seed=0)
    unit = UTM.to_unit(cloud.points)
    assert np.abs(np.linalg.norm(unit, axis=1) - 0.5).max() < 0.01  # in place, to a float32 of the ball
    error = np.abs(cloud.colors - painting(unit))
    texel = np.sqrt(np.linalg.norm(np.cross(*edges(source.vertices, faces)), axis=1).sum() / 2 / (0.5 * 512**2))
    assert error.mean() < 0.002  # half a byte, and what is interpolated
    assert error.max() < 2 * texel * 0.45 * 5 + 1 / 255  # two texels, at the steepest
    assert len(read_surface(path).faces) == len(written.faces) == len(faces)


def test_a_baked_mesh_is_placed_for_other_programs(tmp_path, painting):
    """Upright, in metres, at the origin; read back where it was, if there is a node to say so."""
    source, placement = ball_mesh(radii=(0.2, 0.3, 0.5)), Placement("z", "cm", center=True)
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
def test_baked_normals_are_those_of_the_surface(subdivisions, bumpy):
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
        found = (frame_axes(normals, tangents) @ stored[..., None])[..., 0]  # as a renderer does
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


def test_normals_of_no_length_are_upright_and_those_turned_away_are_laid_down():
    mesh = unwrap(*ball(2), size=64)
    assert (bake(mesh, None, np.zeros_like, size=64).normal == (128, 128, 255)).all()
    # Still on the front, so that no renderer lights the back.
    assert bake(mesh, None, np.negative, size=64).normal[..., 2].min() >= 128


def test_glb_holds_what_gltf_asks_for(tmp_path, painting, bumpy):
    textured_mesh(tmp_path / "ball.glb", ball_mesh(2), UTM, painting, bumpy, size=64)
    header, body = glb_parts(tmp_path / "ball.glb")
    assert header["nodes"][0]["translation"] == list(UTM.center)
    material = header["materials"][0]
    for texture in (material["pbrMetallicRoughness"]["baseColorTexture"], material["normalTexture"]):
        image = header["images"][header["textures"][texture["index"]]["source"]]
        png = view_of(header, body, image["bufferView"])
        assert png[:8] == b"\x89PNG\r\n\x1a\n"
        assert cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED).shape == (64, 64, 3)
    assert [header["accessors"][k]["type"] for k in range(5)] == ["SCALAR", "VEC3", "VEC3", "VEC4", "VEC2"]
    assert [file.name for file in tmp_path.iterdir()] == ["ball.glb"]


def test_obj_comes_with_its_files(tmp_path, painting, bumpy):
    textured_mesh(tmp_path / "ball.obj", ball_mesh(2), UTM, painting, bumpy, size=64)
    names = {"ball.obj", "ball.mtl", "ball_color.png", "ball_normal.png"}
    assert {file.name for file in tmp_path.iterdir()} == names
    library = (tmp_path / "ball.mtl").read_text()
    assert "map_Kd ball_color.png" in library
    assert "norm ball_normal.png" in library
    assert "map_Bump" not in library  # which most programs take for heights
    # Nothing but normals: no colour is claimed.
    textured_mesh(tmp_path / "bare.obj", ball_mesh(2), UTM, None, bumpy, size=64)
    assert "map_Kd" not in (tmp_path / "bare.mtl").read_text()
    assert not (tmp_path / "bare_color.png").exists()


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_failure_leaves_the_old_files_and_no_others(tmp_path, monkeypatch, suffix, painting):
    path = tmp_path / f"ball{suffix}"
    path.write_text("old")

    def full(self, other):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(path), "replace", full)
    with pytest.raises(InputError, match="No space left on device"):
        textured_mesh(path, ball_mesh(1), UTM, painting, None, size=64)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_bad_requests_are_one_line(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("mine")
    for name, message in (("ball.ply", r"ball\.ply: "), ("file/ball.glb", "file is no folder")):
        with pytest.raises(InputError, match=message):
            check_textured_path(tmp_path / name)
    for size in (0, 8, 20_000):
        with pytest.raises(InputError, match=f"--texture {size}: "):
            check_texture_size(size)
    with pytest.raises(ValueError, match="expected at least one"):
        bake(unwrap(*ball(1), size=64), None, None)
    with pytest.raises(ValueError, match="none of them has an area"):
        unwrap(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)
    with pytest.raises(InputError, match="--texture needs xatlas"):
        unwrap_module.check_tools("--texture", "xatlas")
