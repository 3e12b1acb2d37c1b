"""Shadings, on points of a sphere whose colours can be worked out by hand."""

import dataclasses

import numpy as np
import pytest
import torch
from fields import FIELDS
from mplicits.datasets.cameras import Camera, look_at
from mplicits.neural_fields import Field, Plane, Siren, Sphere, Union
from mplicits.pipelines.render.shade import (
    COLOR_MAPS,
    SHADINGS,
    ShadeOptions,
    apply_color_map,
    compose,
    downsample,
    shade,
    value_limits,
)
from mplicits.pipelines.render.trace import Seen

RADIUS, SIZE = 0.5, 48
EYE = (0.0, 0.0, 4.0)


def camera_at(eye: tuple[float, float, float] = EYE) -> Camera:
    return look_at(eye, (0, 0, 0), fov=16, width=SIZE, height=SIZE)


CAMERA = camera_at()


def ball(camera: Camera, *, device: torch.device | str = "cpu", color: torch.Tensor | None = None) -> Seen:
    """The exact view of a sphere around the origin."""
    eye, rays = camera.rays(device=device)
    rays = rays.reshape(-1, 3)
    along = -(rays @ eye)
    gap = along**2 - eye @ eye + RADIUS**2
    pixel = (gap > 0).nonzero()[:, 0]
    rays, depth = rays[pixel], (along - gap.clamp(min=0).sqrt())[pixel]
    position = eye + depth[:, None] * rays
    colors = None if color is None else color.expand_as(position)
    return Seen((SIZE, SIZE), pixel, depth, position, position / RADIUS, rays, colors)


def shade_fully(seen: Seen, shading: str, field: Field, *, level: int = -1) -> torch.Tensor:
    """With shadows and occlusion, and with depths as the errors."""
    options = ShadeOptions(shadows=True, occlusion=True)
    values = seen.depth if shading == "error" else None
    return shade(seen, shading, camera=CAMERA, field=field, level=level, options=options, values=values)


@pytest.mark.parametrize("name", [name for name, make in FIELDS.items() if make().in_dim == 3])
def test_every_shading_of_every_field_is_a_colour(name):
    field = FIELDS[name]()
    seen = ball(CAMERA, color=torch.tensor([0.2, 0.5, 0.9]))
    for shading in SHADINGS:
        for level in range(field.num_levels):
            rgb = shade_fully(seen, shading, field, level=level)
            assert rgb.shape == (len(seen.pixel), 3)
            assert rgb.dtype == torch.float32
            assert ((rgb >= 0) & (rgb <= 1)).all()


@pytest.mark.parametrize("shading", SHADINGS)
def test_images_in_which_nothing_is_seen(shading):
    seen = ball(CAMERA, color=torch.ones(3))
    empty = Seen((3, 2), *(part[:0] for part in (seen.pixel, seen.depth, seen.position, seen.normal, seen.direction)))
    empty = dataclasses.replace(empty, color=torch.empty(0, 3))
    assert (compose(empty, shade_fully(empty, shading, Sphere())) == 255).all()


def test_shading_runs_where_the_view_is(device):
    seen = ball(CAMERA, device=device, color=torch.ones(3, device=device))
    for shading in SHADINGS:
        rgb = shade_fully(seen, shading, Sphere(radius=RADIUS).to(device))
        assert rgb.device.type == device.type
        assert compose(seen, rgb).shape == (SIZE, SIZE, 3)


def test_the_headlight_is_brightest_in_the_middle_and_the_key_lamp_above_left():
    seen = ball(CAMERA)
    middle = (SIZE - 1) / 2
    for shading, low, high in (("headlight", -1.0, 1.0), ("lambert", -0.8 * middle, -0.2 * middle)):
        light = shade(seen, shading, camera=CAMERA).sum(1)
        brightest = int(seen.pixel[light.argmax()])
        x, y = brightest % SIZE - middle, brightest // SIZE - middle
        assert low <= x <= high
        assert low <= y <= high
        assert light.min() > 0.3  # nothing is black on the page
        assert light.max() < 3


