import numpy as np
import pytest
import trimesh
from glb import attribute, glb_parts
from mplicits.datasets import linear_to_srgb, read_cloud
from mplicits.neural_fields import InputError, Similarity, Sphere
from mplicits.neural_fields.meshing.extract import Mesh, extract_mesh
from mplicits.pipelines.mesh.files import check_mesh_path, write_mesh
from mplicits.pipelines.surface.surface import read_surface

NEAR = Similarity((1.0, -2.0, 3.0), 2.5)
UTM = Similarity((512_345.678, 5_403_210.987, 312.5), 40.0)


@pytest.fixture(scope="module")
def mesh():
    plain = extract_mesh(Sphere(radius=0.7, center=(0.1, 0.0, 0.0)), resolution=24)
    colors = np.linspace(0, 1, 3 * len(plain.vertices)).reshape(-1, 3).astype(np.float32)
    return Mesh(plain.vertices, plain.faces, plain.normals, colors)


def stored_normals(path):
    """Normals as they stand in the file: mesh readers prefer to compute their own."""
    if path.suffix.lower() == ".ply":
        return read_cloud(path).normals
    if path.suffix == ".obj":
        lines = [line.split()[1:] for line in path.read_text().splitlines() if line.startswith("vn ")]
        return np.array(lines, np.float64)
    return attribute(path, "NORMAL")


def stored_colors(path):
    if path.suffix == ".glb":  # linear by its standard; 65535 is 1
        return linear_to_srgb(attribute(path, "COLOR_0")[:, :3] / 65535)
    return read_surface(path).colors


@pytest.mark.parametrize("similarity", [NEAR, UTM], ids=["near", "utm"])
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".PLY"])
def test_round_trip(tmp_path, mesh, suffix, similarity):
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, mesh, similarity)
    back = read_surface(path)
    assert np.array_equal(back.faces, mesh.faces)
    # A thousandth of a cell at 2048³, far from the origin too.
    assert np.abs(back.vertices - similarity.to_input(mesh.vertices)).max() < 1e-6 * similarity.scale
    assert np.abs(stored_normals(path) - mesh.normals).max() < 1e-5
    assert np.abs(stored_colors(path) - mesh.colors).max() < 0.51 / 255
    assert np.abs(back.colors - mesh.colors).max() < 0.51 / 255
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_stl_round_trip(tmp_path, mesh):
    write_mesh(tmp_path / "mesh.stl", mesh, NEAR)
    back = trimesh.load_mesh(tmp_path / "mesh.stl")
    assert back.is_watertight
    assert len(back.faces) == len(mesh.faces)
    assert back.volume == pytest.approx(4 / 3 * np.pi * (0.7 * 2.5) ** 3, rel=0.02)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl"])
def test_without_normals_and_colors(tmp_path, mesh, suffix):
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, Mesh(mesh.vertices, mesh.faces))
    back = trimesh.load_mesh(path)
    assert len(back.faces) == len(mesh.faces)
    assert back.volume > 0


def test_ply_is_double_only_where_needed(tmp_path, mesh):
    for similarity, word in ((NEAR, b"float x"), (UTM, b"double x")):
        write_mesh(tmp_path / "mesh.ply", mesh, similarity)
        assert word in (tmp_path / "mesh.ply").read_bytes()[:400]


def test_ply_is_read_as_a_cloud_too(tmp_path, mesh):
    write_mesh(tmp_path / "mesh.ply", mesh, UTM)
    cloud = read_cloud(tmp_path / "mesh.ply")
    assert np.abs(cloud.points - UTM.to_input(mesh.vertices)).max() < 1e-8
    assert np.abs(cloud.normals - mesh.normals).max() < 1e-6


def test_glb_records_its_origin(tmp_path, mesh):
    write_mesh(tmp_path / "mesh.glb", mesh, UTM)
    (node,) = glb_parts(tmp_path / "mesh.glb")[0]["nodes"]
    assert node["translation"] == node["extras"]["origin"] == list(UTM.center)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("mesh.xyz", "unknown mesh format"),
        ("mesh", "no extension"),
        ("file/deeper/mesh.ply", "file is no folder"),
        ("folder.ply", "is a folder"),
    ],
)
def test_bad_path_is_one_line_before_any_work(tmp_path, name, words):
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=words) as error:
        check_mesh_path(tmp_path / name)
    assert "\n" not in str(error.value)
    assert str(tmp_path / name) in str(error.value)
