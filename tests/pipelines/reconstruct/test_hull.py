"""The visual hull of a sphere's masks, against the sphere, and what is done where masks give no hull."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import PosedImages
from mplicits.neural_fields import InputError, Siren
from mplicits.pipelines.reconstruct import hull
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct.hull import (
    HULL,
    Agreement,
    begin,
    carve,
    fitting_resolution,
    seen_through,
    start_at_hull,
)
from mplicits.pipelines.reconstruct.measured import MeasuredDepths
from mplicits.pipelines.reconstruct.model import build_scene
from mplicits.pipelines.training.settings import ReconstructConfig

SMALL = ReconstructConfig(
    widths=(16, 16),
    depths=(1, 1),
    features=2,
    color_width=8,
    color_depth=1,
    color_grid=8,
    color_frequencies=1,
    radius=0.3,
)
RADIUS = 0.6  # of the painted sphere


@pytest.fixture(autouse=True)
def _no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it is before does not matter."""
    monkeypatch.setattr(scene_model, "fit_sphere", lambda *_: None)


@lru_cache
def images() -> PosedImages:
    return render_scene(SCENES["painted-sphere"](), views=12, size=24, samples=1)


def inverted() -> PosedImages:
    def other(mask: np.ndarray | None) -> np.ndarray:
        assert mask is not None
        return 1 - mask

    return replace(images(), views=tuple(replace(view, mask=other(view.mask)) for view in images().views))


def filled(share: float) -> PosedImages:
    """With masks that are the same everywhere."""
    views = tuple(replace(view, mask=np.full_like(view.color[..., 0], share)) for view in images().views)
    return replace(images(), views=views)


def lengths(count: int) -> np.ndarray:
    """Of the vertices of a grid."""
    axis = np.linspace(-1, 1, count)
    return np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)


