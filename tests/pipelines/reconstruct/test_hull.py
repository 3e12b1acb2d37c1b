"""The visual hull of a sphere's masks, against the sphere, and what is done where masks give no hull."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from mplicits.datasets import SCENES, PosedImages, render_scene
from mplicits.neural_fields import InputError, Siren
from mplicits.neural_fields.tracing.sphere import ball_points
from mplicits.pipelines.reconstruct import hull
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct.hull import (
    HULL,
    Agreement,
    begin,
    carve,
    fitting_resolution,
    free_space,
    start_at_hull,
)
from mplicits.pipelines.reconstruct.measured import MeasuredDepths
from mplicits.pipelines.reconstruct.model import build_scene
from reconstructions import TINY_SCENE, painted_sphere, with_views, without

SMALL = replace(TINY_SCENE, features=2, color_width=8, color_frequencies=1, radius=0.3)
RADIUS = 0.6  # of the painted sphere


@pytest.fixture(autouse=True)
def _no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the start as a sphere, which does not matter here."""
    monkeypatch.setattr(scene_model, "fit_sphere", lambda *_: None)


@lru_cache
def images(**options: bool) -> PosedImages:
    return painted_sphere(12, 24, **options)


def with_masks(change: Callable[[np.ndarray], np.ndarray]) -> PosedImages:
    return with_views(images(), lambda _, view: replace(view, mask=change(view.mask)))


def lengths(count: int) -> np.ndarray:
    """Of the vertices of a grid."""
    axis = np.linspace(-1, 1, count)
    return np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)


def test_a_sphere_is_carved_out() -> None:
    distances = carve(images().views, images().similarity, resolution=20)
    cell, length = 2 / 20, lengths(21)
    # Nothing of the object is carved away: up to half a cell of a vertex's neighbourhood sees object.
    assert bool((distances[length < RADIUS] < 0).all())
    # A pixel sees 2 tan(fov / 2) · distance / 24 of the sphere; half of one and half a cell (times √2, as windows are
    # squares) is what masks are too large by. Twelve views leave corners between their cones, 1 / cos of half the
    # angle between neighbours: at most 60°.
    camera = images().views[0].camera
    pixel = float(camera.eye.norm() / camera.intrinsics[0, 0])
    most = (RADIUS + 2**0.5 * (1.5 * pixel + 0.5 * cell)) / np.cos(np.pi / 6)
    assert bool((distances[length > most] > 0).all())
    assert float(distances[10, 10, 10]) < -RADIUS + cell


