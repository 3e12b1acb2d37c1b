"""Films, folders of meshes and moving meshes of surfaces whose motion is known."""

import json
import shutil
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
import trimesh
from evolutions import fails
from glb import attribute, read_glb
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
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.tracing.sphere import project_to_surface
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.evolve import animate
from mplicits.pipelines.evolve.animate import MovingSurface, SequenceOptions, animate_run, film_frames
from mplicits.pipelines.evolve.follow import follow_mesh
from mplicits.pipelines.mesh.extract import MeshOptions, mesh_run
from mplicits.pipelines.render.draw import Orbit, RenderOptions, render_run
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.texture.spread import CELL
from mplicits.pipelines.texture.transport import TransportedColors, borrowed_colors, texture_colors
from mplicits.pipelines.training.folder import load_still

from benchmarks.motion.figures import ShrinkingSphere

RADIUS, DRIFT = 0.3, torch.tensor([0.5, 0.0, 0.0])
START = torch.tensor([-0.25, 0.0, 0.0])
PLACE = Similarity((100.0, -20.0, 3.0), 2.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A small network that is a ball, nearly, and whose motion is exact: W(x − v t) + b."""
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
    directory = tmp_path_factory.mktemp("run")
    save_field(directory / "field.safetensors", field, similarity=PLACE)
    torch.manual_seed(3)
    texture = TextureField(moment(field, 0.0), ColorSiren(16, 1, omega=4.0), delta=0.1)
    save_texture(directory / "texture.safetensors", texture)
    return directory


@pytest.fixture(scope="module")
def still(run: Path, tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("still") / "ball.safetensors"
    save_field(file, moving_field(run).at(0.0))
    return file


def moving_field(run: Path) -> SpaceTimeSDF:
    return load_field(run / "field.safetensors").field


def start_texture(run: Path) -> TextureField:
    return load_texture(run / "texture.safetensors", moment(moving_field(run), 0.0))


def points_of(field: SpaceTimeSDF, t: float) -> torch.Tensor:
    """Points of the surface at a time."""
    return torch.from_numpy(extract_mesh(moment(field, t), resolution=16).vertices).float()


def center(t: float) -> np.ndarray:
    return PLACE.to_input((START + t * DRIFT).double().numpy()[None])[0]


def test_a_time_goes_with_what_moves_and_with_nothing_else(run, still, tmp_path):
    x = 2 * torch.rand(50, 3) - 1
    torch.testing.assert_close(load_still(run, 0.25).field.value(x), TimeSlice(moving_field(run), 0.25).value(x))
    mesh = tmp_path / "ball.ply"
    trimesh.creation.icosphere().export(mesh)
    picture, at_start = tmp_path / "picture.png", RenderOptions(time=0.0)
    for call, message in (
        (lambda: load_still(run), r"field\.safetensors: .*--time"),
        (lambda: load_still(still, 0.5), r"--time 0\.5: .*ball\.safetensors"),
        (lambda: load_still(run, 1.5), r"--time 1\.5"),
        (lambda: mesh_run(run, tmp_path / "mesh.ply"), "--time"),
        (lambda: render_run(still, picture, at_start), "--time 0"),
        (lambda: render_run(mesh, picture, at_start), r"--time 0: .*ball\.ply"),
    ):
        with pytest.raises(InputError, match=message):
            call()


@pytest.mark.parametrize("time", [0.0, 0.5, 1.0])
def test_a_mesh_of_a_moment_is_where_the_surface_is_then(run, tmp_path, time):
    mesh_run(run, tmp_path / "mesh.ply", MeshOptions(time=time, resolution=32))
    surface = read_surface(tmp_path / "mesh.ply")
    away = np.linalg.norm(surface.vertices - center(time), axis=1)
    np.testing.assert_allclose(away, RADIUS * PLACE.scale, atol=0.05)
    assert surface.colors is not None


def test_every_frame_of_a_film_is_what_tracing_it_alone_shows(run):
    options = SequenceOptions(frames=4, size=(40, 32), samples=1, shading="normals")
    frames = list(film_frames(MovingSurface(run, moving_field(run), PLACE, 0, None, options)))
    assert {frame.shape for frame in frames} == {(32, 40, 3)}
    balls = [(frame < 255).any(axis=2) for frame in frames]
    steps = np.diff([np.nonzero(ball)[1].mean() for ball in balls])
    assert (steps > 1).all()  # the ball travels to the right, evenly
    assert steps.std() < 0.5


def test_films_are_written(run, tmp_path):
    options = SequenceOptions(frames=3, size=(32, 32), fps=10.0)
    told: list[tuple[int, int]] = []
    for name in ("ball.gif", "ball.mp4"):
        said = animate_run(run, tmp_path / name, options, progress=lambda *done: told.append(done))
        assert said == "3 frames of 32×32"
    assert told == 2 * [(1, 3), (2, 3), (3, 3)]
    assert len(iio.imread(tmp_path / "ball.gif", index=None)) == 3
    assert cv2.VideoCapture(str(tmp_path / "ball.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3


def test_a_sheet_has_all_frames_with_their_times(run, tmp_path):
    options = SequenceOptions(frames=8, size=(32, 24), samples=1, no_colors=True)
    assert animate_run(run, tmp_path / "ball.png", options) == "8 moments of 32×24"
    sheet = iio.imread(tmp_path / "ball.png")
    assert sheet.shape == (2 * (24 + 40), 7 * (32 + 12), 3)
    frames = list(film_frames(MovingSurface(run, moving_field(run), PLACE, 0, None, options)))
    np.testing.assert_array_equal(sheet[40:64, 6:38], frames[0])
    np.testing.assert_array_equal(sheet[104:128, 6:38], frames[7])
    assert (sheet[64:, 44:] == 255).all()


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


def test_a_moving_mesh_is_on_the_surface_in_every_frame(run, tmp_path):
    file = tmp_path / "ball.glb"
    said = animate_run(run, file, SequenceOptions(frames=5, fps=8.0, resolution=20))
    header, arrays = read_glb(file)
    (primitive,) = header["meshes"][0]["primitives"]
    base = attribute(file, "POSITION")
    assert said.startswith(f"{len(base):,} vertices in 5 frames")
    (animation,) = header["animations"]
    (sampler,) = animation["samplers"]
    assert animation["channels"] == [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]
    np.testing.assert_allclose(arrays[sampler["input"]][:, 0], np.arange(5) / 8.0)
    weights = arrays[sampler["output"]].reshape(5, 4)
    assert len(header["meshes"][0]["weights"]) == len(primitive["targets"]) == 4
    field = moving_field(run)
    for frame, t in enumerate(np.linspace(0, 1, 5)):
        frames = {}
        for name in ("POSITION", "NORMAL"):
            targets = np.stack([arrays[target[name]] for target in primitive["targets"]])
            frames[name] = attribute(file, name) + np.tensordot(weights[frame], targets, axes=1)
        points = torch.from_numpy(PLACE.to_unit(frames["POSITION"].astype(np.float64))).float()
        jet = TimeSlice(field, float(t)).jet(points)
        assert float(jet.value.abs().max()) < 1e-3
        np.testing.assert_allclose(points.mean(dim=0), START + t * DRIFT, atol=0.02)
        np.testing.assert_allclose(frames["NORMAL"], torch.nn.functional.normalize(jet.gradient, dim=-1), atol=1e-4)
    np.testing.assert_allclose(trimesh.load_mesh(file, process=False).vertices, base)


def test_colours_of_a_moving_mesh_are_those_of_its_start(run, tmp_path):
    animate_run(run, tmp_path / "ball.glb", SequenceOptions(frames=2, resolution=16))
    mesh_run(run, tmp_path / "start.ply", MeshOptions(time=0.0, resolution=16))
    colors = linear_to_srgb(attribute(tmp_path / "ball.glb", "COLOR_0")[:, :3] / 65535)
    np.testing.assert_allclose(colors, read_surface(tmp_path / "start.ply").colors, atol=2 / 255)


def test_a_moving_mesh_of_a_z_up_run_is_turned_y_up(run, tmp_path):
    for up in ("y", "z"):
        animate_run(run, tmp_path / f"{up}.glb", SequenceOptions(frames=2, resolution=16, orbit=Orbit(up=up)))
    turned, plain = (trimesh.load_mesh(tmp_path / f"{up}.glb", process=False).vertices for up in ("z", "y"))
    np.testing.assert_allclose(turned, plain[:, [0, 2, 1]] * (1, 1, -1), atol=1e-6 * np.abs(plain).max())


def test_a_mesh_is_not_followed_through_a_merger():
    def two_balls(speed: float) -> Union:
        left, right = (Sphere(radius=0.3, center=(x, 0.0, 0.0)) for x in (-0.55, 0.55))
        there, back = (RigidMotion(velocity=(v, 0.0, 0.0)) for v in (speed, -speed))
        return Union(Moving(left, there), Moving(right, back))

    times = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert len(follow_mesh(two_balls(0.0), times, resolution=24).vertices) == 6
    with pytest.raises(InputError, match=r"two: .* time 0\.[68] \(it has 1 piece with"):
        follow_mesh(two_balls(0.4), times, resolution=24, name="two")


def test_colours_ride_along_with_a_rigid_motion(run):
    field, texture = moving_field(run), start_texture(run)
    transported = TransportedColors(field, texture_colors(texture))
    points, there = points_of(field, 0.0), points_of(field, 1.0)
    torch.testing.assert_close(transported.at(0.0)(points), texture.colors(points))
    torch.testing.assert_close(transported.at(1.0)(there), texture.colors(there - DRIFT), atol=0.01, rtol=0)


def test_colours_ride_along_a_velocity_that_was_learnt(run):
    """A turn of a ball, which no level set shows, turns its colours too."""
    field, texture = moving_field(run), start_texture(run)
    motion = RigidMotion(angle=1.0, center=tuple(START.tolist()), velocity=tuple(DRIFT.tolist()))
    there = points_of(field, 1.0)
    found = TransportedColors(field, texture_colors(texture), motion=motion.velocity).at(1.0)(there)
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
    start = moving_field(run).at(0.0)
    first = start.base.layers[0]
    with torch.no_grad():  # x = 1.25 x' + 0.1 e₁
        first.bias += 0.1 * first.weight[:, 0]
        first.weight *= 1.25
    texture = TextureField(start, ColorSiren(16, 1, omega=4.0), delta=0.1).requires_grad_(False)
    save_field(tmp_path / "field.safetensors", start, similarity=own)
    save_texture(tmp_path / "texture.safetensors", texture)
    borrowed = borrowed_colors(tmp_path, field, place)
    points = points_of(field, 0.0)
    same = torch.from_numpy(own.to_unit(place.to_input(points.numpy()))).float()
    found = TransportedColors(field, borrowed).at(0.0)(points)
    torch.testing.assert_close(found, texture.colors(same), atol=1e-4, rtol=0)
    with torch.no_grad():
        first.weight *= 1.5
    save_field(tmp_path / "field.safetensors", start, similarity=own)
    save_texture(tmp_path / "texture.safetensors", TextureField(start, ColorSiren(16, 1), delta=0.1))
    with pytest.raises(InputError, match=r"--colors .*: is not where the motion starts"):
        borrowed_colors(tmp_path, field, place)


def test_colours_of_the_last_shape_are_where_it_was_put(run, tmp_path):
    """The ball arrives where the second shape was put: turned, moved and of half its size in its own run."""
    shutil.copytree(run, tmp_path / "run")
    turn, end = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), START + DRIFT
    placed = {"rotation": turn.tolist(), "scale": 0.5, "shift": end.tolist()}
    (tmp_path / "run" / "run.json").write_text(json.dumps({"config": {}, "placements": [placed, placed]}))
    field, own = moving_field(run), moving_field(run).at(0.0)
    first = own.base.layers[0]
    with torch.no_grad():  # x = s R y + c is where the ball of time 1 is; at time 0 it is there less the drift
        first.bias += first.weight[:, :3] @ START
        first.weight[:, :3] = 0.5 * first.weight[:, :3] @ turn
    texture = TextureField(own, ColorSiren(16, 1, omega=4.0), delta=0.1).requires_grad_(False)
    save_field(tmp_path / "last.safetensors", own)
    save_texture(tmp_path / "texture.safetensors", texture)
    last = animate.last_colors(tmp_path / "last.safetensors", tmp_path / "run" / "field.safetensors", field)
    points = points_of(field, 1.0)
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
        torch.testing.assert_close(
            TransportedColors(field, texture_colors(texture)).at(t)(points), expected, atol=2e-3, rtol=0
        )


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


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("RUN -o film.avi", "film.avi: write a film"),
        ("RUN -o file/film.mp4", "file is no folder"),
        ("RUN -o full", "full: exists already"),
        ("STILL -o film.mp4", "ball.safetensors: does not move"),
        ("RUN -o film.mp4 --level 3", "--level 3: "),
        ("RUN -o film.mp4 --colors STILL", "ball.safetensors: has no texture"),
        ("RUN -o ball.glb --frames 1", "--frames 1: "),
        ("RUN -o meshes --size 64", "--size: goes with a film"),
        ("RUN -o meshes --loop", "--loop: goes with a film"),
        ("RUN -o sheet.png --loop", "--loop: goes with a film"),
        ("RUN -o film.mp4 --resolution 64", "--resolution: goes with meshes"),
        ("RUN -o film.mp4 --no-colors --colors x", "--colors: --no-colors"),
        ("RUN -o film.mp4 --no-colors --last-colors x", "--last-colors: --no-colors"),
    ],
)
def test_what_cannot_be_written_is_refused_first(run, still, tmp_path, monkeypatch, capsys, line, message):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("mine")
    Path("full").mkdir()
    Path("full/notes.txt").write_text("mine")
    assert message in fails(capsys, f"animate {line.replace('RUN', str(run)).replace('STILL', str(still))}")
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
    shown = [int(frame[0, 0, 0]) for frame in animate.there_and_back(iter(frames))]
    assert shown[:count] == list(range(count))
    assert len(shown) == max(2 * count - 2, 1)
    jumps = np.abs(np.diff([*shown, shown[0]]))
    assert (jumps == (count > 1)).all()


@pytest.mark.parametrize(("flags", "count"), [("--frames 2", 2), ("--frames 3 --ease --loop", 4)])
def test_the_command_writes_films(run, tmp_path, flags, count):
    out = tmp_path / "ball.gif"
    line = f"animate {run} -o {out} {flags} --size 24 --samples 1 --shading headlight --up z --no-colors"
    assert main(line.split()) == 0
    assert len(iio.imread(out, index=None)) == count
