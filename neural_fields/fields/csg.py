"""Constructive solid geometry: union, intersection, difference, sharp or blended; offsets, shells, placing, bounding.

Level j of a combination is that of its parts, a part with fewer levels staying at its finest. A band is so wide that
outside it no part changes the sign:

    h_{j+1} = join(f_{j+1}, g_{j+1}, …) where every coarser |h_i| < δ_i, and h_j elsewhere.

With parts of slope at most L each combination has slope at most L. |h| is a bound on the distance to its surface, which
is exact, and less where the nearest point of a part was cut away.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from ..backend.devices import few_numbers
from ..backend.errors import at_least, positive
from ..backend.fixed_shapes import current_shapes, one_evaluation
from .field import Field, FieldLike, Jet, as_field, solid
from .similarity import Similarity


class Gated(Field):
    """A field of other fields, whose level j + 1 is h_{j+1} where every coarser |h_i| < δ_i, and h_j elsewhere.

    A subclass defines the values of all levels without that, and the jet of one of them.
    """

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.level_values(x, level=level)[-1]

    def level_values(self, x: Tensor, *, level: int = -1) -> list[Tensor]:
        """See `Field.level_values`."""
        return self._walk(x, self.resolve_level(level))[0]

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; each point has the jet of the finest level whose bands it is in."""
        level = self.resolve_level(level)
        if level == 0 or not self.check_points(x).numel():
            return self._jet(self.check_points(x), level)
        if current_shapes() is not None:
            return self._jet_of_all(x, level)
        with torch.no_grad():
            reached = self._walk(x, level)[1].reshape(-1)
        rows = [(reached == each).nonzero()[:, 0] for each in range(level + 1)]
        rows = [(each, index) for each, index in enumerate(rows) if len(index)]
        if len(rows) == 1:
            return self._jet(x, rows[0][0])
        points = x.reshape(-1, self.in_dim)
        jets = [self._jet(points[index], each) for each, index in rows]
        order = torch.cat([index for _, index in rows]).argsort()
        joined = (torch.cat(pieces)[order] for pieces in zip(*jets, strict=True))
        return Jet(*(part.reshape(*x.shape[:-1], *part.shape[1:]) for part in joined))

    def _jet_of_all(self, x: Tensor, level: int) -> Jet:
        """The same inside `fixed_shapes`: jets of all levels at every point, then a choice."""
        with one_evaluation():
            with torch.no_grad():
                reached = self._walk(x, level)[1]
            jet = self._jet(x, 0)
            for each in range(1, level + 1):
                there = reached >= each
                jet = Jet(
                    *(
                        torch.where(there.reshape(*there.shape, *[1] * (new.ndim - there.ndim)), new, old)
                        for new, old in zip(self._jet(x, each), jet, strict=True)
                    )
                )
        return jet

    def _walk(self, x: Tensor, level: int) -> tuple[list[Tensor], Tensor]:
        """The values of all levels up to ``level``, and the level that each point reaches, int64 ``(...,)``."""
        first, *finer = self._levels(self.check_points(x), level)
        found, inside = [first], torch.ones_like(first, dtype=torch.bool)
        reached = torch.zeros_like(inside, dtype=torch.int64)
        for joined, delta in zip(finer, self.deltas, strict=False):
            inside = inside & (found[-1].abs() < delta)
            found.append(torch.where(inside, joined, found[-1]))
            reached = reached + inside
        return found, reached

    @abstractmethod
    def _levels(self, x: Tensor, level: int) -> list[Tensor]:
        """The values ``(...,)`` of the levels up to ``level`` everywhere, coarse to fine."""

    @abstractmethod
    def _jet(self, x: Tensor, level: int) -> Jet:
        """The jet of one level, wherever ``x`` is."""


