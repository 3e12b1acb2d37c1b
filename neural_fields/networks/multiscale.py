"""The paper's multiscale SDF (Sec. 3.1): a base field plus residuals, each one only in the band before it.

f_0 is the base; f_{j+1} = f_j + γ(|f_j| / δ_j) r_j where every coarser level is inside its own band, and f_j elsewhere.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..backend.devices import uncompiled, under_vmap
from ..backend.errors import positive
from ..backend.fixed_shapes import FixedShapes, Rows, current_shapes
from ..backend.kernels.switch import Choice, choose
from ..fields.field import Field, FieldLike, Jet, SecondJet, as_field
from ..fields.losses import data_loss, eikonal_loss, normal_loss
from .siren import Siren, needs_graph

if TYPE_CHECKING:
    from ..backend.kernels.levels import Levels

# The tensors of a jet of any order, the value first; ``(N,)``, alone or with features, is a jet of order 0.
Parts = tuple[Tensor, ...]


class MultiscaleSDF(Field):
    """Nested residual levels around the surface of a base field.

    Rows outside a band are gathered away before the residual is evaluated (see `fixed_shapes` for GPUs, which would
    wait for that). The gate is the paper's hard one for ``taper=0``; otherwise it falls from 1 at ``(1 − taper) δ`` to
    0 at δ as the cubic 1 − u²(3 − 2u), so value and gradient are continuous for renderers that differentiate them.

    Args:
        base: level 0, defined everywhere; a field, or a function of points ``(..., 3)`` → ``(...,)``.
        residuals: the r_j, finest last; same ``in_dim`` and number of features as the base.
        deltas: half-width δ_j of the band around each level but the last (Eq. 5).
        taper: fraction of the band over which the gate closes, in [0, 1].

    Raises:
        ValueError: the numbers of residuals and deltas differ, or an argument is out of range.

    Example:
        >>> from mplicits.neural_fields import MultiscaleSDF
        >>> sdf = MultiscaleSDF.from_widths([(128, 2), (256, 2), (400, 2)], omegas=[30, 45, 100])
        >>> sdf.num_levels, sum(p.numel() for p in sdf.parameters())
        (3, 246627)
    """

    defined_by = ("taper",)

    def __init__(
        self, base: FieldLike, residuals: Sequence[Field], deltas: Sequence[float] | Tensor, *, taper: float = 0.0
    ) -> None:
        super().__init__()
        base = as_field(base)
        widths = torch.as_tensor(deltas, dtype=torch.get_default_dtype()).reshape(-1)
        if len(widths) != len(residuals):
            raise ValueError(f"deltas has {len(widths)} entries for {len(residuals)} residuals; expected one for each")
        if not bool((widths > 0).all()):
            raise ValueError(f"deltas={widths.tolist()}: expected numbers > 0")
        if not 0 <= taper <= 1:
            raise ValueError(f"taper={taper}: expected a fraction in [0, 1]")
        for index, residual in enumerate(residuals):
            if residual.in_dim != base.in_dim:
                raise ValueError(f"residuals[{index}].in_dim={residual.in_dim}; the base has {base.in_dim}")
        self.base, self.residuals, self.taper = base, nn.ModuleList(residuals), float(taper)
        self.in_dim, self.num_levels = base.in_dim, 1 + len(residuals)
        self.register_buffer("deltas", widths)

    @property
    def same_rows(self) -> bool:
        """True: gating by bands keeps track of the rows."""
        return True

    @classmethod
    def from_widths(
        cls,
        sizes: Sequence[tuple[int, int]],
        *,
        omegas: Sequence[float],
        deltas: Sequence[float] | None = None,
        taper: float = 0.0,
        in_dim: int = 3,
        num_features: int = 0,
        residual_gain: float = 0.1,
    ) -> MultiscaleSDF:
        """Untrained SIREN levels, the paper's (N₀, d₀) ▷ (N₁, d₁) ▷ ….

        Args:
            sizes: (width, depth) of each level.
            omegas: ω₀ of each level; the paper uses 30, 45, 100.
            deltas: half-widths of the bands; before training 0.03 · 2⁻ʲ by default, the size that the paper measures
                (suppl. "Measured adaptive band widths").
            taper: see the class.
            in_dim: dimension of the domain.
            num_features: extra outputs of every level; they begin with unit variance.
            residual_gain: factor on the residuals' initial output weights; a new level starts close to the one before
                it.

        Raises:
            ValueError: no sizes, or the numbers of omegas or deltas differ.
        """
        if not sizes or len(omegas) != len(sizes):
            raise ValueError(f"omegas has {len(omegas)} entries for {len(sizes)} sizes; expected one for each, and ≥ 1")
        levels = [
            Siren(
                width,
                depth,
                omega=omega,
                in_dim=in_dim,
                num_features=num_features,
                output_gain=residual_gain if index else 1.0,
                feature_gain=omega,
            )
            for index, ((width, depth), omega) in enumerate(zip(sizes, omegas, strict=True))
        ]
        if deltas is None:
            deltas = [0.03 * 0.5**index for index in range(len(sizes) - 1)]
        return cls(levels[0], levels[1:], deltas, taper=taper)

    def with_level(self, residual: Field, *, delta: float) -> MultiscaleSDF:
        """This field with one more level inside ``|f_last| < delta``; the levels are shared, not copied."""
        deltas = [*self.deltas.tolist(), float(delta)]
        return MultiscaleSDF(self.base, [*self.levels[1:], residual], deltas, taper=self.taper)

    def first_levels(self, count: int) -> MultiscaleSDF:
        """This field with only its ``count`` coarsest levels, which are shared, not copied."""
        return MultiscaleSDF(self.base, self.levels[1:count], self.deltas[: count - 1], taper=self.taper)

    @property
    def levels(self) -> tuple[Field, ...]:
        """The base, and the residuals after it, coarse to fine."""
        return (self.base, *self.residuals)  # pyright: ignore[reportReturnType]

    @uncompiled
    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`; outside the band of level j − 1, level j is level j − 1."""
        if self._choose(self.check_points(x), level, jet=False).fused:
            from ..backend.kernels.levels import levels_value

            return levels_value(x.reshape(-1, self.in_dim), as_levels(self, level), _mask()).reshape(x.shape[:-1])
        (f,) = deque(self._walk(x, level, _value), maxlen=1).pop()
        return f

    @uncompiled
    def value_features(self, x: Tensor, *, level: int = -1) -> tuple[Tensor, Tensor]:
        """See `Field.value_features`; without gradients at any level."""
        walk = self._walk(x, level, lambda part, points: part.value_features(points))
        value, features = deque(walk, maxlen=1).pop()
        return value, features

    def level_values(self, x: Tensor, *, level: int = -1) -> list[Tensor]:
        """See `Field.level_values`; every level is evaluated once, and only inside the bands before it."""
        return [f for (f,) in self._walk(x, level, _value)]

    @uncompiled
    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; inside a tapered band ∇(γr) = γ∇r + r γ′ ∇f."""
        if self._choose(self.check_points(x), level, jet=True).fused:
            from ..backend.kernels.levels import levels_jet

            shape = x.shape[:-1]
            value, gradient = levels_jet(x.reshape(-1, self.in_dim), as_levels(self, level), _mask())
            return Jet(value.reshape(shape), gradient.reshape(x.shape), x.new_empty(*shape, 0))
        return Jet(*deque(self._walk(x, level, lambda part, points: part.jet(points)), maxlen=1).pop())

    @uncompiled
    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        """See `Field.second_jet`; inside a tapered band the product rule is applied twice."""
        dims = self.resolve_dims(dims)
        walk = self._walk(x, level, lambda part, points: part.second_jet(points, dims=dims))
        return SecondJet(*deque(walk, maxlen=1).pop())

    def _choose(self, x: Tensor, level: int, *, jet: bool) -> Choice:
        """Whether one launch evaluates all levels up to ``level`` at ``x``."""
        levels = self.levels[: self.resolve_level(level) + 1]
        if len(levels) == 1 or under_vmap():
            return Choice(False, "one level is evaluated by itself")
        choice = choose_levels(levels, x, jet=jet)
        if choice.fused and needs_graph(x, [weight for part in levels for weight in part.parameters()]):
            return Choice(False, "a graph is recorded; levels are evaluated one by one")
        return choice

    def _walk(self, x: Tensor, level: int, evaluate: Callable[[Field, Tensor], Parts]) -> Iterator[Parts]:
        """The jets of the levels up to ``level``."""
        levels = self.levels[: self.resolve_level(level) + 1]
        return walk_levels(levels, self.deltas, self.check_points(x), evaluate, self._add)

    def _add(self, before: Parts, own: Parts, delta: Tensor) -> Parts:
        """Add γ(f) r to f, to the order of their jets."""
        f, r = before[0], own[0]
        gate, *slopes = self._gate(f, delta, order=max(0, len(own) - 2))
        if not slopes:
            return f + gate * r, *(a + gate[:, None] * b for a, b in zip(before[1:], own[1:], strict=True))
        steeper = 1 + slopes[0] * r
        gradient = steeper[:, None] * before[1] + gate[:, None] * own[1]
        value = f + gate * r
        features = before[2] + gate[:, None] * own[2]
        if len(slopes) == 1:
            return value, gradient, features
        dims = own[3].shape[-1]
        column, row = before[1][:, :dims, None], before[1][:, None, :dims]
        cross = column * own[1][:, None, :dims]
        hessian = (
            steeper[:, None, None] * before[3]
            + gate[:, None, None] * own[3]
            + slopes[0][:, None, None] * (cross + cross.mT)
            + (slopes[1] * r)[:, None, None] * column * row
        )
        return value, gradient, features, hessian

    def _gate(self, f: Tensor, delta: Tensor, order: int) -> list[Tensor]:
        """γ and its derivatives by f up to ``order`` ≤ 2, at values f inside the band."""
        if self.taper == 0:
            return [torch.ones_like(f), *(torch.zeros_like(f) for _ in range(order))]
        width = delta * self.taper
        u = ((f.abs() / delta - (1 - self.taper)) / self.taper).clamp(0, 1)
        gate = [1 - u * u * (3 - 2 * u)]
        if order > 0:
            gate.append(-6 * u * (1 - u) * f.sign() / width)
        if order > 1:  # it jumps where the gate begins to close
            gate.append(torch.where((u > 0) & (u < 1), -6 * (1 - 2 * u) / width**2, 0.0))
        return gate


def levels_of(field: Field) -> tuple[Field, ...]:
    """The levels of a `MultiscaleSDF`, coarse to fine; any other field is one level."""
    return field.levels if isinstance(field, MultiscaleSDF) else (field,)


def as_levels(field: Field, level: int = -1) -> Levels:
    """The levels up to ``level`` of a `MultiscaleSDF` of SIRENs, or a `Siren`, as the fused kernels take them."""
    from ..backend.kernels.levels import Levels
    from ..backend.kernels.packing import packed

    networks = [part for part in levels_of(field)[: field.resolve_level(level) + 1] if isinstance(part, Siren)]
    taper = field.taper if isinstance(field, MultiscaleSDF) else 0.0
    return Levels.of([packed(network) for network in networks], field.deltas, taper)


def choose_levels(levels: Sequence[Field], x: Tensor, *, jet: bool) -> Choice:
    """How levels, coarse to fine, are evaluated together at points ``x`` without a graph: see `kernels.switch`."""
    networks = [level for level in levels if isinstance(level, Siren)]
    if len(networks) < len(levels):
        return Choice(False, "a level is no SIREN")
    if any((network.like.dtype, network.like.device) != (x.dtype, x.device) for network in networks):
        return Choice(False, "points and networks differ in precision or device; PyTorch reports it")
    return choose(
        x,
        width=max(network.width for network in networks),
        depth=max(network.depth for network in networks),
        features=networks[0].num_features if jet else 0,
        levels=len(networks),
    )


def walk_levels(
    levels: Sequence[Field],
    deltas: Tensor,
    x: Tensor,
    evaluate: Callable[[Field, Tensor], Parts],
    join: Callable[[Parts, Parts, Tensor], Parts],
) -> Iterator[Parts]:
    """Evaluate level after level, each once, and only at the points in every band before it.

    ``evaluate`` maps a level and points ``(M, d)`` to the parts of its jet, ``(M, …)`` each, the value first. ``join``
    maps the parts so far, those of the next level at the same points, and δ to the new parts. Yields the parts ``(...,
    …)`` after each level; outside the band before it, a level changes nothing.
    """

    def shaped(parts: Parts) -> Parts:
        return tuple(part.reshape((*x.shape[:-1], *part.shape[1:])) for part in parts)

    points = x.reshape(-1, x.shape[-1])
    parts = evaluate(levels[0], points)
    yield shaped(parts)
    shapes = current_shapes()
    if shapes is not None:
        yield from map(shaped, _walk_on(levels[1:], deltas, points, parts, evaluate, join, shapes))
        return
    if under_vmap():  # every level everywhere: which rows are in a band differs from call to call
        inside = torch.ones_like(parts[0], dtype=torch.bool)
        for level, delta in zip(levels[1:], deltas, strict=False):
            inside = inside & (parts[0].abs() < delta)
            joined = join(parts, evaluate(level, points), delta)
            parts = _where(inside, joined, parts)
            yield shaped(parts)
        return
    rows = torch.arange(len(points), device=points.device)
    for level, delta in zip(levels[1:], deltas, strict=False):
        kept = (parts[0][rows].abs() < delta).nonzero()[:, 0]
        points, rows = points[kept], rows[kept]
        joined = join(tuple(part[rows] for part in parts), evaluate(level, points), delta)
        parts = tuple(part.index_copy(0, rows, new) for part, new in zip(parts, joined, strict=True))
        yield shaped(parts)


def _walk_on(
    residuals: Sequence[Field],
    deltas: Tensor,
    points: Tensor,
    parts: Parts,
    evaluate: Callable[[Field, Tensor], Parts],
    join: Callable[[Parts, Parts, Tensor], Parts],
    shapes: FixedShapes,
) -> Iterator[Parts]:
    """The walk from the base on inside `fixed_shapes`."""
    shapes.begin()
    count = len(points)
    inside = torch.ones_like(parts[0], dtype=torch.bool) if shapes.mask is None else shapes.mask
    for index, (level, delta) in enumerate(zip(residuals, deltas, strict=False)):
        inside, rows = shapes.admit(index, inside & (parts[0].abs() < delta))
        if rows is None:
            joined = join(parts, evaluate(level, points), delta)
            parts = _where(inside, joined, parts)
        else:
            band = Rows(rows, count, full=False)  # surplus places evaluate the last point,
            joined = join(tuple(map(band.of, parts)), evaluate(level, band.of(points)), delta)
            parts = tuple(
                torch.cat((part, part[:1])).index_copy(0, rows, new)[:count]  # and their values are cut off
                for part, new in zip(parts, joined, strict=True)
            )
        yield parts


def _where(inside: Tensor, new: Parts, old: Parts) -> Parts:
    """The new parts in rows that are ``inside`` ``(N,)``, the old ones elsewhere."""
    pairs = zip(new, old, strict=True)
    return tuple(torch.where(inside.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs)


def _mask() -> Tensor | None:
    """The mask of points that bands admit inside `fixed_shapes`; one launch has capacity for all of them."""
    shapes = current_shapes()
    if shapes is None:
        return None
    shapes.begin()
    return shapes.mask


def _value(level: Field, points: Tensor) -> Parts:
    return (level.value(points),)


def fit_sphere(
    network: Siren, radius: float = 0.5, *, steps: int = 200, batch: int = 1024, learning_rate: float = 3e-3
) -> None:
    """Train a SIREN in place to |x| − radius on the unit ball, for training from images; a few seconds on a CPU.

    torch's random state is used; units stay as they were. The weights are small enough for hosts without a warm-up.

    Args:
        network: the coarse level.
        radius: of the sphere.
        steps: of Adam, its rate falling linearly.
        batch: points per step.
        learning_rate: the first rate.

    Raises:
        ValueError: the radius is not positive.
    """
    positive(radius=radius)
    units = network.units
    network.set_units()  # else the rate would mean something else
    place = network.output.weight
    adam = torch.optim.Adam(network.parameters(), lr=learning_rate, betas=(0.9, 0.99))
    for step in range(steps):
        direction = nn.functional.normalize(torch.randn(batch, network.in_dim).to(place), dim=1)
        lengths = 1.05 * torch.rand(batch, 1).to(place)  # a little further out than the unit sphere
        jet = network.jet(direction * lengths)
        data = data_loss(jet.value, lengths[:, 0] - radius)
        # Squared distances weigh 100, beside cosines and slopes of order one.
        loss = 100.0 * data + normal_loss(jet.gradient, direction) + eikonal_loss(jet.gradient)
        for group in adam.param_groups:
            group["lr"] = learning_rate * (1 - step / steps)
        adam.zero_grad(set_to_none=True)
        loss.mean().backward()
        adam.step()
    network.set_units(*units)
