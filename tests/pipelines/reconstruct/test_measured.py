"""Measured depths against exact spheres: where rays end, what they pass, scale and shift, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.formats.shots import DepthKind
from mplicits.datasets.views.images import PosedImages
from mplicits.neural_fields import InputError, Jet, Similarity, Sphere, Union, render_volume
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.reconstruct.measured import LIMITS, DepthRays, MeasuredDepths, depth_loss, fit_scale_shift
from torch import Tensor

CPU = torch.device("cpu")
RADIUS = 0.6  # of the painted sphere
EXACT = Sphere(radius=RADIUS)
# Depths and directions of the rays are rounded to float32, as eyes are: a few units in the last place of 4, how far
# the eyes are in radii of the region.
ROUNDING = 8 * 4 * 2.0**-24


@pytest.fixture(scope="module")
def images() -> PosedImages:
    """A sphere with depth maps and sparse points, and without masks."""
    scene = render_scene(SCENES["painted-sphere"](), views=8, size=24, samples=1, depths=True)
    return replace(scene, views=tuple(replace(view, mask=None) for view in scene.views))


def only_points(images: PosedImages) -> PosedImages:
    return replace(images, views=tuple(replace(view, depth=None) for view in images.views))


def told_as(images: PosedImages, kind: DepthKind, scales: np.ndarray, shifts: np.ndarray) -> PosedImages:
    """With maps of numbers m, where z or 1 / z is a m + b for each view, as ``kind`` says."""
    views = []
    for view, a, b in zip(images.views, scales, shifts, strict=True):
        assert view.depth is not None
        z = view.depth.numbers.astype(np.float64)
        numbers = ((1 / z if kind == "disparity" else z) - b) / a
        views.append(replace(view, depth=replace(view.depth, numbers=numbers.astype(np.float32), kind=kind)))
    return replace(images, views=tuple(views))


def ends(measured: MeasuredDepths) -> Tensor:
    rays = measured.at(torch.arange(len(measured)))
    return rays.origins + rays.reach[:, None] * rays.directions


def measured_of(images: PosedImages) -> MeasuredDepths:
    return MeasuredDepths(images.views, images, CPU)


def test_rays_end_on_the_surface(images: PosedImages) -> None:
    pixels = sum(int(np.isfinite(view.depth.numbers).sum()) for view in images.views if view.depth)
    assert images.observations is not None
    for some, count in ((images, pixels + len(images.observations)), (only_points(images), len(images.observations))):
        measured = measured_of(some)
        assert len(measured) == count
        assert float(EXACT.value(ends(measured)).abs().max()) <= ROUNDING
        assert bool(measured.exact.all())


def test_coordinates_are_those_of_the_region(images: PosedImages) -> None:
    region = Similarity((0.1, -0.2, 0.0), 2.0)
    found = ends(measured_of(replace(images, similarity=region))).double()
    world = found * region.scale + torch.tensor(region.center, dtype=torch.float64)
    assert float((world.norm(dim=1) - RADIUS).abs().max()) <= 2 * ROUNDING


def test_views_that_are_held_out_say_nothing(images: PosedImages) -> None:
    some = MeasuredDepths(images.views[2:5], images, CPU)
    assert some.eyes.shape == (3, 3)
    torch.testing.assert_close(some.eyes[1], images.views[3].camera.eye.float())
    assert images.observations is not None
    points = np.isin(images.observations[:, 0], (2, 3, 4)).sum()
    assert len(some) == points + sum(int(np.isfinite(v.depth.numbers).sum()) for v in images.views[2:5] if v.depth)


def test_what_is_outside_the_masks_is_left_out(images: PosedImages) -> None:
    left = np.zeros((24, 24), np.float32)
    left[:, :12] = 1
    masked = replace(images, views=tuple(replace(view, mask=left) for view in images.views))
    measured = measured_of(masked)
    assert 0 < len(measured) < len(measured_of(images))
    for number, view in enumerate(images.views):
        pixels, _ = view.camera.project(ends(measured)[measured.views == number].double())
        assert float(pixels[:, 0].max()) < 11.5 + 1e-3


def test_scale_and_shift_are_found_among_outliers() -> None:
    random = torch.Generator().manual_seed(0)
    m, group = torch.rand(400, generator=random), torch.arange(400) % 2
    a, b = torch.tensor([2.0, 0.5]), torch.tensor([-0.25, 1.0])
    z = a[group] * m + b[group]
    z[:80] += 5 * torch.rand(80, generator=random)  # a fifth
    found = fit_scale_shift(m, z, group, 2)
    # A residual counts as one once it is LEAST_RESIDUAL of z; those of a fifth, all on one side, pull by as much.
    torch.testing.assert_close(found, torch.stack((a, b), dim=1).double(), rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("numbers", "wanted"),
    [
        (torch.rand(LIMITS.fewest - 1), torch.rand(LIMITS.fewest - 1)),
        (torch.full((50,), 3.0), torch.rand(50)),
        (torch.arange(50.0), -torch.arange(50.0)),
    ],
)
def test_numbers_that_say_no_scale_say_none(numbers: Tensor, wanted: Tensor) -> None:
    group = torch.zeros(len(numbers), dtype=torch.int64)
    assert fit_scale_shift(numbers, wanted, group, 1).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("kind", ["relative", "disparity"])
def test_sparse_points_say_what_the_numbers_of_a_map_are(images: PosedImages, kind: DepthKind) -> None:
    random = np.random.default_rng(1)
    some = told_as(images, kind, random.uniform(0.5, 3, 8), random.uniform(-0.5, 0.5, 8))
    measured = measured_of(some)
    assert not measured.is_loose
    assert int((~measured.exact).sum()) == sum(int(np.isfinite(v.depth.numbers).sum()) for v in images.views if v.depth)
    # A sparse point is up to half a pixel from the one whose number it is held against. Seen from the middle of the
    # sphere a pixel is 0.04 wide; at the rim, where depth changes fast, that says little, and the fit is robust.
    assert float(EXACT.value(ends(measured)[~measured.exact]).abs().median()) < 0.02


@pytest.mark.parametrize("kind", ["relative", "disparity"])
def test_without_points_the_surface_itself_says_it(images: PosedImages, kind: DepthKind) -> None:
    scales, shifts = np.linspace(0.5, 3, 8), np.linspace(-0.4, 0.4, 8)
    measured = measured_of(replace(told_as(images, kind, scales, shifts), points=None, observations=None))
    assert measured.is_loose
    nothing = depth_loss(EXACT, measured.at(torch.arange(len(measured))))
    assert float(nothing.abs().max()) == 0  # before they are known
    measured.settle(EXACT.value)
    np.testing.assert_allclose(measured.affine[:, 0], scales, rtol=0.02)
    assert float(EXACT.value(ends(measured)).abs().median()) < 2e-3


def test_an_exact_field_misses_nothing_and_another_one_by_its_distance(images: PosedImages) -> None:
    rays = measured_of(images).at(torch.arange(500))
    random = torch.Generator().manual_seed(0)
    # One for each of three places, and one to spare.
    assert float(depth_loss(EXACT, rays, generator=random).max()) <= 4 * ROUNDING
    # Of a smaller sphere each place is further off, by the difference of the radii, which at the end is all there is.
    smaller = depth_loss(Sphere(radius=0.5), rays)
    assert float(smaller.min()) >= 0.1 - 4 * ROUNDING
    # A larger one holds the end of the ray.
    larger = depth_loss(Sphere(radius=0.7), rays)
    assert float(larger.min()) >= 0.1 - 4 * ROUNDING


def along_z(reach: float, *, eye: float = -3.0) -> DepthRays:
    """A ray along the z axis through the middle of the sphere, and how far it gets."""
    return DepthRays(
        torch.tensor([[0.0, 0.0, eye]]),
        torch.tensor([[0.0, 0.0, 1.0]]),
        torch.tensor([reach]),
        torch.tensor([True]),
        torch.tensor([0]),
    )


def test_what_ends_outside_the_region_says_that_the_way_is_free() -> None:
    rays = along_z(9.0)
    # In the middle of the way by its square: at depth 4 - 0.25 * 2, which is 0.5 from the middle of the sphere.
    assert float(depth_loss(Sphere(radius=0.8), rays)) == pytest.approx(0.3, abs=1e-6)
    assert float(depth_loss(Sphere(radius=0.3), rays)) == 0


@pytest.mark.parametrize(("eye", "entry"), [(-3.0, -1.0), (-0.9, -0.9)])
def test_a_ray_that_was_measured_does_not_enter_inside_of_anything(eye: float, entry: float) -> None:
    """Which a picture cannot tell: what the ray enters inside of stops none of its light."""
    ball, slab = Sphere(radius=0.3), Sphere(radius=0.1, center=(0.0, 0.0, entry))
    rays = along_z(-0.3 - eye, eye=eye)
    assert float(depth_loss(ball, rays)) == pytest.approx(0, abs=4 * ROUNDING)
    assert float(depth_loss(Union(ball, slab), rays)) == pytest.approx(0.1, abs=4 * ROUNDING)

    def white(x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
        return torch.ones_like(x)

    alone, behind = (
        render_volume(field, white, *rays[:2], inv_std=torch.tensor(1000.0), sampling=Sampling(uniform=64))
        for field in (ball, Union(ball, slab))
    )
    torch.testing.assert_close(behind.depth, alone.depth, rtol=0, atol=1e-2)
    # What measurements do not reach is not known: this one ends before the region.
    assert float(depth_loss(Union(ball, slab), along_z(0.05, eye=-2.0))) == 0


def scaled(images: PosedImages, factor: float) -> PosedImages:
    views = []
    for view in images.views:
        assert view.depth is not None
        depth = replace(view.depth, numbers=view.depth.numbers * np.float32(factor), source=Path("a.png"))
        views.append(replace(view, depth=depth))
    return replace(images, views=tuple(views))


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_maps_in_other_units_are_refused(images: PosedImages, factor: float) -> None:
    with pytest.raises(InputError, match=r"a\.png: 0\.0% of the depths in all maps end in the region.*--depth-scale"):
        measured_of(replace(scaled(images, factor), points=None, observations=None))


def test_maps_that_sparse_points_contradict_are_refused(images: PosedImages) -> None:
    with pytest.raises(InputError, match=r"a\.png: depths in all maps are 1\.25 times those of the sparse points"):
        measured_of(scaled(images, 1.25))
    assert len(measured_of(scaled(images, 1.02)))
