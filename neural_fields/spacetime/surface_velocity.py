"""A velocity for the points of a moving surface: the best motion of the whole shape, and the rest along the normal.

A level set defines only the normal speed v_n = −∂f/∂t / |∇f| of its points; by that alone the points of a travelling
ball slide to its rear. This takes the motion u(x) = a + b × x + c x (travel, turn and growth) that explains the normal
speeds best,

    min over a, b, c of Σ (⟨n, u(x)⟩ − v_n(x))²  over points of the surface,   V = u + (v_n − ⟨n, u⟩) n.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..backend.errors import at_least
from ..fields.field import Field
from ..tracing.sphere import BOUNDING_RADIUS, ball_points, project_to_surface
from .dynamic_tracing import moment
from .field import at_time


class CarriedVelocity:
    """V(x, t) on the moving surface of a four-dimensional field, for `flow`.

    The motion as a whole is found at ``nodes`` ≥ 2 times from 2048 surface points, and interpolated; |∇f| counts as at
    least 0.1. Rigid motions are exact as far as normals show them: a turning sphere stays at rest.
    """

    def __init__(self, field: Field, *, level: int = -1, nodes: int = 17) -> None:
        at_least(2, nodes=nodes)
        self.field, self.level = field, field.resolve_level(level)
        points = ball_points(2048, radius=1.0, generator=torch.Generator().manual_seed(0))
        parts = [self._whole(points.to(field.like), t) for t in torch.linspace(0, 1, nodes).tolist()]
        self.parts = torch.stack(parts)  # (nodes, 7)

    def __call__(self, x: Tensor, t: Tensor) -> Tensor:
        """Velocities ``(N, 3)`` of points ``(N, 3)`` at times ``(N,)``."""
        normal, speed = self._normal_speed(x, t)
        place = t.clamp(0, 1) * (len(self.parts) - 1)
        before = place.floor().long().clamp(max=len(self.parts) - 2)
        part = torch.lerp(self.parts[before].to(x), self.parts[before + 1].to(x), (place - before)[:, None])
        whole = part[:, :3] + torch.linalg.cross(part[:, 3:6], x) + part[:, 6:] * x
        return whole + (speed - (normal * whole).sum(dim=-1))[:, None] * normal

    def _normal_speed(self, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        gradient = self.field.jet(at_time(x, t), level=self.level).gradient
        slope = gradient[..., :3].norm(dim=-1).clamp(min=0.1)
        return gradient[..., :3] / slope[:, None], -gradient[..., 3] / slope

    @torch.no_grad()
    def _whole(self, points: Tensor, t: float) -> Tensor:
        """(a, b, c) ``(7,)`` at a time; zero without a surface."""
        moved, arrived = project_to_surface(moment(self.field, t), points, level=self.level)
        moved = moved[arrived & (moved.norm(dim=-1) <= BOUNDING_RADIUS)]
        normal, speed = self._normal_speed(moved, moved.new_full((len(moved),), t))
        growth = (normal * moved).sum(dim=-1, keepdim=True)
        system = torch.cat((normal, torch.linalg.cross(moved, normal), growth), dim=-1).double()
        # Motions that normals hardly show, as turns of a sphere, are left out: singular values below 3 % of the first.
        least = torch.linalg.pinv(system.T @ system, rtol=3e-2**2, hermitian=True)
        return (least @ (system.T @ speed.double())).to(points)
