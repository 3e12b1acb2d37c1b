"""Slices: exact values at pixel centres, lines and bands where they belong, planes in input coordinates."""

import math
import re

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from evolutions import fails
from fields import small_multiscale
from mplicits.neural_fields import Box, MultiscaleSDF, Plane, Similarity, Siren, Sphere, Torus, Union, save_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.render import slice as slices
from mplicits.pipelines.render.legend import with_legend
from mplicits.pipelines.render.slice import FINEST, draw_slice, level_color, plane_axes, slice_points, take_slice
from mplicits.pipelines.render.slicing import SliceOptions, slice_run

ACROSS_Z = {"origin": (0.0, 0.0, 0.0), "u": (1.0, 0.0, 0.0), "v": (0.0, 1.0, 0.0)}
INK = np.array(FINEST) * 255


def is_ink(image: np.ndarray, color=FINEST, *, within: float = 40.0) -> np.ndarray:
    return np.abs(image.astype(float) - np.array(color) * 255).max(axis=2) < within


def is_inside(image: np.ndarray) -> np.ndarray:
    """Orange, not blue."""
    return image[..., 0].astype(int) > image[..., 2]


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("normal", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -2), (1, -2, 3)])
def test_the_axes_of_a_plane_are_seen_from_the_side_of_its_normal(normal, up):
    u, v = plane_axes(normal, up=up)
    np.testing.assert_allclose(np.cross(u, v), np.array(normal) / np.linalg.norm(normal), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm((u, v), axis=1), 1, atol=1e-12)
    if abs(normal["xyz".index(up)]) < 0.9 * np.linalg.norm(normal):
        assert v["xyz".index(up)] > 0


def test_the_default_view_has_x_to_the_right_and_y_upwards():
    u, v = plane_axes((0, 0, 1))
    np.testing.assert_array_equal((u, v), [(1, 0, 0), (0, 1, 0)])
    points = slice_points(origin=(5, 6, 7), u=u, v=v, half_size=2, size=(6, 4))
    assert points.shape == (4, 6, 3)
    np.testing.assert_allclose(points[0, 0], (5 - 2.5, 6 + 1.5, 7))
    np.testing.assert_allclose(points[3, 5], (5 + 2.5, 6 - 1.5, 7))
    np.testing.assert_allclose(points[1, 3] - points[1, 2], (1, 0, 0))  # pixels are square


def test_values_are_the_fields_own_at_every_pixel_centre():
    u, v = plane_axes((1, 2, 3))
    origin, half, step = np.array((0.1, -0.2, 0.05)), 0.7, 0.07
    torus = Torus(major=0.5, minor=0.2)
    (values,) = take_slice(torus, origin=origin, u=u, v=v, half_size=half, size=(30, 20)).levels
    assert values.shape == (20, 30)
    for row, column in ((0, 0), (3, 17), (19, 29)):
        x, y, z = origin + (column - 14.5) * step * u + (9.5 - row) * step * v
        assert values[row, column] == pytest.approx(np.hypot(np.hypot(x, y) - 0.5, z) - 0.2, abs=1e-6)


def test_every_level_and_band_of_a_slice_is_that_of_the_field():
    field = small_multiscale()
    view = {"origin": (0.1, 0.0, 0.2), "u": (1.0, 0.0, 0.0), "v": (0.0, 0.6, 0.8), "half_size": 0.9, "size": (50, 40)}
    points = slice_points(**view).float()
    for level in (0, 1, 2, -1):
        taken = take_slice(field, **view, level=level)
        resolved = field.resolve_level(level)
        assert len(taken.levels) == resolved + 1
        assert taken.finest == (resolved == 2)
        for index, values in enumerate(taken.levels):
            np.testing.assert_allclose(values, field.value(points, level=index).detach(), atol=1e-6)
        assert len(taken.bands) == min(resolved + 1, 2)
        for index, band in enumerate(taken.bands):
            np.testing.assert_array_equal(band, field.in_band(points, level=index + 1))
            assert 0.05 < band.mean() < 0.95


def test_the_zero_line_lies_on_the_circle_to_a_pixel():
    size, half, radius, center = 256, 1.0, 0.6, (0.1, -0.05, 0.0)
    taken = take_slice(Sphere(radius=radius, center=center), **ACROSS_Z, half_size=half, size=(size, size))
    image = draw_slice(taken, iso_step=0.1)
    points = slice_points(**ACROSS_Z, half_size=half, size=(size, size)).numpy()
    distance = (np.linalg.norm(points[..., :2] - center[:2], axis=2) - radius) / taken.pixel  # in pixels
    ink = is_ink(image)
    assert np.abs(distance[ink]).max() < 1
    assert ink[np.abs(distance) < 0.5].all()
    assert distance[ink].mean() == pytest.approx(0, abs=0.05)
    assert is_inside(image)[distance < -2].all()
    assert not is_inside(image)[distance > 2].any()


