import contextlib
import itertools
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from mplicits.datasets.cameras import look_at
from mplicits.neural_fields import (
    InputError,
    Moving,
    MultiscaleSDF,
    RigidMotion,
    Similarity,
    Siren,
    SpaceTimeSDF,
    Sphere,
    TextureField,
    TimeSlice,
    save_field,
)
from mplicits.neural_fields.fields.primitives import Plane
from mplicits.neural_fields.networks.texture import ColorSiren
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.pipelines.render.trace import trace_view
from mplicits.pipelines.training.folder import named_cloud
from mplicits.pipelines.viewer import frames
from mplicits.pipelines.viewer.camera import (
    describe_reading,
    first_eye,
    image_size,
    probe,
    viser_camera,
    z_buffer,
)
from mplicits.pipelines.viewer.controls import Controls, slice_range
from mplicits.pipelines.viewer.frames import FrameScheduler, Look, View, halvings_in_time
from mplicits.pipelines.viewer.paint import Moments, Painter
from mplicits.pipelines.viewer.scene import OffsetField, Shapes, slice_image
from mplicits.pipelines.viewer.server import free_port, open_run, show_field
from scipy.spatial.transform import Rotation

LOOK = Look(level=0, normal_level=0, shading="normals")


def bumpy_sphere() -> MultiscaleSDF:
    return MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0)], [0.1], taper=0.3)


def some_camera(width: int = 64, height: int = 48):
    return look_at((0.3, 0.4, 2.5), (0.0, 0.0, 0.0), fov=35.0, width=width, height=height)


# Cameras and images


def test_camera_is_the_one_viser_describes():
    viser = pytest.importorskip("viser")
    for wxyz in np.random.default_rng(0).normal(size=(20, 4)):
        rotation = viser.transforms.SO3(wxyz / np.linalg.norm(wxyz))
        camera = viser_camera(wxyz, (1.0, -2.0, 3.0), 0.7, (80, 60))
        np.testing.assert_allclose(camera.world_from_camera[:3, :3], rotation.as_matrix(), atol=1e-12)
        np.testing.assert_array_equal(camera.eye, [1.0, -2.0, 3.0])
        # The middle of the upper edge, which half the angle of view away from the axis meets.
        edge = camera.eye + torch.from_numpy(rotation.apply(np.array([0.0, -math.tan(0.35), 1.0])))
        pixel, z = camera.project(edge)
        np.testing.assert_allclose(pixel, [39.5, -0.5], atol=1e-9)
        assert float(z) == pytest.approx(1.0)


@pytest.mark.parametrize("canvas", [(1280, 800), (400, 900), (100, 80)])
def test_image_has_the_shape_of_the_canvas_and_is_never_larger(canvas):
    width, height = image_size(256, canvas)
    assert width <= canvas[0]
    assert height <= canvas[1]
    assert width / height == pytest.approx(canvas[0] / canvas[1], rel=0.01)
    assert width * height == pytest.approx(min(256**2, canvas[0] * canvas[1]), rel=0.01)


def test_z_buffer_is_distance_from_the_plane_of_the_eye():
    camera = some_camera()
    seen = trace_view(Sphere(radius=0.5), camera)
    z = z_buffer(seen, camera).reshape(-1)
    np.testing.assert_allclose(z[seen.pixel], camera.project(seen.position)[1], atol=1e-6)
    assert np.isinf(np.delete(z, seen.pixel)).all()


@pytest.mark.parametrize(("up", "axis"), [("y", 1), ("z", 2)])
def test_first_view_holds_the_unit_sphere_from_a_little_above(up, axis):
    fov = 0.5
    eye = np.array(first_eye(up, fov))
    assert np.arcsin(1 / np.linalg.norm(eye)) <= fov / 2 + 1e-9
    assert 0.1 < eye[axis] / np.linalg.norm(eye) < 0.5


