"""Measured depths against exact spheres: where rays end, what they pass, scale and shift, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mplicits.datasets.views.formats.shots import DepthKind
from mplicits.datasets.views.images import PosedImage, PosedImages
from mplicits.neural_fields import InputError, Jet, Similarity, Sphere, Union, render_volume
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.reconstruct.measured import LIMITS, DepthRays, MeasuredDepths, depth_loss, fit_scale_shift
from reconstructions import painted_sphere, with_views, without
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
    return without(painted_sphere(8, 24, depths=True), "mask")


def told_as(images: PosedImages, kind: DepthKind, scales: np.ndarray, shifts: np.ndarray) -> PosedImages:
    """With maps of numbers m, where z or 1 / z is a m + b for each view, as ``kind`` says."""

    def told(k: int, view: PosedImage) -> PosedImage:
        z = view.depth.numbers.astype(np.float64)
        numbers = ((1 / z if kind == "disparity" else z) - shifts[k]) / scales[k]
        return replace(view, depth=replace(view.depth, numbers=numbers.astype(np.float32), kind=kind))

    return with_views(images, told)


def ends(measured: MeasuredDepths) -> Tensor:
    rays = measured.at(torch.arange(len(measured)))
    return rays.origins + rays.reach[:, None] * rays.directions


def measured_of(images: PosedImages) -> MeasuredDepths:
    return MeasuredDepths(images.views, images, CPU)


def readings(images: PosedImages) -> int:
    return sum(int(np.isfinite(view.depth.numbers).sum()) for view in images.views)


def test_rays_end_on_the_surface(images: PosedImages) -> None:
    for some, count in (
        (images, readings(images) + len(images.observations)),
        (without(images, "depth"), len(images.observations)),
    ):
        measured = measured_of(some)
        assert len(measured) == count
        assert float(EXACT.value(ends(measured)).abs().max()) <= ROUNDING
        assert bool(measured.exact.all())


def test_coordinates_are_those_of_the_region(images: PosedImages) -> None:
    region = Similarity((0.1, -0.2, 0.0), 2.0)
    found = ends(measured_of(replace(images, similarity=region))).double()
    world = found * region.scale + torch.tensor(region.center, dtype=torch.float64)
    assert float((world.norm(dim=1) - RADIUS).abs().max()) <= 2 * ROUNDING


def test_views_that_are_held_out_are_not_measured(images: PosedImages) -> None:
    some = MeasuredDepths(images.views[2:5], images, CPU)
    assert some.eyes.shape == (3, 3)
    torch.testing.assert_close(some.eyes[1], images.views[3].camera.eye.float())
    points = np.isin(images.observations[:, 0], (2, 3, 4)).sum()
    assert len(some) == points + readings(replace(images, views=images.views[2:5]))


def test_what_is_outside_the_masks_is_left_out(images: PosedImages) -> None:
    left = np.zeros((24, 24), np.float32)
    left[:, :12] = 1
    masked = with_views(images, lambda _, view: replace(view, mask=left))
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
def test_numbers_that_fix_no_scale_have_none(numbers: Tensor, wanted: Tensor) -> None:
    group = torch.zeros(len(numbers), dtype=torch.int64)
    assert fit_scale_shift(numbers, wanted, group, 1).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("kind", ["relative", "disparity"])
def test_sparse_points_fix_the_scale_of_a_map(images: PosedImages, kind: DepthKind) -> None:
    random = np.random.default_rng(1)
    some = told_as(images, kind, random.uniform(0.5, 3, 8), random.uniform(-0.5, 0.5, 8))
    measured = measured_of(some)
    assert not measured.is_loose
    assert int((~measured.exact).sum()) == readings(images)
    # A sparse point is up to half a pixel from the one whose number it is held against. Seen from the middle of the
    # sphere a pixel is 0.04 wide; at the rim, where depth changes fast, that says little, and the fit is robust.
    assert float(EXACT.value(ends(measured)[~measured.exact]).abs().median()) < 0.02


@pytest.mark.parametrize("kind", ["relative", "disparity"])
def test_without_points_the_surface_fixes_the_scale(images: PosedImages, kind: DepthKind) -> None:
    scales, shifts = np.linspace(0.5, 3, 8), np.linspace(-0.4, 0.4, 8)
    measured = measured_of(replace(told_as(images, kind, scales, shifts), points=None, observations=None))
    assert measured.is_loose
    nothing = depth_loss(EXACT, measured.at(torch.arange(len(measured))))
    assert float(nothing.abs().max()) == 0  # before they are known
    measured.align(EXACT.value)
    np.testing.assert_allclose(measured.affine[:, 0], scales, rtol=0.02)
    assert float(EXACT.value(ends(measured)).abs().median()) < 2e-3


def test_an_exact_field_misses_nothing_and_another_one_by_its_distance(images: PosedImages) -> None:
    rays = measured_of(images).at(torch.arange(500))
    # One for each of three places, and one to spare.
    assert float(depth_loss(EXACT, rays, generator=torch.Generator().manual_seed(0)).max()) <= 4 * ROUNDING
    # To a smaller sphere each place is further, by the difference of the radii; a larger one holds the end of the ray.
    for radius in (0.5, 0.7):
        assert float(depth_loss(Sphere(radius=radius), rays).min()) >= 0.1 - 4 * ROUNDING


def along_z(reach: float, *, eye: float = -3.0) -> DepthRays:
    """A ray along the z axis through the middle of the sphere, and how far it gets."""
    origins, directions = torch.tensor([[0.0, 0.0, eye]]), torch.tensor([[0.0, 0.0, 1.0]])
    return DepthRays(origins, directions, torch.tensor([reach]), torch.tensor([True]), torch.tensor([0]))


def test_the_way_of_what_ends_outside_the_region_is_free() -> None:
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
    def changed(_: int, view: PosedImage) -> PosedImage:
        numbers = view.depth.numbers * np.float32(factor)
        return replace(view, depth=replace(view.depth, numbers=numbers, source=Path("a.png")))

    return with_views(images, changed)


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_maps_in_other_units_are_refused(images: PosedImages, factor: float) -> None:
    with pytest.raises(InputError, match=r"a\.png: 0\.0% of the depths in all maps end in the region.*--depth-scale"):
        measured_of(replace(scaled(images, factor), points=None, observations=None))


def test_maps_that_sparse_points_contradict_are_refused(images: PosedImages) -> None:
    with pytest.raises(InputError, match=r"a\.png: depths in all maps are 1\.25 times those of the sparse points"):
        measured_of(scaled(images, 1.25))
    assert len(measured_of(scaled(images, 1.02)))