@pytest.mark.parametrize("tilt", [0.0, 60.0, 75.0])
def test_lines_are_as_wide_at_any_gradient(tilt):
    """A plane that the slice meets at a slant: its distance grows by cos(tilt) per unit of the picture."""
    a = math.radians(tilt)
    field = Plane(normal=(math.cos(a), 0.0, math.sin(a)))
    step = 0.2
    taken = take_slice(field, **ACROSS_Z, half_size=0.5 / math.cos(a), size=(640, 640))
    image = draw_slice(taken, iso_step=step).astype(float)
    row = image[320]
    paper = 255 * np.where(np.arange(640)[:, None] < 320, slices.INSIDE[0], slices.OUTSIDE[0])
    cover = ((paper - row) / (paper - INK)).mean(axis=1)[316:324]
    assert cover.sum() == pytest.approx(slices.STYLE.zero_line, abs=0.2)  # of 640 pixels
    # So is the first iso-line outside, 128 pixels from the middle, whatever the gradient.
    at = round(319.5 + 128)
    cover = ((row[at - 6] + row[at + 6]) / 2 - row[at - 5 : at + 6]).sum(axis=0)
    strength = 0.26 * (row[at - 6] - 255 * 0.45 * np.array(slices.OUTSIDE[1]))
    np.testing.assert_allclose(cover / strength, slices.STYLE.line, atol=0.15)
    # Iso-lines stand at multiples of the step: 0.2 is 128 pixels from the middle of 640 pixels for 1.
    notch = np.convolve(row.sum(axis=1), [0.5, -1, 0.5], mode="same")
    lines = np.flatnonzero(notch[2:-2] > 6) + 2
    away = np.abs(lines - 319.5)
    assert {round(place / 128) for place in away if place > 4} == {1, 2}
    assert all(abs(place - 128 * round(place / 128)) < 1.6 for place in away if place > 4)


def test_the_tint_covers_exactly_the_band():
    field = MultiscaleSDF(small_multiscale().base, [Siren(8, 1, omega=3.0)], [0.1])
    taken = take_slice(field, **ACROSS_Z, half_size=1.0, size=(160, 120))
    with_bands, without = (draw_slice(taken, iso_step=0.5, bands=bands).astype(int) for bands in (True, False))
    changed = (with_bands != without).any(axis=2)
    band = np.abs(taken.levels[0]) < 0.1
    np.testing.assert_array_equal(band, taken.bands[0])
    assert 0.05 < band.mean() < 0.9
    line = is_ink(without, within=2) | is_ink(without, level_color(0), within=2)  # opaque over everything
    assert changed[band & ~line].all()
    outline = cv2.dilate(band.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)  # half of its width is outside
    assert not changed[~outline].any()


def test_each_level_has_its_own_line_and_an_inner_band_ends_with_the_outer_one():
    field = MultiscaleSDF(Sphere(radius=0.5), [_Constant(0.04), _Constant(-0.08)], [0.2, 0.1])
    view = {**ACROSS_Z, "half_size": 401 * 0.0025, "size": (401, 401)}  # a pixel is 0.005, one is in the middle
    taken = take_slice(field, **view)
    row = draw_slice(taken, iso_step=0.5)[200, 200:].astype(float)

    for radius, color in ((0.5, level_color(0)), (0.46, level_color(1)), (0.54, FINEST)):
        np.testing.assert_allclose(row[round(radius / 0.005)] / 255, color, atol=0.02)
    # Level 1 is f_0 + 0.04 within 0.2 of the sphere, so its band is |r − 0.46| < 0.1.
    inner = taken.bands[1][200, 200:].nonzero()[0] * 0.005
    assert (inner[0], inner[-1]) == pytest.approx((0.36, 0.56), abs=0.006)
    plain = draw_slice(taken, iso_step=0.5, bands=False)[200, 200:].astype(float)
    for radius, colors in ((0.33, [0]), (0.42, [0, 1]), (0.65, [0]), (0.75, []), (0.2, [])):
        tinted = plain[round(radius / 0.005)]
        for index in colors:
            tinted = tinted + slices.STYLE.tint * (255 * np.array(level_color(index)) - tinted)
        np.testing.assert_allclose(row[round(radius / 0.005)], tinted, atol=1.5)
    coarse = draw_slice(take_slice(field, **view, level=0), iso_step=0.5)
    assert not is_ink(coarse).any()  # the finest level's colour is kept for it
    assert is_ink(coarse, level_color(0)).any()