def test_a_raking_light_shows_a_degree():
    """Of a face that looks at the camera the display value is that of half the albedo, and its turn by 1° shows."""
    front = -CAMERA.forward.float()
    pixel, depth = torch.zeros(1, dtype=torch.int64), torch.ones(1)
    seen = Seen((SIZE, SIZE), pixel, depth, front[None], front[None], -front[None])
    options = ShadeOptions(clay=(1.0, 1.0, 1.0))
    for degrees in (0.0, 1.0, -1.0, 8.0, 60.0, -60.0):
        turn, lamp = np.radians(degrees), np.radians(12)
        normal = np.cos(turn) * front - np.sin(turn) * CAMERA.right.float()  # towards the lamp
        expected = np.clip(np.sin(lamp + turn) / (2 * np.sin(lamp)), 0.02, 1) ** (1 / 2.2)
        rgb = shade(dataclasses.replace(seen, normal=normal.float()[None]), "raking", camera=CAMERA, options=options)
        torch.testing.assert_close(rgb, torch.full((1, 3), float(expected)), atol=2e-5, rtol=0)


@pytest.mark.parametrize("shading", ["lambert", "headlight", "raking", "depth"])
def test_lamps_turn_with_the_camera(shading):
    pictures = []
    for eye in (EYE, (4.0, 0.0, 0.0), (1.2, 3.0, -2.2)):
        camera = camera_at(tuple(np.asarray(eye) / np.linalg.norm(eye) * 4))
        seen = ball(camera)
        pictures.append(compose(seen, shade(seen, shading, camera=camera)).astype(int))
    for other in pictures[1:]:
        off = np.abs(other - pictures[0]).max(axis=2)
        assert np.quantile(off, 0.98) <= 2  # pixels of the outline may come and go


def test_colours_of_the_surface_are_what_the_light_falls_on():
    clay = shade(ball(CAMERA), "lambert", camera=CAMERA, options=ShadeOptions(clay=(0.3, 0.6, 0.1)))
    colored = shade(ball(CAMERA, color=torch.tensor([0.3, 0.6, 0.1])), "lambert", camera=CAMERA)
    torch.testing.assert_close(clay, colored)
    assert (clay[:, 1] > clay[:, 0]).all()


def plate_under_ball() -> tuple[Field, Seen, Camera]:
    """Points of the plane y = −0.3 below a ball, seen from the front and above."""
    field = Union(Plane(normal=(0, 1, 0), offset=-0.3), Sphere(radius=0.2))
    camera = camera_at((0, 2, 4))
    x, z = (0.4 * (2 * torch.rand(2, 500) - 1)).unbind()
    points = torch.stack((x, torch.full_like(x, -0.3), z), -1)
    away = points - camera.eye.float()
    depth = away.norm(dim=1)
    normal = torch.tensor([0.0, 1.0, 0.0]).expand_as(points)
    return field, Seen((SIZE, SIZE), torch.arange(500), depth, points, normal, away / depth[:, None]), camera


def test_shadows_and_occlusion_only_take_light_away_and_only_near_the_ball():
    field, seen, camera = plate_under_ball()
    plain = shade(seen, "lambert", camera=camera, field=field)
    assert plain.std(0).max() < 0.01  # a plane under a distant lamp
    away = seen.position[:, [0, 2]].norm(dim=1)  # from the point below the ball's centre

    def share(options: ShadeOptions) -> torch.Tensor:
        return (shade(seen, "lambert", camera=camera, field=field, options=options) / plain).mean(1)

    shadow = share(ShadeOptions(shadows=True, softness=1e-3))
    assert shadow.max() <= 1 + 1e-6
    dark = shadow < 0.9
    assert torch.equal(dark, shadow < 0.99)  # sharp
    # A disc of radius 0.2 seen slantwise, which the lamp above left of the camera throws to the right and behind.
    assert 0.1 < dark.float().mean() < 0.4
    assert (seen.position[dark].mean(0)[[0, 2]] * torch.tensor([1.0, -1.0]) > 0.05).all()
    occlusion = share(ShadeOptions(occlusion=True, reach=0.2))
    assert occlusion.max() <= 1 + 1e-6
    assert (occlusion[away > 0.39] > 0.999).all()
    assert occlusion[away < 0.1].max() < 0.9 < occlusion[away > 0.3].min()


