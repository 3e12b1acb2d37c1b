"""Frames that know the one before them, against closed forms and against tracing from scratch."""

import pytest
import torch
from fields import SCREW, Watched, assert_depths, small_multiscale, small_spacetime, solve_sphere, sphere_depth
from mplicits.datasets.cameras import look_at
from mplicits.neural_fields import (
    Field,
    Moving,
    MultiscaleSDF,
    RigidMotion,
    Sphere,
    TimeSlice,
    Torus,
    Union,
    sphere_trace,
)
from mplicits.neural_fields.spacetime.dynamic_tracing import DynamicTracer, moment
from mplicits.neural_fields.tracing.sphere import Expected, trace_expected
from torch import Tensor

TIMES = [0.2 + k / 40 for k in range(10)]


def ball(radius: float, center: tuple[float, float, float], velocity: tuple[float, float, float]) -> Field:
    return Moving(Sphere(radius=radius, center=center), RigidMotion(velocity=velocity))


def image(size: int = 48, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    eye, directions = look_at((0.4, 0.5, 2.6), (0.0, 0.0, 0.0), fov=42.0, width=size, height=size).rays()
    return eye.to(dtype), torch.nn.functional.normalize(directions.to(dtype), dim=-1)


def assert_same(field: Field, times, tracer: DynamicTracer, eye: Tensor, directions: Tensor, **settings) -> int:
    """Every frame is what tracing from scratch gives → how many rays hit."""
    hit = 0
    for t in times:
        found, fresh = tracer.trace(t), sphere_trace(moment(field, t), eye, directions, **settings)
        assert_depths(found, fresh, 2 * settings["tolerance"])
        torch.testing.assert_close(found.position, eye + found.depth[..., None] * directions)
        hit += int(found.mask.sum())
    return hit


@pytest.mark.parametrize("tolerance", [1e-4, 1e-9])
def test_a_ball_that_turns_and_travels_is_met_where_it_is(tolerance):
    eye, directions = image(dtype=torch.float64)
    center = torch.tensor([-0.3, 0.1, 0.2], dtype=torch.float64)
    field = Moving(Sphere(radius=0.4, center=tuple(center.tolist())), SCREW).double()
    tracer = DynamicTracer(field, eye, directions, tolerance=tolerance)
    for t in TIMES:
        found = tracer.trace(t)
        expected = sphere_depth(eye, directions, 0.4, SCREW.forward(center, t))
        assert_depths(found, expected, 1.01 * tolerance)
        assert int(found.mask.sum()) > 100


@pytest.mark.parametrize("step", [0.02, *(pytest.param(step, marks=pytest.mark.slow) for step in (0.002, 0.2))])
def test_frames_are_those_from_scratch_however_far_apart_they_are(step):
    eye, directions = image(dtype=torch.float64)
    field = Moving(Torus(major=0.5, minor=0.2), RigidMotion(axis=(1.0, 1.0, 0.0), angle=3.0, velocity=(0.2, 0.0, 0.3)))
    settings = {"tolerance": 1e-5, "resolution": 1e-4}
    tracer = DynamicTracer(field.double(), eye, directions, **settings)
    times = [step * k for k in range(5)] + [0.5, 0.1]  # and back again
    assert assert_same(field, times, tracer, eye, directions, **settings) > 1000


def test_what_comes_into_view_in_front_of_the_last_hit_is_found():
    eye, directions = image(dtype=torch.float64)
    small, start, drift = 0.06, (-0.6, 0.1, 0.6), (1.2, 0.0, 0.0)
    field = Union(ball(0.5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ball(small, start, drift)).double()
    tracer = DynamicTracer(field, eye, directions, tolerance=1e-6)
    in_front = uncovered = 0
    before = torch.zeros(directions.shape[:-1], dtype=torch.bool)
    for t in torch.linspace(0, 1, 12).tolist():
        here = torch.tensor(start).double() + t * torch.tensor(drift).double()
        large, near = sphere_depth(eye, directions, 0.5), sphere_depth(eye, directions, small, here)
        expected = torch.minimum(near, large)
        found = tracer.trace(t)
        assert_depths(found, expected, 2e-6)
        covered = near < large
        in_front += int((covered & large.isfinite() & ~before).sum())
        uncovered += int((before & ~covered & large.isfinite()).sum())
        before = covered
    assert min(in_front, uncovered) > 50


@pytest.mark.parametrize("make", [small_spacetime, lambda: Moving(small_multiscale(0.3), SCREW)])
def test_all_levels_are_those_from_scratch(make):
    torch.manual_seed(4)
    field, (eye, directions) = make(), image(32)
    settings = {"tolerance": 1e-3, "resolution": 5e-3}
    for level in range(field.num_levels):
        tracer = DynamicTracer(field, eye, directions, level=level, **settings)
        for t in TIMES[:4]:
            found, fresh = tracer.trace(t), sphere_trace(moment(field, t), eye, directions, level=level, **settings)
            # Untrained levels are no distances: a ray may meet them twice within the resolution, but few do.
            same = found.mask == fresh.mask
            assert float(same.float().mean()) > 0.98
            apart = (found.depth - fresh.depth)[found.mask & fresh.mask].abs()
            assert float((apart < 2e-3).float().mean()) > 0.97


def test_rays_need_no_image_and_may_begin_inside():
    torch.manual_seed(0)
    origins = torch.cat((0.1 * torch.randn(200, 3), torch.nn.functional.normalize(torch.randn(200, 3), dim=-1) * 2))
    directions = torch.nn.functional.normalize(torch.randn(400, 3) - origins, dim=-1)
    origins, directions = origins.double(), directions.double()
    field = ball(0.5, (0.0, 0.0, 0.0), (0.1, 0.2, 0.0)).double()
    settings = {"tolerance": 1e-6}
    tracer = DynamicTracer(field, origins, directions, **settings)
    assert assert_same(field, TIMES, tracer, origins, directions, **settings) > 2000


def test_wrong_expectations_change_nothing_but_the_cost():
    torch.manual_seed(0)
    eye, directions = image(dtype=torch.float64)
    torus = Torus(major=0.5, minor=0.2).double()
    fresh = sphere_trace(torus, eye, directions)
    shape = directions.shape[:-1]
    for low, high in ((0.0, 4.0), (1.5, 3.0)):
        depth = low + (high - low) * torch.rand(shape, dtype=torch.float64)
        depth[torch.rand(shape) < 0.2] = torch.inf
        unknown = torch.full_like(depth, torch.inf)
        found, *_ = trace_expected(torus, eye, directions, Expected(depth, torch.rand(shape).double(), unknown))
        assert_depths(found, fresh, 2e-5)


def test_small_pictures_of_a_network_miss_nothing():
    """Whose values are wrong far outside the unit ball, where wide tiles end."""
    torch.manual_seed(0)
    field = MultiscaleSDF.from_widths([(128, 2), (64, 2)], omegas=[10, 45], deltas=[0.03], residual_gain=0.01)
    solve_sphere(field.base)
    moving = Moving(field.requires_grad_(False), RigidMotion(velocity=(0.2, 0.0, 0.0)))
    eye, directions = image(64)
    tracer = DynamicTracer(moving, eye, directions)
    for t in (0.0, 0.02):
        fresh = sphere_trace(moment(moving, t), eye, directions)
        assert int((tracer.trace(t).mask != fresh.mask).sum()) < 5


def test_near_is_where_rays_pass_within_reach():
    eye, directions = image(64, dtype=torch.float64)
    ball, reach = Sphere(radius=0.4).double(), 0.1
    found, _, near = trace_expected(ball, eye, directions, None, reach=reach, tolerance=1e-6)
    outer = sphere_depth(eye, directions, 0.4 + reach)
    passing = near.clear.isfinite() & ~found.mask
    assert 50 < int(passing.sum()) < passing.numel() - 50
    # A ray with a note came within reach, and was clear of it where the note says so.
    assert bool((outer.isfinite() | near.clear.isinf()).all())
    assert bool((near.clear <= outer)[near.clear.isfinite()].all())
    noted = near.clear.isfinite() & near.value.isfinite()
    where = eye + near.clear[..., None] * directions
    torch.testing.assert_close(near.value[noted], ball.value(where)[noted])
    assert float(near.value[noted].min()) >= reach
    behind = eye + near.leave[..., None] * directions
    left = passing & near.leave.isfinite()
    assert int(left.sum()) > 20
    assert float(ball.value(behind)[left].min()) >= reach
    along = -(eye * directions).sum(dim=-1)
    closest = ball.value(eye + along[..., None] * directions)
    assert bool(near.clear.isfinite()[closest < 0.5 * reach].all())


def test_frames_in_between_leave_out_what_is_far_and_cost_little_where_it_is_near():
    eye, directions = image(96)
    field = Watched(Moving(Torus(major=0.5, minor=0.2), RigidMotion(axis=(1.0, 1.0, 0.0), angle=1.0)))
    settings = {"tolerance": 2e-4, "resolution": 3e-3}
    tracer = DynamicTracer(field, eye, directions, **settings)
    costs, kinds = [], []
    for k in range(12):
        before, key = field.counts()[0], tracer._key
        hits = tracer.trace(k / 160)
        kinds.append(tracer._key is key)
        costs.append(field.counts()[0] - before)
        fresh = sphere_trace(TimeSlice(field.inner, k / 160), eye, directions, **settings)
        assert int((hits.mask != fresh.mask).sum()) <= 1
        apart = (hits.depth - fresh.depth)[hits.mask & fresh.mask].abs()
        assert float((apart < 6e-4).float().mean()) > 0.998
    between, keys = ([cost for cost, kind in zip(costs, kinds, strict=True) if kind is same] for same in (True, False))
    assert len(between) >= 8
    assert max(between[1:]) < 0.4 * min(keys[1:])
    assert float((hits.steps[hits.mask] == 1).float().mean()) > 0.5


@pytest.mark.parametrize("speed", [0.3, 1.5])
def test_the_speed_is_measured_unless_it_is_given(speed):
    eye, directions = image(16)
    field = ball(0.4, (0.0, 0.0, 0.0), (0.0, speed, 0.0))
    tracer = DynamicTracer(field, eye, directions, resolution=1e-2)
    tracer.trace(0.0)
    lasts = tracer._key.lasts
    assert tracer.reach / (1.26 * speed) < lasts < tracer.reach / (1.1 * speed)
    given = DynamicTracer(field, eye, directions, reach=0.05, speed=2.0)
    given.trace(0.0)
    assert given._key.lasts == pytest.approx(0.025)


def test_without_reach_every_frame_is_a_key_frame():
    eye, directions = image(dtype=torch.float64)
    field = ball(0.4, (0.0, 0.0, 0.0), (0.0, 0.1, 0.0)).double()
    tracer = DynamicTracer(field, eye, directions, reach=0.0)
    assert len({tracer._key.time for t in TIMES[:4] if tracer.trace(t)}) == 4
    assert assert_same(field, TIMES, tracer, eye, directions, tolerance=1e-5) > 1000
