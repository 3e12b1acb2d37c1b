"""Films, folders of meshes and moving meshes of surfaces whose motion is known."""

import copy
import functools
import json
import struct
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
import trimesh
from mplicits.datasets import linear_to_srgb
from mplicits.neural_fields import (
    InputError,
    Moving,
    RigidMotion,
    Similarity,
    Siren,
    SpaceTimeSDF,
    Sphere,
    TextureField,
    TimeSlice,
    Union,
    extract_mesh,
    load_field,
    load_texture,
    save_field,
)
from mplicits.neural_fields.checkpoint import save_texture
from mplicits.neural_fields.networks.colors import ColorSiren
from mplicits.neural_fields.spacetime.dynamic_tracing import moment
from mplicits.neural_fields.spacetime.moving import Keyframes, ShrinkingSphere
from mplicits.neural_fields.tracing.sphere import project_to_surface
from mplicits.pipelines.cli.draw import ANIMATE as COMMAND
from mplicits.pipelines.evolve.animate import (
    SequenceOptions,
    animate_run,
    check_sequence_path,
    film_frames,
    last_colors,
    there_and_back,
)
from mplicits.pipelines.evolve.follow import follow_mesh
from mplicits.pipelines.mesh.extract import MeshOptions, mesh_run
from mplicits.pipelines.render.draw import Orbit, RenderOptions, render_run
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.texture.spread import CELL
from mplicits.pipelines.texture.transport import TransportedColors, borrowed_texture
from mplicits.pipelines.training.folder import load_still

RADIUS, DRIFT = 0.3, torch.tensor([0.5, 0.0, 0.0])
START = torch.tensor([-0.25, 0.0, 0.0])
PLACE = Similarity((100.0, -20.0, 3.0), 2.0)


def travelling_ball() -> SpaceTimeSDF:
    """A small network that is a ball, nearly, and whose motion is exact: W(x − v t) + b."""
    return copy.deepcopy(_trained_ball())


@functools.cache
def _trained_ball() -> SpaceTimeSDF:
    torch.manual_seed(0)
    siren = Siren(32, 2, omega=5.0)
    adam = torch.optim.Adam(siren.parameters(), lr=5e-3)
    still = Sphere(radius=RADIUS, center=tuple(START.tolist()))
    for _ in range(400):
        x = 2.4 * torch.rand(512, 3) - 1.2
        loss = (siren.value(x) - still.value(x)).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    field = SpaceTimeSDF.from_static(siren)
    first = field.sdf.base.layers[0]
    with torch.no_grad():
        first.weight[:, 3] = -first.weight[:, :3] @ DRIFT
    return field.requires_grad_(False)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    field = travelling_ball()
    save_field(directory / "field.safetensors", field, similarity=PLACE)
    torch.manual_seed(3)
    texture = TextureField(moment(field, 0.0), ColorSiren(16, 1, omega=4.0), delta=0.1)
    save_texture(directory / "texture.safetensors", texture)
    return directory


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("still") / "ball.safetensors"
    save_field(file, travelling_ball().at(0.0))
    return file


def center(t: float) -> np.ndarray:
    return PLACE.to_input((START + t * DRIFT).double().numpy()[None])[0]