def test_where_nothing_is_open_only_the_key_lamp_is_left():
    class Closed(Siren):
        def value(self, x: torch.Tensor, *, level: int = -1) -> torch.Tensor:
            return torch.zeros_like(x[..., 0])

    seen = ball(CAMERA)
    rgb = shade(seen, "lambert", camera=CAMERA, field=Closed(4, 1), options=ShadeOptions(occlusion=True))
    lower_right = (seen.normal[:, 0] > 0.5) & (seen.normal[:, 1] < -0.5)
    assert lower_right.any()
    assert (rgb[lower_right] == 0).all()
    upper_left = (seen.normal[:, 0] < -0.4) & (seen.normal[:, 1] > 0.4)
    assert (rgb[upper_left] > 0.4).all()


def test_depth_is_light_near_and_dark_far_between_the_ends_of_its_map():
    seen = ball(CAMERA)
    rgb = shade(seen, "depth", camera=CAMERA)
    order = seen.depth.argsort()
    light = (rgb @ torch.tensor([0.2126, 0.7152, 0.0722]))[order]
    assert (light.diff() <= 1e-5).all()
    table = torch.from_numpy(COLOR_MAPS["viridis"])
    torch.testing.assert_close(rgb[order[0]], table[-1])
    torch.testing.assert_close(rgb[order[-1]], table[0])
    fixed = shade(seen, "depth", camera=CAMERA, options=ShadeOptions(limits=(0.0, 100.0)))
    assert (fixed - table[-10]).abs().max() < 0.1  # every depth is near 4


def test_measured_errors_are_taken_as_they_are():
    seen = ball(CAMERA)
    values = torch.full_like(seen.depth, RADIUS)
    options = ShadeOptions(limits=(0.0, 2 * RADIUS), relief=0.0)
    half = torch.from_numpy(COLOR_MAPS["magma"][127:129]).mean(0)
    for errors, expected in ((values, half), (torch.zeros_like(values), torch.from_numpy(COLOR_MAPS["magma"][-1]))):
        rgb = shade(seen, "error", camera=CAMERA, values=errors, options=options)
        torch.testing.assert_close(rgb, expected.expand_as(rgb), atol=1e-3, rtol=0)
    assert value_limits(values, "error", ShadeOptions()) == pytest.approx((0, RADIUS), abs=1e-5)


def test_curvature_is_white_on_a_plane_red_on_a_ball_and_blue_in_a_bowl():
    seen = ball(CAMERA)
    limits = ShadeOptions(limits=(-4.0, 4.0), relief=0.0)
    table = torch.from_numpy(COLOR_MAPS["diverging"])
    for field, expected in ((Sphere(radius=RADIUS), table[192]), (Plane(), table[128])):
        rgb = shade(seen, "curvature", camera=CAMERA, field=field, options=limits)
        torch.testing.assert_close(rgb, expected.expand_as(rgb), atol=0.02, rtol=0)
    low, high = value_limits(torch.tensor([-1.0, 3.0, 0.5]), "curvature", ShadeOptions(quantile=1.0))
    assert (low, high) == (-3, 3)
    assert table[0, 2] > table[0, 0]  # hollows are blue
    assert table[-1, 0] > table[-1, 2]


def test_limits_hold_the_share_of_the_values_that_they_should():
    values = torch.arange(1000.0)
    assert value_limits(values, "error", ShadeOptions(quantile=0.9)) == (0, 899)
    assert value_limits(values, "curvature", ShadeOptions(quantile=0.5)) == (-499, 499)
    assert value_limits(values, "depth", ShadeOptions()) == (0, 999)
    assert value_limits(values, "depth", ShadeOptions(limits=(2, 5))) == (2, 5)


def test_maps_are_linear_between_their_entries_and_clamped():
    table = np.array([[0, 0, 0], [1, 0, 0.5], [1, 1, 1]], np.float32)
    found = apply_color_map(torch.tensor([-5.0, 1.0, 1.5, 2.0, 2.5, 3.0, 9.0]), (1.0, 3.0), table)
    expected = [[0, 0, 0], [0, 0, 0], [0.5, 0, 0.25], [1, 0, 0.5], [1, 0.5, 0.75], [1, 1, 1], [1, 1, 1]]
    torch.testing.assert_close(found, torch.tensor(expected))
    backwards = apply_color_map(torch.tensor([3.0, 1.0]), (3.0, 1.0), table)
    torch.testing.assert_close(backwards, torch.tensor([[0.0, 0, 0], [1, 1, 1]]))
    assert apply_color_map(torch.ones(4), (1.0, 1.0), table).isfinite().all()


