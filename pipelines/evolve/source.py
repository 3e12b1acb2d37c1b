"""Where two carried shapes differ: what one has and the other has not comes and goes without falling to pieces.

Between two keys a place is on its way from A, what the first says of it, to B, what the second says. The blend
f = (1 − s) A + s B, s from 0 to 1 in time, makes up what the motion leaves, each place by itself. So a foot may
condense beside a leg and join it later, or be cut off from one leg before it has grown onto the other. Here each place
has a progress σ of its own in the place of s, on a grid of places at the first key:

- what comes (A ≥ 0 > B, in the blend at b = A / (A − B)) waits until what leads to it from the common part has come,

      τ(x) = max(b'(x), min over neighbours y of τ(y) + PACE · |x − y|),    τ = 0 where both are solid,

  where b' is b, or sooner by so much that all that is led to from x can come after it in time;
- what goes does the same in reversed time;
- around a piece that is cut off nevertheless, coming is hastened by up to twice, and going put off: at twice all has
  come before anything goes, so that there the surface is as connected as those of the keys.

Where nothing of this is needed σ is s, and nothing changes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from ...neural_fields import Field, Jet, flow
from ...neural_fields.spacetime.flow import Solver
from ...neural_fields.spacetime.moving import Keyframes
from ...neural_fields.spacetime.velocity import CarriedKeyframes, Velocity
from .samples import values_at

__all__ = ["Pace", "PacedKeyframes", "pace_of"]

Float64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

CELLS = 96  # along each side of the grid
MOMENTS = 25  # at which pieces are counted
PACE = 0.5  # time that what waits takes to come, per unit of length; less, if all would take half the time
LAST = 0.98  # by which all has come
REACHES = (0.1, 0.2, 0.4, 4.0)  # around a piece that is cut off; the last one is everywhere
FEWEST = 4  # vertices of a piece that counts
ROWS, STEPS = 1 << 15, 8  # points that are carried at a time; steps of Runge and Kutta 4
# Grid of the second shape that is COARSER first, and refined where it or the first one is nearer than REFINED: three
# halves of a coarse cell's diagonal, as motions stretch.
COARSER, REFINED = 4, 0.2


class Pace(NamedTuple):
    """How far each place is on its way, by a grid over [−1, 1]³.

    Attributes:
        waits: ``(3, n, n, n)`` at its vertices by x, y and z: by how much what comes is later than in the blend, τ − b;
            by how much what goes is sooner; and by how much coming is hastened and going put off, from 0 to 1.
    """

    waits: Tensor

    def progress(self, x: Tensor, s: Tensor, first: Tensor, second: Tensor) -> Tensor:
        """σ at places ``(N, 3)`` of the first key, of which the keys say ``first`` and ``second`` ``(N,)``.

        Args:
            x: the places.
            s: ``(N,)`` shares of the time between the keys.
            first: A.
            second: B.
        """
        at = x.flip(-1)[None, None, None]  # the last axis of the grid first
        found = torch.nn.functional.grid_sample(self.waits[None].to(x), at, padding_mode="border", align_corners=True)
        return _progress(s, first, second, *found.reshape(3, -1))


class PacedKeyframes(CarriedKeyframes):
    """`CarriedKeyframes` in which each place has its pace: f = (1 − σ) f_k∘φ + σ f_{k+1}∘φ between two keys.

    Args:
        keys: the shapes and their times.
        velocity: carries them.
        paces: one for each two keys; None is the blend.
        steps: see `CarriedKeyframes`.
    """

    def __init__(self, keys: Keyframes, velocity: Velocity, paces: Sequence[Pace | None], *, steps: int = 8) -> None:
        super().__init__(keys, velocity, steps=steps)
        self.paces = tuple(paces)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        rows = self.check_points(x).reshape(-1, 4)
        value, blended = rows.new_zeros(len(rows)), torch.ones(len(rows), dtype=torch.bool, device=rows.device)
        for index, (pace, (start, end)) in enumerate(zip(self.paces, itertools.pairwise(self.keys.times), strict=True)):
            if pace is None:
                continue
            between = (rows[:, 3] > start) & (rows[:, 3] < end)
            blended &= ~between
            heard = between.nonzero()[:, 0]
            place, time = rows[heard, :3], rows[heard, 3]
            homes = [self.home(place, time, key) for key in (index, index + 1)]
            first, second = (self.keys.key(index + key).value(home) for key, home in enumerate(homes))
            share = pace.progress(homes[0], (time - start) / (end - start), first, second)
            value = value.index_copy(0, heard, torch.lerp(first, second, share))
        others = blended.nonzero()[:, 0]
        value = value.index_copy(0, others, super().value(rows[others], level=level))
        return value.reshape(x.shape[:-1])

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; by automatic differentiation, as it is asked once for each sample that is learnt from."""
        if all(pace is None for pace in self.paces):
            return super().jet(x, level=level)
        with torch.enable_grad():
            points = self.check_points(x).detach().requires_grad_()
            value = self.value(points, level=level)
            (gradient,) = torch.autograd.grad(value.sum(), points)
        return Jet(value.detach(), gradient, x.new_empty((*x.shape[:-1], 0)))