def test_a_band_wider_than_the_one_before_it_ends_with_that_one():
    field = MultiscaleSDF(Sphere(radius=0.5), [_Constant(0.0), _Constant(0.0)], [0.1, 0.3])
    taken = take_slice(field, **ACROSS_Z, half_size=1.0, size=(200, 200))
    np.testing.assert_array_equal(taken.bands[1], taken.bands[0])
    with_bands, without = (draw_slice(taken, iso_step=0.5, bands=bands) for bands in (True, False))
    changed = (with_bands != without).any(axis=2)
    assert not changed[np.abs(taken.levels[0]) > 0.12].any()


class _Constant(Sphere):
    """A residual that is one number everywhere."""

    def __init__(self, number: float) -> None:
        super().__init__()
        self.number = number

    def _evaluate(self, x):
        return torch.full_like(x[..., 0], self.number), torch.zeros_like(x)


@pytest.mark.parametrize(
    ("length", "step"), [(1.0, 1), (0.14, 0.1), (0.15, 0.2), (3.1, 2), (3.3, 5), (8, 10), (6e4, 5e4), (7.2e-5, 1e-4)]
)
def test_steps_are_round(length, step):
    assert slices.round_step(length) == pytest.approx(step)


def test_pictures_of_ridges_corners_and_emptiness_are_finite():
    for field in (Union(Box(), Sphere(radius=0.5)), Plane(offset=5.0), Plane()):  # Plane(): all of it is zero
        image = draw_slice(take_slice(field, **ACROSS_Z, half_size=1.0, size=(65, 64)), iso_step=0.05)
        assert image.shape == (64, 65, 3)


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda view: plane_axes((0, 0, 0)), "normal="),
        (lambda view: plane_axes((0, 0, 1), up="x"), "up='x'"),
        (lambda view: take_slice(Sphere(), **view, level=3), "level=3"),
        (lambda view: take_slice(Sphere(), **{**view, "half_size": 0}), "half_size=0"),
        (lambda view: draw_slice(take_slice(Sphere(), **view), iso_step=0), "iso_step=0"),
    ],
)
def test_arguments_out_of_range_are_named(call, argument):
    with pytest.raises(ValueError, match=argument):
        call({**ACROSS_Z, "half_size": 1.0, "size": (8, 8)})


@pytest.mark.parametrize("width", [64, 300, 900])
def test_the_legend_leaves_the_picture_alone_and_its_bar_is_to_scale(width):
    taken = take_slice(small_multiscale(), **ACROSS_Z, half_size=1.0, size=(width, 200))
    picture = draw_slice(taken, iso_step=0.1)
    whole = with_legend(picture, taken, caption="z = 0", iso_step=0.1, unit=50.0)
    np.testing.assert_array_equal(whole[:200], picture)
    strip = whole[200:].astype(int)
    assert strip.shape[1] == width
    dark = (strip.max(axis=2) < 90).astype(int)
    runs = [len(run) for row in dark for run in "".join(map(str, row)).split("0")]
    # One field unit is 100 pixels and 50 input units, so a bar of a round number of these has twice as many pixels.
    bar, sample = (
        round(2 * slices.round_step(0.12 * width / 2)),
        2 * max(9, round(width / 48)),
    )  # f₂'s is as dark
    assert max(runs) == max(bar, sample)
    assert bar in runs
    for color in (level_color(0), level_color(1), FINEST):
        assert is_ink(strip, color, within=3).any()
    narrower = with_legend(picture, taken, caption="z = −0.123", iso_step=0.1, unit=50.0, bands=False)
    assert narrower.shape[0] <= whole.shape[0]


CENTER, SIMILARITY = np.array((0.1, -0.05, 0.15)), Similarity((1000.0, -50.0, 20.0), 7.0)
REACH = math.acos(0.2) / 2  # of the blob along each axis


@pytest.fixture
def run(tmp_path, cosine_blob):
    field = MultiscaleSDF(cosine_blob(CENTER), [Siren(8, 1, omega=3.0, output_gain=0.0)], [0.2])
    save_field(tmp_path / "field.safetensors", field, similarity=SIMILARITY)
    return tmp_path


def expected_inside(half_size: float, size: int, *, u, v, origin) -> np.ndarray:
    """Where the blob is, at the pixels of a square picture."""
    points = slice_points(origin=origin, u=u, v=v, half_size=half_size, size=(size, size)).numpy()
    return np.cos(2 * (points - CENTER)).sum(axis=2) > 2.2


def differing(picture: np.ndarray, expected: np.ndarray) -> int:
    """Pixels that are on the wrong side, away from the zero line."""
    edge = cv2.morphologyEx(expected.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5)))
    return int(((is_inside(picture) != expected) & (edge == 0)).sum())


