"""What a reconstruction learns: its uncertainty, its bands, its start and what is behind it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from mplicits.datasets import Camera, PosedImage, look_at
from mplicits.datasets.cameras import intrinsics
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.neural_fields import ColorNetwork, InputError, Similarity, Sphere
from mplicits.neural_fields.volume.render import Sampling
from mplicits.neural_fields.volume.weights import sphere_span
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct.model import RayPool, SceneModel, build_scene, meets_sphere
from reconstructions import TINY_SCENE
from torch import Tensor

SMALL = replace(TINY_SCENE, widths=(24, 16), depths=(2, 1))
PAPER = replace(SMALL, widths=(128, 256), depths=(4, 5), features=32)


@pytest.fixture
def no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the start as a sphere where a test is about something else."""
    monkeypatch.setattr(scene_model, "fit_sphere", lambda network, radius: None)


def test_the_uncertainty_begins_as_in_neus_and_can_be_trained() -> None:
    model = SceneModel(Sphere(radius=0.5), ColorNetwork(0, width=8, depth=1), None, torch.zeros(3))
    assert float(model.inv_std.detach()) == pytest.approx(math.exp(3), rel=1e-6)
    (slope,) = torch.autograd.grad(model.inv_std, model.variance)
    assert float(slope) == pytest.approx(10 * math.exp(3), rel=1e-5)
    assert model.variance in set(model.parameters())
    with torch.no_grad():
        model.variance.fill_(5.0)
    assert float(model.inv_std.detach()) == 1e6  # and not infinite


@pytest.mark.usefixtures("no_start")
def test_bands_follow_the_uncertainty_down_to_their_floor() -> None:
    model = build_scene(SMALL, has_masks=True)
    assert model.geometry.deltas.tolist() == pytest.approx([SMALL.radius])
    for inv_std, expected in ((20.0, 0.2), (100.0, 0.04), (400.0, 0.02), (1e5, 0.02)):
        with torch.no_grad():
            model.variance.fill_(math.log(inv_std) / 10)
        model.widen(4.0, 0.02)
        assert model.geometry.deltas.tolist() == pytest.approx([expected], rel=1e-4)


@pytest.mark.parametrize("geometry", ["multiscale", "neus"])
@pytest.mark.parametrize("radius", [0.4, 0.6])
def test_every_geometry_begins_as_a_sphere(geometry: str, radius: float) -> None:
    model = build_scene(replace(SMALL, geometry=geometry, radius=radius), has_masks=True)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    for level in range(model.geometry.num_levels):
        with torch.inference_mode():
            assert float(model.geometry.value(0.5 * radius * directions, level=level).max()) < 0
            assert float(model.geometry.value(min(1.0, 1.6 * radius) * directions, level=level).min()) > 0


def test_residuals_begin_near_zero() -> None:
    geometry = build_scene(SMALL, has_masks=True).geometry
    x = torch.rand(2000, 3) - 0.5
    with torch.inference_mode():
        change = (geometry.value(x, level=1) - geometry.value(x, level=0)).abs()
    assert 0 < float(change.max()) < 0.05


@pytest.mark.usefixtures("no_start")
def test_the_papers_geometry_is_more_than_a_third_smaller_than_that_of_neus() -> None:
    multiscale, neus = (
        sum(p.numel() for p in build_scene(replace(PAPER, geometry=name), has_masks=True).geometry.parameters())
        for name in ("multiscale", "neus")
    )
    assert multiscale <= (1 - 0.37) * neus