def read_glb(path: Path) -> tuple[dict, list[np.ndarray]]:
    """The header, and the array of every accessor."""
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    length = struct.unpack("<I", data[12:16])[0]
    header, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    assert header["buffers"][0]["byteLength"] == len(body)
    kinds, widths = {5123: "<u2", 5125: "<u4", 5126: "<f4"}, {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
    arrays = []
    for accessor in header["accessors"]:
        view = header["bufferViews"][accessor["bufferView"]]
        part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        array = np.frombuffer(part, kinds[accessor["componentType"]])
        assert len(array) == accessor["count"] * widths[accessor["type"]]
        arrays.append(array.reshape(accessor["count"], -1))
        for bound, of in (("min", np.min), ("max", np.max)):
            if bound in accessor:
                np.testing.assert_array_equal(accessor[bound], of(arrays[-1], axis=0))
    return header, arrays


# Moments of runs


def test_a_time_goes_with_what_moves_and_with_nothing_else(run, still, tmp_path):
    with pytest.raises(InputError, match=r"field\.safetensors: a surface that moves; say when with --time"):
        load_still(run)
    with pytest.raises(InputError, match=r"--time 0\.5: .*ball\.safetensors does not move; leave it out"):
        load_still(still, 0.5)
    with pytest.raises(InputError, match=r"--time 1\.5: expected a time from 0 to 1"):
        load_still(run, 1.5)
    x = 2 * torch.rand(50, 3) - 1
    whole = load_field(run / "field.safetensors").field
    torch.testing.assert_close(load_still(run, 0.25).field.value(x), TimeSlice(whole, 0.25).value(x))
    with pytest.raises(InputError, match=r"say when with --time"):
        mesh_run(run, tmp_path / "mesh.ply")
    with pytest.raises(InputError, match=r"--time 0: .* does not move"):
        render_run(still, tmp_path / "picture.png", RenderOptions(time=0.0))
    trimesh.creation.icosphere().export(tmp_path / "ball.ply")
    with pytest.raises(InputError, match=r"--time 0: .*ball\.ply does not move"):
        render_run(tmp_path / "ball.ply", tmp_path / "picture.png", RenderOptions(time=0.0))


@pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
def test_a_mesh_of_a_moment_is_where_the_surface_is_then(run, tmp_path, time):
    mesh_run(run, tmp_path / "mesh.ply", MeshOptions(time=time, resolution=32))
    surface = read_surface(tmp_path / "mesh.ply")
    away = np.linalg.norm(surface.vertices - center(time), axis=1)
    np.testing.assert_allclose(away, RADIUS * PLACE.scale, atol=0.05)
    assert surface.colors is not None


# Films


def test_every_frame_of_a_film_is_what_tracing_it_alone_shows(run):
    field = load_field(run / "field.safetensors").field
    options = SequenceOptions(frames=4, size=(40, 32), samples=1, shading="normals")
    frames = list(film_frames(run, field, None, 0, options))
    assert {frame.shape for frame in frames} == {(32, 40, 3)}
    middles = []
    for frame in frames:
        ball = (frame < 255).any(axis=2)
        assert 30 < ball.sum() < 600
        middles.append(np.nonzero(ball)[1].mean())
    steps = np.diff(middles)
    assert (steps > 1).all()  # the ball travels to the right, evenly
    assert steps.std() < 0.5


def test_films_are_written(run, tmp_path):
    options = SequenceOptions(frames=3, size=(32, 32), fps=10.0)
    for name in ("ball.gif", "ball.mp4"):
        told: list[tuple[int, int]] = []
        said = animate_run(run, tmp_path / name, options, progress=lambda *done, told=told: told.append(done))
        assert said == "3 frames of 32×32"
        assert told == [(1, 3), (2, 3), (3, 3)]
    assert len(iio.imread(tmp_path / "ball.gif", index=None)) == 3
    assert cv2.VideoCapture(str(tmp_path / "ball.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3


def test_a_sheet_has_all_frames_with_their_times(run, tmp_path):
    options = SequenceOptions(frames=8, size=(32, 24), samples=1, no_colors=True)
    assert animate_run(run, tmp_path / "ball.png", options) == "8 moments of 32×24"
    sheet = iio.imread(tmp_path / "ball.png")
    assert sheet.shape == (2 * (24 + 40), 7 * (32 + 12), 3)
    field = load_field(run / "field.safetensors").field
    frames = list(film_frames(run, field, None, 0, options))
    np.testing.assert_array_equal(sheet[40:64, 6:38], frames[0])
    np.testing.assert_array_equal(sheet[104:128, 6:38], frames[7])
    assert (sheet[64:, 44:] == 255).all()


# Folders of meshes


def test_a_folder_holds_a_mesh_of_every_frame(run, tmp_path):
    assert animate_run(run, tmp_path / "meshes", SequenceOptions(frames=3, resolution=24)) == "3 meshes"
    files = sorted((tmp_path / "meshes").iterdir())
    assert [file.name for file in files] == ["frame_0000.ply", "frame_0001.ply", "frame_0002.ply"]
    for file, t in zip(files, (0.0, 0.5, 1.0), strict=True):
        surface = read_surface(file)
        np.testing.assert_allclose(surface.vertices.mean(axis=0), center(t), atol=0.03)
        assert surface.colors is not None
    with pytest.raises(InputError, match=r"meshes: exists already"):
        animate_run(run, tmp_path / "meshes", SequenceOptions(frames=3))


# Meshes that move


def test_a_moving_mesh_is_on_the_surface_in_every_frame(run, tmp_path):
    file = tmp_path / "ball.glb"
    said = animate_run(run, file, SequenceOptions(frames=5, fps=8.0, resolution=20))
    header, arrays = read_glb(file)
    (primitive,) = header["meshes"][0]["primitives"]
    attributes = {name: arrays[k] for name, k in primitive["attributes"].items()}
    base = attributes["POSITION"]
    assert said.startswith(f"{len(base):,} vertices in 5 frames")
    (animation,) = header["animations"]
    sampler, channel = animation["samplers"][0], animation["channels"][0]
    assert channel == {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    np.testing.assert_allclose(arrays[sampler["input"]][:, 0], np.arange(5) / 8.0)
    weights = arrays[sampler["output"]].reshape(5, 4)
    assert len(header["meshes"][0]["weights"]) == len(primitive["targets"]) == 4
    field = load_field(run / "field.safetensors").field
    for frame, t in enumerate(np.linspace(0, 1, 5)):
        frames = {}
        for name in ("POSITION", "NORMAL"):
            targets = np.stack([arrays[target[name]] for target in primitive["targets"]])
            frames[name] = attributes[name] + np.tensordot(weights[frame], targets, axes=1)
        points = torch.from_numpy(PLACE.to_unit(frames["POSITION"].astype(np.float64))).float()
        jet = TimeSlice(field, float(t)).jet(points)
        assert float(jet.value.abs().max()) < 1e-3
        np.testing.assert_allclose(points.mean(dim=0), START + t * DRIFT, atol=0.02)
        np.testing.assert_allclose(frames["NORMAL"], torch.nn.functional.normalize(jet.gradient, dim=-1), atol=1e-4)
    loaded = trimesh.load_mesh(file, process=False)
    np.testing.assert_allclose(loaded.vertices, base)


def test_colours_of_a_moving_mesh_are_those_of_its_start(run, tmp_path):
    animate_run(run, tmp_path / "ball.glb", SequenceOptions(frames=2, resolution=16))
    mesh_run(run, tmp_path / "start.ply", MeshOptions(time=0.0, resolution=16))
    header, arrays = read_glb(tmp_path / "ball.glb")
    attributes = header["meshes"][0]["primitives"][0]["attributes"]
    colors = linear_to_srgb(arrays[attributes["COLOR_0"]][:, :3] / 65535)
    np.testing.assert_allclose(colors, read_surface(tmp_path / "start.ply").colors, atol=2 / 255)


def test_a_moving_mesh_of_a_z_up_run_is_turned_y_up(run, tmp_path):
    for up in ("y", "z"):
        animate_run(run, tmp_path / f"{up}.glb", SequenceOptions(frames=2, resolution=16, orbit=Orbit(up=up)))
    turned, plain = (trimesh.load_mesh(tmp_path / f"{up}.glb", process=False).vertices for up in ("z", "y"))
    np.testing.assert_allclose(turned, plain[:, [0, 2, 1]] * (1, 1, -1), atol=1e-6 * np.abs(plain).max())


@pytest.mark.parametrize(("speed", "when"), [(0.4, 0.6), (0.0, None)])
def test_a_mesh_is_not_followed_through_a_merger(speed, when):
    parts = [
        Moving(Sphere(radius=0.3, center=(side * 0.55, 0.0, 0.0)), RigidMotion(velocity=(-side * speed, 0.0, 0.0)))
        for side in (-1.0, 1.0)
    ]
    times = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    if when is None:
        assert follow_mesh(Union(*parts), times, resolution=24).vertices.shape[0] == 6
        return
    with pytest.raises(InputError, match=r"two: its mesh cannot be followed to time 0\.[68] \(it has 1 piece with"):
        follow_mesh(Union(*parts), times, resolution=24, name="two")


def test_colours_ride_along_with_a_rigid_motion(run):
    field = load_field(run / "field.safetensors").field
    texture = load_texture(run / "texture.safetensors", moment(field, 0.0))
    transported = TransportedColors(field, texture)
    points = torch.from_numpy(extract_mesh(moment(field, 0.0), resolution=16).vertices).float()
    there = torch.from_numpy(extract_mesh(moment(field, 1.0), resolution=16).vertices).float()
    torch.testing.assert_close(transported.at(0.0)(points), texture.colors(points))
    torch.testing.assert_close(transported.at(1.0)(there), texture.colors(there - DRIFT), atol=0.01, rtol=0)


def test_colours_ride_along_a_velocity_that_was_learnt(run):
    """A turn of a ball, which no level set shows, turns its colours too."""
    field = load_field(run / "field.safetensors").field
    texture = load_texture(run / "texture.safetensors", moment(field, 0.0))
    motion = RigidMotion(angle=1.0, center=tuple(START.tolist()), velocity=tuple(DRIFT.tolist()))
    there = torch.from_numpy(extract_mesh(moment(field, 1.0), resolution=16).vertices).float()
    found = TransportedColors(field, texture, motion=motion.velocity).at(1.0)(there)
    start, home = moment(field, 0.0), motion.inverse(there, 1.0)
    back = project_to_surface(start, home)[0]
    near = start.value(home).abs() < 0.4 * CELL  # from half a cell on colours are averaged
    assert near.float().mean() > 0.5
    # Runge and Kutta's error of a turn by 1/12, twelve times: (1/12)⁴ / 120 of the radius; times the colours' slope
    torch.testing.assert_close(found[near], texture.colors(back)[near], atol=1e-4, rtol=0)
    assert (found - texture.colors(there - DRIFT)).abs().max() > 0.01


def test_colours_are_borrowed_from_a_run_in_other_units(run, tmp_path):
    """The first shape's own run has its own unit sphere, and may be a little larger or smaller in it."""
    field, place, _ = load_field(run / "field.safetensors")
    own = Similarity((place.center[0] + 0.1 * place.scale, *place.center[1:]), 1.25 * place.scale)
    start = travelling_ball().at(0.0)
    first = start.base.layers[0]
    with torch.no_grad():  # x = 1.25 x' + 0.1 e₁
        first.bias += 0.1 * first.weight[:, 0]
        first.weight *= 1.25
    texture = TextureField(start, ColorSiren(16, 1, omega=4.0), delta=0.1).requires_grad_(False)
    save_field(tmp_path / "field.safetensors", start, similarity=own)
    save_texture(tmp_path / "texture.safetensors", texture)
    borrowed, placed = borrowed_texture(tmp_path, field, place)
    points = torch.from_numpy(extract_mesh(moment(field, 0.0), resolution=16).vertices).float()
    same = torch.from_numpy(own.to_unit(place.to_input(points.numpy()))).float()
    found = TransportedColors(field, borrowed, placed=placed).at(0.0)(points)
    torch.testing.assert_close(found, texture.colors(same), atol=1e-4, rtol=0)
    with torch.no_grad():
        first.weight *= 1.5
    save_field(tmp_path / "field.safetensors", start, similarity=own)
    save_texture(tmp_path / "texture.safetensors", TextureField(start, ColorSiren(16, 1), delta=0.1))
    with pytest.raises(InputError, match=r"--colors .*: is not where the motion starts"):
        borrowed_texture(tmp_path, field, place)


def test_colours_of_the_last_shape_are_where_it_was_put(run, tmp_path):
    """The ball arrives where the second shape was put: turned, moved and of half its size in its own run."""
    (tmp_path / "run").mkdir()
    for name in ("field.safetensors", "texture.safetensors"):
        (tmp_path / "run" / name).write_bytes((run / name).read_bytes())
    turn, end = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), START + DRIFT
    placed = {"rotation": turn.tolist(), "scale": 0.5, "shift": end.tolist()}
    (tmp_path / "run" / "run.json").write_text(json.dumps({"config": {}, "placements": [placed, placed]}))
    field, own = load_field(run / "field.safetensors").field, travelling_ball().at(0.0)
    first = own.base.layers[0]
    with torch.no_grad():  # x = s R y + c is where the ball of time 1 is; at time 0 it is there less the drift
        first.bias += first.weight[:, :3] @ START
        first.weight[:, :3] = 0.5 * first.weight[:, :3] @ turn
    texture = TextureField(own, ColorSiren(16, 1, omega=4.0), delta=0.1).requires_grad_(False)
    save_field(tmp_path / "last.safetensors", own)
    save_texture(tmp_path / "texture.safetensors", texture)
    last = last_colors(tmp_path / "last.safetensors", tmp_path / "run" / "field.safetensors", field)
    points = torch.from_numpy(extract_mesh(moment(field, 1.0), resolution=16).vertices).float()
    torch.testing.assert_close(last(points), texture.colors((points - end) @ turn / 0.5), atol=1e-4, rtol=0)
    sheet = SequenceOptions(frames=2, size=(24, 24), samples=1, last_colors=tmp_path / "last.safetensors")
    assert "2 moments" in animate_run(tmp_path / "run", tmp_path / "sheet.png", sheet)
    with pytest.raises(InputError, match=r"--last-colors .* is not known to go from shape to shape"):
        animate_run(run, tmp_path / "film.gif", sheet)


def test_colours_ride_along_the_normals():
    """The points of a sphere that shrinks go straight inward."""
    field, start = ShrinkingSphere(radius=0.8, alpha=0.12), Sphere(radius=0.8)
    texture = TextureField(start, ColorSiren(16, 1, omega=4.0), delta=0.1).requires_grad_(False)
    towards = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    expected = texture.colors(0.8 * towards)
    assert float(expected.std(dim=0).min()) > 0.01
    for t in (0.0, 0.3, 1.0):
        points = towards * field.radius_at(torch.tensor(t))
        torch.testing.assert_close(TransportedColors(field, texture).at(t)(points), expected, atol=2e-3, rtol=0)


def test_colours_of_both_ends_fade_into_each_other():
    """On a sphere that a velocity turns: a point of time t was elsewhere t before, and will be 1 − t after."""
    field = Keyframes([0.0, 1.0], [Sphere(radius=0.5), Sphere(radius=0.5)])
    turn = RigidMotion(angle=1.0)
    transported = TransportedColors(field, lambda x: 0.5 + x, last=lambda x: 0.5 - x, motion=turn.velocity)
    points = 0.5 * torch.nn.functional.normalize(torch.randn(100, 3), dim=-1)
    for t in (0.0, 0.25, 1.0):
        before, after = turn.inverse(points, t), turn.forward(points, 1 - t)
        torch.testing.assert_close(transported.at(t)(points), 0.5 + (1 - t) * before - t * after, atol=1e-5, rtol=0)


def test_colours_do_not_tear_where_points_leave_the_surface():
    """Of points that come from a sphere's axis the nearest ones lie all around; those of one colour keep it."""
    sphere = Sphere(radius=0.5)
    field, shift = Keyframes([0.0, 1.0], [sphere, sphere]), RigidMotion(velocity=(0.5, 0.0, 0.0))
    across = torch.tensor([0.5, 0.0, 0.0]) + torch.linspace(-1e-3, 1e-3, 20)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    torn = TransportedColors(field, lambda x: (x[:, 1:2] > 0).float().expand(-1, 3), motion=shift.velocity)
    # Between cells of a half the slope is at most 2 for each unit.
    assert torn.at(1.0)(across).diff(dim=0).abs().max() < 4 * 2e-3 / 19
    plain = TransportedColors(field, lambda x: torch.full_like(x, 0.7), motion=shift.velocity)
    torch.testing.assert_close(plain.at(1.0)(across), torch.full_like(across, 0.7))


# Bad input


def test_what_cannot_be_written_is_refused_first(run, still, tmp_path):
    (tmp_path / "file").write_text("mine")
    for name, message in (
        ("film.avi", r"film\.avi: write a film \(\.mp4, \.gif\), a sheet of moments \(\.png\), a \.glb, or a folder"),
        ("file/film.mp4", r"file is no folder"),
    ):
        with pytest.raises(InputError, match=message):
            check_sequence_path(tmp_path / name)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"full: exists already"):
        check_sequence_path(tmp_path / "full")
    with pytest.raises(InputError, match=r"ball\.safetensors: does not move"):
        animate_run(still, tmp_path / "film.mp4")
    with pytest.raises(InputError, match=r"--level 3: .* has levels 0 to 0"):
        animate_run(run, tmp_path / "film.mp4", SequenceOptions(level=3))
    with pytest.raises(InputError, match=r"--colors .*ball\.safetensors: has no texture"):
        animate_run(run, tmp_path / "film.mp4", SequenceOptions(colors=still))
    with pytest.raises(InputError, match=r"--frames 1: a mesh moves in 2 frames or more"):
        animate_run(run, tmp_path / "ball.glb", SequenceOptions(frames=1))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "full"]


def test_eased_times_begin_and_end_at_rest():
    even, eased = (np.array(SequenceOptions(frames=201, ease=ease).times) for ease in (False, True))
    assert (eased[0], eased[100], eased[-1]) == (0.0, 0.5, 1.0)
    np.testing.assert_allclose(eased, 1 - eased[::-1], atol=1e-15)
    slope = np.gradient(eased, even)
    # ds²(3 − 2s) = 6 s (1 − s), to a cell's width at the ends and its square within.
    assert max(slope[0], slope[-1]) < 6 / 200
    np.testing.assert_allclose(slope[1:-1], (6 * even * (1 - even))[1:-1], atol=4 / 200**2)
    assert SequenceOptions(frames=1, ease=True).times == [0.0]


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_a_loop_goes_there_and_back_without_a_jump(count: int):
    frames = [np.full((2, 2, 3), index, np.uint8) for index in range(count)]
    shown = [int(frame[0, 0, 0]) for frame in there_and_back(iter(frames))]
    assert shown[:count] == list(range(count))
    assert len(shown) == max(2 * count - 2, 1)
    jumps = np.abs(np.diff([*shown, shown[0]]))
    assert (jumps == (count > 1)).all()


def test_flags_of_films_go_with_films(run, tmp_path):
    import argparse

    parser = argparse.ArgumentParser()
    COMMAND.add_arguments(parser)
    for line, message in (
        ("-o meshes --size 64", "--size: goes with a film"),
        ("-o meshes --loop", "--loop: goes with a film"),
        ("-o sheet.png --loop", "--loop: goes with a film"),
        ("-o film.mp4 --resolution 64", "--resolution: goes with meshes"),
        ("-o film.mp4 --no-colors --colors x", "--colors: --no-colors leaves them out"),
        ("-o film.mp4 --no-colors --last-colors x", "--last-colors: --no-colors leaves them out"),
    ):
        with pytest.raises(InputError, match=message):
            COMMAND.run(parser.parse_args([str(run), *line.split()]))
    out = tmp_path / "ball.gif"
    line = f"-o {out} --frames 2 --size 24 --samples 1 --shading headlight --up z --no-colors"
    assert COMMAND.run(parser.parse_args([str(run), *line.split()])) == 0
    assert len(iio.imread(out, index=None)) == 2
    line = line.replace("--frames 2", "--frames 3 --ease --loop")
    assert COMMAND.run(parser.parse_args([str(run), *line.split()])) == 0
    assert len(iio.imread(out, index=None)) == 4