def test_painter_draws_every_shading_offered(tmp_path):
    cloud = tmp_path / "cloud.xyz"
    np.savetxt(cloud, torch.nn.functional.normalize(torch.randn(500, 3), dim=1).numpy() / 2)
    shown = show_field(bumpy_sphere(), cloud=cloud)
    assert "error" in shown.shadings
    assert "error" not in show_field(bumpy_sphere()).shadings
    images = []
    for shading in shown.shadings:
        rgb, z = shown.painter(some_camera(), Look(0, 1, shading), lambda: None)
        assert rgb.shape == (48, 64, 3)
        assert (rgb[np.isinf(z)] == 255).all()
        images.append(rgb)
    assert not any(np.array_equal(a, b) for a, b in itertools.combinations(images, 2))
    clear = shown.painter.picture(some_camera(), LOOK, lambda: None, transparent=True)
    np.testing.assert_array_equal(clear[..., 3] == 0, np.isinf(z))


def test_painter_stops_when_it_is_told_to():
    def stop() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        Painter(Sphere(radius=0.5), lambda: np.zeros((1, 3), np.float32))(some_camera(), LOOK, stop)


# What is drawn when


@pytest.mark.parametrize(
    ("measured", "halvings"),
    [
        ({}, 2),
        ({0: 0.1}, 0),
        ({0: 0.3}, 1),  # a quarter of the pixels: 0.075 s
        ({2: 0.02}, 1),  # four times as many: 0.08 s, sixteen times: 0.32 s
        ({0: 3.0, 1: 0.9, 2: 0.19}, 2),
        ({2: 90.0}, 3),  # never smaller than an eighth
    ],
)
def test_first_image_is_the_largest_that_is_quick(measured, halvings):
    assert halvings_in_time(measured, 0.2) == halvings


class Studio:
    """A scheduler whose drawings take as long as the test wants, and what came of them."""

    def __init__(self) -> None:
        self.begun: list[tuple[int, int]] = []  # view (by the number of its level) and width
        self.shown: list[tuple[int, int, int]] = []  # client, view, width
        self.errors: list[str] = []
        self.go = threading.Event()
        self.go.set()
        self.hold = 10**6  # width from which on drawings wait for `go`
        self.scheduler = FrameScheduler(self.draw, self.deliver, lambda _client, error: self.errors.append(str(error)))

    def draw(self, camera, look, check):
        self.begun.append((look.level, camera.width))
        if look.shading == "bad":
            raise RuntimeError("cannot draw this")
        while camera.width >= self.hold and not self.go.is_set():
            check()
            time.sleep(0.002)
        check()
        size = (camera.height, camera.width)
        return np.zeros((*size, 3), np.uint8), np.full(size, np.inf, np.float32)

    def deliver(self, client, frame):
        self.shown.append((client, self.begun[-1][0], frame.camera.width))

    def request(self, client, number, shading="normals"):
        self.scheduler.request(client, View(some_camera(), Look(number, number, shading)))

    def wait(self, condition):
        deadline = time.monotonic() + 5
        while not condition():
            assert time.monotonic() < deadline, (self.begun, self.shown)
            time.sleep(0.002)


@pytest.fixture
def studio():
    made = Studio()
    yield made
    made.go.set()
    made.scheduler.close()


def test_images_become_finer_until_they_are_full(studio):
    studio.request(7, 1)
    studio.wait(lambda: len(studio.shown) == 3)
    assert studio.shown == [(7, 1, 16), (7, 1, 32), (7, 1, 64)]
    studio.request(7, 1)  # the same again: all of it is known to be quick now
    studio.wait(lambda: len(studio.shown) == 4)
    time.sleep(0.02)
    assert studio.shown[3:] == [(7, 1, 64)]


def test_a_newer_view_cancels_fine_images_of_the_older(studio):
    studio.hold = 32
    studio.go.clear()
    studio.request(1, 1)
    studio.wait(lambda: (1, 32) in studio.begun)
    studio.request(1, 2)
    studio.wait(lambda: (2, 32) in studio.begun)
    studio.go.set()
    studio.wait(lambda: (1, 2, 64) in studio.shown)
    assert studio.shown == [(1, 1, 16), (1, 2, 16), (1, 2, 32), (1, 2, 64)]


