"""Traced depths against closed forms, against a dense search along the rays, and against the field itself."""

import math

import mplicits.neural_fields as nf
import numpy as np
import pytest
import torch
from bounds import rounding
from fields import FIELDS, Scaled, Watched, assert_depths, small_multiscale, sphere_depth
from mplicits.neural_fields.networks.colors import ColorSiren
from mplicits.neural_fields.tracing.sphere import map_attribute
from torch import Tensor

from benchmarks.peers import BaconSDF

THREE_D = {name: make for name, make in FIELDS.items() if make().in_dim == 3}


def unit(x: Tensor) -> Tensor:
    return torch.nn.functional.normalize(x, dim=-1)


def random_rays(count: int, *, spread: float, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Rays from a sphere of radius 2.5 towards random points in a cube."""
    origins = 2.5 * unit(torch.randn(count, 3, dtype=dtype))
    return origins, unit(spread * (2 * torch.rand(count, 3, dtype=dtype) - 1) - origins)


def box_depth(origins: Tensor, directions: Tensor, half: Tensor) -> Tensor:
    a, b = (-half - origins) / directions, (half - origins) / directions
    enter, leave = torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)
    return torch.where(enter < leave, enter, torch.inf)


def torus_depth(origins: Tensor, directions: Tensor, major: float, minor: float) -> Tensor:
    """First positive root of the quartic (|p|² + R² − r²)² = 4 R² (p_x² + p_y²)."""
    depths = []
    for o, d in zip(origins.numpy(), directions.numpy(), strict=True):
        square = np.array([d @ d, 2 * o @ d, o @ o])
        around = np.array([d[:2] @ d[:2], 2 * o[:2] @ d[:2], o[:2] @ o[:2]])
        left = square + np.array([0, 0, major**2 - minor**2])
        roots = np.roots(np.polysub(np.polymul(left, left), 4 * major**2 * around))
        real = roots[np.abs(roots.imag) < 1e-7].real
        depths.append(min(real[real > 0], default=np.inf))
    return torch.tensor(np.array(depths))


PLATE = (0.5, 0.0005, 0.5)  # thin
EXACT_SHAPES = {
    "plate": (lambda: nf.Box(half_size=PLATE), lambda o, d: box_depth(o, d, o.new_tensor(PLATE))),
    "sphere": (lambda: nf.Sphere(radius=0.6), lambda o, d: sphere_depth(o, d, 0.6)),
    "box": (lambda: nf.Box(half_size=(0.5, 0.3, 0.4)), lambda o, d: box_depth(o, d, o.new_tensor([0.5, 0.3, 0.4]))),
    "torus": (lambda: nf.Torus(major=0.5, minor=0.2), lambda o, d: torus_depth(o, d, 0.5, 0.2)),
}


@pytest.mark.parametrize("name", EXACT_SHAPES)
@pytest.mark.parametrize("tolerance", [1e-5, 1e-9])
def test_depth_of_a_thousand_random_rays(name, tolerance):
    make, exact = EXACT_SHAPES[name]
    origins, directions = random_rays(1000, spread=0.75)
    expected = exact(origins, directions)
    hits = nf.sphere_trace(make().double(), origins, directions, tolerance=tolerance)
    assert_depths(hits, expected, tolerance)
    assert (20 if name == "plate" else 200) < int(hits.mask.sum()) < 1000
    torch.testing.assert_close(hits.position, origins + hits.depth[:, None] * directions)
    single = nf.sphere_trace(make(), origins.float(), directions.float())
    error = (single.depth.double() - expected)[single.mask & hits.mask].abs()
    assert float(error.median()) < 1e-6
    assert float(error.max()) < 1e-4  # a rounding error across the ray moves a grazing one by more than 1e-5
    assert int((single.mask != hits.mask).sum()) == 0 or name == "plate"


@pytest.mark.parametrize("miss", [False, True])
def test_grazing_rays_of_a_sphere(miss):
    """Rays that pass the silhouette by 1e-1 to 1e-8, inside or outside."""
    count = 1000
    directions = unit(torch.randn(count, 3, dtype=torch.float64))
    aside = unit(torch.linalg.cross(directions, torch.randn(count, 3, dtype=torch.float64)))
    by = 10 ** torch.linspace(-8, -1, count, dtype=torch.float64)
    origins = -2 * directions + aside * (0.6 + (by if miss else -by))[:, None]
    hits = nf.sphere_trace(nf.Sphere(radius=0.6).double(), origins, directions)
    expected = sphere_depth(origins, directions, 0.6)
    assert_depths(hits, expected, 1e-5)
    assert bool(hits.mask.any()) != miss
    assert float(hits.steps.double().mean()) < 150  # plain sphere tracing needs up to 10⁴ for the nearest


def test_rays_along_a_face_end():
    """Parallel to a face at 1e-5 above it, plain sphere tracing would need 10⁵ steps."""
    heights = 0.3 + torch.tensor([1e-5, 1e-3, -1e-5, -1e-3], dtype=torch.float64)
    origins = torch.stack((torch.full_like(heights, -2), torch.zeros_like(heights), heights), dim=1)
    hits = nf.sphere_trace(nf.Box(half_size=(0.5, 0.5, 0.3)).double(), origins, origins.new_tensor([1.0, 0.0, 0.0]))
    assert hits.mask.tolist() == [False, False, True, True]
    assert float((hits.depth[2:] - 1.5).abs().max()) < 1e-5
    assert int(hits.steps.max()) < 400


def nested(field: nf.Field) -> nf.Field:
    """Residuals small enough to keep each surface within the band before it, as training leaves them."""
    for part in field.modules():  # of a field of fields, all
        if isinstance(part, nf.MultiscaleSDF):
            with torch.no_grad():
                for residual in part.levels[1:]:
                    residual.output.weight.mul_(0.1)
                    residual.output.bias.mul_(0.1)
        if isinstance(part, BaconSDF):  # an untrained product of sines is far steeper than any distance
            with torch.no_grad():
                for parameter in part.heads.parameters():
                    parameter.mul_(0.02)
    return field


@pytest.mark.parametrize("name", THREE_D)
def test_every_field_against_a_dense_search(name):
    field = nested(THREE_D[name]()).double().requires_grad_(False)
    origins, directions = random_rays(100, spread=0.6)
    step = 5e-4
    origins = origins + 1.4 * directions  # some begin inside
    ladder = torch.arange(0.0, 2.2, step, dtype=torch.float64)
    hits = nf.sphere_trace(field, origins, directions, far=2.2, radius=None, lipschitz=2.0)
    values = field.value(origins[:, None] + ladder[:, None] * directions[:, None])
    flips = (values[:, :-1] < 0) != (values[:, 1:] < 0)
    first = torch.where(flips.any(1), ladder[flips.int().argmax(1)], torch.inf)
    agree = (hits.mask == first.isfinite()) & (~hits.mask | ((hits.depth - first - step / 2).abs() < step))
    # A ray may touch the surface between two rungs of the ladder; the trace is then the better of the two.
    touched = hits.mask & (hits.depth < first) & (field.value(hits.position).abs() < 1e-5)
    assert bool((agree | touched).all())
    assert float((touched & ~agree).double().mean()) < 0.02


@pytest.mark.parametrize("level", [0, 1, 2])
def test_hits_lie_on_the_requested_level(level):
    field = nf.MultiscaleSDF(nf.Sphere(radius=0.5), small_multiscale().levels[1:], [0.3, 0.2], taper=0.5)
    field = field.double().requires_grad_(False)
    origins, directions = random_rays(300, spread=0.3)
    hits = nf.sphere_trace(field, origins, directions, level=level, lipschitz=2.0)
    assert float(hits.mask.double().mean()) > 0.5
    x = hits.position[hits.mask].requires_grad_()
    value = field.value(x, level=level)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert bool((value.abs() <= 1e-5 * gradient.norm(dim=-1)).all())  # 1e-5 in depth
    assert set(hits.level[hits.mask].tolist()) == {level}


def test_residuals_are_evaluated_only_in_their_band():
    base, residual = (
        Watched(nf.Sphere(radius=0.5)),
        Watched(nf.FunctionField(lambda x: 0.02 * torch.sin(20 * x[..., 0]))),
    )
    field = nf.MultiscaleSDF(base, [residual], [0.05]).double()
    origins, directions = random_rays(500, spread=0.5)
    hits = nf.sphere_trace(field, origins, directions, lipschitz=1.4)
    steps, evaluated = int(hits.steps.sum()), torch.cat(residual.values)
    assert base.counts() == (steps, 0)  # once for each step, whatever the levels
    assert 0 < len(evaluated) < 0.7 * steps
    assert float(base.inner.value(evaluated).abs().max()) < 0.05


def test_near_and_far_bound_the_search():
    field = nf.Sphere(radius=0.5).double()
    origin = torch.tensor([0.0, 0.0, -2.0], dtype=torch.float64)
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert not nf.sphere_trace(field, origin, -direction).mask
    # A start behind the surface was a wrong guess, unless the ray has nowhere else to begin.
    for bounds, depth in (
        ({"far": 1.49}, None),
        ({"far": 1.51}, 1.5),
        ({"near": 2.6}, None),
        ({"near": torch.tensor(1.2)}, 1.5),
        ({"near": 2.0}, 1.5),
    ):
        hits = nf.sphere_trace(field, origin, direction, **bounds)
        assert bool(hits.mask) == (depth is not None)
        assert depth is None or hits.depth == pytest.approx(depth, abs=1e-5)
    assert nf.sphere_trace(field, torch.zeros_like(origin), direction, near=0.3).depth == pytest.approx(0.5, abs=1e-5)


def test_steep_fields_need_their_lipschitz_constant():
    origins, directions = random_rays(2000, spread=0.6)
    expected = torus_depth(origins, directions, 0.5, 0.05)
    hits = nf.sphere_trace(Scaled(nf.Torus(major=0.5, minor=0.05), 3.0).double(), origins, directions, lipschitz=3.0)
    assert_depths(hits, expected, 1e-5)


def test_without_a_bounding_ball():
    plane = nf.Plane(normal=(0.0, 0.0, 1.0), offset=-3.0).double()
    origin = torch.zeros(3, dtype=torch.float64)
    direction = unit(torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64))
    assert not nf.sphere_trace(plane, origin, direction).mask
    assert nf.sphere_trace(plane, origin, direction, radius=None, far=10.0).depth == pytest.approx(3 / 0.8, abs=1e-5)


def test_the_papers_budget_converges_head_on_and_counts():
    field = nf.MultiscaleSDF(
        nf.Sphere(radius=0.5), [nf.FunctionField(lambda x: 0 * x[..., 0])] * 2, [0.05, 0.02]
    ).double()
    origins = torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.9, -2.0], [0.0, 3.0, -2.0]], dtype=torch.float64)
    hits = nf.sphere_trace(field, origins, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), budget=(20, 5, 5))
    assert hits.mask.tolist() == [True, False, False]
    assert float(hits.depth[0]) == pytest.approx(1.5, abs=1e-9)
    assert bool((hits.steps <= torch.tensor([6, 30, 0])).all())


def test_levels_without_bands_lead_nowhere():
    field, origin = small_multiscale(), torch.tensor([0.0, 0.0, -2.0])
    field.deltas.fill_(torch.inf)
    direction = torch.tensor([0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match=r"budget=\[20, 5\]: a level without a band leads to no other"):
        nf.sphere_trace(field, origin, direction, level=1, budget=(20, 5))
    assert int(nf.sphere_trace(field, origin, direction, level=1, budget=(0, 20)).steps) <= 20


@pytest.mark.parametrize("shape", [(), (0,), (1,), (4, 3)])
def test_shapes(shape, device, dtype):
    field = nf.Sphere(radius=0.5).to(device, dtype)
    origins = torch.tensor([0.0, 0.0, -2.0], device=device, dtype=dtype)
    directions = torch.tensor([0.0, 0.0, 1.0], device=device, dtype=dtype).expand(*shape, 3)
    hits = nf.sphere_trace(field, origins, directions)
    assert hits.mask.shape == hits.depth.shape == hits.level.shape == hits.steps.shape == shape
    assert (hits.position.shape, hits.depth.dtype) == ((*shape, 3), dtype)
    assert bool(hits.mask.all())


@pytest.mark.parametrize("length", [0.5, 1.2, 2.0, 1e-3, 1e3])
@pytest.mark.parametrize("budget", [None, (60,)])
def test_directions_of_any_length(length: float, budget: tuple[int, ...] | None) -> None:
    origins = torch.tensor([[0.0, 0.0, -2.0], [0.2, 0.1, -2.0], [0.0, 0.9, -2.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.05, 0.9], [0.0, 0.0, 1.0]])
    directions, field = unit(directions), nf.Sphere(radius=0.5)
    expected = nf.sphere_trace(field, origins, directions, budget=budget)
    scaled = nf.sphere_trace(field, origins, length * directions, budget=budget)
    assert expected.mask.tolist() == scaled.mask.tolist() == [True, True, False]
    torch.testing.assert_close(scaled.depth[:2] * length, expected.depth[:2], rtol=1e-6, atol=2e-5)
    torch.testing.assert_close(scaled.position[:2], expected.position[:2], rtol=0, atol=2e-5)
    later = nf.sphere_trace(field, origins[0], length * directions[0], near=1.4 / length)
    assert abs(float(later.depth) * length - 1.5) < 2e-5
    assert not bool(nf.sphere_trace(field, origins[0], length * directions[0], far=1.4 / length).mask)


@pytest.mark.parametrize("name", ["sphere", "torus", "multiscale-tapered", "union"])
def test_depths_against_finite_differences(name: str) -> None:
    field = FIELDS[name]().double()
    torch.manual_seed(1)
    origins = (torch.tensor([0.3, 0.1, -2.0]) + 0.1 * torch.rand(40, 3)).double().requires_grad_()
    directions = (torch.tensor([0.0, 0.0, 1.3]) + 0.1 * torch.rand(40, 3)).double().requires_grad_()

    def trace(o, d):
        return nf.sphere_trace(field, o, d, tolerance=1e-12, differentiable=True, max_steps=2000)

    hits = trace(origins, directions)
    slope = (field.jet(hits.position).gradient * directions).sum(dim=1).abs()
    kept = (hits.mask & (slope > 0.3)).detach()
    assert kept.any()
    ours = torch.autograd.grad(hits.depth[kept].sum(), (origins, directions), retain_graph=True)
    step = 1e-6
    for index, gradient in enumerate(ours):
        for axis in range(3):
            shift = torch.zeros(3, dtype=torch.float64)
            shift[axis] = step
            shifts = [shift if i == index else 0 for i in range(2)]
            ahead, behind = (trace(origins + s * shifts[0], directions + s * shifts[1]).depth for s in (1, -1))
            numeric = ((ahead - behind) / (2 * step)).detach()
            # Central differences are off by step² of a third derivative, and by the tolerance over the step.
            torch.testing.assert_close(gradient[kept, axis], numeric[kept], rtol=1e-4, atol=1e-4)
    if parameters := [p for p in field.parameters() if p.requires_grad]:
        assert any(g is not None for g in torch.autograd.grad(hits.depth[kept].sum(), parameters, allow_unused=True))
    position = origins + hits.depth[:, None] * directions
    torch.testing.assert_close(hits.position[kept], position[kept], rtol=0, atol=1e-14)


def test_misses_carry_no_gradient() -> None:
    origin = torch.tensor([[0.0, 0.0, -2.0], [0.0, 2.0, -2.0]], requires_grad=True)
    hits = nf.sphere_trace(nf.Sphere(radius=0.5), origin, torch.tensor([0.0, 0.0, 1.0]), differentiable=True)
    (gradient,) = torch.autograd.grad(hits.depth.sum(), origin)
    assert gradient.tolist() == [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]


MAJOR, MINOR = 0.5, 0.2


def torus_point(u: Tensor, v: Tensor, minor: float | Tensor = MINOR) -> Tensor:
    """Angle u around the axis z, angle v around the tube, at distance ``minor`` from its core."""
    ring = MAJOR + minor * torch.cos(v)
    return torch.stack((ring * torch.cos(u), ring * torch.sin(u), minor * torch.sin(v)), dim=-1)


def random_shell(count: int, least: float, most: float) -> Tensor:
    """Points whose distance from the origin is between two."""
    directions = unit(torch.randn(count, 3, dtype=torch.float64))
    return directions * (least + (most - least) * torch.rand(count, 1, dtype=torch.float64))


def angles(count: int) -> Tensor:
    """``(2, count)``."""
    return 2 * math.pi * torch.rand(2, count, dtype=torch.float64)


# Right on its zero set, wrong as a distance; steps along its gradient stay on rays from the origin.
SQUARED = nf.FunctionField(lambda x: x.square().sum(dim=-1) - 0.25)


def test_closest_points_of_a_torus() -> None:
    torus = nf.Torus(major=MAJOR, minor=MINOR).double()
    u, v = angles(2000)
    offset = MINOR + 0.35 * torch.rand(2000, dtype=torch.float64) - 0.15  # inside and outside the tube
    inner = MAJOR + offset * torch.cos(v) > 0.05  # further through the hole the other side is nearer
    feet, arrived = nf.project_to_surface(torus, torus_point(u, v, offset)[inner])
    assert arrived.all()
    torch.testing.assert_close(feet, torus_point(u, v)[inner], rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3)])
def test_shapes_of_projections(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
    x = (torch.rand(*shape, 3, dtype=dtype) + 0.1).to(device)
    feet, arrived = nf.project_to_surface(nf.Sphere(radius=0.5), x)
    assert arrived.shape == shape
    torch.testing.assert_close(feet, x / x.norm(dim=-1, keepdim=True) / 2, rtol=0, atol=1e-5)
    assert feet.device.type == device.type


def test_a_field_that_is_no_distance_takes_several_steps() -> None:
    x = random_shell(500, 0.3, 0.9)
    feet, arrived = nf.project_to_surface(SQUARED, x, tolerance=1e-10)
    assert arrived.all()
    torch.testing.assert_close(feet, x / x.norm(dim=-1, keepdim=True) / 2, rtol=0, atol=1e-9)
    assert not nf.project_to_surface(SQUARED, x, tolerance=1e-10, steps=1)[1].any()


def test_points_without_a_way_have_not_arrived() -> None:
    feet, arrived = nf.project_to_surface(SQUARED, torch.zeros(1, 3))
    assert not arrived.any()
    assert torch.isfinite(feet).all()
    empty = nf.Siren(16, 2, omega=3.0)
    with torch.no_grad():
        empty.output.bias.fill_(5.0)
    assert not nf.project_to_surface(empty, torch.rand(20, 3))[1].any()


def test_the_surface_of_a_siren() -> None:
    """Untrained, and so no distance; shifted so that it has a zero set."""
    network = nf.Siren(32, 2, omega=4.0).double()
    x = 2 * torch.rand(500, 3, dtype=torch.float64) - 1
    with torch.no_grad():
        network.output.bias.sub_(network.value(x).median())
    feet, arrived = nf.project_to_surface(network, x, steps=30)
    assert arrived.float().mean() > 0.5
    # The projection looks at the values of jets, which are rounded in their own way.
    value, off = network.value(feet).abs(), 2 * rounding(network, feet, lambda field, x: [field.value(x)])[0]
    assert (value < 1e-5 + off)[arrived].all()
    assert (value >= 1e-5 - off)[~arrived].all()


class _AroundTheTube(ColorSiren):
    """Colours that depend on the angles of the closest point of the torus only, so constant along its normals."""

    def value(self, x: Tensor) -> Tensor:
        u = torch.atan2(x[..., 1], x[..., 0])
        v = torch.atan2(x[..., 2], x[..., :2].norm(dim=-1) - MAJOR)
        return torch.stack((torch.cos(u), torch.sin(v), torch.cos(u + v)), dim=-1) / 2 + 0.5


def exact_texture(delta: float) -> nf.TextureField:
    return nf.TextureField(
        nf.Torus(major=MAJOR, minor=MINOR), _AroundTheTube(2, 1), delta=delta, outside=(1, 0, 1)
    ).double()


@pytest.mark.parametrize("shift", [-0.1, -0.01, 0.0, 0.02, 0.15])
def test_shifted_surfaces_have_the_colors_of_their_closest_points(shift: float) -> None:
    texture = exact_texture(0.03)
    u, v = angles(1000)
    surface = torus_point(u, v, MINOR + shift)
    colors, reached = nf.map_colors(texture, surface, batch=300)
    assert reached.all()
    torch.testing.assert_close(colors, texture.colors(torus_point(u, v)), rtol=0, atol=1e-10)
    colors, reached = nf.map_colors(texture, surface[:0])
    assert (colors.shape, reached.shape) == ((0, 3), (0,))


def test_points_of_the_band_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    texture = exact_texture(0.03)
    u, v = angles(200)
    near, far = torus_point(u, v, 0.21), torus_point(u, v, 0.29)
    seen: list[Tensor] = []
    evaluate = _AroundTheTube.value
    monkeypatch.setattr(_AroundTheTube, "value", lambda self, x: (seen.append(x), evaluate(self, x))[1])
    nf.map_colors(texture, torch.stack((near, far)))
    torch.testing.assert_close(seen[0], torch.cat((near, torus_point(u, v))), rtol=0, atol=1e-12)
    assert torch.equal(seen[0][:200], near)


def test_points_that_are_not_reached_get_the_color_of_outside() -> None:
    texture = nf.TextureField(SQUARED, ColorSiren(4, 1), delta=0.1, outside=(1, 0, 1))
    colors, reached = nf.map_colors(texture, torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert reached.tolist() == [True, False]
    assert colors[1].tolist() == [1, 0, 1]
    assert colors[0].tolist() != [1, 0, 1]


def test_normals_of_a_fine_surface_on_a_coarse_one() -> None:
    sphere = nf.Sphere(radius=0.5).double()
    points = random_shell(300, 0.3, 0.6)
    normals, reached = map_attribute(sphere, lambda x: sphere.jet(x).gradient, points.reshape(3, 100, 3), delta=0.05)
    assert reached.shape == (3, 100)
    assert reached.all()
    torch.testing.assert_close(normals.reshape(-1, 3), points / points.norm(dim=-1, keepdim=True))