@torch.no_grad()
def pace_of(keys: Sequence[Field], times: Sequence[float], velocity: Velocity, *, cells: int = CELLS) -> Pace | None:
    """The pace between two keys, or None where the blend has no more pieces than the keys.

    Args:
        keys: two static fields.
        times: of both.
        velocity: carries one to the other.
        cells: along each side of the grid.
    """

    def carried(part: Tensor) -> Tensor:
        ends = (flow(velocity, rows, *times, solver=solver) for rows in part.split(ROWS))
        return values_at(keys[1], torch.cat(list(ends)))

    shape, solver = (cells + 1,) * 3, Solver(method="rk4", step=(times[1] - times[0]) / STEPS)
    x = _lattice(cells)
    values = values_at(keys[0], x)
    # Most of the cube is far outside both shapes. On a coarse grid that can be seen of the second one, too.
    coarse = carried(_lattice(cells // COARSER)).reshape(1, 1, *(cells // COARSER + 1,) * 3)
    others = torch.nn.functional.interpolate(coarse, shape, mode="trilinear", align_corners=True).flatten()
    near = (torch.minimum(values, others) < REFINED).nonzero()[:, 0]
    others[near] = carried(x[near])
    first, second = (part.double().numpy().reshape(shape) for part in (values, others))
    if not _cut_off(first, second, np.zeros((3, *shape))).any():
        return None
    coming, going = _waits(first, second, cells), _waits(second, first, cells)
    waits = np.stack([coming, going, np.zeros(shape)])
    for reach in REACHES:
        pieces = _cut_off(first, second, waits)
        if not pieces.any():
            break
        away = 2 / cells * np.asarray(ndimage.distance_transform_edt(~pieces))
        waits[2] = np.maximum(waits[2], np.clip(2 - away / reach, 0, 1))
    return Pace(torch.from_numpy(waits).float())


def _lattice(cells: int) -> Tensor:
    """Vertices ``(n³, 3)`` of a grid over [−1, 1]³, z the fastest."""
    axis = torch.linspace(-1, 1, cells + 1)
    return torch.cartesian_prod(axis, axis, axis)


def _progress(s: Tensor, first: Tensor, second: Tensor, coming: Tensor, going: Tensor, hurry: Tensor) -> Tensor:
    """σ, see the module: s where nobody waits or hurries."""
    comes = second < first
    crossing = (first / torch.where(first == second, 1.0, first - second)).clamp(0, 1)
    own = torch.where(comes, crossing, 1 - crossing)  # when the blend has it come, or go in reversed time
    clock = ((1 + hurry) * torch.where(comes, s, 1 - s)).clamp(max=1)
    late = torch.where(comes, coming, going)
    due = (own + late).clamp(1 - LAST, LAST)
    before, after = own * clock / due, own + (clock - due) * (1 - own) / (1 - due)
    share = torch.where(late == 0, clock, torch.where(clock < due, before, after))
    return torch.where(comes, share, 1 - share)


def _waits(first: Float64, second: Float64, cells: int) -> Float64:
    """τ − b where something comes, 0 elsewhere; vertices beside have what their neighbours have, for interpolation."""
    common, comes = (first < 0) & (second < 0), (first >= 0) & (second < 0)
    crossing = (first / np.where(comes, first - second, 1.0))[comes]
    rows, edge = np.argwhere(comes) + 1, 2 / cells
    beside = [tuple((rows + sign * step).T) for step in np.eye(3, dtype=int) for sign in (-1, 1)]

    def spread(grid: Float64, step: Callable[[Float64], Float64]) -> Float64:
        """What comes by the fixed point of x ← step(its six neighbours); other vertices stay as the grid has them."""
        grid = np.pad(grid, 1, constant_values=np.inf)
        while True:
            found = step(np.stack([grid[place] for place in beside]))
            if np.array_equal(grid[place := tuple(rows.T)], found):
                return found
            grid[place] = found

    begun = np.where(common, 0.0, np.inf)
    away = spread(begun, lambda others: others.min(axis=0) + edge)
    led = np.isfinite(away)
    if not led.any():
        return np.zeros(first.shape)
    # How far it is from the common part to the furthest place that is reached through here: so much comes after this.
    places = np.full(first.shape, -np.inf)
    places[comes] = np.where(led, away, -np.inf)
    around = np.pad(places, 1, constant_values=-np.inf)
    further = np.stack([around[place] > away for place in beside])
    furthest = spread(places, lambda others: np.maximum(np.where(further, others, -np.inf).max(axis=0), away))
    pace = min(PACE, LAST / (2 * float(away[led].max())))
    ahead = np.subtract(furthest, away, out=np.zeros_like(away), where=led)
    begins = np.minimum(crossing, LAST - pace * ahead)
    due = spread(begun, lambda others: np.maximum(begins, others.min(axis=0) + pace * edge))
    waits = np.zeros(first.shape)
    waits[comes] = np.where(np.isfinite(due), np.minimum(due, LAST) - crossing, 0.0)
    nearest = np.asarray(ndimage.distance_transform_edt(~comes, return_distances=False, return_indices=True))
    return np.where(ndimage.binary_dilation(comes, np.ones((3, 3, 3))), waits[tuple(nearest)], 0.0)


def _cut_off(first: Float64, second: Float64, waits: Float64) -> Bools:
    """Where there are pieces more than the ends have at some moment on the way: all but the largest ones."""
    a, b, *rest = (torch.from_numpy(part) for part in (first, second, *waits))
    most = max(_pieces(first < 0)[1], _pieces(second < 0)[1], 1)
    found = np.zeros(first.shape, dtype=bool)
    for s in torch.linspace(0, 1, MOMENTS, dtype=a.dtype)[1:-1]:
        share = _progress(s, a, b, *rest)
        labels, count, sizes = _pieces((torch.lerp(a, b, share) < 0).numpy())
        if count > most:
            found |= np.isin(labels, np.argsort(-sizes)[most:count] + 1)
    return found


def _pieces(solid: Bools) -> tuple[NDArray[np.int32], int, NDArray[np.intp]]:
    """Labels from 1 of vertices that hang together, how many pieces are large enough, and the sizes of all."""
    labels = np.zeros(solid.shape, np.int32)
    ndimage.label(solid, output=labels)
    sizes = np.bincount(labels.ravel())[1:]
    return labels, int((sizes >= FEWEST).sum()), sizes
