"""BACON, the band-limited coordinate network of Lindell et al. 2022: a multiplicative filter network (their Eq. 2).

With filters g_i(x) = sin(Ω_i x + φ_i), whose frequencies Ω_i are drawn once and never trained,

    z_0 = g_0(x),   z_i = g_i(x) ⊙ (W_i z_{i-1} + b_i),   f_i(x) = w_i · z_i + c_i.

A product of sines is a sum of sines of the sums and differences of their frequencies. So z_i holds no frequency above
the sum of the filters' own, whatever the weights are. Since all frequencies are whole multiples of one, every output is
a Fourier series with a known number of terms. The gradient is one sweep back: with
a_i = W_i z_{i-1} + b_i and ζ_i the derivative of f by z_i,

    ∇f = Σ_i (ζ_i ⊙ a_i ⊙ cos(Ω_i x + φ_i)) Ω_i  (a_0 = 1),   ζ_{i-1} = (ζ_i ⊙ g_i) W_i.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from mplicits.neural_fields.backend.errors import at_least, positive
from mplicits.neural_fields.fields.field import Field, Jet
from torch import Tensor, nn

# The shapes experiments of the paper: 384 samples per period, their Nyquist harmonic 192 shared out as
# 1/24, 1/24, 1/24, 1/16, 1/16, 1/8, 1/8, 1/4, 1/4.
BANDS = (8, 8, 8, 12, 12, 24, 24, 48, 48)
OUTPUTS = (2, 4, 6, 8)
# The paper scales a shape's longest side to 0.9 periods.
PERIOD = 2 / 0.9
# Rows at a time, so that the activations of a block stay in the cache of a CPU.
BLOCK_ROWS = 2048


class BaconSDF(Field):
    """A multiplicative filter network with an output after some of its layers, coarse to fine.

    The outputs are alternatives, each one a field of its own everywhere: the bands around them are infinitely wide.

    Args:
        width: neurons per layer.
        bands: highest harmonic of each layer's filter, along each axis; one more than there are linear layers.
            Neighbouring layers with the same band share one filter, as in the published code.
        outputs: after which linear layers there is an output, counted from 1, in rising order.
        period: of the field along each axis; what is fitted must stay inside [-period / 2, period / 2]³.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> from benchmarks.peers import BaconSDF
        >>> field = BaconSDF()
        >>> field.num_levels, field.harmonics(level=0), field.harmonics(level=-1)
        (4, 24, 192)
    """

    defined_by = ("width", "bands", "outputs", "period")

    def __init__(
        self,
        width: int = 256,
        *,
        bands: Sequence[int] = BANDS,
        outputs: Sequence[int] = OUTPUTS,
        period: float = PERIOD,
    ) -> None:
        super().__init__()
        bands, outputs = tuple(bands), tuple(outputs)
        at_least(1, width=width)
        if len(bands) < 2 or min(bands) < 1:
            raise ValueError(f"bands={bands}: expected at least two whole numbers ≥ 1")
        if not outputs or any(a >= b for a, b in itertools.pairwise((0, *outputs, len(bands)))):
            raise ValueError(f"outputs={outputs}: expected rising numbers from 1 to {len(bands) - 1}")
        positive(period=period)
        self.in_dim, self.num_levels = 3, len(outputs)
        self.width, self.bands, self.outputs, self.period = width, bands, outputs, float(period)
        self.register_buffer("deltas", torch.full((len(outputs) - 1,), math.inf), persistent=False)
        # Which filter each layer uses, and the band of each filter.
        self.filter_of = list(itertools.accumulate((a != b for a, b in itertools.pairwise(bands)), initial=0))
        kept = [band for band, _ in itertools.groupby(bands)]
        harmonics = torch.stack([torch.randint(-band, band + 1, (width, 3)) for band in kept])
        self.frequencies: Tensor  # whole numbers, so that they survive any change of precision
        self.register_buffer("frequencies", harmonics.to(torch.get_default_dtype()))  # (filters, width, 3)
        self.phases = nn.Parameter((2 * torch.rand(len(kept), width) - 1) * math.pi)
        self.layers = nn.ModuleList(nn.Linear(width, width) for _ in bands[1:])
        self.heads = nn.ModuleList(nn.Linear(width, 1) for _ in outputs)
        for module in (*self.layers, *self.heads):
            assert isinstance(module, nn.Linear)
            nn.init.uniform_(module.weight, -math.sqrt(6 / width), math.sqrt(6 / width))

    def harmonics(self, *, level: int = -1) -> int:
        """Highest harmonic of the period that a level can hold, along each axis."""
        return sum(self.bands[: self.outputs[self.resolve_level(level)] + 1])

    def parameters_to(self, level: int) -> int:
        """How many trained numbers one level needs."""
        depth = self.outputs[self.resolve_level(level)]
        filters = self.filter_of[depth] + 1
        return filters * self.width + depth * (self.width + 1) * self.width + self.width + 1

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.level_values(x, level=level)[-1]

    def level_values(self, x: Tensor, *, level: int = -1) -> list[Tensor]:
        """See `Field.level_values`; all of them for the price of the finest."""
        level = self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, 3)
        parts = [self._outputs(part, level) for part in rows.split(BLOCK_ROWS)]
        return [torch.cat(blocks).reshape(x.shape[:-1]) for blocks in zip(*parts, strict=True)]

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; one sweep back through the layers."""
        level = self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, 3)
        parts = [self._jet(part, level) for part in rows.split(BLOCK_ROWS)]
        value, gradient = (torch.cat(part) for part in zip(*parts, strict=True))
        shape = x.shape[:-1]
        return Jet(value.reshape(shape), gradient.reshape(x.shape), rows.new_empty(*shape, 0))

    def _outputs(self, x: Tensor, level: int) -> list[Tensor]:
        """Every output up to ``level`` ``(N,)``."""
        angles = self._angles(x, self.outputs[level])
        sines = [angle.sin() for angle in angles]
        z, found = sines[0], []
        for index in range(1, self.outputs[level] + 1):
            z = sines[self.filter_of[index]] * self.layers[index - 1](z)
            if index in self.outputs:
                found.append(self.heads[len(found)](z)[:, 0])
        return found

    def _jet(self, x: Tensor, level: int) -> tuple[Tensor, Tensor]:
        depth = self.outputs[level]
        angles = self._angles(x, depth)
        sines = [angle.sin() for angle in angles]
        z, linear = sines[0], []
        for index in range(1, depth + 1):
            linear.append(self.layers[index - 1](z))
            z = sines[self.filter_of[index]] * linear[-1]
        head = self.heads[level]
        assert isinstance(head, nn.Linear)
        g = head.weight.expand(len(x), -1)
        # Cotangents of each filter's outputs, over all the layers that use it.
        bars = [torch.zeros_like(z) for _ in angles]
        for index in range(depth, 0, -1):
            which, layer = self.filter_of[index], self.layers[index - 1]
            assert isinstance(layer, nn.Linear)
            bars[which] = bars[which] + g * linear[index - 1]
            g = (g * sines[which]) @ layer.weight
        bars[0] = bars[0] + g
        slopes = [bar * angle.cos() for bar, angle in zip(bars, angles, strict=True)]
        gradient = sum((s @ omega for s, omega in zip(slopes, self.frequencies, strict=False)), torch.zeros_like(x))
        return head(z)[:, 0], gradient * (2 * math.pi / self.period)

    def _angles(self, x: Tensor, depth: int) -> list[Tensor]:
        """Arguments of the sines of the filters that the first ``depth`` linear layers need."""
        turns = x * (2 * math.pi / self.period)
        used = self.filter_of[depth] + 1
        return [torch.addmm(self.phases[i], turns, self.frequencies[i].t()) for i in range(used)]
