"""Colour fields: with the direction of view and outside the unit sphere (NeuS, NeRF++), and over a surface's band.

The last is the paper's texture network g (Sec. 3, "Texture mapping"). With ω₀ folded in as in `siren`, colour and its
derivative along a direction v come from one pass of one tangent:

    z_i = W_i h_{i-1} + b_i,   h_i = sin z_i,           h_0 = x,   g(x) = W_out h_d + b_out
                               u_i = (W_i u_{i-1}) ⊙ cos z_i,   u_0 = v,   ∇g(x) v = W_out u_d
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..backend.errors import at_least, positive
from ..fields.field import Field, Jet, OneLevelField
from .grids import HashEncoding
from .siren import Siren, block_rows, forward, needs_graph, plain_jet


def encode(x: Tensor, frequencies: int) -> Tensor:
    """Positional encoding: x, sin 2ᵏx, cos 2ᵏx for k < K frequencies; ``(..., d)`` → ``(..., d (1 + 2 K))``."""
    phases = (x[..., None, :] * 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)[:, None]).flatten(-2)
    return torch.cat((x, phases.sin(), phases.cos()), dim=-1)


def encoded_size(dim: int, frequencies: int) -> int:
    """Number of outputs of `encode` for ``dim`` inputs."""
    return dim * (1 + 2 * frequencies)


class ColorNetwork(nn.Module):
    """Colour of a surface point from a viewing direction: NeuS's c(x, v, ∇f/|∇f|, features).

    The geometry enters only through its `Jet`, so any field works, at any level.

    Args:
        num_features: of the jet.
        width: neurons per hidden layer.
        depth: hidden layers.
        view_frequencies: octaves of the direction's encoding.
        point_frequencies: octaves of the position's encoding; 0 in NeuS.
        grid: a learnt encoding of the position beside it, or None.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import ColorNetwork, Siren
        >>> jet = Siren(32, 2, num_features=8).jet(torch.zeros(5, 3))
        >>> ColorNetwork(8, width=64)(torch.zeros(5, 3), torch.ones(5, 3), jet).shape
        torch.Size([5, 3])
    """

    def __init__(
        self,
        num_features: int,
        *,
        width: int = 256,
        depth: int = 4,
        view_frequencies: int = 4,
        point_frequencies: int = 0,
        grid: HashEncoding | None = None,
    ) -> None:
        super().__init__()
        at_least(1, width=width, depth=depth)
        at_least(0, num_features=num_features, view_frequencies=view_frequencies, point_frequencies=point_frequencies)
        self.num_features, self.width, self.depth = num_features, width, depth
        self.view_frequencies, self.point_frequencies = view_frequencies, point_frequencies
        self.grid = grid
        inputs = encoded_size(3, point_frequencies) + encoded_size(3, view_frequencies) + 3 + num_features
        inputs += 0 if grid is None else grid.size
        self.layers = nn.ModuleList(_relu_layers([inputs, *[width] * depth, 3]))

    def forward(self, x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
        """Colours ``(..., 3)`` in [0, 1].

        Args:
            x: ``(..., 3)`` points.
            direction: ``(..., 3)`` unit vectors, from the camera to the points.
            jet: of the geometry there, with ``num_features`` features; ValueError otherwise.
        """
        if jet.features.shape[-1] != self.num_features:
            raise ValueError(f"jet.features: {jet.features.shape[-1]} of them; expected {self.num_features}")
        normal = nn.functional.normalize(jet.gradient, dim=-1)
        inputs = [encode(x, self.point_frequencies), encode(direction, self.view_frequencies), normal, jet.features]
        if self.grid is not None:
            inputs.append(self.grid(x))
        return _relu_network(torch.cat(inputs, dim=-1), self.layers).sigmoid()


class BackgroundField(nn.Module):
    """Density and colour outside the unit sphere, over (x/r, 1/r): the outer network of NeRF++.

    Args:
        width: neurons per hidden layer.
        depth: hidden layers.
        point_frequencies: octaves of the encoding of (x/r, 1/r).
        view_frequencies: octaves of the encoding of the direction.
        grid: a learnt encoding beside it, or None; evaluated at (2 − 1/r) x/r, the contraction of mip-NeRF 360.
    """

    def __init__(
        self,
        *,
        width: int = 128,
        depth: int = 4,
        point_frequencies: int = 8,
        view_frequencies: int = 4,
        grid: HashEncoding | None = None,
    ) -> None:
        super().__init__()
        self.width, self.depth = width, depth
        self.point_frequencies, self.view_frequencies = point_frequencies, view_frequencies
        self.grid = grid
        inputs = encoded_size(4, point_frequencies) + (0 if grid is None else grid.size)
        self.trunk = nn.ModuleList(_relu_layers([inputs, *[width] * depth, 1 + width]))
        self.head = nn.ModuleList(_relu_layers([width + encoded_size(3, view_frequencies), width // 2, 3]))

    def forward(self, inverted: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``(...,)`` ≥ 0 per unit of length, and colour ``(..., 3)`` in [0, 1].

        ``inverted`` ``(..., 4)`` is from `volume.weights.invert_outside`; ``direction`` ``(..., 3)`` are unit vectors.
        """
        inputs = encode(inverted, self.point_frequencies)
        if self.grid is not None:
            contracted = (2 - inverted[..., 3:]) * inverted[..., :3]
            inputs = torch.cat((inputs, self.grid(contracted)), dim=-1)
        hidden = _relu_network(inputs, self.trunk)
        density = nn.functional.softplus(hidden[..., 0] - 1)
        color = _relu_network(torch.cat((hidden[..., 1:], encode(direction, self.view_frequencies)), dim=-1), self.head)
        return density, color.sigmoid()


