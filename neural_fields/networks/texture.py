"""Colour as a field over the band around a surface: the paper's texture network g (Sec. 3, "Texture mapping").

With ω₀ folded in as in `siren`, colour and its derivative along a direction v come from one pass of one tangent:

    z_i = W_i h_{i-1} + b_i,   h_i = sin z_i,           h_0 = x,   g(x) = W_out h_d + b_out
                               u_i = (W_i u_{i-1}) ⊙ cos z_i,   u_0 = v,   ∇g(x) v = W_out u_d
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..backend.errors import positive
from ..fields.field import Field, Jet, OneLevelField
from .siren import Siren, forward, needs_graph, plain_jet


class ColorSiren(nn.Module):
    """A SIREN with three outputs, defined everywhere and not limited to [0, 1].

    ``omega`` is ω₀ of Eq. 2, higher than for shapes; ``mean`` the RGB of the untrained network nearly everywhere.
    """

    def __init__(
        self, width: int, depth: int, *, omega: float = 60.0, in_dim: int = 3, mean: Sequence[float] = (0.5, 0.5, 0.5)
    ) -> None:
        super().__init__()
        self.siren = Siren(width, depth, omega=omega, in_dim=in_dim, num_features=2)
        with torch.no_grad():
            self.siren.output.bias.copy_(torch.tensor([float(channel) for channel in mean]))

    def value(self, x: Tensor) -> Tensor:
        """Colours at ``x`` ``(..., d)`` → ``(..., 3)``."""
        rows = self._rows(x)
        parameters = self.siren.folded()
        blocks = [rows] if needs_graph(rows, parameters) else self._blocks(rows)
        return torch.cat([forward(part, parameters)[0] for part in blocks]).reshape(*x.shape[:-1], 3)

    def jet(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Colours ``(..., 3)`` and their Jacobian ``(..., 3, d)`` at ``x`` ``(..., d)``, by sweeps back."""
        rows = self._rows(x)
        parameters = self.siren.folded()
        blocks = [rows] if needs_graph(rows, parameters) else self._blocks(rows)
        values, gradients = zip(*(plain_jet(part, parameters, 3) for part in blocks), strict=True)
        shape = (*x.shape[:-1], 3)
        return torch.cat(values).reshape(shape), torch.cat(gradients).reshape(*shape, x.shape[-1])

    def derivative_along(self, x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Colours and their derivative ``∇g(x) v``, both ``(..., 3)``, by one tangent forward.

        ``x`` and the directions v, of any length, are ``(..., d)``. Differentiable by parameters, ``x`` and
        ``direction``.
        """
        if direction.shape != x.shape:
            raise ValueError(f"direction has shape {tuple(direction.shape)}; expected that of x, {tuple(x.shape)}")
        rows, tangents = self._rows(x), self._rows(direction)
        parameters = self.siren.folded()
        pairs = [(rows, tangents)]
        if not needs_graph(rows, [tangents, *parameters]):
            pairs = zip(self._blocks(rows), self._blocks(tangents), strict=True)
        parts = [_tangent(part, along, parameters) for part, along in pairs]
        value, derivative = (torch.cat(both) for both in zip(*parts, strict=True))
        shape = (*x.shape[:-1], 3)
        return value.reshape(shape), derivative.reshape(shape)

    def _rows(self, x: Tensor) -> Tensor:
        return self.siren.check_points(x).reshape(-1, self.siren.in_dim)

    def _blocks(self, rows: Tensor) -> tuple[Tensor, ...]:
        """At least one block, so that no points are a legal number of points."""
        return rows.split(self.siren.block_rows(rows.device))


class TextureField(OneLevelField):
    """RGB in the band ``|f| < δ`` around a surface, a constant colour elsewhere.

    Colours are display numbers (sRGB-encoded) in [0, 1]: the network's output is clamped. Points outside the band are
    gathered away before the network is evaluated, for one value of the geometry per point; `colors` skips that test.

    Args:
        geometry: the field f whose surface has the colours; evaluated only, never trained here.
        network: g.
        delta: half-width δ of the band, in units of the field.
        geometry_level: the level of the geometry.
        outside: RGB outside the band.

    Raises:
        ValueError: an argument is out of range, or the dimensions of geometry and network differ.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere, TextureField
        >>> from mplicits.neural_fields.networks.texture import ColorSiren
        >>> texture = TextureField(Sphere(radius=0.5), ColorSiren(64, 2), delta=0.1)
        >>> texture.value(torch.tensor([0.9, 0.0, 0.0])).tolist()
        [0.5, 0.5, 0.5]
    """

    def __init__(
        self,
        geometry: Field,
        network: ColorSiren,
        *,
        delta: float,
        geometry_level: int = -1,
        outside: Sequence[float] = (0.5, 0.5, 0.5),
    ) -> None:
        super().__init__(geometry.in_dim)
        positive(delta=delta)
        if network.siren.in_dim != geometry.in_dim:
            raise ValueError(f"network: of {network.siren.in_dim} dimensions; the geometry has {geometry.in_dim}")
        color = torch.tensor([float(channel) for channel in outside])
        if color.shape != (3,) or not bool(((color >= 0) & (color <= 1)).all()):
            raise ValueError(f"outside={tuple(outside)}: expected three numbers from 0 to 1")
        self.geometry, self.network = geometry, network
        self.geometry_level = geometry.resolve_level(geometry_level)
        self.register_buffer("delta", torch.tensor(float(delta)))
        self.register_buffer("outside", color)
        self.delta: Tensor
        self.outside: Tensor

    def colors(self, x: Tensor) -> Tensor:
        """Colours at ``x`` ``(..., d)`` → ``(..., 3)``, in the band or not; the geometry is not evaluated."""
        return self.network.value(x).clamp(0, 1)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """Colours at ``x`` ``(..., d)`` → ``(..., 3)`` in [0, 1]."""
        rows, inside = self._inside(x, level)
        found = self._background(rows).index_copy(0, inside, self.colors(rows[inside]))
        return found.reshape(*x.shape[:-1], 3)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`: value ``(..., 3)``, gradient ``(..., 3, d)``, which is 0 outside the band."""
        rows, inside = self._inside(x, level)
        raw, slope = self.network.jet(rows[inside])
        value = self._background(rows).index_copy(0, inside, raw.clamp(0, 1))
        gradient = rows.new_zeros(len(rows), 3, self.in_dim)
        gradient = gradient.index_copy(0, inside, slope * _unclamped(raw)[..., None])
        shape = (*x.shape[:-1], 3)
        return Jet(value.reshape(shape), gradient.reshape(*shape, self.in_dim), x.new_empty((*x.shape[:-1], 0)))

    def derivative_along(self, x: Tensor, direction: Tensor, *, level: int = -1) -> tuple[Tensor, Tensor]:
        """Colours and their derivative along ``direction``, both ``(..., 3)``: see `ColorSiren.derivative_along`."""
        rows, inside = self._inside(x, level)
        if direction.shape != x.shape:
            raise ValueError(f"direction has shape {tuple(direction.shape)}; expected that of x, {tuple(x.shape)}")
        raw, slope = self.network.derivative_along(rows[inside], direction.reshape(rows.shape)[inside])
        value = self._background(rows).index_copy(0, inside, raw.clamp(0, 1))
        derivative = rows.new_zeros(len(rows), 3).index_copy(0, inside, slope * _unclamped(raw))
        shape = (*x.shape[:-1], 3)
        return value.reshape(shape), derivative.reshape(shape)

    @torch.no_grad()
    def in_band(self, x: Tensor, *, level: int = -1) -> Tensor:
        """Whether ``|f(x)| < δ`` → bool ``(...,)``: where there are colours."""
        self.resolve_level(level)
        return self.geometry.value(self.check_points(x), level=self.geometry_level).abs() < self.delta

    def _inside(self, x: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """The points as rows ``(N, d)``, and the indices of those in the band."""
        rows = self.check_points(x).reshape(-1, self.in_dim)
        return rows, self.in_band(rows, level=level).nonzero()[:, 0]

    def _background(self, rows: Tensor) -> Tensor:
        return self.outside.to(rows).expand(len(rows), 3)


def _unclamped(raw: Tensor) -> Tensor:
    """1 where clamping to [0, 1] changes nothing, 0 elsewhere: the derivative of the clamp."""
    return ((raw >= 0) & (raw <= 1)).to(raw.dtype)


def _tangent(x: Tensor, v: Tensor, parameters: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Outputs and derivative along ``v``, both ``(N, 3)``, in operations that autograd can differentiate."""
    h, u = x, v
    for weight, bias in zip(parameters[0:-2:2], parameters[1:-2:2], strict=True):
        z = torch.addmm(bias, h, weight.t())
        h, u = z.sin(), (u @ weight.t()) * z.cos()
    return torch.addmm(parameters[-1], h, parameters[-2].t()), u @ parameters[-2].t()
