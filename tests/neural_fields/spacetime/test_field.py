import math

import mplicits.neural_fields as nf
import pytest
import torch
from bounds import assert_within, rounding, unit_roundoff
from fields import FIELDS, SCREW, cube, small_multiscale, small_spacetime
from mplicits.neural_fields.spacetime.moving import Keyframes
from torch import Tensor

from benchmarks.motion.figures import ShrinkingSphere

TRAVEL = nf.RigidMotion(velocity=(0.4, 0.2, 0.0), center=(-0.2, 0.0, 0.1), angle=2.0)


@pytest.mark.parametrize("name", ["spacetime", "spacetime-tapered", "moving-multiscale", "keyframes"])
def test_a_slice_is_the_field_at_its_time(name: str) -> None:
    field = FIELDS[name]().double()
    x, part = cube(500), nf.TimeSlice(field, 0.3)
    whole = nf.at_time(x, 0.3)
    for level in range(field.num_levels):
        slope = torch.cat((part.jet(x, level=level).gradient, part.spacetime_jet(x, level=level).rate[:, None]), dim=1)
        assert torch.equal(part.value(x, level=level), field.value(whole, level=level))
        assert torch.equal(slope, field.jet(whole, level=level).gradient)
        assert torch.equal(part.in_band(x, level=level), field.in_band(whole, level=level))
    both = part.spacetime_jet(x)
    torch.testing.assert_close((both.position, both.time), (x, whole[:, 3]), rtol=0, atol=0)
    assert both.hessian.shape == (500, 0, 0)


def test_a_slice_follows_its_field_and_passes_gradients_to_the_time() -> None:
    field = small_spacetime(0.4).double()
    x, t = cube(50), torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    part = nf.TimeSlice(field, t)
    part.value(x).sum().backward()
    torch.testing.assert_close(t.grad, part.spacetime_jet(x).rate.sum())
    with torch.no_grad():
        before = part.value(x)
        field.sdf.base.output.bias += 1
        assert float((part.value(x) - before).abs().max()) > 0.5


@pytest.mark.parametrize("taper", [0.0, 0.4])
def test_the_time_folds_into_the_biases(taper: float, dtype: torch.dtype) -> None:
    field = small_spacetime(taper).to(dtype)
    x = cube(2000).to(dtype)
    state = torch.random.get_rng_state()
    frozen = field.at(0.37)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert frozen.base.in_dim == 3
    assert not any(p.requires_grad for p in frozen.parameters())
    part = nf.TimeSlice(field, 0.37)
    keep = torch.ones(len(x), dtype=torch.bool)
    for level in range(3):  # hard gates depend on the last bit
        keep &= frozen.in_band(x, level=level) == part.in_band(x, level=level)
    assert float(keep.double().mean()) > 0.999
    x = x[keep]
    off = rounding(part, x, lambda field, x: field.jet(x))
    assert_within(frozen.jet(x), part.jet(x), off, times=2)
    assert_within(frozen.value(x), part.value(x), 2 * off[0])


def test_levels_that_are_no_sirens_are_sliced_too() -> None:
    sdf = nf.MultiscaleSDF(nf.Moving(nf.Sphere(), TRAVEL), [nf.Siren(16, 1, omega=5.0, in_dim=4)], [0.2])
    part, x = nf.TimeSlice(nf.SpaceTimeSDF(sdf).double(), 0.8), cube(300)
    off = rounding(part, x, lambda field, x: [field.value(x)])[0]
    assert_within(nf.SpaceTimeSDF(sdf).at(0.8).value(x), part.value(x), 2 * off)


@pytest.mark.parametrize("taper", [0.0, 0.4])
def test_a_static_field_is_embedded_exactly(taper: float) -> None:
    static = small_multiscale(taper).double().requires_grad_(False)
    field = nf.SpaceTimeSDF.from_static(static)
    assert torch.equal(field.deltas, static.deltas)
    x = cube(1000)
    for t in (0.0, 0.4, 1.0):
        for level in range(3):
            jet, expected = field.jet(nf.at_time(x, t), level=level), static.jet(x, level=level)
            off = rounding(static, x, lambda field, x, level=level: field.jet(x, level=level))
            for ours, theirs, bound in zip(jet, expected, off, strict=True):
                assert_within(ours[..., : theirs.shape[-1]], theirs, 2 * bound)
            assert not bool(jet.gradient[:, 3].any())


def test_an_embedded_field_starts_to_move_at_once() -> None:
    field = nf.SpaceTimeSDF.from_static(nf.Siren(16, 2, omega=5.0).requires_grad_(False))
    field.value(torch.rand(100, 4)).square().sum().backward()
    for layer in [*field.sdf.base.layers, field.sdf.base.output]:
        assert bool((layer.weight.grad != 0).all())


