"""Scenes whose images are known in closed form: what is drawn must be that."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from mplicits.datasets.cameras import Camera, look_at
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.datasets.synthetic import corner, scenes
from mplicits.datasets.synthetic.samples import sample_surface
from mplicits.datasets.synthetic.scenes import LAMP, SCENES, Scene, pictures, render_scene
from mplicits.neural_fields import Box, Similarity
from mplicits.neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear

CHEAP = [name for name in SCENES if name != "statue"]


@pytest.fixture
def sphere() -> Scene:
    return SCENES["painted-sphere"]()


def sphere_hits(camera, radius=0.6):
    """Where the rays of a camera first meet a sphere around the origin: mask ``(H, W)`` and points ``(H, W, 3)``."""
    eye, directions = (x.numpy() for x in camera.rays(dtype=torch.float64))
    along = directions @ eye
    discriminant = along**2 - (eye @ eye - radius**2)
    depth = -along - np.sqrt(np.maximum(discriminant, 0))
    return discriminant > 0, eye + depth[..., None] * directions


def test_pixels_have_the_colour_of_the_point_they_see(sphere):
    camera = look_at((1.2, 0.9, 2.0), (0.1, 0.0, -0.1), fov=32, width=23, height=17)
    ((color, mask),) = pictures(sphere, [camera], samples=1)
    expected, points = sphere_hits(camera)
    assert 100 < expected.sum() < expected.size
    assert np.array_equal(mask, expected.astype(np.float32))
    assert np.abs(color[expected] - sphere.color(points[expected])).max() < 1e-6
    assert not color[~expected].any()
    assert color.dtype == mask.dtype == np.float32


@pytest.mark.parametrize("at_once", [1, 2 * 16**2, 1 << 17])
def test_views_that_are_traced_together_show_what_each_does_alone(at_once, monkeypatch):
    monkeypatch.setattr(scenes, "RAYS_AT_ONCE", at_once)
    told: list[tuple[int, int]] = []
    traced: list[int] = []

    def spied(scene: Scene, cameras: Sequence[Camera]):
        traced.append(sum(camera.width * camera.height for camera in cameras))
        return together_traced(scene, cameras)

    together_traced = scenes._traced
    monkeypatch.setattr(scenes, "_traced", spied)
    scene = SCENES["figure"]()
    told_at = {"progress": lambda *at: told.append(at)}
    images = render_scene(scene, views=3, size=8, samples=2, shaded=True, depths=True, **told_at)
    together = {1: 1, 2 * 16**2: 2}.get(at_once, 3)
    assert told == [(done, 3) for done in (*range(together, 3, together), 3)]
    # No more than may be at once, or a row of a picture, or the depths of one.
    assert max(traced) <= max(at_once, 2 * 16, 8**2)
    monkeypatch.undo()
    for view in images.views:
        ((color, mask),) = pictures(scene, [view.camera], samples=2, shaded=True)
        np.testing.assert_allclose(view.color, color, atol=1e-6)
        np.testing.assert_allclose(view.mask, mask, atol=1e-6)
        alone = scenes.scene_depths(scene, [view.camera])[0]
        np.testing.assert_allclose(view.depth.numbers, alone.numbers, atol=1e-6)


def test_samples_of_a_pixel_are_averaged_in_linear_light(sphere):
    camera = look_at((0.0, 0.0, 2.4), (0.5, 0.0, 0.0), fov=20, width=12, height=10)
    ((color, mask),) = pictures(sphere, [camera], samples=3)
    hit, points = sphere_hits(camera.resized(36, 30))
    light = np.where(hit[..., None], srgb_to_linear(sphere.color(points.reshape(-1, 3))).reshape(30, 36, 3), 0)
    count = hit.reshape(10, 3, 12, 3).sum(axis=(1, 3))
    mean = light.reshape(10, 3, 12, 3, 3).sum(axis=(1, 3)) / np.maximum(count, 1)[..., None]
    assert np.abs(mask - count / 9).max() < 1e-6
    assert np.abs(color - linear_to_srgb(mean)).max() < 1e-6
    assert ((mask > 0) & (mask < 1)).any()


def test_shading_is_lambert_times_the_paint(sphere):
    camera = look_at((0.5, 1.0, 2.0), (0, 0, 0), fov=32, width=15, height=15)
    ((color, mask),) = pictures(sphere, [camera], samples=1, shaded=True)
    hit, points = sphere_hits(camera)
    cosine = points[hit] / 0.6 @ (np.array(LAMP) / np.linalg.norm(LAMP))
    shade = scenes.AMBIENT + (1 - scenes.AMBIENT) * cosine.clip(0)
    light = srgb_to_linear(sphere.color(points[hit])) * shade[:, None]
    assert cosine.min() < -0.05  # some of it lies in the shade
    assert np.array_equal(mask > 0, hit)
    assert np.abs(color[hit] - linear_to_srgb(light)).max() < 1e-6


def test_gloss_is_the_mirror_image_of_the_lamp(sphere):
    """On a sphere it is brightest where the normal halves the angle between the lamp and the eye, from any side."""
    lamp = np.array(LAMP) / np.linalg.norm(LAMP)
    for eye in ((0.5, 1.0, 2.0), (2.0, 1.0, 1.0)):
        camera = look_at(eye, (0, 0, 0), fov=32, width=41, height=41)
        plain, shiny = (pictures(sphere, [camera], samples=1, glossy=glossy)[0][0] for glossy in (False, True))
        more = (srgb_to_linear(shiny) - srgb_to_linear(plain))[..., 0]
        hit, points = sphere_hits(camera)
        assert not more[~hit].any()
        normals = points / 0.6
        halfway = unit_rows(lamp + unit_rows((np.array(eye) - points).reshape(-1, 3))).reshape(points.shape)
        lit = hit & (normals @ lamp > 0)
        wanted = np.where(lit, scenes.GLOSS * (normals * halfway).sum(axis=2).clip(0) ** scenes.SHARPNESS, 0)
        clipped = srgb_to_linear(plain)[..., 0] + wanted > 1
        assert np.abs(more - wanted)[hit & ~clipped].max() < 1e-5
        assert wanted.max() > 0.5
        shade, lit_too = (pictures(sphere, [camera], 1, shaded=True, glossy=g)[0][0] for g in (False, True))
        assert (lit_too >= shade - 1e-6).all()


def test_a_box_covers_a_square_with_even_edges():
    """Its near face alone is seen: f·2a/(d − a) pixels wide."""
    scene = Scene("box", Box(half_size=(0.3, 0.3, 0.3)), lambda points: np.ones_like(points), radius=0.55)
    for size in (20, 15, 25):  # focal lengths of twice as many pixels
        camera = look_at((0, 0, 2.3), (0, 0, 0), fov=2 * math.degrees(math.atan(0.25)), width=size, height=size)
        ((_, mask),) = pictures(scene, [camera], samples=3)
        seen = np.arange(size) // (size // 5)  # the middle three fifths
        assert mask[size // 2].tolist() == mask[:, size // 2].tolist() == ((seen > 0) & (seen < 4)).tolist()


@pytest.mark.parametrize("name", SCENES)
def test_shapes_lie_in_their_ball_and_colours_in_range(name):
    scene = SCENES[name]()
    assert scene.name == name
    points = sample_surface(scene.field, 3000, seed=1).points
    values = scene.field.value(torch.from_numpy(points))
    assert float(values.abs().max()) < 1e-8
    assert 0.9 * scene.radius < np.linalg.norm(points, axis=1).max() <= scene.radius + 1e-9 <= 1 + 1e-9
    colors = scene.color(points)
    assert ((colors >= 0) & (colors <= 1)).all()
    assert colors.std(axis=0).min() > 0.1  # painted, not plain


@pytest.mark.parametrize("name", CHEAP)
def test_all_of_the_shape_is_in_view(name):
    images = render_scene(SCENES[name](), 6, 24, seed=2)
    for view in images.views:
        assert view.mask.max() == 1
        assert not any(edge.any() for edge in (view.mask[0], view.mask[-1], view.mask[:, 0], view.mask[:, -1]))
        pixels, z = view.camera.project(torch.from_numpy(images.points))
        assert float(z.min()) > 0
        assert 0 < float(pixels.min()) < float(pixels.max()) < 23
    assert images.similarity == Similarity.identity()
    assert [view.name for view in images.views] == [f"00{k}.png" for k in range(6)]
    assert images.points.shape == (1000, 3)


def test_cameras_are_even_upright_and_held_out_by_seed(sphere):
    cameras = scenes.cameras_around(sphere.radius, views=50, size=8, seed=1)
    again, other = (scenes.cameras_around(sphere.radius, views=50, size=8, seed=seed) for seed in (1, 2))
    eyes, again, other = (torch.stack([camera.eye for camera in some]) for some in (cameras, again, other))
    assert torch.allclose(eyes.norm(dim=1), torch.tensor(2.4, dtype=torch.float64))
    assert float(eyes.mean(dim=0).norm()) < 0.05
    near = torch.cdist(eyes, eyes).fill_diagonal_(9).amin(dim=1)
    assert float(near.min()) > 0.5  # 50 discs on a sphere of radius 2.4 are about 0.68 apart at best
    assert all(float(camera.down[1]) <= 0 for camera in cameras)
    assert torch.equal(eyes, again)
    assert float(torch.cdist(eyes, other).diagonal().min()) > 0.1


def test_frontal_cameras_are_even_and_in_front():
    scene = SCENES["corner"]()
    cameras = scenes.cameras_around(scene.radius, views=49, size=(40, 30), seed=1, frontal=scene.frontal)
    assert {(camera.width, camera.height) for camera in cameras} == {(40, 30)}
    towards = torch.nn.functional.normalize(torch.stack([camera.eye for camera in cameras]), dim=1)
    azimuth, rise = torch.rad2deg(torch.atan2(towards[:, 0], towards[:, 2])), torch.rad2deg(towards[:, 1].asin())
    assert float(azimuth.abs().max()) <= 45
    assert 5 < float(rise.min()) < 7
    assert 48 < float(rise.max()) < 50
    near = torch.rad2deg((towards @ towards.T).fill_diagonal_(-1).amax(dim=1).acos())
    assert 5 < float(near.min()) < float(near.max()) < 12
    above = scenes.frontal_directions(5, 0.3, up="z")
    np.testing.assert_allclose(above[:, [0, 2, 1]] * (1, 1, -1), scenes.frontal_directions(5, 0.3), atol=1e-12)


@pytest.mark.parametrize("size", [(40, 30), (20, 90)])
def test_pictures_that_are_not_square_show_the_whole_corner(size):
    images = render_scene(SCENES["corner"](), 6, size, seed=3, samples=1)
    for view in images.views:
        assert view.mask.shape == size[::-1]
        assert not any(edge.any() for edge in (view.mask[0], view.mask[-1], view.mask[:, 0], view.mask[:, -1]))
        assert view.mask.mean() > 0.05


def test_the_corner_has_what_photographs_find_hard():
    """Exact distances to a flat wall, a sharp edge, a thin rod, a crease and a bowl; and a wall without texture."""
    scene = SCENES["corner"]()
    turn = corner.turned(torch.eye(3, dtype=torch.float64))  # rows: turned axes

    def distance(*places):
        return scene.field.value(torch.tensor(places, dtype=torch.float64) @ turn.T).tolist()

    assert distance((0.1, 0.3, -0.2), (-0.5, 0.4, -0.25)) == pytest.approx([0.1, 0.05])  # before the wall
    assert distance((0.6, 0.48, -0.3), (0.63, 0.52, -0.3)) == pytest.approx([0.0, 0.05], abs=1e-8)  # its corner
    assert distance((0.55, -0.3, -0.2), (0.55, -0.34, -0.28)) == pytest.approx([0.06, 0.02])  # in the crease
    assert distance((0.04, 0.3, 0.16), (0.04, 0.4, 0.16)) == pytest.approx([-0.012, 0.088])  # the rod
    assert distance((-0.26, -0.2, 0.1), (-0.26, -0.17, 0.1)) == pytest.approx([0.06, 0.09])  # in the bowl
    wall = np.random.default_rng(0).uniform((-0.55, -0.3, -0.3), (0.55, 0.4, -0.3), (500, 3))
    colors = scene.color(wall @ turn.numpy().T)
    assert colors[wall[:, 0] > corner.CORNER.plain].std(axis=0).max() < 1e-12
    assert colors[wall[:, 0] < corner.CORNER.plain].std(axis=0).min() > 0.1


@pytest.mark.parametrize("name", CHEAP)
def test_the_mesh_is_the_surface(name):
    scene = SCENES[name]()
    mesh = scenes.scene_mesh(scene, resolution=64)
    cell = 2 * 1.02 * scene.radius / 64  # what is cut off a right-angled edge or corner is less than half of it
    assert np.abs(scene.field.value(torch.from_numpy(mesh.vertices)).numpy()).max() < cell / 2
    assert np.array_equal(mesh.colors, scene.color(mesh.vertices).astype(np.float32))
    if name == "painted-sphere":
        corners = mesh.vertices[mesh.faces]
        volume = np.linalg.det(corners).sum() / 6
        assert volume == pytest.approx(4 / 3 * math.pi * 0.6**3, rel=2e-3)


def test_bad_arguments_are_named(sphere):
    for views, size, samples, message in ((0, 8, 1, "views=0"), (2, 0, 1, "size=0"), (1, 8, 0, "samples=0")):
        with pytest.raises(ValueError, match=message):
            render_scene(sphere, views, size, samples=samples)