def test_a_first_image_is_finished_though_the_camera_moves_on(studio):
    studio.hold = 16
    studio.go.clear()
    studio.request(1, 1)
    studio.wait(lambda: studio.begun)
    studio.request(1, 2)
    studio.go.set()
    studio.wait(lambda: (1, 2, 64) in studio.shown)
    assert studio.shown[:2] == [(1, 1, 16), (1, 2, 16)]


def test_a_client_that_never_stops_asking_does_not_keep_others_from_fine_images(studio, monkeypatch):
    monkeypatch.setattr(frames, "AHEAD", 0.01)
    deliver, draw = studio.scheduler._deliver, studio.scheduler._draw

    def slow(*arguments):
        time.sleep(0.002)
        return draw(*arguments)

    def again(client, frame):  # there is a first image to be drawn for it at any time
        deliver(client, frame)
        if client == 1:
            studio.request(1, len(studio.shown))

    studio.scheduler._draw, studio.scheduler._deliver = slow, again
    studio.request(1, 0)
    studio.wait(lambda: len(studio.shown) > 5)
    studio.request(2, 10**6)
    studio.wait(lambda: any(client == 2 and width == 64 for client, _, width in studio.shown))
    before = len(studio.shown)
    studio.wait(lambda: len(studio.shown) > before + 5)  # nor is it forgotten itself
    studio.scheduler.leave(1)


def test_first_images_of_others_come_before_fine_ones(studio):
    studio.hold = 64
    studio.go.clear()
    studio.request(1, 1)
    studio.wait(lambda: (1, 64) in studio.begun)
    studio.request(2, 2)
    studio.wait(lambda: (2, 2, 32) in studio.shown)  # while the other's full image waits
    studio.go.set()
    studio.wait(lambda: {(1, 1, 64), (2, 2, 64)} <= set(studio.shown))


def test_a_client_that_leaves_costs_nothing_more(studio):
    studio.hold = 32
    studio.go.clear()
    studio.request(1, 1)
    studio.wait(lambda: (1, 32) in studio.begun)
    studio.scheduler.forget(1)
    studio.request(2, 2)
    studio.wait(lambda: (2, 32) in studio.begun)
    studio.go.set()
    studio.wait(lambda: (2, 2, 64) in studio.shown)
    assert [width for client, _, width in studio.shown if client == 1] == [16]


def test_a_failed_drawing_is_told_and_the_next_one_is_drawn(studio, capsys):
    studio.request(1, 1, shading="bad")
    studio.wait(lambda: studio.errors)
    assert studio.errors == ["cannot draw this"]
    studio.request(1, 2)
    studio.wait(lambda: (1, 2, 64) in studio.shown)
    assert "RuntimeError: cannot draw this" in capsys.readouterr().err


def test_closing_ends_the_thread_in_the_midst_of_a_drawing(studio):
    studio.hold = 16
    studio.go.clear()
    studio.request(1, 1)
    studio.wait(lambda: studio.begun)
    before = threading.active_count()
    studio.scheduler.close()
    assert threading.active_count() == before - 1


# Beside the image


def test_probe_reads_position_normal_and_distances_in_input_coordinates():
    similarity = Similarity((100.0, 200.0, 300.0), 10.0)
    field = MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0)], [0.1]).requires_grad_(False)
    reading = probe(field, similarity, (0.0, 0.0, 3.0), (0.0, 0.0, -2.0), level=0)
    assert reading is not None
    np.testing.assert_allclose(reading.position, [100.0, 200.0, 305.0], atol=1e-4)
    np.testing.assert_allclose(reading.normal, [0.0, 0.0, 1.0], atol=1e-5)
    correction = float(field.value(torch.tensor([[0.0, 0.0, 0.5]]), level=1))
    np.testing.assert_allclose(reading.distances, [0.0, 10 * correction], atol=1e-4)
    assert not reading.on_plane
    text = describe_reading(reading, similarity.scale)
    assert "position 100.0000, 200.0000, 305.0000" in text
    assert "normal +0.000, +0.000, +1.000" in text