@pytest.mark.parametrize(
    ("shading", "options", "missing"),
    [
        ("curvature", ShadeOptions(), "field"),
        ("error", ShadeOptions(), "values"),
        ("color", ShadeOptions(), "no colours"),
        ("lambert", ShadeOptions(shadows=True), "field"),
        ("lambert", ShadeOptions(occlusion=True), "field"),
        ("toon", ShadeOptions(), r"'toon'.*lambert"),
    ],
)
def test_what_a_shading_lacks_is_named(shading, options, missing):
    with pytest.raises(ValueError, match=missing):
        shade(ball(CAMERA), shading, camera=CAMERA, options=options)


def test_backs_are_tinted_only_where_asked():
    seen = ball(CAMERA)
    turned = dataclasses.replace(seen, normal=-seen.normal)
    front = shade(seen, "lambert", camera=CAMERA)
    # A normal that faces away just a little is a rim's, seen from in front.
    facing = (seen.normal * seen.direction).sum(1).abs() > 0.21
    assert 0.9 < float(facing.float().mean()) < 1
    torch.testing.assert_close(shade(turned, "lambert", camera=CAMERA)[facing], front[facing])
    tinted = ShadeOptions(back_faces=True)
    torch.testing.assert_close(shade(seen, "lambert", camera=CAMERA, options=tinted), front)
    back = shade(turned, "lambert", camera=CAMERA, options=tinted)
    assert ((back[:, 0] - back[:, 2]) > (front[:, 0] - front[:, 2]) + 0.05).float().mean() > 0.9


def test_normals_of_a_rim_that_face_away_are_mirrored():
    seen = ball(CAMERA)
    cosine = (seen.normal * seen.direction).sum(1, keepdim=True)
    rim = (cosine > -0.15)[:, 0]
    beyond = torch.where(rim[:, None], seen.normal - 2 * cosine * seen.direction, seen.normal)
    assert int(rim.sum()) > 20
    lit, mirrored = (shade(s, "lambert", camera=CAMERA) for s in (seen, dataclasses.replace(seen, normal=beyond)))
    torch.testing.assert_close(mirrored, lit)


def test_compose_puts_each_colour_at_its_pixel():
    seen = dataclasses.replace(ball(CAMERA), size=(5, 3), pixel=torch.tensor([0, 7, 14]))
    rgb = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 0.5]])
    expected = np.full((15, 3), (255, 128, 0), np.uint8)
    expected[[0, 7, 14]] = [[255, 0, 0], [0, 255, 0], [0, 0, 128]]
    np.testing.assert_array_equal(compose(seen, rgb, background=(1.0, 0.5, 0.0)), expected.reshape(3, 5, 3))
    clear = compose(seen, rgb, background=None)
    assert clear.shape == (3, 5, 4)
    assert clear[..., 3].sum() == 3 * 255
    assert clear[1, 2].tolist() == [0, 255, 0, 255]


def test_downsampling_a_transparent_image_and_pasting_it_is_the_other_way_round_too():
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (24, 36, 3), dtype=np.uint8)
    alpha = np.where(rng.random((24, 36, 1)) < 0.5, 255, 0).astype(np.uint8)
    paper = np.array([255, 128, 0], np.uint8)
    small = downsample(np.concatenate((color, alpha), -1), 4).astype(float)
    assert small.shape == (6, 9, 4)
    share = small[..., 3:] / 255
    pasted = small[..., :3] * share + paper * (1 - share)
    expected = downsample(np.where(alpha > 0, color, paper), 4)
    assert np.abs(pasted - expected).max() <= 1.5
    hidden = np.concatenate((color, np.zeros_like(alpha)), -1)
    assert not downsample(hidden, 2)[..., 3].any()
    assert downsample(color, 1) is color
    with pytest.raises(ValueError, match="factor=5"):
        downsample(color, 5)