def test_a_sphere_is_carved_out() -> None:
    resolution = 20
    distances = carve(images().views, images().similarity, resolution=resolution)
    assert distances is not None
    cell, length = 2 / resolution, lengths(resolution + 1)
    # Nothing of the object is carved away: up to half a cell of a vertex's neighbourhood sees object.
    assert bool((distances[length < RADIUS] < 0).all())
    # A pixel sees 2 tan(fov / 2) · distance / 24 of the sphere; half of one and half a cell (times √2, as windows are
    # squares) is what masks are too large by. Twelve views leave corners between their cones, 1 / cos of half the
    # angle between neighbours: at most 60°.
    camera = images().views[0].camera
    pixel = float(camera.eye.norm() / camera.intrinsics[0, 0])
    most = (RADIUS + 2**0.5 * (1.5 * pixel + 0.5 * cell)) / np.cos(np.pi / 6)
    assert bool((distances[length > most] > 0).all())
    assert float(distances[resolution // 2, resolution // 2, resolution // 2]) < -RADIUS + cell


def test_coarse_grids_decide_nothing_that_the_fine_one_would_not(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = render_scene(SCENES["striped-torus"](), views=12, size=24, samples=1)
    carved = carve(scene.views, scene.similarity, resolution=64)
    monkeypatch.setattr(hull, "HULL", replace(HULL, coarsest=64))
    at_once = carve(scene.views, scene.similarity, resolution=64)
    assert carved is not None
    assert at_once is not None
    assert np.array_equal(carved, at_once)
    assert carved[32, 32, 32] > 0  # there is a hole


def test_a_gap_that_one_camera_of_many_sees_is_carved() -> None:
    views = list(images().views) * 3
    mask = np.array(views[7].mask)
    mask[11:14, 11:14] = 0  # of which a pixel is left, as far as a cell is from others
    views[7] = replace(views[7], mask=mask)
    assert len(Agreement.of(views, images().similarity).trusted()) == len(views)
    distances = carve(views, images().similarity, resolution=32)
    assert distances is not None
    assert distances[16, 16, 16] > 0  # in the middle of the hole, and of the ball


def test_masks_that_are_wrong_do_not_carve() -> None:
    views, similarity = list(images().views) * 3, images().similarity
    assert Agreement.of(views, similarity).trusted() == views
    views[0] = inverted().views[0]
    mask = np.array(views[1].mask)
    mask[8:16, 8:16] = 0
    views[1] = replace(views[1], mask=mask)
    assert [id(view) for view in Agreement.of(views, similarity).trusted()] == [id(view) for view in views[2:]]
    # Where all are inverted, nothing tells which to trust; of three views each may cut a third.
    turned = inverted().views
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


def test_a_finer_grid_is_empty_between_empty_vertices() -> None:
    empty = np.zeros((4, 4, 4), dtype=bool)
    empty[1:3] = True
    fine = hull._all_around(empty, 6)
    assert [bool(fine[i].all()) for i in range(7)] == [False, False, True, True, True, False, False]
    assert np.array_equal(hull._all_around(empty, 3), empty)


def test_masks_that_leave_nothing_are_no_start() -> None:
    for share in (0.0, 1.0):
        assert carve(filled(share).views, images().similarity, resolution=12) is None


def test_a_network_is_trained_to_it() -> None:
    torch.manual_seed(0)
    network, state = Siren(24, 2, omega=6.0), torch.get_rng_state()
    length = lengths(13)
    start_at_hull(network, length - RADIUS, steps=80)
    points = 0.9 * hull._in_ball(200)
    with torch.no_grad():
        error = network.value(points) - (points.norm(dim=1) - RADIUS)
    assert float(error.abs().mean()) < 0.03  # it has begun at about ± 0.5
    torch.set_rng_state(state)


@pytest.mark.parametrize(("start", "masks", "expected"), [("auto", True, "hull"), ("auto", False, "sphere")])
def test_settings_say_what_it_begins_as(
    start: str, masks: bool, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hull, "start_at_hull", lambda *_, **__: None)
    some = images() if masks else replace(images(), views=tuple(replace(v, mask=None) for v in images().views))
    model = build_scene(SMALL, has_masks=masks)
    assert begin(model, some.views, some, replace(SMALL, start=start)) == expected
    assert begin(model, some.views, some, replace(SMALL, start="sphere")) == "sphere"
    neus = replace(SMALL, geometry="neus")
    assert begin(build_scene(neus, has_masks=masks), some.views, some, neus) == "sphere"


def test_a_start_that_is_not_there_is_refused() -> None:
    model = build_scene(SMALL, has_masks=True)
    with pytest.raises(InputError, match="no visual hull to begin with"):
        begin(model, filled(0.0).views, filled(0.0), replace(SMALL, start="hull"))
    with pytest.raises(InputError, match="no start by measured depths, which wants depth maps"):
        begin(model, images().views, images(), replace(SMALL, start="depths"))


def test_what_no_measured_ray_passes_is_a_start(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[np.ndarray] = []
    monkeypatch.setattr(hull, "start_at_hull", lambda _, distances, **__: started.append(distances))
    scene = render_scene(SCENES["painted-sphere"](), views=12, size=24, samples=1, depths=True)
    bare = replace(scene, views=tuple(replace(view, mask=None) for view in scene.views))
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
    assert by_masks is not None
    assert bool((started[1] >= by_masks - 2 * cell).all())  # carved further
    assert int((started[1] > 0).sum()) > int((by_masks > 0).sum())


@pytest.fixture(scope="module")
def unmasked() -> PosedImages:
    """A sphere with depth maps and sparse points, and without masks."""
    scene = render_scene(SCENES["painted-sphere"](), views=8, size=24, samples=1, depths=True)
    return replace(scene, views=tuple(replace(view, mask=None) for view in scene.views))


def measured_of(unmasked: PosedImages, *, maps: bool = True) -> MeasuredDepths:
    some = unmasked if maps else replace(unmasked, views=tuple(replace(view, depth=None) for view in unmasked.views))
    return MeasuredDepths(some.views, some, torch.device("cpu"))


@pytest.mark.parametrize("kind", ["maps", "points"])
def test_rays_carve_what_is_outside_and_nothing_inside(unmasked: PosedImages, kind: str) -> None:
    resolution = 24
    empty = seen_through(measured_of(unmasked, maps=kind == "maps"), resolution)
    axis = torch.linspace(-1, 1, resolution + 1)
    length = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0)
    cell = 2 / resolution
    # Places of a ray, which is outside, are rounded to the next vertex: half a diagonal away at most.
    assert not bool(empty[length < RADIUS - 0.5 * 3**0.5 * cell].any())
    beyond = (length > RADIUS + 3 * cell) & (length < 0.95)
    assert float(empty[beyond].float().mean()) > (0.5 if kind == "maps" else 0.15)


def test_one_wrong_measurement_carves_no_hole(unmasked: PosedImages) -> None:
    measured = measured_of(unmasked)
    measured.numbers[0] *= 2  # through the sphere and far behind it
    right, wrong = seen_through(measured_of(unmasked), 24), seen_through(measured, 24)
    axis = torch.linspace(-1, 1, 25)
    inside = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0) < RADIUS - 0.08
    assert not bool((wrong & inside).any())
    assert int((wrong != right).sum()) < 25
