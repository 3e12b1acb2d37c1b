"""3D Tiles: what is in the tree, that it holds the surface, and where it stands on the globe."""

import json

import numpy as np
import pytest
import trimesh
from mplicits.neural_fields import Box, InputError, Similarity, Sphere, Union, save_field
from mplicits.neural_fields.backend import files
from mplicits.neural_fields.meshing.parts import extract_parts
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.mesh import scene
from mplicits.pipelines.mesh.scene import SceneOptions, ply_of_run, scene_of_run
from mplicits.pipelines.surface.surface import Support
from refusals import refused

HOME = Similarity((512_345.0, 5_403_210.0, 312.5), 40.0)  # metres of UTM zone 32


@pytest.fixture
def run(tmp_path):
    path = tmp_path / "field.safetensors"
    save_field(path, Sphere(radius=0.8), similarity=HOME)
    return path


def entries(entry):
    yield entry
    for child in entry.get("children", []):
        yield from entries(child)


def box_of(entry):
    numbers = np.array(entry["boundingVolume"]["box"])
    half = np.abs(numbers[3:].reshape(3, 3)).sum(axis=0)
    return numbers[:3] - half, numbers[:3] + half


def content_of(folder, entry):
    """The mesh of a tile, turned z-up as viewers of 3D Tiles do."""
    scene = trimesh.load(folder / entry["content"]["uri"])
    mesh = scene.to_geometry() if isinstance(scene, trimesh.Scene) else scene
    vertices = np.stack((mesh.vertices[:, 0], -mesh.vertices[:, 2], mesh.vertices[:, 1]), axis=1)
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def test_the_tree_holds_the_surface_coarse_to_fine(run, tmp_path):
    out = tmp_path / "scene"
    scene = scene_of_run(run, out, SceneOptions(resolution=64, cells=16))
    assert sorted(path.name for path in out.iterdir()) == ["tiles", "tileset.json"]
    tree = json.loads((out / "tileset.json").read_text())
    assert tree["asset"]["version"] == "1.1"
    root = tree["root"]
    assert root["refine"] == "REPLACE"
    assert np.allclose(np.reshape(root["transform"], (4, 4)).T[:3, 3], HOME.center)
    tiles = list(entries(root))
    assert sum("content" in tile for tile in tiles) == scene.tiles
    assert tree["geometricError"] >= root["geometricError"]
    fine = []
    for tile in tiles:
        low, high = box_of(tile)
        for child in tile.get("children", []):
            assert child["geometricError"] <= tile["geometricError"]
            assert (box_of(child)[0] >= low - 1e-9).all()
            assert (box_of(child)[1] <= high + 1e-9).all()
        if "content" not in tile:
            assert tile["geometricError"] == 0  # nothing takes the place of a coarse tile
            continue
        mesh = content_of(out, tile)
        room = 1e-6 * HOME.scale  # float32 of coordinates up to 40
        assert (mesh.vertices >= low - room).all()
        assert (mesh.vertices <= high + room).all()
        if "children" not in tile:
            assert tile["geometricError"] == 0
            fine.append(mesh)
    whole = trimesh.util.concatenate(fine)
    whole.merge_vertices(digits_vertex=4)  # a ten-thousandth of a metre, where cells have 1.3 metres
    assert whole.is_watertight
    assert np.linalg.norm(whole.vertices, axis=1) == pytest.approx(32, abs=1e-3)
    # Chords of coarser cells: h² / 8r for an edge of h, and three times that on the diagonal of a cell.
    step = 2.04 * HOME.scale / 64
    coarse = step * 2 ** (scene.steps - 1)
    assert 0 < root["geometricError"] < 3 * coarse**2 / (8 * 32) + 3 * (coarse / 2) ** 2 / (8 * 32) + coarse / 100


def two_balls():
    """Points of a ball, and a stray, so that the box of the lattice holds another ball."""
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    points = 0.3 * directions / np.linalg.norm(directions, axis=1, keepdims=True) - (0.5, 0, 0)
    return Support(np.concatenate((points, [(0.9, 0.4, 0.4)])), 0.05)