def test_a_quarter_turn_and_a_step() -> None:
    motion = nf.RigidMotion(axis=(0, 0, 2), angle=math.pi / 2, center=(1.0, 0.0, 0.0), velocity=(0.0, 0.0, 3.0))
    x = torch.tensor([[2.0, 0.0, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(motion.forward(x, 1.0), torch.tensor([[1.0, 1.0, 3.5]], dtype=torch.float64))
    torch.testing.assert_close(motion.inverse(motion.forward(x, 0.7), 0.7), x)


def test_the_velocity_of_a_motion_is_its_derivative() -> None:
    x, t = cube(100), torch.rand(100, dtype=torch.float64, requires_grad=True)
    moved = SCREW.forward(x, t)
    tangent = torch.stack([torch.autograd.grad(moved[:, k].sum(), t, retain_graph=True)[0] for k in range(3)], dim=-1)
    torch.testing.assert_close(SCREW.velocity(SCREW.forward(x, t), t), tangent)


def test_a_moving_field_keeps_its_values() -> None:
    static = nf.Torus(major=0.5, minor=0.2)
    x, t = cube(500), torch.rand(500, dtype=torch.float64)
    torch.testing.assert_close(nf.Moving(static, SCREW).value(nf.at_time(SCREW.forward(x, t), t)), static.value(x))


def test_both_shrinking_spheres_have_the_radius_of_the_formula() -> None:
    direction = torch.nn.functional.normalize(cube(100), dim=-1)
    t = torch.rand(100, dtype=torch.float64)
    surface = direction * (0.8**2 - 4 * 0.12 * t).sqrt()[:, None]
    for exact_law in (False, True):
        field = ShrinkingSphere(radius=0.8, alpha=0.12, exact_law=exact_law)
        # Lengths, roots and their difference, of numbers below 1.
        assert float(field.value(nf.at_time(surface, t)).abs().max()) < 16 * unit_roundoff(torch.float64)
        assert torch.equal(field.value(nf.at_time(surface, 0.0)), surface.norm(dim=-1) - 0.8) or exact_law


def test_keyframes_meet_their_keys_and_blend_in_between() -> None:
    keys: list[nf.Field] = [nf.Sphere(radius=0.3), nf.Box(), nf.Torus()]
    frames = Keyframes([0.0, 0.25, 1.0], keys)
    x = cube(300)
    for time, key in zip(frames.times, keys, strict=True):
        assert torch.equal(frames.value(nf.at_time(x, time)), key.value(x))
    third = frames.jet(nf.at_time(x, 0.5))
    torch.testing.assert_close(third.value, (2 * keys[1].value(x) + keys[2].value(x)) / 3)
    torch.testing.assert_close(third.gradient[:, 3], (keys[2].value(x) - keys[1].value(x)) / 0.75)
    outside = frames.jet(nf.at_time(x, 1.5))
    torch.testing.assert_close(outside.value, keys[2].value(x))
    assert not bool(outside.gradient[:, 3].any())
    assert torch.equal(frames.jet(nf.at_time(x, 0.0)).gradient[:, 3], (keys[1].value(x) - keys[0].value(x)) / 0.25)


def autograd_hessian(field: nf.Field, x: Tensor, level: int) -> Tensor:
    x = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(field.value(x, level=level).sum(), x, create_graph=True)
    columns = [torch.autograd.grad(gradient[:, k].sum(), x, retain_graph=True)[0] for k in range(field.in_dim)]
    return torch.stack(columns, dim=-1)


@pytest.mark.parametrize(("depth", "in_dim", "features"), [(1, 3, 0), (2, 3, 2), (4, 4, 0)])
def test_hessian_of_a_siren(depth: int, in_dim: int, features: int) -> None:
    network = nf.Siren(12, depth, omega=4.0, in_dim=in_dim, num_features=features).double()
    x = cube(50, dim=network.in_dim)
    second = network.second_jet(x)
    off = rounding(network, x, lambda field, x: field.second_jet(x))
    with torch.inference_mode():
        again = network.second_jet(x)
    for others in (again, (*network.jet(x), autograd_hessian(network, x, -1))):
        assert_within(second, others, off, times=2)
    assert_within(network.second_jet(x, dims=2).hessian, second.hessian[:, :2, :2], 2 * off[3][:, :2, :2])


@pytest.mark.parametrize("name", ["multiscale", "multiscale-tapered", "multiscale-over-sphere", "spacetime-tapered"])
def test_hessian_of_a_multiscale_field(name: str) -> None:
    """Against the default, which differentiates the gradient that the contract tests have checked."""
    field = FIELDS[name]().double()
    x = cube(400, dim=field.in_dim)
    for level in range(field.num_levels):
        ours, expected = field.second_jet(x, level=level), nf.Field.second_jet(field, x, level=level)
        off = rounding(field, x, lambda field, x, level=level: field.second_jet(x, level=level))
        assert_within(ours, expected, off, times=2)


def test_derivatives_of_the_hessian() -> None:
    network = nf.Siren(5, 2, omega=3.0).double()
    x = cube(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, *_: network.second_jet(x).hessian, (x, *network.parameters()))


def test_hessians_of_closed_forms() -> None:
    x = cube(200)
    length = x.norm(dim=-1)
    normal = x / length[:, None]
    expected = (torch.eye(3, dtype=x.dtype) - normal[:, :, None] * normal[:, None, :]) / length[:, None, None]
    torch.testing.assert_close(nf.Sphere().second_jet(x).hessian, expected)
    assert not nf.Sphere().second_jet(x).hessian.requires_grad
    assert nf.Sphere().second_jet(x.clone().requires_grad_()).hessian.requires_grad
    with torch.inference_mode():
        torch.testing.assert_close(nf.Sphere().second_jet(x).hessian, expected)
    assert float(nf.Plane().second_jet(x).hessian.abs().max()) == 0
    sliced = nf.TimeSlice(nf.Moving(nf.Sphere(), TRAVEL), 0.5).second_jet(TRAVEL.forward(x, 0.5)).hessian
    torch.testing.assert_close(sliced.diagonal(dim1=1, dim2=2).sum(dim=1), 2 / length)


@pytest.mark.parametrize("shape", [(), (0,), (2, 3)])
def test_second_jets_follow_the_shape_of_the_input(shape: tuple[int, ...]) -> None:
    for name in ("siren", "multiscale-tapered", "sphere", "spacetime", "slice", "keyframes"):
        field = FIELDS[name]()
        jet = field.second_jet(torch.rand(*shape, field.in_dim), dims=3)
        assert jet.hessian.shape == (*shape, 3, 3)
        assert jet.gradient.shape == (*shape, field.in_dim)