def test_coarse_grids_decide_nothing_that_the_fine_one_would_not(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = render_scene(SCENES["striped-torus"](), views=12, size=24, samples=1)
    carved = carve(scene.views, scene.similarity, resolution=64)
    monkeypatch.setattr(hull, "HULL", replace(HULL, coarsest=64))
    at_once = carve(scene.views, scene.similarity, resolution=64)
    np.testing.assert_array_equal(carved, at_once)
    assert carved[32, 32, 32] > 0  # there is a hole


def test_points_dropped_early_are_those_that_all_silhouettes_drop() -> None:
    broken = with_masks(lambda mask: mask * (np.random.default_rng(int(mask.sum())).random(mask.shape) < 0.9))
    for made in (images(), broken):
        points = hull.grid_in_ball(16)[0]
        masks = [hull.silhouette(view, made.similarity, points, 1 / 8) for view in made.views]
        visible, objects = (torch.stack(parts).float().sum(dim=0) for parts in zip(*masks, strict=True))
        agreed = (objects >= HULL.agree * visible) & (visible >= max(1.0, HULL.seeing * len(masks)))
        assert torch.equal(hull._agreed(made.views, made.similarity, points, 1 / 8), agreed)
        assert 0 < agreed.float().mean() < 1


def test_a_gap_that_one_camera_of_many_sees_is_carved() -> None:
    views = list(images().views) * 3
    mask = np.array(views[7].mask)
    mask[11:14, 11:14] = 0  # of which a pixel is left, as far as a cell is from others
    views[7] = replace(views[7], mask=mask)
    assert len(Agreement.of(views, images().similarity).trusted()) == len(views)
    distances = carve(views, images().similarity, resolution=32)
    assert distances[16, 16, 16] > 0  # in the middle of the hole, and of the ball


def test_masks_that_are_wrong_do_not_carve() -> None:
    views, similarity = list(images().views) * 3, images().similarity
    assert Agreement.of(views, similarity).trusted() == views
    turned = with_masks(lambda mask: 1 - mask).views
    views[0] = turned[0]
    mask = np.array(views[1].mask)
    mask[8:16, 8:16] = 0
    views[1] = replace(views[1], mask=mask)
    assert [id(view) for view in Agreement.of(views, similarity).trusted()] == [id(view) for view in views[2:]]
    # Where all are inverted, nothing tells which to trust; of three views each may cut a third.
    assert Agreement.of(turned, similarity).trusted() is turned
    assert Agreement.of(views[2:5], similarity).trusted() == views[2:5]


@pytest.mark.parametrize(("size", "expected"), [(12, 32), (48, 64), (400, 128)])
def test_cells_are_as_large_as_pixels(size: int, expected: int) -> None:
    # A pixel of the 24 sees |eye| / f of a plane through the middle; one of them is 24 / size as large.
    views = [replace(view, camera=view.camera.resized(size, size)) for view in images().views]
    resolution = fitting_resolution(views, images().similarity)
    camera = views[0].camera
    pixel = float(camera.eye.norm() / camera.intrinsics[0, 0])
    assert resolution == expected
    assert 2 / resolution <= HULL.pixels * pixel or resolution == HULL.finest
    assert 4 / resolution > HULL.pixels * pixel or resolution == HULL.coarsest


def test_masks_that_leave_nothing_are_no_start() -> None:
    empty, full = with_masks(np.zeros_like), with_masks(np.ones_like)
    for some in (empty, full):
        assert carve(some.views, some.similarity, resolution=12) is None
    for some, start, message in ((empty, "hull", "visual hull"), (images(), "depths", "wants depth maps")):
        with pytest.raises(InputError, match=message):
            begin(build_scene(SMALL, has_masks=True), some.views, some, replace(SMALL, start=start))


def test_a_network_is_trained_to_it() -> None:
    network = Siren(24, 2, omega=6.0)
    start_at_hull(network, lengths(13) - RADIUS, steps=80)
    points = 0.9 * ball_points(200, radius=1.0, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        error = network.value(points) - (points.norm(dim=1) - RADIUS)
    assert float(error.abs().mean()) < 0.03  # it has begun at about ± 0.5


@pytest.mark.parametrize(("masks", "expected"), [(True, "hull"), (False, "sphere")])
def test_settings_say_what_it_begins_as(masks: bool, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hull, "start_at_hull", lambda *_, **__: None)
    some = images() if masks else without(images(), "mask")
    for changes, start in (({}, expected), ({"start": "sphere"}, "sphere"), ({"geometry": "neus"}, "sphere")):
        config = replace(SMALL, **changes)
        assert begin(build_scene(config, has_masks=masks), some.views, some, config) == start


def test_what_no_measured_ray_passes_is_a_start(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[np.ndarray] = []
    monkeypatch.setattr(hull, "start_at_hull", lambda _, distances, **__: started.append(distances))
    scene = images(depths=True)
    bare = without(scene, "mask")
    for some, start, expected in ((bare, "auto", "depths"), (scene, "auto", "hull"), (scene, "depths", "depths")):
        measured = MeasuredDepths(some.views, some, torch.device("cpu"))
        model = build_scene(SMALL, has_masks=some is scene)
        assert begin(model, some.views, some, replace(SMALL, start=start), measured) == expected
    # Vertices half a diagonal inside are never passed, and those beyond what the rays see are solid; the distances
    # are those of a grid, to a cell.
    cell = 2 / HULL.resolution
    for distances in started:
        assert bool((distances[lengths(len(distances)) < RADIUS - 2 * cell] < 0).all())
    by_masks = carve(scene.views, scene.similarity)
    assert bool((started[1] >= by_masks - 2 * cell).all())  # carved further
    assert int((started[1] > 0).sum()) > int((by_masks > 0).sum())


def measured_of(*, maps: bool = True) -> MeasuredDepths:
    """Of a sphere without masks, with sparse points and perhaps depth maps."""
    some = without(images(depths=True), "mask")
    some = some if maps else without(some, "depth")
    return MeasuredDepths(some.views, some, torch.device("cpu"))


@pytest.mark.parametrize("kind", ["maps", "points"])
def test_rays_carve_what_is_outside_and_nothing_inside(kind: str) -> None:
    resolution = 24
    empty = free_space(measured_of(maps=kind == "maps"), resolution)
    length, cell = torch.from_numpy(lengths(resolution + 1)), 2 / resolution
    # Places of a ray, which is outside, are rounded to the next vertex: half a diagonal away at most.
    assert not bool(empty[length < RADIUS - 0.5 * 3**0.5 * cell].any())
    beyond = (length > RADIUS + 3 * cell) & (length < 0.95)
    assert float(empty[beyond].float().mean()) > (0.5 if kind == "maps" else 0.15)


def test_one_wrong_measurement_carves_no_hole() -> None:
    measured = measured_of()
    measured.numbers[0] *= 2  # through the sphere and far behind it
    right, wrong = free_space(measured_of(), 24), free_space(measured, 24)
    assert not bool((wrong & torch.from_numpy(lengths(25) < RADIUS - 0.08)).any())
    assert int((wrong != right).sum()) < 25