def test_parts_without_points_go_as_from_a_mesh(tmp_path, monkeypatch):
    """A ball with points and a ball without, which reaches through several tiles."""
    run = tmp_path / "field.safetensors"
    save_field(run, Union(Sphere(center=(-0.5, 0, 0), radius=0.3), Sphere(center=(0.5, 0, 0), radius=0.3)))
    monkeypatch.setattr(scene, "read_support", lambda *_: two_balls())
    for keep, volume in ((False, 1), (True, 2)):
        out = tmp_path / f"scene{keep}"
        scene_of_run(run, out, SceneOptions(resolution=64, cells=16, keep_unsupported=keep))
        tree = json.loads((out / "tileset.json").read_text())["root"]
        meshes = [content_of(out, tile) for tile in entries(tree) if "children" not in tile and "content" in tile]
        found = sum(mesh.triangles_center[:, 0].size for mesh in meshes)
        right = sum((mesh.triangles_center[:, 0] > 0).sum() for mesh in meshes)
        assert (right > 0) == keep
        assert found / (found - right) == pytest.approx(volume, rel=0.05)


def test_on_the_globe_every_vertex_is_where_its_system_says(run, tmp_path):
    pyproj = pytest.importorskip("pyproj")
    out = tmp_path / "scene"
    scene_of_run(run, out, SceneOptions(resolution=48, cells=64, crs="EPSG:25832"))
    tree = json.loads((out / "tileset.json").read_text())["root"]
    matrix = np.reshape(tree["transform"], (4, 4)).T
    mesh = content_of(out, tree)
    earth = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    back = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS("EPSG:25832").to_3d(), always_xy=True)
    x, y, z = back.transform(*earth.T)
    points = (np.stack((x, y, z), axis=1) - HOME.center) / HOME.scale
    # One float32 step of the coordinates, and the chords of cells of 1.7 metres on a ball of 32.
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.8, abs=1e-4)
    assert np.allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-12)
    assert matrix[:3, 2] @ matrix[:3, 3] / np.linalg.norm(matrix[:3, 3]) > 0.99  # up is away from the globe


def test_a_plate_that_coarse_cells_miss(tmp_path):
    """Half a cell of the coarsest step thick, between its lattice planes: finer tiles hang below an empty one."""
    run, out = tmp_path / "field.safetensors", tmp_path / "scene"
    save_field(run, Box(center=(0.01, 0.01, 0.06), half_size=(0.5, 0.5, 0.02)))
    scene_of_run(run, out, SceneOptions(resolution=64, cells=16))
    root = json.loads((out / "tileset.json").read_text())["root"]
    assert "content" not in root
    low, high = box_of(root)
    assert root["geometricError"] >= np.linalg.norm(high - low)
    assert any("content" in tile for tile in entries(root))


def test_of_a_reconstruction_the_region_of_interest_alone_is_written(tmp_path):
    run, out, about = tmp_path / "field.safetensors", tmp_path / "scene", {"run": {"region": "the unit sphere"}}
    beyond = Sphere(center=(0.85, 0.85, 0.0), radius=0.15)
    save_field(run, Union(Sphere(radius=0.4), beyond), metadata=about)
    scene_of_run(run, out, SceneOptions(resolution=64, cells=32))
    root = json.loads((out / "tileset.json").read_text())["root"]
    for tile in (tile for tile in entries(root) if "content" in tile):
        assert np.linalg.norm(content_of(out, tile).vertices, axis=1).max() < 0.41
    save_field(run, beyond, metadata=about)
    with pytest.raises(InputError, match="region"):
        scene_of_run(run, tmp_path / "none", SceneOptions(resolution=64, cells=32))


