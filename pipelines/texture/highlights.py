"""What the direction of view adds to a texture, learnt by a network small enough for a page.

A reconstruction's colours c(x, v) want a normal, features and a hash encoding; a page has SIRENs. With the texture g,
which is the same for every direction,

    c(x, v) ≈ g(x) + h(x, v)

where v, of unit length, goes from the eye to x, and h is a SIREN of six inputs. With the mirrored ray in place of v
(Verbin et al. 2022, Ref-NeRF) h would not have to learn how the surface turns, but it then shows every unevenness of
the normals, which those of photographs have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, Jet, Mesh, TextureField, ViewColor, project_to_surface, sphere_trace
from ...neural_fields.networks.texture import ColorSiren
from ..surface.surface import from_mesh, sample_points
from ..training.report import Report
from ..training.trainer import Group, Interrupted, Objective, Trainer, seeded, stop_on_signals, warm_cosine

__all__ = ["Highlights", "fit_highlights"]

STAGE = "colours by direction"
PLACES, LOOKS = 40_000, 6  # points, and looks at each
HELD_OUT = 0.1  # share of the points at which what was learnt is judged
FACING, MOST_EYES = 0.2, 64  # cosine within which a camera faces a point; cameras of a part of the points
WIDTH, DEPTH, OMEGA = 64, 3, 25.0
CLEAR = 0.02  # what hides a point is further off than this
STEPS, BATCH, RATE = 600, 8192, 2e-3
# What saves less than a tenth of the texture's error is not worth a network in every page.
WORTH = 0.9
ROWS = 1 << 15


@dataclass(frozen=True)
class Highlights:
    """What was learnt.

    Attributes:
        network: h, on the CPU.
        before: root mean square error of the texture alone, in display RGB from 0 to 1, at points that h has not seen.
        after: with h.
    """

    network: ColorSiren
    before: float
    after: float

    @property
    def worth_it(self) -> bool:
        """Whether h saves more than it costs."""
        return self.after < WORTH * self.before


def fit_highlights(
    color: ViewColor,
    texture: TextureField,
    mesh: Mesh,
    eyes: NDArray[np.floating] | None = None,
    *,
    steps: int = STEPS,
    seed: int = 0,
    progress: Report | None = None,
) -> Highlights:
    """Teach a small network what a texture leaves of the colours by direction.

    Points are seen from cameras that face them, if nothing is between; where there are no cameras, or none sees any
    point, from directions around their normals.

    Args:
        color: c.
        texture: g, around its geometry.
        mesh: of its surface, or of the part of that which photographs have seen.
        eyes: ``(V, 3)`` of the cameras whose photographs c was trained on, in the coordinates of the geometry.
        steps: of the training.
        seed: of weights, points and directions.
        progress: called now and then with how far the training is.

    Raises:
        Interrupted: Ctrl-C.
    """
    pool = _Looks.of(color, texture, mesh, eyes, seed)
    known, unseen = pool.parted(HELD_OUT)
    with seeded(seed):
        network = ColorSiren(WIDTH, DEPTH, omega=OMEGA, in_dim=6, mean=(0.0, 0.0, 0.0))
    objective = _HighlightObjective(network, known, torch.Generator().manual_seed(seed))
    trainer = Trainer(objective, stage=STAGE, steps=steps)
    with stop_on_signals() as flag:
        if not trainer.run(flag, report=progress):
            raise Interrupted(None)
    network.requires_grad_(False)
    before, after = (unseen.error(one) for one in (None, network))
    return Highlights(network, before, after)


@dataclass(frozen=True)
class _Looks:
    """Looks at points of a surface, one behind the other.

    Attributes:
        places: ``(N, 6)``, x and v.
        base: ``(N, 3)``, what the texture says.
        seen: ``(N, 3)``, what is seen.
        points: ``(N,)``, which point each is a look at, in rising order.
    """

    places: Tensor
    base: Tensor
    seen: Tensor
    points: Tensor

    @classmethod
    @torch.no_grad()
    def of(
        cls, color: ViewColor, texture: TextureField, mesh: Mesh, eyes: NDArray[np.floating] | None, seed: int
    ) -> _Looks:
        """Looks from cameras that see the points; where there are no cameras, or none sees any, from all around."""
        geometry, level, random = texture.geometry, texture.geometry_level, np.random.default_rng(seed)
        found, _ = sample_points(from_mesh(mesh), PLACES, random)
        places, base, seen, points = [], [], [], []
        for first in range(0, PLACES, ROWS // LOOKS):
            part = torch.from_numpy(found[first : first + ROWS // LOOKS]).float()
            part, _ = project_to_surface(geometry, part, level=level)
            jet = geometry.jet(part, level=level)
            normal = torch.nn.functional.normalize(jet.gradient, dim=-1)
            if eyes is None:
                point, way = _from_around(normal.numpy(), random)
            else:
                point, way = _from_cameras(part.numpy(), normal.numpy(), eyes, random)
                clear = _unhidden(geometry, level, part[point], way)
                point, way = point[clear], way[clear]
            direction = torch.nn.functional.normalize(way, dim=-1)
            places.append(torch.cat((part[point], direction), dim=1))
            base.append(texture.network.value(part[point]))
            seen.append(color(part[point], direction, Jet(*(held[point] for held in jet))))
            points.append(first + point)
        looks = cls(torch.cat(places), torch.cat(base), torch.cat(seen), torch.cat(points))
        return looks if len(looks.points) else cls.of(color, texture, mesh, None, seed)

    def parted(self, share: float) -> tuple[_Looks, _Looks]:
        """Looks at all but the last of the points, and at those."""
        where = int(torch.searchsorted(self.points, round((1 - share) * PLACES)))
        both = [held.tensor_split([where]) for held in (self.places, self.base, self.seen, self.points)]
        known, unseen = zip(*both, strict=True)
        return _Looks(*known), _Looks(*unseen)

    @torch.no_grad()
    def error(self, network: ColorSiren | None) -> float:
        """Root mean square of what the texture, with a network or alone, leaves of the colours."""
        found = self.base if network is None else self.base + network.value(self.places)
        return float((found.clamp(0, 1) - self.seen).square().mean().sqrt())


def _from_around(normals: NDArray[np.floating], random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Which points are looked at, ``(L,)``, and the ways to them, ``(L, 3)``: `LOOKS` to each, by their cosine."""
    around = random.normal(size=(len(normals), LOOKS, 3))
    # Uniform on the unit sphere that touches the surface.
    towards = around / np.linalg.norm(around, axis=2, keepdims=True) + normals[:, None]
    return torch.arange(len(normals)).repeat_interleave(LOOKS), torch.from_numpy(-towards.reshape(-1, 3)).float()


