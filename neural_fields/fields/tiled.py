"""Fields of neighbouring boxes as one, for what one network cannot represent.

A binary tree of planes cuts space into boxes, and each has a field. Across a plane at c its two sides have the weights
σ and 1 − σ of (x − c) / h. The cubic σ rises from 0 at −1 to 1 at 1. The weight w_i of a box is the product
along its path, so all weights add up to 1 everywhere, also where planes meet. Then

    f(x) = Σ_i w_i(x) clamp(f_i(x), −r, r).

A tile sees what lies within r of the places where it has a weight. What is further away it may miss, so its distances
count up to r only.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..backend.devices import few_numbers
from ..backend.errors import positive
from .csg import Gated
from .field import Field, Jet, solid
from .similarity import Similarity

SLOPE = 3 / 4  # largest derivative of σ


class Split(NamedTuple):
    """A plane of the tree.

    Attributes:
        axis: 0, 1 or 2.
        place: coordinate of the plane.
        half: half the width h of the blend around it.
        below: the split on the lower side; −1 − i is tile i.
        above: the same on the other side.
    """

    axis: int
    place: float
    half: float
    below: int
    above: int


class Tile(NamedTuple):
    """A field, the similarity from the coordinates of all tiles to its own, and −1 if its inside is to be outside."""

    field: Field
    similarity: Similarity
    sign: int = 1


class TiledField(Gated):
    """Σ_i w_i(x) clamp(f_i(x), −reach, reach) over tiles that are loaded when they are needed.

    Levels are those of the tiles, one with fewer staying at its finest. Each band is as wide as the widest of the tiles
    plus ``gap``. Values are distances up to ``reach``. Where a tile has no weight it is not evaluated.

    With tiles of slope L that differ by at most ``gap`` where they overlap, the slope is at most `slope_bound` (L). The
    gradients of the weights add up to zero, so only differences of tiles count.

    Args:
        load: number of a tile → the tile; called again after it was dropped.
        splits: the tree, from its root; none for a single tile.
        deltas: half-widths of the bands of the tiles in these coordinates, the widest of each level.
        reach: r, in these coordinates.
        gap: largest difference between tiles where they overlap.
        domain: half-edge of the cube, in a tile's own coordinates, in which it is known; beyond, the value at the
            nearest point counts, which is no more than the distance.
        held: most tiles kept in memory.

    Raises:
        ValueError: a number is out of range, or the tree is none.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Plane, Similarity
        >>> from mplicits.neural_fields.fields.tiled import Split, Tile, TiledField
        >>> halves = [Tile(Plane(), Similarity((side, 0.0, 0.0), 0.6)) for side in (-0.5, 0.5)]
        >>> field = TiledField(halves.__getitem__, [Split(0, 0.0, 0.1, -1, -2)], reach=0.2)
        >>> field(torch.tensor([[0.05, 0.0, 0.1], [0.0, 0.0, 0.9]]))
        tensor([0.1000, 0.2000])
    """

    defined_by = ("splits", "reach", "gap", "domain")

    def __init__(
        self,
        load: Callable[[int], Tile],
        splits: Sequence[Split],
        *,
        deltas: Sequence[float] = (),
        reach: float,
        gap: float = 0.0,
        domain: float = 1.05,
        held: int = 32,
    ) -> None:
        super().__init__()
        positive(reach=reach, domain=domain, held=held)
        self.load, self.splits = load, tuple(Split(*split) for split in splits)
        named = [child for split in self.splits for child in (split.below, split.above)]
        expected = [*range(-1 - len(self.splits), 0), *range(1, len(self.splits))]
        if self.splits and sorted(named) != expected:
            raise ValueError(f"splits: name the children {sorted(named)}; expected {expected}, each once")
        for split in self.splits:
            positive(half=split.half)
        self.reach, self.gap, self.domain, self.held = float(reach), float(gap), float(domain), held
        self.num_levels = 1 + len(deltas)
        self.register_buffer("deltas", torch.as_tensor(deltas, dtype=torch.get_default_dtype()) + self.gap)
        self._open: OrderedDict[int, Tile] = OrderedDict()

    @property
    def num_tiles(self) -> int:
        """The number of tiles."""
        return 1 + len(self.splits)

    @property
    def same_rows(self) -> bool:
        """False: each tile is evaluated at the points where it has a weight."""
        return False

    def slope_bound(self, slope: float) -> float:
        """See `Field.slope_bound`: ½ gap Σ|∇w_i| is added, and a plane adds 2 · ¾ / h to the sum.

        A point lies within the blend of one plane of each axis at most, as tiles are wider than two blends.
        """
        widest = max((SLOPE / split.half for split in self.splits), default=0.0)
        return slope + len({split.axis for split in self.splits}) * widest * self.gap

    def tile(self, number: int) -> Tile:
        """A tile, on the device and in the precision of this field; the one not used for longest is dropped."""
        if number not in self._open:
            while len(self._open) >= self.held:
                self._open.popitem(last=False)
            tile = self.load(number)
            self._open[number] = tile._replace(field=solid(tile.field).to(self.like))
        self._open.move_to_end(number)
        return self._open[number]

    def weights(self, x: Tensor) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
        """The tiles with a weight at points ``x`` ``(N, 3)``.

        Yields:
            number of the tile, its rows ``(n,)``, its weights there ``(n,)``, and their gradients ``(n, 3)``.
        """
        every = torch.arange(len(x), device=x.device)
        waiting = [(0 if self.splits else -1, every, torch.ones_like(x[:, 0]), torch.zeros_like(x))]
        while waiting:
            node, rows, weight, slope = waiting.pop()
            if not len(rows):
                continue
            if node < 0:
                yield -1 - node, rows, weight, slope
                continue
            axis, place, half, below, above = self.splits[node]
            u = ((x[rows, axis] - place) / half).clamp(-1, 1)
            up = (2 + u * (3 - u * u)) / 4
            rise = SLOPE * (1 - u * u) / half
            for child, share, change in ((below, 1 - up, -rise), (above, up, rise)):
                kept = (u < 1 if child == below else u > -1).nonzero()[:, 0]
                w, s = weight[kept], share[kept]
                gradient = slope[kept] * s[:, None]
                gradient[:, axis] += w * change[kept]
                waiting.append((child, rows[kept], w * s, gradient))

    def tile_values(self, x: Tensor, *, level: int) -> Iterator[tuple[int, Tensor, Tensor, list[Tensor]]]:
        """The tiles with a weight at points ``x`` ``(N, 3)``, and their own distances there.

        Yields:
            number of the tile, its rows ``(n,)``, its weights ``(n,)``, and its values ``(n,)`` of all levels up to
            ``level``, between −reach and reach.
        """
        for number, rows, weight, _ in self.weights(x):
            tile = self.tile(number)
            field, scale = tile.field, tile.sign * tile.similarity.scale
            found = field.level_values(self._home(tile, x[rows]), level=min(level, field.num_levels - 1))
            found += found[-1:] * (level + 1 - len(found))
            yield number, rows, weight, [(scale * each.to(x.dtype)).clamp(-self.reach, self.reach) for each in found]

    def _home(self, tile: Tile, x: Tensor) -> Tensor:
        home = (x - few_numbers(tile.similarity.center, x)) / tile.similarity.scale
        return home.clamp(-self.domain, self.domain).to(tile.field.like.dtype)

    def _levels(self, x: Tensor, level: int) -> list[Tensor]:
        points = x.reshape(-1, 3)
        sums = [torch.zeros_like(points[:, 0]) for _ in range(level + 1)]
        for _, rows, weight, values in self.tile_values(points, level=level):
            sums = [total.index_add(0, rows, weight * each) for total, each in zip(sums, values, strict=True)]
        return [total.reshape(x.shape[:-1]) for total in sums]

    def _jet(self, x: Tensor, level: int) -> Jet:
        points = x.reshape(-1, 3)
        value, gradient = torch.zeros_like(points[:, 0]), torch.zeros_like(points)
        for number, rows, weight, slope in self.weights(points):
            tile = self.tile(number)
            field, scale = tile.field, tile.sign * tile.similarity.scale
            home = self._home(tile, points[rows])
            jet = field.jet(home, level=min(level, field.num_levels - 1))
            full = scale * jet.value.to(x.dtype)
            values = full.clamp(-self.reach, self.reach)
            counts = (full.abs() < self.reach)[:, None] & (home.abs() < self.domain)
            own = torch.where(counts, tile.sign * jet.gradient.to(x.dtype), 0.0)
            value = value.index_add(0, rows, weight * values)
            gradient = gradient.index_add(0, rows, weight[:, None] * own + values[:, None] * slope)
        shape = x.shape[:-1]
        return Jet(value.reshape(shape), gradient.reshape(x.shape), x.new_empty((*shape, 0)))

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Any:
        """Move the bands, and forget the tiles, which are loaded onto the new device."""
        self._open.clear()
        return super()._apply(fn, recurse)