def test_units_and_axes_without_a_system(run, tmp_path):
    out = tmp_path / "scene"
    scene_of_run(run, out, SceneOptions(resolution=32, cells=32, up="y", unit="mm"))
    tree = json.loads((out / "tileset.json").read_text())["root"]
    assert np.linalg.norm(content_of(out, tree).vertices, axis=1) == pytest.approx(0.032, rel=1e-3)
    x, y, z = np.array(HOME.center) / 1000
    assert np.reshape(tree["transform"], (4, 4)).T[:3, 3] == pytest.approx((x, -z, y))


def test_an_older_scene_is_replaced_and_nothing_else(run, tmp_path, capsys):
    out = tmp_path / "scene"
    command = ["mesh", str(run), "-o", str(out), "--format", "3dtiles", "--resolution", "24"]
    assert main(command) == 0
    (out / "viewer.html").touch()
    (out / "tiles" / "old.glb").touch()
    assert main(command) == 0
    assert sorted(path.name for path in out.iterdir()) == ["tiles", "tileset.json", "viewer.html"]
    assert not (out / "tiles" / "old.glb").exists()
    full = tmp_path / "full"
    full.mkdir()
    (full / "thesis.tex").touch()
    assert main([*command[:3], str(full), *command[4:]]) == 2
    assert main([*command, "--keep-largest"]) == 2
    assert main([*command[:4], "--crs", "EPSG:25832"]) == 2
    assert main([*command, "--crs", "Middle-earth"]) == 2
    assert (full / "thesis.tex").is_file()
    errors = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(errors) == 4


def contents(path):
    """The bytes of a file, or of all files of a folder, by name."""
    return {str(file.relative_to(path)): file.read_bytes() for file in [path, *path.rglob("*")] if file.is_file()}


@pytest.mark.parametrize(
    ("name", "stage", "done"),
    [
        ("mesh.ply", "tiles of 64", 3),
        ("mesh.ply", "writing", 2),
        ("scene", "tiles of 64", 3),
        ("scene", "tiles of 16", 1),
        ("scene", "writing", 2),
    ],
)
def test_an_interrupted_command_goes_on_from_its_parts(tmp_path, monkeypatch, name, stage, done):
    run, make = tmp_path / "field.safetensors", ply_of_run if name == "mesh.ply" else scene_of_run
    save_field(run, Union(Sphere(center=(-0.5, 0, 0), radius=0.3), Sphere(center=(0.5, 0, 0), radius=0.3)))
    monkeypatch.setattr(scene, "read_support", lambda *_: two_balls())
    options, whole, out = SceneOptions(resolution=64, cells=16), tmp_path / "whole" / name, tmp_path / "again" / name
    extracted, stopped = [], []

    def counted_parts(*args, **settings):
        for part in extract_parts(*args, **settings):
            extracted.append(part.place)
            yield part

    def stop(progress):
        if progress.stage.startswith(stage) and progress.step == done and not stopped:
            stopped.append(progress)
            raise KeyboardInterrupt

    monkeypatch.setattr(scene, "extract_parts", counted_parts)
    make(run, whole, options)
    once = len(extracted)
    extracted.clear()
    with pytest.raises(KeyboardInterrupt):
        make(run, out, options, report=stop)
    assert not out.exists()
    make(run, out, options)
    assert once <= len(extracted) <= once + 1  # the one that was under way is extracted again
    assert contents(out) == contents(whole)
    assert [path.name for path in out.parent.iterdir()] == [name]


def test_a_full_disk_keeps_the_parts_and_other_settings_do_not(run, tmp_path, monkeypatch):
    out, options = tmp_path / "mesh.ply", SceneOptions(resolution=64, cells=16)
    rename, room = files.rename, [5]

    def rename_while_there_is_room(path, target):
        room[0] -= target.suffix == ".npz"
        if room[0] < 0:
            raise OSError(28, "No space left on device")
        rename(path, target)

    monkeypatch.setattr(files, "rename", rename_while_there_is_room)
    for _ in range(2):
        with refused(tmp_path / ".mesh.ply.parts", "No space left on device"):
            ply_of_run(run, out, options)
        assert len([*(tmp_path / ".mesh.ply.parts" / "parts").glob("*.npz")]) == 5
    room[0] = 10**6
    ply_of_run(run, out, SceneOptions(resolution=64, cells=32))
    assert 10**6 - room[0] == 8  # all eight cubes of this size
    assert sorted(path.name for path in tmp_path.iterdir()) == ["field.safetensors", "mesh.ply"]