@pytest.mark.parametrize(
    ("similarity", "axis", "expected"),
    [
        (Similarity.identity(), 0, (-1.0, 1.0, 0.01)),
        (Similarity((100.0, 200.0, 300.0), 10.0), 1, (190.0, 210.0, 0.1)),
        (Similarity((0.0, 0.0, 0.123), 0.0456), 2, (0.0775, 0.1685, 0.0005)),
        (Similarity((512_345.678, 5_403_210.987, 312.5), 40.0), 1, (5_403_171.0, 5_403_250.5, 0.5)),
        (Similarity((0.0, 0.0, 0.0), 30_000.0), 0, (-30_000.0, 30_000.0, 200.0)),
    ],
)
def test_slices_stand_at_round_input_coordinates(similarity, axis, expected):
    low, high, step = slice_range(similarity, axis)
    assert (low, high) == expected[:2]
    assert step == pytest.approx(expected[2])


class Panel:
    """A panel without a browser: controls that only hold what they are given."""

    class Control:
        def __init__(self, value=None, **said):
            self.value, self.heard = value, []
            vars(self).update(said)

        def on_update(self, listener):
            self.heard.append(listener)

        def set(self, value):
            self.value = value
            for listener in self.heard:
                listener(None)

    def __init__(self):
        self.controls = {}

    def add_folder(self, *_, **__):
        return contextlib.nullcontext()

    def _add(self, label, value, **said):
        return self.controls.setdefault(label, self.Control(value, **said))

    def add_slider(self, label, *, initial_value, **said):
        return self._add(label, initial_value, **said)

    def add_dropdown(self, label, options, initial_value=None, **said):
        return self._add(label, initial_value or options[0], **said)

    def add_checkbox(self, label, value, **said):
        return self._add(label, value, **said)

    def add_number(self, label, value, **said):
        return self._add(label, value, **said)

    def add_button(self, label, **said):
        return self._add(label, None, **said)

    def add_markdown(self, text):
        return self._add(text, None, content=text)


def test_colours_of_a_motion_that_was_learnt_ride_along_it():
    """A ball that turns about z, by a velocity beside its field, which itself stands still."""
    still, turn = Sphere(radius=0.5), RigidMotion(angle=1.0)
    texture = TextureField(still, ColorSiren(8, 1, omega=4.0), delta=0.1).requires_grad_(False)
    painter = Painter(
        Keyframes([0.0, 1.0], [still, still]), lambda: np.zeros((0, 3), np.float32), texture, turn.velocity
    )
    points = 0.5 * torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    colors = painter._colors(replace(LOOK, time=1.0))
    assert colors is not None
    torch.testing.assert_close(colors(points), texture.colors(turn.inverse(points, 1.0)), atol=1e-4, rtol=0)


def test_the_slice_slider_and_the_readout_are_in_the_same_units():
    panel = Panel()
    similarity = Similarity((100.0, 200.0, 300.0), 10.0)
    controls = Controls(panel, levels=2, shadings=["normals"], has_cloud=False, similarity=similarity, deltas=[0.05])
    slider, axis = panel.controls["Slice at"], panel.controls["Slice across"]
    assert (slider.min, slider.max, slider.value) == (90.0, 110.0, 100.0)
    assert controls.slice is None
    panel.controls["Slice plane"].set(True)
    slider.set(104.0)
    assert controls.slice == (0, pytest.approx(0.4))
    axis.set("z")
    assert (slider.min, slider.max, slider.value) == (290.0, 310.0, 300.0)
    assert controls.slice == (2, pytest.approx(0.0))
    slider.set(307.5)
    reading = probe(
        Sphere(radius=0.5), similarity, (0.2, 0.1, 3.0), (0.0, 0.0, -1.0), level=0, surface=False, plane=controls.slice
    )
    assert reading is not None
    assert reading.position[2] == pytest.approx(307.5, abs=1e-5)
    assert "δ = 0.5 in input units" in panel.controls["Band"].hint


