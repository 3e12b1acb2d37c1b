"""What holds of every motion in closed form, and of the fields that it moves."""

import torch
from mplicits.neural_fields import at_time, flow
from torch import Tensor

# Some tens of operations on numbers of order one, and a division by κ ≥ 1e-6, in float64.
ROUNDING = 1e-9


def inside(*half: float, count: int = 500) -> tuple[Tensor, Tensor]:
    """Points of a box, and times."""
    generator = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    return x * torch.tensor(half, dtype=torch.float64), torch.rand(count, generator=generator, dtype=torch.float64)


def slopes(motion, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """∂Φ/∂X ``(N, 3, 3)`` and ∂Φ/∂t ``(N, 3)`` by autograd: no row of the map looks at another one."""
    x, t = x.clone().requires_grad_(), t.clone().requires_grad_()
    moved = motion.forward(x, t)
    rows = [torch.autograd.grad(moved[:, axis].sum(), (x, t), retain_graph=True) for axis in range(3)]
    return torch.stack([row[0] for row in rows], dim=1), torch.stack([row[1] for row in rows], dim=1)


def check_derivatives(motion, x: Tensor, t: Tensor, *, gradient_bound: float) -> None:
    jacobian, rate = slopes(motion, x, t)
    assert (motion.velocity(x, t) - rate).abs().max() < 1e-8  # the series at φ = 0.05: φ⁶ / 10⁴
    covector = torch.ones_like(x) * torch.tensor([1.0, -2.0, 0.5], dtype=x.dtype)
    wanted = torch.linalg.solve(jacobian.mT, covector)
    assert (motion.gradient(x, t, covector) - wanted).abs().max() < gradient_bound


def check_jets(field, points: Tensor, *, bound: float, share: float) -> None:
    """Central differences are off by h² times third derivatives, but where parts meet in between."""
    jet, step = field.jet(points), 1e-6
    assert torch.equal(jet.value, field.value(points))
    for axis in range(4):
        shift = torch.zeros(4, dtype=points.dtype)
        shift[axis] = step
        slope = (field.value(points + shift) - field.value(points - shift)) / (2 * step)
        assert ((slope - jet.gradient[:, axis]).abs() < bound).double().mean() > share


def check_carried(field, rest: Tensor, times: tuple[float, float], *, until: float) -> None:
    """Points of the surface at rest stay on it, in the unit sphere, and go where the flow takes them."""
    motion = field.motion
    for time in times:
        moved = motion.forward(rest, time)
        assert (field.value(at_time(moved, time)) - field.field.value(rest)).abs().max() < 1e-7
        assert moved.norm(dim=1).max() < 1
    start = rest[:: max(1, len(rest) // 50)]
    carried = flow(lambda x, t: motion.velocity(motion.inverse(x, t), t), start, 0.1, until)
    wanted = motion.forward(motion.inverse(start, 0.1), until)
    assert (carried - wanted).abs().max() < 1e-3  # `Solver`'s 1e-5 over a hundred steps