def test_a_place_outside_of_the_system_is_refused(tmp_path):
    pytest.importorskip("pyproj")
    run = tmp_path / "field.safetensors"
    save_field(run, Sphere(radius=0.8), similarity=Similarity((5e9, 5e9, 0.0), 40.0))
    for crs, complaint in (("EPSG:25832", "outside"), ("EPSG:4326", "lengths")):
        with pytest.raises(InputError, match=complaint):
            scene_of_run(run, tmp_path / "scene", SceneOptions(resolution=24, crs=crs))


def test_a_mesh_in_parts_is_one_closed_mesh_in_input_coordinates(run, tmp_path, capsys):
    out = tmp_path / "ball.ply"
    assert main(["mesh", str(run), "-o", str(out), "--in-parts", "--resolution", "64"]) == 0
    assert "--in-parts" not in capsys.readouterr().err
    options = SceneOptions(resolution=64, cells=16, up="y")  # a PLY is z-up
    lines = []
    written = ply_of_run(run, tmp_path / "cubes.ply", options, say=lines.append)
    assert lines == ["coordinates: z up"]
    one, cubes = (trimesh.load(path, process=False) for path in (out, tmp_path / "cubes.ply"))
    assert written == (len(cubes.vertices), len(cubes.faces)) == (len(one.vertices), len(one.faces))
    assert one.is_watertight
    assert cubes.is_watertight
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.ply", "cubes.ply", "field.safetensors"]
    x, y, z = HOME.center
    for mesh, center in ((one, (x, y, z)), (cubes, (x, -z, y))):
        assert np.linalg.norm(mesh.vertices - center, axis=1) == pytest.approx(32, abs=2e-3)
        assert mesh.volume == pytest.approx(4 / 3 * np.pi * 32**3, rel=2e-3)
        outward = (mesh.vertices - center) / 32
        rows = mesh.metadata["_ply_raw"]["vertex"]["data"]
        normals = np.stack([rows[name] for name in ("nx", "ny", "nz")], axis=1)
        assert np.allclose(normals, outward, atol=2.04 / 64 / 0.8 / 8)  # an eighth of a cell aside


def test_a_mesh_in_parts_loses_whole_components(tmp_path, monkeypatch):
    run, out = tmp_path / "field.safetensors", tmp_path / "mesh.ply"
    save_field(run, Union(Sphere(center=(-0.5, 0, 0), radius=0.3), Sphere(center=(0.5, 0, 0), radius=0.3)))
    monkeypatch.setattr(scene, "read_support", lambda *_: two_balls())
    ply_of_run(run, out, SceneOptions(resolution=64, cells=16))
    mesh = trimesh.load(out, process=False)
    assert mesh.is_watertight
    assert mesh.vertices[:, 0].max() < 0
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.3**3, rel=0.02)


@pytest.mark.parametrize(
    ("flags", "complaint"),
    [
        (["-o", "x.obj"], "writes .ply only"),
        (["-o", "x.ply", "--faces", "100"], "--faces: does not go with --in-parts"),
        (["-o", "x.ply", "--crs", "EPSG:4326"], "--crs: does not go with --in-parts"),
        (["-o", "x.ply", "--format", "3dtiles"], "--format: does not go with --in-parts"),
    ],
)
def test_what_does_not_go_with_parts_is_refused(run, tmp_path, capsys, monkeypatch, flags, complaint):
    monkeypatch.chdir(tmp_path)
    assert main(["mesh", str(run), "--in-parts", *flags]) == 2
    assert complaint in capsys.readouterr().err