@pytest.mark.usefixtures("no_start")
@pytest.mark.parametrize(
    ("background", "has_masks", "outside", "behind"),
    [
        ("auto", True, False, 1.0),
        ("auto", False, True, 0.0),
        ("black", True, False, 0.0),
        ("white", False, False, 1.0),
        ("outside", True, True, 0.0),
    ],
)
def test_what_is_behind(background: str, has_masks: bool, outside: bool, behind: float) -> None:
    model = build_scene(replace(SMALL, background=background), has_masks=has_masks)
    assert (model.outside is not None) is outside
    assert model.background.tolist() == [behind] * 3
    assert "background" in model.state_dict()
    # A ray that passes the sphere sees it.
    origins, directions = torch.tensor([[0.0, 3.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    with torch.no_grad():
        seen = model.render(origins, directions, Sampling(4, 4, 1))
    assert float(seen.opacity) == pytest.approx(0, abs=1e-6)
    if not outside:
        assert seen.color[0].tolist() == pytest.approx([behind] * 3)


@pytest.mark.usefixtures("no_start")
def test_a_seed_decides_the_start_and_leaves_the_global_random_state() -> None:
    before = torch.get_rng_state()
    first, again, other = (build_scene(replace(SMALL, seed=seed), has_masks=True) for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    same, differ = first.state_dict(), other.state_dict()
    assert all(torch.equal(tensor, same[name]) for name, tensor in again.state_dict().items())
    assert any(not torch.equal(tensor, differ[name]) for name, tensor in same.items())


@pytest.mark.usefixtures("no_start")
@pytest.mark.parametrize("half", [False, True])
def test_everything_is_trained_by_one_picture(half: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # On a GPU products of colours are in half precision, which the CPU has too.
    monkeypatch.setattr(scene_model, "HALF_PRECISION", ("cpu",) if half else ())
    model = build_scene(replace(SMALL, background="outside"), has_masks=False)
    origins = torch.nn.functional.normalize(torch.randn(64, 3), dim=1) * 2
    directions = torch.nn.functional.normalize(0.5 * (torch.rand(64, 3) - 0.5) - origins, dim=1)
    seen = model.render(origins, directions, Sampling(16, 8, 1), cos_anneal=0.5)
    (seen.color.square().mean() + (seen.jet.gradient.norm(dim=-1) - 1).square().mean()).backward()
    missing = [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.isfinite().all())]
    assert missing == []
    assert float(model.variance.grad.abs()) > 0


WORLD = Similarity(center=(50.0, -20.0, 7.0), scale=4.0)
CPU = torch.device("cpu")


def view(number: int, width: int, height: int, *, masked: bool, back: bool = False, fov: float = 40.0) -> PosedImage:
    """A picture of the unit sphere, in world coordinates, whose colours spell (view, y, x) of each pixel."""
    eye = WORLD.to_input(3.0 * np.array([[1.0, 0.2, 0.1], [0.1, 0.3, -1.0], [-0.5, -1.0, 0.4]])[number])
    target = 2 * eye - np.array(WORLD.center) if back else np.array(WORLD.center)
    camera = look_at(eye.tolist(), target.tolist(), fov=fov, width=width, height=height)
    y, x = np.mgrid[:height, :width]
    color = np.stack((np.full_like(x, number), y, x), axis=-1).astype(np.float32) / 255
    mask = ((11 * x + 7 * y + number) % 256).astype(np.float32) / 255 if masked else None
    return PosedImage(f"{number}.png", camera, color, mask)


def views(*, masked: bool = True) -> list[PosedImage]:
    return [view(0, 14, 9, masked=masked), view(1, 8, 12, masked=masked), view(2, 10, 10, masked=masked, fov=60)]


def places(pool: RayPool, count: int = 20_000) -> list[tuple[int, ...]]:
    """(view, y, x) of drawn rays."""
    colors = pool.draw(count, torch.Generator().manual_seed(1)).color
    return [tuple(place) for place in (colors * 255).round().long().tolist()]


def test_a_drawn_ray_is_that_of_its_pixel_with_its_colour_and_mask() -> None:
    pictures = views()
    pool = RayPool(pictures, WORLD, CPU)
    rays = pool.draw(500, torch.Generator().manual_seed(0))
    assert rays.origins.dtype == rays.directions.dtype == rays.color.dtype == rays.mask.dtype == torch.float32
    number, y, x = (rays.color * 255).round().long().unbind(dim=1)
    assert set(number.tolist()) == {0, 1, 2}
    for index, picture in enumerate(pictures):
        rows = number == index
        eye, directions = picture.camera.moved(WORLD).rays()
        torch.testing.assert_close(rays.origins[rows], eye.expand(int(rows.sum()), 3), atol=1e-6, rtol=0)
        torch.testing.assert_close(rays.directions[rows], directions[y[rows], x[rows]], atol=1e-6, rtol=0)
        mask = torch.from_numpy(picture.mask)[y[rows], x[rows]]
        torch.testing.assert_close(rays.mask[rows], mask, atol=1e-7, rtol=0)


def test_rays_in_the_unit_sphere_pass_through_the_world_points_of_the_camera() -> None:
    picture = view(0, 14, 9, masked=False)
    eye, directions = picture.camera.moved(WORLD).rays()
    there = WORLD.to_input((eye + 2.5 * directions).double().reshape(-1, 3).numpy())
    pixels, depth = picture.camera.project(torch.from_numpy(there))
    y, x = np.mgrid[:9, :14]
    assert np.allclose(pixels.numpy(), np.stack((x.ravel(), y.ravel()), axis=1), atol=1e-4)
    assert bool((depth > 0).all())


def by_brute_force(camera: Camera) -> Tensor:
    """Which pixels' rays meet the unit sphere, by the rays of all of them."""
    eye, directions = camera.rays(dtype=torch.float64)
    near, far = sphere_span(eye.expand_as(directions).reshape(-1, 3), directions.reshape(-1, 3))
    return (far > near).reshape(directions.shape[:2])


@pytest.mark.parametrize("distance", [0.3, 0.9, 1.1, 2.0, 5.0])
def test_the_rays_that_meet_the_sphere_are_those_of_all_pixels_that_do(distance: float) -> None:
    random, kinds = np.random.default_rng(0), set()
    for _ in range(20):
        eye, target = distance * unit_rows(random.normal(size=(1, 3)))[0], random.normal(size=3)
        lens = intrinsics(*random.uniform(10, 60, size=2), *random.uniform(0, 40, size=2))
        pose = look_at(eye.tolist(), target.tolist(), width=1, height=1).world_from_camera
        camera = Camera(lens, pose, 43, 31)
        expected = by_brute_force(camera).numpy()
        # In float64 the sides differ by some 1e-15 at most, which no random pixel is from the border.
        assert np.array_equal(meets_sphere(camera), expected)
        kinds |= {bool(expected.any()), bool(expected.all())}
    assert kinds == {True, False} if distance > 1 else kinds == {True}


def test_pixels_that_miss_the_sphere_are_never_drawn_and_all_others_are() -> None:
    pictures = views()
    pool = RayPool(pictures, WORLD, CPU)
    expected = set()
    for index, picture in enumerate(pictures):
        meets = by_brute_force(picture.camera.moved(WORLD))
        expected |= {(index, y, x) for y, x in meets.nonzero().tolist()}
    everything = sum(picture.color.shape[0] * picture.color.shape[1] for picture in pictures)
    assert 0.3 * everything < len(expected) < 0.95 * everything  # a test of both kinds of pixels
    assert len(pool) == len(expected)
    assert set(places(pool)) == expected


@pytest.mark.parametrize("whole", [False, True])
def test_pixels_that_are_left_out_are_never_drawn(whole: bool) -> None:
    pictures = views()
    hole = np.zeros(pictures[1].color.shape[:2], dtype=bool)
    hole[3:9, 2:6] = True
    everything, rest = (places(RayPool(pictures, WORLD, CPU, whole=whole, left_out=out)) for out in ({}, {1: hole}))
    assert set(rest) == {(number, y, x) for number, y, x in everything if number != 1 or not hole[y, x]}
    assert len(set(rest)) < len(set(everything))


@pytest.mark.parametrize("whole", [False, True])
def test_a_pixel_s_number_says_its_view_and_place(whole: bool) -> None:
    pictures = views()
    hole = np.zeros((12, 8), dtype=bool)
    hole[3:9, 2:6] = True
    pool = RayPool(pictures, WORLD, CPU, whole=whole, left_out={1: hole})
    expected = []
    for index, picture in enumerate(pictures):
        chosen = by_brute_force(picture.camera.moved(WORLD)).numpy() | whole
        y, x = np.nonzero(chosen & ~hole if index == 1 else chosen)
        expected.append(np.stack((np.full_like(x, index), x, y), axis=1))
    view, place = pool.places(torch.arange(len(pool)))
    assert np.array_equal(torch.column_stack((view, place)).numpy(), np.concatenate(expected))
    # The colours spell (view, y, x).
    assert torch.equal(pool.colors.long(), torch.column_stack((view, place.flip(1))))
    assert pool.colors.dtype == torch.uint8


def test_all_pixels_are_equally_likely() -> None:
    pool = RayPool(views(), WORLD, CPU)
    _, counts = np.unique(np.array(places(pool, 100 * len(pool))), axis=0, return_counts=True)
    # χ² with n − 1 degrees of freedom is within five standard deviations of its mean.
    excess = ((counts - 100.0) ** 2 / 100).sum() - (len(pool) - 1)
    assert abs(excess) < 5 * (2 * len(pool)) ** 0.5


def test_without_masks_everything_counts_as_object() -> None:
    pool = RayPool(views(masked=False), WORLD, CPU)
    assert not pool.has_masks
    assert pool.draw(30, torch.Generator()).mask.tolist() == [1.0] * 30
    # In one view without a mask it is not known what the object is.
    assert not RayPool([*views(), view(0, 14, 9, masked=False)], WORLD, CPU).has_masks


def test_cameras_that_all_look_away_are_refused() -> None:
    away = [view(number, 8, 8, masked=True, back=True) for number in range(3)]
    for whole in (False, True):
        with pytest.raises(InputError, match="sees the region of interest; see `mplicits check-cameras`"):
            RayPool(away, WORLD, CPU, whole=whole)
    mixed = RayPool([away[0], *views()[1:]], WORLD, CPU)
    assert {number for number, _, _ in places(mixed)} == {1, 2}