def test_probe_finds_the_slice_plane_where_it_is_in_front():
    field, unit = Sphere(radius=0.5), Similarity.identity()
    look = {"origin": (0.2, 0.1, 3.0), "direction": (0.0, 0.0, -1.0), "level": 0}
    reading = probe(field, unit, **look, plane=(2, 0.75))
    assert reading is not None
    assert reading.on_plane
    np.testing.assert_allclose(reading.point, [0.2, 0.1, 0.75], atol=1e-6)
    assert reading.distances[0] == pytest.approx(math.sqrt(0.05 + 0.75**2) - 0.5, abs=1e-6)
    behind = probe(field, unit, **look, plane=(2, -0.75))
    assert behind is not None
    assert not behind.on_plane
    hidden = probe(field, unit, **look, plane=(2, -0.75), surface=False)
    assert hidden is not None
    assert hidden.point[2] == pytest.approx(-0.75)
    aside = {**look, "origin": (1.5, 0.0, 3.0)}
    assert probe(field, unit, **aside, plane=(2, 0.0)) is None
    assert probe(field, unit, **aside, plane=(0, 0.0)) is None  # parallel to the ray
    assert describe_reading(None, 1.0) == "Nothing is under the pointer."


def test_shells_stand_where_the_level_says_delta():
    field = bumpy_sphere()
    shapes = Shapes(field, Similarity.identity())
    for mesh, radius in zip(shapes.shells(0), (0.4, 0.6), strict=True):
        assert mesh is not None
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), radius, atol=1e-3)
    surface = shapes.surface(0)
    assert surface is not None
    np.testing.assert_allclose(np.linalg.norm(surface.vertices, axis=1), 0.5, atol=1e-3)
    assert shapes.surface(0) is surface
    points = torch.randn(50, 3) / 3
    torch.testing.assert_close(
        OffsetField(field, level=1, offset=0.2).jet(points).value, field.value(points, level=1) - 0.2
    )


def test_a_shape_too_thin_for_its_inner_shell_has_none():
    thin = MultiscaleSDF(Sphere(radius=0.05), [Siren(16, 2, omega=5.0)], [0.1])
    inner, outer = Shapes(thin, Similarity.identity()).shells(0)
    assert inner is None
    assert outer is not None


def test_cloud_comes_in_unit_coordinates_or_not_at_all(tmp_path):
    file = tmp_path / "cloud.xyz"
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.savetxt(file, points * 3 + [11.0, 20.0, 30.0])
    similarity = Similarity((11.0, 20.0, 30.0), 3.0)
    np.testing.assert_allclose(Shapes(Sphere(), similarity, cloud=file).cloud(), points, atol=1e-6)
    with pytest.raises(InputError, match="not to be found"):
        Shapes(Sphere(), similarity).cloud()


