"""Patches of photographs on tangent planes: a textured plane whose pictures are known in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from fields import solve_sphere
from mplicits.datasets.cameras import Camera, look_at
from mplicits.datasets.views.images import PosedImage
from mplicits.neural_fields import Field, FunctionField, MultiscaleSDF, Sphere, render_volume, sphere_trace
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.reconstruct.consistency import (
    Cameras,
    ConsistencyOptions,
    GreyPictures,
    Pixels,
    Surface,
    choose_neighbours,
    consistency_loss,
    correlation,
    flatness_loss,
    surface_between,
    warp,
)
from torch import Tensor

EYES = [(0.0, 0.0, 2.5), (0.5, 0.0, 2.4), (-0.45, 0.1, 2.4), (0.1, 0.6, 2.4), (1.9, 0.0, 1.6)]  # 12°, 11°, 14°, 50°
OPTIONS = ConsistencyOptions()
WIDTH, HEIGHT = 96, 72


def texture(points: Tensor) -> Tensor:
    """Grey values of points of the plane: waves from eight to twenty pixels long."""
    x, y = points[..., 0], points[..., 1]
    return 0.5 + 0.15 * (17 * x + 3 * torch.sin(5 * y)).sin() + 0.15 * (23 * y - 9 * x).cos() + 0.1 * (31 * x).sin()


def cameras_at(eyes: list[tuple[float, float, float]]) -> list[Camera]:
    return [look_at(eye, (0, 0, 0), up=(0, 1, 0), fov=36, width=WIDTH, height=HEIGHT) for eye in eyes]


def on_plane(camera: Camera, normal: Tensor, height: float) -> Tensor:
    """Where the rays of all pixels meet the plane ⟨n, x⟩ = h, ``(H, W, 3)``."""
    eye, directions = camera.rays(dtype=torch.float64)
    depth = (height - eye @ normal) / (directions @ normal)
    return eye + depth[..., None] * directions


NORMAL = torch.nn.functional.normalize(torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64), dim=0)


def scene(*, plain: bool = False) -> tuple[Cameras, GreyPictures, list[Camera]]:
    """Pictures of the plane with `NORMAL` through the origin, in float64."""
    views = []
    cameras = cameras_at(EYES)
    for number, camera in enumerate(cameras):
        grey = texture(on_plane(camera, NORMAL, 0.0)).numpy()
        color = (0 * grey + 0.5 if plain else grey)[..., None].repeat(3, axis=2).astype("float32")
        views.append(PosedImage(f"{number}.png", camera, color, None))
    pictures = GreyPictures(views, torch.device("cpu"))
    lens = torch.stack([camera.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras])
    axes = torch.stack([camera.world_from_camera[:3, :3] for camera in cameras])
    return Cameras(torch.stack([camera.eye for camera in cameras]), axes, lens), pictures, cameras


def pixels_and_rays(cameras: Cameras, count: int = 40) -> tuple[Pixels, Tensor, Tensor]:
    """Random pixels in the middle of the first picture, and their rays."""
    random = torch.Generator().manual_seed(3)
    place = torch.stack(
        (torch.randint(25, 70, (count,), generator=random), torch.randint(20, 50, (count,), generator=random)), dim=1
    )
    view = torch.zeros(count, dtype=torch.int64)
    lens = cameras.lens[0]
    line = torch.cat(((place - lens[2:]) / lens[:2], torch.ones(count, 1)), dim=1)
    directions = torch.nn.functional.normalize(line.double() @ cameras.axes[0].T, dim=1)
    return Pixels(view, place), cameras.eyes[view], directions


class Plane(torch.nn.Module):
    """The textured plane, moved by a height and tilted by a slope."""

    def __init__(self, height: float, slope: float) -> None:
        super().__init__()
        self.height, self.slope = (torch.nn.Parameter(torch.tensor(number).double()) for number in (height, slope))

    def forward(self, x: Tensor) -> Tensor:
        tilt = self.slope * torch.tensor([1.0, 0.0, 0.0])
        return x @ torch.nn.functional.normalize(NORMAL + tilt, dim=0).to(x) - self.height


def plane(height: float = 0.0) -> Field:
    return FunctionField(Plane(height, 0.0).requires_grad_(False))


def surface_of(field: Field, origins: Tensor, directions: Tensor, samples: int = 300, skip: float = 0.0) -> Surface:
    """The surface between evenly spaced samples, which do not move with the field."""
    rendered = render_volume(
        field, lambda x, *_: torch.zeros_like(x), origins, directions,
        inv_std=64.0, sampling=Sampling(uniform=samples, importance=0), alpha_threshold=skip,
    )  # fmt: skip
    return surface_between(rendered, origins, directions, OPTIONS)


def loss_of(field: Field, parts: tuple[Cameras, GreyPictures, list[Camera]], options=OPTIONS, distance=None) -> Tensor:
    cameras, pictures, _ = parts
    pixels, origins, directions = pixels_and_rays(cameras)
    surface = surface_of(field, origins, directions)
    return consistency_loss(surface, pixels, cameras, pictures, distance or field.value, options)


def test_grey_values_are_bilinear_and_those_of_the_border_beyond_it() -> None:
    color = np.arange(24, dtype=np.uint8).reshape(4, 6)[..., None].repeat(3, axis=2)
    views = [PosedImage("0.png", cameras_at(EYES)[0].resized(6, 4), color / np.float32(255), None)]
    pictures = GreyPictures(views, torch.device("cpu"))
    place = torch.tensor([[1.0, 2.0], [0.25, 1.5], [5.0, 3.0], [-7.0, 1.0], [9.0, 99.0], [math.inf, 0.0]])
    found = pictures.at(torch.zeros(6, dtype=torch.int64), place)
    torch.testing.assert_close(255 * found, torch.tensor([13.0, 9.25, 23.0, 6.0, 23.0, 5.0]))
    nowhere = torch.full((1, 2), math.nan, requires_grad=True)
    value = pictures.at(torch.zeros(1, dtype=torch.int64), nowhere)
    (slope,) = torch.autograd.grad(value.sum(), nowhere)
    assert 0 <= float(value.detach()) <= 1
    assert bool(slope.isfinite().all())


def test_the_homography_maps_as_rays_do_that_meet_the_plane() -> None:
    cameras, _, cams = scene()
    pixels, origins, directions = pixels_and_rays(cameras)
    surface = surface_of(plane(), origins, directions)
    assert bool(surface.found.all())
    offsets = torch.tensor([[0, 0], [-3, 2], [3, 3]])
    neighbours = torch.tensor([[1, 4]]).expand(40, 2)
    found = warp(surface, pixels, offsets, neighbours, cameras)
    points = on_plane(cams[0], NORMAL, 0.0)
    for column, other in enumerate((1, 4)):
        for row, offset in enumerate(offsets):
            x, y = (pixels.place + offset).T
            expected, _ = cams[other].project(points[y, x])
            assert torch.allclose(found[:, column, row], expected, atol=1e-9)


def test_patches_correlate_on_the_true_plane_and_pull_towards_it() -> None:
    parts = scene()
    true = float(loss_of(plane(), parts).mean())
    assert true < 0.01  # of bilinear interpolation: (2π / 10 pixels)² / 8 of the amplitude at most, a twentieth
    for number in (0.02, -0.02):
        field = FunctionField(Plane(number, 0.0))
        loss = loss_of(field, parts).mean()
        uphill, _ = torch.autograd.grad(loss, list(field.parameters()))
        assert float(loss.detach()) > 3 * true
        assert float(uphill) * number > 0  # downhill is towards 0
    for number in (0.15, -0.15):
        field = FunctionField(Plane(0.0, number))
        _, uphill = torch.autograd.grad(loss_of(field, parts).mean(), list(field.parameters()))
        assert float(uphill) * number > 0


def test_neighbours_look_from_other_angles_and_past_what_hides_them() -> None:
    cameras, pictures, _ = scene()
    pixels, origins, directions = pixels_and_rays(cameras)
    surface = surface_of(plane(), origins, directions)
    chosen, visible = choose_neighbours(surface, pixels.view, cameras, pictures, plane().value, OPTIONS)
    # Neither the photograph itself nor the one at 50°.
    assert all(set(row[seen].tolist()) == {1, 2, 3} for row, seen in zip(chosen, visible, strict=True))
    middle = 0.5 * cameras.eyes[1] / 2  # a ball before the second camera
    hidden = FunctionField(lambda x: torch.minimum(plane().value(x), (x - middle).norm(dim=-1) - 0.15))
    chosen, visible = choose_neighbours(surface, pixels.view, cameras, pictures, hidden.value, OPTIONS)
    away = cameras.eyes[1] - surface.position
    along = torch.nn.functional.normalize(away, dim=1)
    passing = torch.linalg.cross(middle - surface.position, along).norm(dim=1)
    saw = (visible & (chosen == 1)).any(dim=1)
    assert not bool(saw[passing < 0.14].any())
    assert bool(saw[passing > 0.16].all())
    assert 0 < int(saw.sum()) < 40
    blocked = loss_of(plane(0.02), scene(), distance=lambda x: torch.full_like(x[..., 0], -1.0))
    assert float(blocked.abs().max()) == 0


def test_no_texture_no_loss_and_what_is_outside_a_mask_weighs_nothing() -> None:
    assert float(loss_of(plane(0.02), scene(plain=True)).abs().max()) == 0
    random = torch.Generator().manual_seed(1)
    first, second = torch.rand(2, 5, 49, generator=random)
    weights = torch.ones(5, 49)
    alike, deviation = correlation(first, 3 * first + 0.2, weights)
    assert torch.allclose(alike, torch.ones(5), atol=1e-5)  # of any brightness and contrast
    assert torch.allclose(deviation, first.std(dim=1, correction=0), atol=1e-6)
    exact = torch.stack([torch.corrcoef(torch.stack(pair))[0, 1] for pair in zip(first, second, strict=True)])
    assert torch.allclose(correlation(first, second, weights)[0], exact, atol=1e-5)
    weights[:, 30:] = 0
    spoilt = second.clone()
    spoilt[:, 30:] = 9.0
    assert torch.allclose(correlation(first, spoilt, weights)[0], correlation(first, second, weights)[0], atol=1e-5)


def test_surfaces_and_their_derivatives_are_those_of_sphere_tracing() -> None:
    field = MultiscaleSDF.from_widths([(16, 1)], omegas=[5.0]).double()
    solve_sphere(field.base, 0.5)
    eye = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.tensor([[0.1, 0.0, -1.0], [0.0, -0.15, -1.0]]).double(), dim=1)
    hits = sphere_trace(field, eye, directions, tolerance=1e-10, differentiable=True)
    surface = surface_of(field, eye.expand(2, 3), directions, samples=4000)
    assert bool(surface.found.all())
    assert torch.allclose(surface.position, hits.position, atol=1e-6)
    weights = [parameter for parameter in field.parameters() if parameter.requires_grad]
    ours, theirs = (torch.autograd.grad(found.position[:, 2].sum(), weights) for found in (surface, hits))
    for mine, other in zip(ours, theirs, strict=True):
        assert torch.allclose(mine, other, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("skip", [0.0, 1e-3])
def test_surface_points_are_as_near_as_linear_interpolation_or_not_found(skip: float) -> None:
    """Of a ball, f'' is (1 − s²) / |x| along a ray, and the error at most h² f'' / 8 / |s|."""
    radius, samples = 0.5, 40
    across = torch.linspace(-0.6, 0.6, 41, dtype=torch.float64)
    eyes = torch.stack((across, torch.zeros(41), torch.full((41,), 2.0)), dim=1)
    ahead = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(eyes)
    surface = surface_of(Sphere(radius=radius), eyes, ahead, samples=samples, skip=skip)
    slope = (1 - (across / radius) ** 2).clamp(min=0).sqrt()
    interval = 2 / samples  # at most
    assert torch.equal(surface.found, slope > OPTIONS.facing)
    error = (surface.position.norm(dim=1) - radius)[surface.found]
    inner = radius - interval
    assert bool((error.abs() <= interval**2 * ((1 - slope[surface.found] ** 2) / inner + 1e-9) / 8).all())
    assert torch.allclose(surface.normal.norm(dim=1)[surface.found], torch.ones(1).double())
    thin = surface_of(Sphere(radius=0.03), eyes, ahead, samples=samples, skip=skip)
    assert not bool(thin.found.any())  # bent by far more than can be interpolated


def test_the_gradient_is_that_of_finite_differences() -> None:
    """In the weights of a small network whose surface is a sphere beside the plane: position and normal both matter."""
    parts = scene()
    field = MultiscaleSDF.from_widths([(8, 1)], omegas=[3.0]).double()
    solve_sphere(field.base, 0.5)
    # Every pixel counts, so that the loss has no steps.
    every = replace(OPTIONS, floor=-1.0, texture=0.0)
    cameras, pictures, _ = parts

    def loss() -> Tensor:
        pixels, origins, directions = pixels_and_rays(cameras, 6)
        surface = surface_of(field, origins, directions)
        assert bool(surface.found.any())
        return consistency_loss(surface, pixels, cameras, pictures, lambda x: torch.ones_like(x[..., 0]), every).sum()

    weight = next(field.parameters())
    (slope,) = torch.autograd.grad(loss(), weight)
    random = torch.Generator().manual_seed(0)
    for _ in range(3):
        direction = torch.randn(weight.shape, generator=random, dtype=torch.float64)
        step = 1e-8  # so short that hardly a place passes from one pixel to the next, where bilinear values have a kink
        with torch.no_grad():
            values = []
            for sign in (1, -1):
                weight.add_(sign * step * direction)
                values.append(float(loss()))
                weight.sub_(sign * step * direction)
        assert (values[0] - values[1]) / (2 * step) == pytest.approx(float((slope * direction).sum()), rel=1e-4)


def test_what_misses_counts_nothing() -> None:
    cameras, pictures, _ = scene()
    pixels, origins, directions = pixels_and_rays(cameras)
    far = surface_of(Sphere(radius=0.01), origins, directions)
    assert not bool(far.found.any())
    loss = consistency_loss(far, pixels, cameras, pictures, plane().value, OPTIONS)
    assert float(loss.abs().max()) == 0
    assert math.isfinite(float(loss.sum()))
    single = Surface(torch.zeros(1, 3).double(), NORMAL[None], torch.ones(1, dtype=torch.bool))
    alone = Cameras(*(part[:1] for part in cameras))
    pixel = Pixels(torch.zeros(1, dtype=torch.int64), torch.tensor([[48, 36]]))
    assert float(consistency_loss(single, pixel, alone, pictures, plane().value, OPTIONS)) == 0


def flatness_of(field: Field, parts: tuple[Cameras, GreyPictures, list[Camera]], options=OPTIONS) -> Tensor:
    cameras, pictures, _ = parts
    pixels, origins, directions = pixels_and_rays(cameras)
    surface = surface_of(field, origins, directions)
    assert bool(surface.found.all())
    return flatness_loss(field, surface, pixels, cameras, pictures, options, torch.Generator().manual_seed(0))


def test_a_plane_is_flat_and_a_sphere_bends_by_its_radius_where_pictures_are_plain() -> None:
    parts = scene(plain=True)
    assert float(flatness_of(plane(0.1), parts).abs().max()) < 1e-12
    radius, known = 2.0, replace(OPTIONS, nearest=0.1, furthest=0.1 * (1 + 1e-9))
    ball = FunctionField(lambda x: (x + radius * NORMAL.to(x)).norm(dim=-1) - radius)
    bend = 2 * (math.hypot(radius, 0.1) - radius) / 0.1  # of each tangent alike
    expected = math.hypot(bend, OPTIONS.bend) - OPTIONS.bend
    found = flatness_of(ball, parts, known)
    inside = found > 0  # all 0.1 beside it is in the picture
    assert int(inside.sum()) > 20
    assert torch.allclose(found[inside], torch.full_like(found[inside], expected), rtol=1e-4)  # |f(x)| < 1e-9
    # Waves of eight to twenty pixels: hardly a tangent has one grey value at five places.
    assert float(flatness_of(ball, scene(), replace(known, plain=0.002)).mean()) < 0.05 * expected


def test_a_crease_stays_where_the_picture_has_an_edge_and_a_dent_goes_where_it_has_none() -> None:
    cameras, pictures, cams = scene(plain=True)
    bent = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    # A roof whose ridge is seen as the column in the middle of the first picture, which looks along z.
    roof = FunctionField(lambda x: (x[..., 2] + bent * x[..., 0].abs()) / (1 + bent.square()).sqrt())
    parts = cameras, pictures, cams
    loss = flatness_of(roof, parts).mean()
    (slope,) = torch.autograd.grad(loss, bent)
    flat = float(loss.detach())
    assert flat > 0
    assert float(slope) > 0  # flatter is better
    pictures.grey[0, :, WIDTH // 2 :] += 76
    edges = flatness_of(roof, parts).detach()
    # Bilinear grey values rise over one pixel, within which a crossing is not seen.
    assert float(edges.mean()) < 0.02 * flat
    pictures.grey[0, :, WIDTH // 2 :] -= 76
    pictures.masks[:] = 0
    assert float(flatness_of(roof, parts).detach().abs().max()) == 0