def _from_cameras(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    eyes: NDArray[np.floating],
    random: np.random.Generator,
) -> tuple[Tensor, Tensor]:
    """Which points are looked at, and the ways to them, from up to `LOOKS` cameras that face each."""
    ways = points[:, None] - eyes[random.permutation(len(eyes))[:MOST_EYES]]
    facing = -np.einsum("nvd,nd->nv", ways, normals) >= FACING * np.linalg.norm(ways, axis=2)
    # The highest of random numbers, among those that face: each camera with the same chance.
    chosen = np.argsort(-random.uniform(size=facing.shape) * facing, axis=1)[:, :LOOKS]
    point, rank = np.nonzero(np.take_along_axis(facing, chosen, axis=1))
    return torch.from_numpy(point), torch.from_numpy(ways[point, chosen[point, rank]]).float()


def _unhidden(geometry: Field, level: int, points: Tensor, ways: Tensor) -> Tensor:
    """Whether nothing is between points ``(L, 3)`` and the eyes from which ``ways`` lead there."""
    far = ways.norm(dim=-1, keepdim=True)
    limits = {"far": far[:, 0] - CLEAR, "tolerance": CLEAR / 10, "resolution": CLEAR / 10}
    hits = sphere_trace(geometry, points - ways, ways / far, level=level, **limits)
    return ~hits.mask


class _HighlightObjective(Objective):
    """Squares of what texture and network leave of the colours."""

    def __init__(self, network: ColorSiren, looks: _Looks, generator: torch.Generator) -> None:
        super().__init__(network, [Group(list(network.parameters()), warm_cosine(RATE))], generator)
        self.colors, self.looks = network, looks

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        rows = torch.randint(len(self.looks.places), (BATCH,), generator=self.generator)
        found = self.looks.base[rows] + self.colors.value(self.looks.places[rows])
        color = (found - self.looks.seen[rows]).square().mean()
        return {"color": color}, color