@pytest.mark.parametrize(
    ("options", "axis", "height"),
    [
        (SliceOptions(), 2, 0.0),
        (SliceOptions(at=20 + 7 * (0.15 + 0.4)), 2, 0.4),
        (SliceOptions(percent=25), 2, -REACH / 2),
        (SliceOptions(axis="x", at=1000 + 7 * (0.1 - 0.5)), 0, -0.5),
        (SliceOptions(axis="y", percent=90), 1, 0.8 * REACH),
    ],
)
def test_a_plane_in_input_coordinates_is_the_right_one(run, options, axis, height):
    size = 128
    options = SliceOptions(**{**vars(options), "size": (size, size), "bands": False})
    done = slice_run(run, run / "slice.png", options)
    place = float(done.split(" = ")[1].split(",")[0].replace("−", "-"))
    assert place == pytest.approx(SIMILARITY.center[axis] + 7 * (CENTER[axis] + height), abs=0.01)
    picture = iio.imread(run / "slice.png")[:size]
    normal = np.eye(3)[axis]
    u, v = plane_axes(normal)
    expected = expected_inside(1.16 * REACH, size, u=u, v=v, origin=CENTER + height * normal)
    assert 0.03 < expected.mean() < 0.7
    assert differing(picture, expected) == 0


def test_a_zoom_shows_the_place_that_was_named(run):
    normal, point = np.array((0.0, 1.0, 0.0)), CENTER + np.array((0.5, 0.3, 0.2))
    options = SliceOptions(
        axis="y",
        at=SIMILARITY.to_input(point)[1],
        center=tuple(SIMILARITY.to_input(point + 0.3 * normal)),  # its nearest point on the plane is `point`
        size=(128, 128),
        bands=False,
        zoom=4,
    )
    slice_run(run, run / "slice.png", options)
    u, v = plane_axes(normal)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.8, 0.8, 101)] * 3, indexing="ij"), -1).reshape(-1, 3)
    shape = grid[np.cos(2 * grid).sum(axis=1) > 2.2]
    half = max(np.ptp(shape @ u), np.ptp(shape @ v)) / 2
    picture = iio.imread(run / "slice.png")[:128]
    expected = expected_inside(1.16 * half / 4, 128, u=u, v=v, origin=point)
    assert 0.2 < expected.mean() < 0.9
    assert differing(picture, expected) <= 20  # the half size is known to a hundredth


def test_a_film_sweeps_through_the_shape_and_back(run):
    said, options = [], SliceOptions(size=(96, 96), frames=8, fps=10)
    done = slice_run(run, run / "sweep.gif", options, progress=lambda *counts: said.append(counts))
    assert said == [(count, 8) for count in range(1, 9)]
    assert re.fullmatch(r"8 slices, from z = 16\.2\d\d to z = 25\.8\d\d", done)
    frames = iio.imread(run / "sweep.gif", plugin="pillow", mode="RGB")[:, :96]
    assert len(frames) == 8
    area = np.array([is_inside(frame).mean() for frame in frames])
    assert area[0] == pytest.approx(area[4], abs=0.01)
    assert area[0] == area.max()
    assert area[2] < 0.05 > area[6]  # at both ends the plane only touches
    assert area[1] == pytest.approx(area[3], abs=0.01)
    slice_run(run, run / "middle.png", SliceOptions(size=(96, 96)))
    assert np.abs(frames[0].astype(int) - iio.imread(run / "middle.png")[:96]).mean() < 3


def test_the_command_draws_and_says_what(run, capsys):
    assert main(f"slice {run} -o {run}/a.png --at 50% --size 120 100 --level 0".split()) == 0
    assert "a.png: z = 21.0" in capsys.readouterr().out
    assert iio.imread(run / "a.png").shape[1] == 120
    assert main(f"slice {run} -o {run}/a.mp4 --size 64 --frames 4".split()) == 0
    assert "4 slices, from z = " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("a.pnm", r"a\.pnm: unknown extension"),
        ("field.safetensors/a.png", "field.safetensors is no folder"),
        ("a.mp4 --at 5", "--at: a film goes through the whole shape"),
        ("a.png --size 100 100 100", "--size: got 3 numbers"),
        ("a.png --level 7", r"--level 7: .*field\.safetensors has levels 0 to 1"),
        ("a.png --at 2000", r"--at: the plane misses the shape, which reaches from 16\.\d+ to 25\.\d+ along z"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(run, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(run)
    assert re.search(message, fails(capsys, f"slice {run} -o {arguments}"))
    assert [file.name for file in run.iterdir()] == ["field.safetensors"]


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (Siren(8, 1, in_dim=4), "a field of 4 coordinates"),
        (Sphere(center=(9.0, 0.0, 0.0)), "no surface to slice"),
        (None, "no such run"),
    ],
)
def test_fields_that_cannot_be_sliced_are_named(tmp_path, capsys, field, message):
    file = tmp_path / "field.safetensors"
    if field is not None:
        save_field(file, field)
    assert f"{file}: {message}" in fails(capsys, f"slice {file} -o {tmp_path}/a.png")