class Combined(Gated):
    """A field of fields; a subclass defines the points of the parts, and how values and jets join."""

    def __init__(self, *parts: FieldLike) -> None:
        super().__init__()
        fields = [as_field(part) for part in parts]
        if len({field.in_dim for field in fields}) != 1:
            dims = [field.in_dim for field in fields]
            raise ValueError(f"parts of {dims} dimensions; expected at least one, all equal")
        self.parts = torch.nn.ModuleList(fields)
        self.in_dim, self.num_levels = fields[0].in_dim, max(field.num_levels for field in fields)

    @property
    def fields(self) -> tuple[Field, ...]:
        """The parts."""
        return tuple(self.parts)  # pyright: ignore[reportReturnType]

    @property
    def same_rows(self) -> bool:
        """Whether it holds for every part."""
        return all(field.same_rows for field in self.fields)

    @property
    def deltas(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Half-widths of the bands: the widest of the parts at each level, plus what the combination adds."""
        bands = [field.deltas for field in self.fields]
        padded = [torch.nn.functional.pad(band, (0, self.num_levels - 1 - len(band))) for band in bands]
        return self._band(torch.stack(padded).amax(dim=0))

    def _levels(self, x: Tensor, level: int) -> list[Tensor]:
        home = self._home(x)
        with one_evaluation():
            columns = [field.level_values(home, level=min(level, field.num_levels - 1)) for field in self.fields]
        return [self._join(x, [column[min(each, len(column) - 1)] for column in columns]) for each in range(level + 1)]

    def _jet(self, x: Tensor, level: int) -> Jet:
        home = self._home(x)
        return self._join_jets(x, [field.jet(home, level=min(level, field.num_levels - 1)) for field in self.fields])

    def _home(self, x: Tensor) -> Tensor:
        """The points at which the parts are evaluated."""
        return x

    @abstractmethod
    def _band(self, delta: Tensor) -> Tensor:
        """|h_j| ≥ this implies that h_{j+1} has the sign of h_j, if the parts keep theirs where |f_j| ≥ ``delta``."""

    @abstractmethod
    def _join(self, x: Tensor, values: list[Tensor]) -> Tensor: ...

    @abstractmethod
    def _join_jets(self, x: Tensor, jets: list[Jet]) -> Jet: ...


class _Pointwise(Combined):
    """h(x) = w(f(x), g(x), …): the gradient is Σ ∂w/∂f_i ∇f_i."""

    @abstractmethod
    def _weigh(self, values: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """The joined value, and its derivatives by those of the parts."""

    def _join(self, x: Tensor, values: list[Tensor]) -> Tensor:
        return self._weigh(values)[0]

    def _join_jets(self, x: Tensor, jets: list[Jet]) -> Jet:
        value, weights = self._weigh([jet.value for jet in jets])
        gradient = torch.zeros_like(x)
        for weight, jet in zip(weights, jets, strict=True):
            # A part of weight 0 may have no gradient there, and NaN times 0 is NaN.
            gradient = gradient + torch.where(weight[..., None] == 0, 0.0, weight[..., None] * jet.gradient)
        return Jet(value, gradient, jets[0].features if len(jets) == 1 else x.new_empty((*x.shape[:-1], 0)))


class _Boolean(_Pointwise):
    """±min(±f, ±g, …); the minimum is blended where two values differ by less than ``smooth``."""

    defined_by = ("smooth",)

    def __init__(self, *parts: FieldLike, smooth: float = 0.0) -> None:
        super().__init__(*parts)
        at_least(0, smooth=smooth)
        self.smooth = float(smooth)

    @abstractmethod
    def _signs(self) -> tuple[int, Sequence[int]]:
        """Of the result, and of each part."""

    def _band(self, delta: Tensor) -> Tensor:
        # Each blend lowers the minimum by at most smooth / 4; beyond that much more, one part alone decides the sign.
        return delta + (len(self.parts) - 1) * self.smooth / 4

    def _weigh(self, values: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        sign, signs = self._signs()
        lowest, *others = (own * value for own, value in zip(signs, values, strict=True))
        weights = [torch.ones_like(lowest)]
        for other in others:
            lowest, share = _smooth_minimum(lowest, other, self.smooth)
            weights = [*(weight * share for weight in weights), 1 - share]
        return sign * lowest, [sign * own * weight for own, weight in zip(signs, weights, strict=True)]


def _smooth_minimum(a: Tensor, b: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """min(a, b) where they differ by more than ``width``, a parabola between; and its derivative s by a (1 − s by b).

    s a + (1 − s) b − width s (1 − s) with s = 1/2 + (b − a) / (2 width) in [0, 1].
    """
    if width == 0:
        return torch.where(b < a, b, a), (b >= a).to(a.dtype)
    share = (0.5 + (b - a) / (2 * width)).clamp(0, 1)
    return share * a + (1 - share) * b - width * share * (1 - share), share


class Union(_Boolean):
    """The points in any of the parts: ``min_i f_i(x)``; exact outside of parts with exact distances, a bound inside.

    With ``smooth`` k, values that differ by less than k are blended by the polynomial minimum: the union grows there by
    at most k/4, and stays as smooth as its parts. Between two planes at a right angle the fillet has radius k/√2 at its
    middle. More than two parts are blended in turn.

    Args:
        parts: fields, or functions of points; shared, not copied.
        smooth: k, in the fields' units; 0 for none.

    Raises:
        ValueError: there are no parts, their dimensions differ, or ``smooth`` is negative.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Box, Sphere, Union
        >>> snowman = Union(Sphere(radius=0.4), Sphere(radius=0.3, center=(0, 0, 0.5)), smooth=0.1)
        >>> snowman(torch.tensor([[0.0, 0.0, 1.0]]))
        tensor([0.2000])
    """

    def _signs(self) -> tuple[int, Sequence[int]]:
        return 1, [1] * len(self.parts)


class Intersection(_Boolean):
    """The points in all of the parts: ``max_i f_i(x)``; exact inside of parts with exact distances, a bound outside.

    With ``smooth`` k it shrinks by at most k/4. Arguments and errors are those of `Union`.
    """

    def _signs(self) -> tuple[int, Sequence[int]]:
        return -1, [-1] * len(self.parts)


class Difference(_Boolean):
    """The points in the first part and in none of the others: ``max(f_0, −f_1, −f_2, …)``, a bound on the distance.

    With ``smooth`` k it shrinks by at most k/4 for each part taken away. Arguments and errors are those of `Union`.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Difference, Sphere
        >>> bowl = Difference(Sphere(radius=0.5), Sphere(radius=0.4), lambda x: -x[..., 2])
        >>> bowl(torch.tensor([[0.0, 0.0, -0.45], [0.0, 0.0, 0.45]])) < 0
        tensor([ True, False])
    """

    def _signs(self) -> tuple[int, Sequence[int]]:
        return -1, [-1, *[1] * (len(self.parts) - 1)]


class Offset(_Pointwise):
    """The solid grown by a distance, or shrunk by a negative one: ``f(x) − by``.

    As exact as f is at that distance from its surface. A `MultiscaleSDF` is its coarsest level where |f_0| ≥ δ_0, so an
    offset beyond δ_0 is one of that level; ``mplicits offset`` measures from the surface of the finest instead.

    Args:
        part: the solid, a field or a function of points.
        by: distance, in the field's units; ValueError if it is not finite.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Offset, Sphere
        >>> Offset(Sphere(radius=0.5), 0.25)(torch.tensor([[1.0, 0.0, 0.0]]))
        tensor([0.2500])
    """

    defined_by = ("by",)

    def __init__(self, part: FieldLike, by: float) -> None:
        super().__init__(part)
        if not math.isfinite(by):
            raise ValueError(f"by={by}: expected a finite number")
        self.by = float(by)

    def _band(self, delta: Tensor) -> Tensor:
        return delta + abs(self.by)

    def _weigh(self, values: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        return values[0] - self.by, [torch.ones_like(values[0])]


class Shell(_Pointwise):
    """A wall along the surface, ``−inside < f(x) < outside``: ``|f(x) − m| − (outside + inside) / 2``.

    m = (outside − inside) / 2. Where f is an exact distance, the wall is ``inside + outside`` thick; for what is
    further than δ_0 from the surface of a `MultiscaleSDF`, see `Offset`.

    Args:
        part: the solid, a field or a function of points.
        inside: depth of the wall inside the solid, in the field's units.
        outside: its height outside.

    Raises:
        ValueError: one is negative or not finite, or the wall has no thickness.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Shell, Sphere
        >>> Shell(Sphere(radius=0.5), inside=0.125)(torch.tensor([[0.5, 0.0, 0.0], [0.25, 0.0, 0.0]]))
        tensor([0.0000, 0.1250])
    """

    defined_by = ("inside", "outside")

    def __init__(self, part: FieldLike, *, inside: float = 0.0, outside: float = 0.0) -> None:
        super().__init__(part)
        if not (min(inside, outside) >= 0 and 0 < inside + outside < math.inf):
            raise ValueError(f"inside={inside}, outside={outside}: expected two finite numbers ≥ 0, not both 0")
        self.inside, self.outside = float(inside), float(outside)

    def _band(self, delta: Tensor) -> Tensor:
        return delta + (self.inside + self.outside) / 2

    def _weigh(self, values: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        away = values[0] - (self.outside - self.inside) / 2
        return away.abs() - (self.outside + self.inside) / 2, [away.sign()]


class Placed(Combined):
    """A field moved and scaled: ``scale · f((x − center) / scale)``, a distance if f is one.

    The ``similarity`` maps from the coordinates of this field to those of the three-dimensional ``part``.
    """

    defined_by = ("similarity",)

    def __init__(self, part: FieldLike, similarity: Similarity) -> None:
        super().__init__(solid(part))
        self.similarity = similarity

    def _home(self, x: Tensor) -> Tensor:
        return (x - few_numbers(self.similarity.center, x)) / self.similarity.scale

    def _band(self, delta: Tensor) -> Tensor:
        return delta * self.similarity.scale

    def _join(self, x: Tensor, values: list[Tensor]) -> Tensor:
        return values[0] * self.similarity.scale

    def _join_jets(self, x: Tensor, jets: list[Jet]) -> Jet:
        return Jet(self._join(x, [jets[0].value]), jets[0].gradient, jets[0].features)


class Bounded(Combined):
    """A three-dimensional field that is known in a ball around 0 only, continued beyond as the solid in the ball.

    Outside the ball f is evaluated at the nearest point p = r x / |x| of the ball. With u = max(f(p), 0) and v = |x| −
    r, √(u² + v²) is at most the distance of x, with the slope of f or 1. Inside it is max(f(x), |x| − r), which closes
    a surface that leaves the ball.
    """

    defined_by = ("radius",)

    def __init__(self, part: FieldLike, *, radius: float = 1.05) -> None:
        super().__init__(solid(part))
        positive(radius=radius)
        self.radius = float(radius)

    def _home(self, x: Tensor) -> Tensor:
        return x * (self.radius / x.norm(dim=-1, keepdim=True).clamp(min=self.radius))

    def _band(self, delta: Tensor) -> Tensor:
        return delta  # the surface of the part lies in its own bands, and that of the ball belongs to all levels

    def _join(self, x: Tensor, values: list[Tensor]) -> Tensor:
        beyond = x.norm(dim=-1) - self.radius
        within = torch.where(values[0] < beyond, beyond, values[0])
        return torch.where(beyond > 0, self._outside(beyond, values[0]), within)

    def _outside(self, beyond: Tensor, value: Tensor) -> Tensor:
        """√(u² + v²) outside the ball; 1 inside, where the root of 0 would have no derivative."""
        return torch.where(beyond > 0, value.clamp(min=0).square() + beyond.square(), 1.0).sqrt()

    def _join_jets(self, x: Tensor, jets: list[Jet]) -> Jet:
        ((value, gradient, features),) = jets
        length = x.norm(dim=-1)
        beyond = length - self.radius
        radial = x / torch.where(length > 0, length, 1.0)[..., None]
        within = torch.where((value < beyond)[..., None], radial, gradient)
        along = (gradient * radial).sum(dim=-1, keepdim=True) * radial
        # x moves its nearest point on the ball along the sphere, and by r / |x| as far.
        carried = (gradient - along) * (self.radius / length.clamp(min=self.radius))[..., None]
        slope = value.clamp(min=0)[..., None] * carried + beyond[..., None] * radial
        outside = slope / self._outside(beyond, value)[..., None]
        joined = torch.where((beyond > 0)[..., None], outside, within)
        return Jet(self._join(x, [value]), joined, features)