@dataclass(frozen=True, eq=False)
class Radiance:
    """Everything `render_volume` needs besides a geometry."""

    color: ColorNetwork  # of the surface, by direction
    outside: BackgroundField | None  # field outside the unit sphere, or None
    background: Tensor  # (3,) display RGB in [0, 1] behind everything
    inv_std: float  # s of NeuS; 1/s is the uncertainty of the surface


def _relu_layers(sizes: list[int]) -> list[nn.Linear]:
    """Layers initialised for ReLU (He et al. 2015), biases 0; the last one small, so that colours begin grey."""
    layers = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
    with torch.no_grad():
        for layer in layers:
            layer.weight.normal_(0, math.sqrt(2 / layer.in_features))
            layer.bias.zero_()
        layers[-1].weight.mul_(0.1)
    return layers


def _relu_network(h: Tensor, layers: nn.ModuleList) -> Tensor:
    *hidden, last = layers
    for layer in hidden:
        h = layer(h).relu_()
    return last(h)


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
        return self._in_blocks(lambda rows, parameters: forward(rows, parameters)[:1], x)[0]

    def jet(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Colours ``(..., 3)`` and their Jacobian ``(..., 3, d)`` at ``x`` ``(..., d)``, by sweeps back."""
        value, jacobian = self._in_blocks(lambda rows, parameters: plain_jet(rows, parameters, 3), x)
        return value, jacobian

    def derivative_along(self, x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Colours and their derivative ``∇g(x) v``, both ``(..., 3)``, by one tangent forward.

        ``x`` and the directions v, of any length, are ``(..., d)``. Differentiable by parameters, ``x`` and
        ``direction``.
        """
        if direction.shape != x.shape:
            raise ValueError(f"direction has shape {tuple(direction.shape)}; expected that of x, {tuple(x.shape)}")
        value, derivative = self._in_blocks(_tangent, x, direction)
        return value, derivative

    def _in_blocks(self, evaluate: Callable[..., Sequence[Tensor]], *points: Tensor) -> list[Tensor]:
        """Results ``(..., ·)`` of ``evaluate(*rows, parameters)`` at points ``(..., d)``, in blocks if without a graph.

        There is at least one block, so that no points are a legal number of points.
        """
        rows = [self.siren.check_points(x).reshape(-1, self.siren.in_dim) for x in points]
        parameters = self.siren.folded()
        blocks = [rows]
        if not needs_graph(rows[0], [*rows[1:], *parameters]):
            size = block_rows(self.siren.width, rows[0].device)
            blocks = zip(*(part.split(size) for part in rows), strict=True)
        results = [evaluate(*block, parameters) for block in blocks]
        joined = [torch.cat(parts) for parts in zip(*results, strict=True)]
        return [whole.reshape(*points[0].shape[:-1], *whole.shape[1:]) for whole in joined]


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
        >>> from mplicits.neural_fields.networks.colors import ColorSiren
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
        return self._background(rows).index_copy(0, inside, self.colors(rows[inside])).reshape(*x.shape[:-1], 3)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`: value ``(..., 3)``, gradient ``(..., 3, d)``, which is 0 outside the band."""
        rows, inside = self._inside(x, level)
        raw, slope = self.network.jet(rows[inside])
        value = self._background(rows).index_copy(0, inside, raw.clamp(0, 1))
        gradient = rows.new_zeros(len(rows), 3, self.in_dim)
        free = ((raw >= 0) & (raw <= 1)).to(raw.dtype)  # the derivative of the clamp
        gradient = gradient.index_copy(0, inside, slope * free[..., None])
        shape = (*x.shape[:-1], 3)
        return Jet(value.reshape(shape), gradient.reshape(*shape, self.in_dim), x.new_empty((*x.shape[:-1], 0)))

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


def _tangent(x: Tensor, v: Tensor, parameters: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Outputs and derivative along ``v``, both ``(N, 3)``, in operations that autograd can differentiate."""
    h, u = x, v
    for weight, bias in zip(parameters[0:-2:2], parameters[1:-2:2], strict=True):
        z = torch.addmm(bias, h, weight.t())
        h, u = z.sin(), (u @ weight.t()) * z.cos()
    return torch.addmm(parameters[-1], h, parameters[-2].t()), u @ parameters[-2].t()
