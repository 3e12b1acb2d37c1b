"""The paper's multiscale SDF (Sec. 3.1): a base field plus residuals, each one only in the band before it.

f_0 is the base; f_{j+1} = f_j + γ(|f_j| / δ_j) r_j where every coarser level is inside its own band, and f_j
elsewhere. The gate γ lives here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from .field import Field, Jet, SecondJet
from .siren import Siren

__all__ = ["MultiscaleSDF"]


class MultiscaleSDF(Field):
    """Nested residual levels around the surface of a base field.

    Rows outside a band are gathered away before the residual sees them, so they cost nothing. The gate is
    the paper's hard one for ``taper=0``; otherwise it falls from 1 at ``(1 − taper) δ`` to 0 at δ as the
    cubic 1 − u²(3 − 2u), which makes value and gradient continuous for renderers that differentiate them.

    Args:
        base: level 0, defined everywhere.
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

    def __init__(
        self, base: Field, residuals: Sequence[Field], deltas: Sequence[float] | Tensor, *, taper: float = 0.0
    ) -> None:
        super().__init__()
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
            deltas: half-widths of the bands; unknown before training, by default 0.03 · 2⁻ʲ (the size the
                paper measures, suppl. "Measured adaptive band widths").
            taper: see the class.
            in_dim: dimension of the domain.
            num_features: extra outputs of every level; they begin with unit variance.
            residual_gain: factor on the residuals' initial output weights, so that a new level starts close to
                the one before it.

        Raises:
            ValueError: no sizes, or as many omegas or deltas are not given.
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
        return MultiscaleSDF(self.base, [*self._levels(self.num_levels - 1), residual], deltas, taper=self.taper)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`; outside the band of level j − 1, level j is level j − 1."""
        level = self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, self.in_dim)
        f = self.base.value(rows)
        inside = _Inside(rows)
        for residual, delta in zip(self._levels(level), self.deltas, strict=False):
            here = inside.narrow(f, delta)
            r = residual.value(inside.points)
            f = f.index_copy(0, inside.rows, here + r * self._gate(here, delta)[0])
        return f.reshape(x.shape[:-1])

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; inside a tapered band ∇(γr) = γ∇r + r γ′ ∇f."""
        level = self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, self.in_dim)
        f, gradient, features = self.base.jet(rows)
        inside = _Inside(rows)
        for residual, delta in zip(self._levels(level), self.deltas, strict=False):
            here = inside.narrow(f, delta)
            r = residual.jet(inside.points)
            gate, slope = self._gate(here, delta)
            grown = (1 + slope * r.value)[:, None] * gradient[inside.rows] + gate[:, None] * r.gradient
            f = f.index_copy(0, inside.rows, here + gate * r.value)
            gradient = gradient.index_copy(0, inside.rows, grown)
            features = features.index_copy(0, inside.rows, features[inside.rows] + gate[:, None] * r.features)
        shape = x.shape[:-1]
        return Jet(f.reshape(shape), gradient.reshape(x.shape), features.reshape(*shape, features.shape[-1]))

    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        """See `Field.second_jet`; inside a tapered band the product rule is applied twice."""
        level, dims = self.resolve_level(level), self.resolve_dims(dims)
        rows = self.check_points(x).reshape(-1, self.in_dim)
        f, gradient, features, hessian = self.base.second_jet(rows, dims=dims)
        inside = _Inside(rows)
        for residual, delta in zip(self._levels(level), self.deltas, strict=False):
            here = inside.narrow(f, delta)
            r = residual.second_jet(inside.points, dims=dims)
            gate, slope = self._gate(here, delta)
            steeper, before = 1 + slope * r.value, gradient[inside.rows]
            cross = before[:, :dims, None] * r.gradient[:, None, :dims]
            bend = (
                (self._gate_bend(here, delta) * r.value)[:, None, None]
                * before[:, :dims, None]
                * before[:, None, :dims]
            )
            bent = (
                steeper[:, None, None] * hessian[inside.rows]
                + gate[:, None, None] * r.hessian
                + slope[:, None, None] * (cross + cross.mT)
                + bend
            )
            f = f.index_copy(0, inside.rows, here + gate * r.value)
            gradient = gradient.index_copy(0, inside.rows, steeper[:, None] * before + gate[:, None] * r.gradient)
            features = features.index_copy(0, inside.rows, features[inside.rows] + gate[:, None] * r.features)
            hessian = hessian.index_copy(0, inside.rows, bent)
        shape = x.shape[:-1]
        return SecondJet(
            f.reshape(shape),
            gradient.reshape(x.shape),
            features.reshape(*shape, features.shape[-1]),
            hessian.reshape(*shape, dims, dims),
        )

    def in_band(self, x: Tensor, *, level: int) -> Tensor:
        """See `Field.in_band`; each level is evaluated only where the coarser ones allow it."""
        level = self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, self.in_dim)
        allowed = torch.ones(len(rows), dtype=torch.bool, device=x.device)
        if level:
            allowed = torch.zeros_like(allowed)
            f = self.base.value(rows)
            inside = _Inside(rows)
            for index, delta in enumerate(self.deltas[:level]):
                here = inside.narrow(f, delta)
                if index + 1 < level:
                    r = self.residuals[index].value(inside.points)  # pyright: ignore[reportCallIssue]
                    f = f.index_copy(0, inside.rows, here + r * self._gate(here, delta)[0])
            allowed[inside.rows] = True
        return allowed.reshape(x.shape[:-1])

    def _levels(self, count: int) -> Iterator[Field]:
        for residual in self.residuals[:count]:
            assert isinstance(residual, Field)
            yield residual

    def _gate(self, f: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
        """γ and dγ/df at values f inside the band."""
        if self.taper == 0:
            return torch.ones_like(f), torch.zeros_like(f)
        u = ((f.abs() / delta - (1 - self.taper)) / self.taper).clamp(0, 1)
        return 1 - u * u * (3 - 2 * u), -6 * u * (1 - u) * f.sign() / (delta * self.taper)

    def _gate_bend(self, f: Tensor, delta: Tensor) -> Tensor:
        """d²γ/df² at values f inside the band; 0 where the gate is fully open."""
        if self.taper == 0:
            return torch.zeros_like(f)
        u = (f.abs() / delta - (1 - self.taper)) / self.taper
        return torch.where((u > 0) & (u < 1), -6 * (1 - 2 * u) / (delta * self.taper) ** 2, 0.0)


class _Inside:
    """The rows of a batch that every band so far has let through."""

    def __init__(self, points: Tensor) -> None:
        self.points = points
        self.rows = torch.arange(len(points), device=points.device)

    def narrow(self, f: Tensor, delta: Tensor) -> Tensor:
        """Keep the rows with |f| < δ and return their f; ``f`` has a value for every row of the batch."""
        here = f[self.rows]
        kept = (here.abs() < delta).nonzero()[:, 0]
        self.points, self.rows = self.points[kept], self.rows[kept]
        return here[kept]