def test_a_run_is_shown_with_its_cloud_from_any_folder(tmp_path, monkeypatch):
    """Without one, a line says that there are no errors to be seen, and what to do about it."""
    said, run = [], tmp_path / "runs" / "ball"
    run.mkdir(parents=True)
    (tmp_path / "ball.xyz").write_text("0 0 1\n0 1 0\n1 0 0\n")
    monkeypatch.chdir(tmp_path)
    save_field(run / "field.safetensors", Siren(8, 1), metadata={"run": named_cloud("ball.xyz", run)})
    monkeypatch.chdir(run)
    assert "error" in open_run(run, say=said.append).shadings
    assert said == []
    (tmp_path / "ball.xyz").rename(tmp_path / "renamed.xyz")
    assert "error" not in open_run(run, say=said.append).shadings
    (line,) = said
    assert "ball.xyz is not to be found; without it no errors are shown; name it with --cloud FILE" in line
    assert "error" in open_run(run, cloud=tmp_path / "renamed.xyz", say=said.append).shadings
    with pytest.raises(InputError, match=r"ball\.xyz: no such file"):
        open_run(run, cloud=tmp_path / "ball.xyz", say=said.append)
    save_field(tmp_path / "own.safetensors", Siren(8, 1))  # fitted to nothing: nothing is missing
    open_run(tmp_path / "own.safetensors", say=said.append)
    assert len(said) == 1


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_slice_stands_where_its_values_are(axis):
    normal = np.array([0.48, 0.6, 0.64])
    image, pose = slice_image(Plane(normal=tuple(normal), offset=0.1), axis, 0.25, level=0, scale=1.0, pixels=64)
    steps = (np.arange(64) + 0.5) / 64 * 2 - 1
    local = np.stack((*np.meshgrid(steps, steps), np.zeros((64, 64))), axis=-1).reshape(-1, 3)
    world = Rotation.from_quat(np.roll(pose.wxyz, -1)).apply(local) + pose.center
    np.testing.assert_allclose(world[:, axis], 0.25, atol=1e-12)
    values = world @ normal - 0.1
    red, _, blue = image.reshape(-1, 3).astype(int).T
    clear = np.abs(values) > 0.1
    assert ((blue > red) == (values > 0))[clear].mean() > 0.97  # blue outside, orange inside, but for iso-lines


# The command


def test_ports_are_found_or_refused_in_a_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=rf"--port {port}: is in use"):
            free_port("127.0.0.1", port)
        assert free_port("127.0.0.1", None) != port
    with pytest.raises(InputError, match=r"--host 192\.0\.2\.1: cannot listen there"):
        free_port("192.0.2.1", None)


def test_a_missing_viser_is_an_error_with_its_cure(monkeypatch):
    from mplicits.pipelines.viewer.server import Viewer

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install mplicits\[view\]"):
        Viewer(show_field(Sphere()))


def test_a_field_that_moves_is_shown_as_it_is_at_each_time(tmp_path):
    field = Moving(Sphere(radius=0.4), RigidMotion(velocity=(0.0, 0.0, 0.5)))
    shown = show_field(field)
    shown.painter.warm_up()
    for t in (0.0, 0.5, 1.0):
        z = shown.painter(some_camera(), replace(LOOK, time=t), lambda: None)[1]
        expected = z_buffer(trace_view(TimeSlice(field, t), some_camera()), some_camera())
        np.testing.assert_array_equal(z, expected)
        mesh = shown.shapes.surface(0, time=t)
        assert mesh is not None
        np.testing.assert_allclose(mesh.vertices.mean(axis=0), (0.0, 0.0, 0.5 * t), atol=0.01)
    save_field(tmp_path / "moving.safetensors", SpaceTimeSDF.from_widths([(8, 1)], omegas=[5]))
    assert open_run(tmp_path / "moving.safetensors").shapes.moments.moves


def test_few_moments_are_kept():
    moments = Moments(Moving(Sphere(), RigidMotion()))
    first = moments.at(0.0)
    assert moments.at(0.0) is first
    for k in range(1, 100):
        moments.at(k / 100)
    assert moments.at(0.0) is not first
    still = Sphere()
    assert Moments(still).at(0.7) is still


def test_ctrl_c_ends_the_command_cleanly(tmp_path):
    pytest.importorskip("viser")
    save_field(tmp_path / "small.safetensors", Siren(8, 1))
    program = (
        "import argparse, sys\n"
        "from mplicits.pipelines.cli.draw import VIEW\n"
        "parser = argparse.ArgumentParser()\n"
        "VIEW.add_arguments(parser)\n"
        "sys.exit(VIEW.run(parser.parse_args()))\n"
    )
    arguments = [sys.executable, "-c", program, str(tmp_path / "small.safetensors"), "--port", "0"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "open http://127.0.0.1:" in line, line
        os.kill(process.pid, signal.SIGINT)
        out, error = process.communicate(timeout=20)
        assert (process.returncode, out.strip(), error) == (0, "", "")
