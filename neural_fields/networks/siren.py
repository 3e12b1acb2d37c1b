"""SIREN, the sinusoidal MLP of the paper's Eq. 2, with its value and its analytic jet.

With ω₀ folded into weights and biases (W ← ω₀W, b ← ω₀b) a network of d sine layers is

    z_i = W_i h_{i-1} + b_i,   h_i = sin z_i,   h_0 = x,   f(x) = W_out h_d + b_out

and, since f is a scalar, one sweep back through the same matrices gives its whole gradient:

    g_d = w_out,   s_i = g_i ⊙ cos z_i,   g_{i-1} = s_i W_i,   ∇f = g_0.

That is one matrix product per layer, where the paper's Algorithm 1 pushes three tangents forward. Rows are taken in
blocks small enough for their activations to stay in cache.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ..backend.devices import Step, is_traced, over_blocks, uncompiled
from ..backend.errors import at_least, positive
from ..backend.kernels.switch import choose
from ..fields.field import Jet, OneLevelField, SecondJet

# Floats per activation matrix of one block: 1 MiB, so that those of a block fit the second- and third-level caches of
# CPUs (`python -m benchmarks normals`); on a GPU blocks only bound the memory.
BLOCK_FLOATS, GPU_BLOCK_FLOATS = 1 << 18, 1 << 27
GRAPH_BLOCK_FACTOR = 8  # larger blocks while a graph is recorded, which keeps every activation anyway


class Siren(OneLevelField):
    """A signed distance (or a residual of one) as a sinusoidal MLP: the paper's (width, depth).

    Initialised as in Sitzmann et al. 2020: first layer U(±1/d), the others U(±√(6/width)/ω₀).

    Args:
        width: neurons in each sine layer.
        depth: number of sine layers, at least 1; (128, 2) has 17,153 parameters in three dimensions.
        omega: the frequency ω₀ of Eq. 2.
        in_dim: dimension of the domain.
        num_features: extra outputs F beside the value, returned in ``Jet.features``.
        output_gain: factor on the initial output weights; a residual starts small with 0.1.
        feature_gain: the same for the features; with ω₀ they begin with unit variance.

    Attributes:
        units: of the sine layers' parameters and of the output's; see `set_units`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Siren
        >>> jet = Siren(128, 2, omega=30.0).jet(torch.zeros(5, 3))
        >>> jet.value.shape, jet.gradient.shape
        (torch.Size([5]), torch.Size([5, 3]))
    """

    defined_by = ("width", "depth", "omega", "in_dim", "num_features")

    def __init__(
        self,
        width: int,
        depth: int,
        *,
        omega: float = 30.0,
        in_dim: int = 3,
        num_features: int = 0,
        output_gain: float = 1.0,
        feature_gain: float = 1.0,
    ) -> None:
        super().__init__(in_dim)
        at_least(1, width=width, depth=depth, in_dim=in_dim)
        at_least(0, num_features=num_features)
        positive(omega=omega)
        self.width, self.depth, self.omega, self.num_features = width, depth, float(omega), num_features
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise([in_dim] + [width] * depth))
        self.output = nn.Linear(width, 1 + num_features)
        self.units = (1.0, 1.0)
        self._initialise(output_gain, feature_gain)
        self.register_state_dict_post_hook(_without_units)
        self.register_load_state_dict_pre_hook(_into_units)

    @torch.no_grad()
    def _initialise(self, output_gain: float, feature_gain: float) -> None:
        for index, layer in enumerate([*self._sine_layers(), self.output]):
            fan_in = layer.in_features
            bound = 1 / fan_in if index == 0 else math.sqrt(6 / fan_in) / self.omega
            layer.weight.uniform_(-bound, bound)
            layer.bias.uniform_(-bound, bound)
        for rows, gain in ((slice(0, 1), output_gain), (slice(1, None), feature_gain)):
            self.output.weight[rows] *= gain
            self.output.bias[rows] *= gain

    @torch.no_grad()
    def set_units(self, sines: float = 1.0, output: float = 1.0) -> None:
        """Keep the parameters in other units: their numbers change, the function and its jets do not, bit for bit.

        A weight W is stored as W / unit. Adam moves a stored number by the learning rate, and so W by unit times as
        much: layers that need different rates can share one. State dicts hold W, whatever the units.

        Args:
            sines: unit of the sine layers' weights and biases, a power of two.
            output: unit of the output's.

        Raises:
            ValueError: a unit is not a power of two, so that numbers would be rounded.
        """
        for name, unit in (("sines", sines), ("output", output)):
            if not 0 < unit < math.inf or math.frexp(unit)[0] != 0.5:
                raise ValueError(f"{name}={unit}: expected a power of two")
        before = dict(self._unit_of_each())
        self.units = (float(sines), float(output))
        for name, unit in self._unit_of_each():
            self.get_parameter(name).mul_(before[name] / unit)

    def _unit_of_each(self) -> Iterator[tuple[str, float]]:
        """The parameters by name, each with its unit."""
        for name, _ in self.named_parameters():
            yield name, self.units[name.startswith("output.")]

    @uncompiled
    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`; ``x`` may have any leading shape, N = 0 included."""
        return self._outputs(x, level, 1)[:, 0].reshape(x.shape[:-1])

    @uncompiled
    def value_features(self, x: Tensor, *, level: int = -1) -> tuple[Tensor, Tensor]:
        """See `Field.value_features`; as many products as a value costs."""
        output, shape = self._outputs(x, level, 1 + self.num_features), x.shape[:-1]
        return output[:, 0].reshape(shape), output[:, 1:].reshape(*shape, self.num_features)

    def _outputs(self, x: Tensor, level: int, channels: int) -> Tensor:
        """The first outputs ``(N, channels)`` at points ``(..., d)``."""
        self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, self.in_dim)
        if is_traced():
            return forward(rows, self.folded())[0][:, :channels]
        parameters = list(self.parameters())
        sizes = {"width": self.width, "depth": self.depth, "features": channels - 1}
        if not needs_graph(rows, parameters) and choose(rows, **sizes).fused:
            from ..backend.kernels.packing import packed
            from ..backend.kernels.siren import siren_value

            return siren_value(rows, packed(self))[:, None]
        parameters = self.folded()
        if needs_graph(rows, parameters):
            return forward(rows, parameters)[0][:, :channels]
        output = rows.new_empty(len(rows), channels)

        def prepare(size: int) -> Step:
            buffers = [rows.new_empty(size, self.width) for _ in range(2)]
            return lambda part: _outputs_into(output[part], rows[part], parameters, buffers)

        over_blocks(len(rows), block_rows(self.width, rows.device), prepare, like=rows)
        return output

    @uncompiled
    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; the gradient comes from one reverse sweep of matrix products, without autograd.

        Differentiable any number of times with respect to ``x`` and the parameters; the first derivative is written out
        by hand and costs four more passes.
        """
        self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, self.in_dim)
        if is_traced():
            output, gradients = plain_jet(rows, self.folded(), 1)
            return _shaped(x, output, gradients[:, 0])
        if choose(rows, width=self.width, depth=self.depth, features=self.num_features).fused:
            value, gradient = self._fused_jet(rows)
            return _shaped(x, value[:, None], gradient)
        parameters = self.folded()
        if needs_graph(rows, parameters):
            size = GRAPH_BLOCK_FACTOR * block_rows(self.width, rows.device)
            parts = [_SirenJet.apply(part, *parameters) for part in rows.split(size)]
            output, gradient = parts[0] if len(parts) == 1 else map(torch.cat, zip(*parts, strict=True))
        else:
            output = rows.new_empty(len(rows), 1 + self.num_features)
            gradient = torch.empty_like(rows, memory_format=torch.contiguous_format)

            def prepare(size: int) -> Step:
                buffers = [rows.new_empty(size, self.width) for _ in range(self.depth + 2)]
                return lambda part: _jet_into(output[part], gradient[part], rows[part], parameters, buffers)

            over_blocks(len(rows), block_rows(self.width, rows.device), prepare, like=rows)
        return _shaped(x, output, gradient)

    def _fused_jet(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Value and gradient by the fused kernels, on the graph if one is recorded."""
        from ..backend.kernels.packing import packed
        from ..backend.kernels.siren import siren_jet

        parameters = self.raw()
        if needs_graph(rows, parameters):
            return _FusedJet.apply(rows, self.omega * self.units[0], self.units[1], *parameters)
        return siren_jet(rows, packed(self))

    @uncompiled
    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        """See `Field.second_jet`; one tangent forward for each of the ``dims`` coordinates, without autograd.

        With ∂z_i/∂x_a the tangents of the pre-activations and g_i the sweep back,
        ∂²f/∂x_a∂x_b = −Σ_i ⟨g_i ⊙ sin z_i, ∂z_i/∂x_a ⊙ ∂z_i/∂x_b⟩.
        """
        self.resolve_level(level)
        dims = self.resolve_dims(dims)
        rows = self.check_points(x).reshape(-1, self.in_dim)
        parameters = self.folded()
        size = block_rows(self.width, rows.device) * (GRAPH_BLOCK_FACTOR if needs_graph(rows, parameters) else 1)
        parts = [_plain_second_jet(part, parameters, dims) for part in rows.split(size)]
        output, gradient, hessian = (torch.cat(part) for part in zip(*parts, strict=True))
        return SecondJet(*_shaped(x, output, gradient), hessian.reshape(*x.shape[:-1], dims, dims))

    def check_points(self, x: Tensor) -> Tensor:
        """See `Field.check_points`; ValueError too for another device, TypeError for another precision."""
        super().check_points(x)
        like = self.output.weight
        if x.device != like.device:
            raise ValueError(f"x is on {x.device}, the network on {like.device}; bring them together: x.to(field.like)")
        if x.dtype != like.dtype and not torch.is_autocast_enabled(x.device.type):
            raise TypeError(f"x is {x.dtype}, the network {like.dtype}; bring them together: x.to(field.like)")
        return x

    def folded(self) -> list[Tensor]:
        """Weights and biases with units and ω₀ folded in: [W_1, b_1, …, W_d, b_d, W_out, b_out]."""
        return fold(self.raw(), self.omega * self.units[0], self.units[1])

    def raw(self) -> list[Tensor]:
        """Weights and biases as they are stored: [W_1, b_1, …, W_out, b_out]."""
        return [part for layer in (*self._sine_layers(), self.output) for part in (layer.weight, layer.bias)]

    def _sine_layers(self) -> Iterator[nn.Linear]:
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            yield layer


def _shaped(x: Tensor, output: Tensor, gradient: Tensor) -> Jet:
    """The jet at ``x`` ``(..., d)`` from outputs ``(N, 1 + F)`` and gradients ``(N, d)``."""
    shape = x.shape[:-1]
    features = output[:, 1:].reshape(*shape, output.shape[1] - 1)
    return Jet(output[:, 0].reshape(shape), gradient.reshape(x.shape), features)


def block_rows(width: int, device: torch.device) -> int:
    """Rows of one block on ``device`` for networks of this width."""
    return max(256, (BLOCK_FLOATS if device.type == "cpu" else GPU_BLOCK_FLOATS) // width)


def fold(parameters: Sequence[Tensor], frequency: float, out: float) -> list[Tensor]:
    """The sine layers' weights and biases times ``frequency``, the output's times ``out``."""
    folded = [parameter * frequency for parameter in parameters[:-2]]
    # The sweep back ends in a product with three columns; BLAS does it three times faster if they are contiguous.
    folded[0] = folded[0].t().contiguous().t()
    last = parameters[-2:]
    return [*folded, *(last if out == 1 else [part * out for part in last])]


def needs_graph(x: Tensor, parameters: Sequence[Tensor]) -> bool:
    """Whether autograd records an evaluation at ``x`` with these parameters."""
    return torch.is_grad_enabled() and (x.requires_grad or any(p.requires_grad for p in parameters))


def forward(x: Tensor, parameters: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Outputs ``(N, 1 + F)``, then sine and pre-activation of every layer, in plain differentiable operations."""
    h, sines, phases = x, [], []
    for weight, bias in zip(parameters[0:-2:2], parameters[1:-2:2], strict=True):
        phases.append(torch.addmm(bias, h, weight.t()))
        h = phases[-1].sin()
        sines.append(h)
    return torch.addmm(parameters[-1], h, parameters[-2].t()), sines, phases


def plain_jet(x: Tensor, parameters: Sequence[Tensor], channels: int) -> tuple[Tensor, Tensor]:
    """Outputs, and the Jacobian ``(N, channels, d)`` of the first of them, by sweeps back that are rows of one matrix.

    In plain operations, which autograd can differentiate any number of times.
    """
    output, _, phases = forward(x, parameters)
    g = parameters[-2][:channels].expand(len(x), -1, -1)  # (N, channels, width)
    for weight, phase in zip(reversed(parameters[0:-2:2]), reversed(phases), strict=True):
        g = (g * phase.cos()[:, None]).flatten(0, 1) @ weight
        g = g.reshape(len(x), channels, weight.shape[1])
    return output, g


def _plain_second_jet(x: Tensor, parameters: Sequence[Tensor], dims: int) -> tuple[Tensor, Tensor, Tensor]:
    """Outputs, gradient and the Hessian by the first ``dims`` coordinates, in plain differentiable operations."""
    output, sines, phases = forward(x, parameters)
    weights, cosines = parameters[0:-2:2], [phase.cos() for phase in phases]
    g, bends = parameters[-2][:1].expand(len(x), -1), []
    for weight, sine, cosine in zip(reversed(weights), reversed(sines), reversed(cosines), strict=True):
        bends.append(-g * sine)
        g = (g * cosine) @ weight

    # In the first layer the tangents are columns of the weights, the same at every point.
    columns = weights[0][:, :dims]
    products = (columns[:, :, None] * columns[:, None, :]).flatten(1)
    hessian = (bends.pop() @ products).reshape(-1, dims, dims)
    tangents = columns.t()[:, None]  # (dims, 1, width)
    for weight, cosine in zip(weights[1:], cosines, strict=False):
        tangents = (tangents * cosine) @ weight.t()  # (dims, N, width)
        bend = bends.pop()
        pairs = [[(bend * a * b).sum(dim=-1) for b in tangents[: index + 1]] for index, a in enumerate(tangents)]
        rows = [torch.stack([pairs[max(a, b)][min(a, b)] for b in range(dims)], dim=-1) for a in range(dims)]
        hessian = hessian + torch.stack(rows, dim=-2)
    return output, g, hessian


def _without_units(siren: Siren, state: dict[str, Any], prefix: str, metadata: object) -> None:
    """Put the weights W themselves into a state dict."""
    for name, unit in siren._unit_of_each():
        if unit != 1:
            state[prefix + name] = state[prefix + name] * unit


def _into_units(siren: Siren, state: dict[str, Any], prefix: str, *_: object) -> None:
    """Convert the weights of a state dict to the units of this network."""
    for name, unit in siren._unit_of_each():
        if unit != 1 and prefix + name in state:
            state[prefix + name] = state[prefix + name] / unit


def _outputs_into(output: Tensor, x: Tensor, parameters: Sequence[Tensor], buffers: Sequence[Tensor]) -> None:
    """Write the first outputs of one block into ``output`` ``(N, channels)``, alternating between two buffers."""
    h, channels = x, output.shape[1]
    for index in range(len(parameters) // 2 - 1):
        z = buffers[index % 2][: len(x)]
        h = torch.addmm(parameters[2 * index + 1], h, parameters[2 * index].t(), out=z).sin_()
    if channels == 1:
        torch.addmv(parameters[-1][:1].expand(len(x)), h, parameters[-2][0], out=output[:, 0])
    else:
        torch.addmm(parameters[-1][:channels], h, parameters[-2][:channels].t(), out=output)


def _jet_into(
    output: Tensor, gradient: Tensor, x: Tensor, parameters: Sequence[Tensor], buffers: Sequence[Tensor]
) -> None:
    """Write outputs and gradient of one block; the last two buffers hold sines going up and g going down."""
    depth = len(parameters) // 2 - 1
    cosines = [buffer[: len(x)] for buffer in buffers[:depth]]
    up, down = buffers[-2][: len(x)], buffers[-1][: len(x)]
    h = x
    for index, cosine in enumerate(cosines):
        # The pre-activation lands where the sine is not being read from, then splits into its sine and cosine.
        z = (up, down)[index % 2]
        torch.addmm(parameters[2 * index + 1], h, parameters[2 * index].t(), out=z)
        torch.cos(z, out=cosine)
        h = z.sin_()
    torch.addmm(parameters[-1], h, parameters[-2].t(), out=output)
    s = cosines[-1].mul_(parameters[-2][0])
    for index in range(depth - 1, 0, -1):
        s = torch.mm(s, parameters[2 * index], out=(up, down)[index % 2])
        s.mul_(cosines[index - 1])
    torch.mm(s, parameters[0], out=gradient)


class _SirenJet(torch.autograd.Function):
    """Outputs and gradient of a SIREN, with the derivative of both written out.

    Let ō and ḡ be the cotangents of outputs and gradient. The reverse sweep is linear in ḡ, so its adjoint is one
    forward sweep of a single tangent: u_0 = ḡ, u_i = (u_{i-1} W_iᵀ) ⊙ cos z_i. The value's adjoint is the usual
    backward pass, with −(u_{i-1} W_iᵀ) ⊙ g_i ⊙ sin z_i added on the way. Both halves of a weight's gradient, s_iᵀ
    u_{i-1} and z̄_iᵀ h_{i-1}, are accumulated in one buffer.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        depth, width = len(parameters) // 2 - 1, parameters[-2].shape[1]
        output = x.new_empty(len(x), len(parameters[-1]))
        gradient = torch.empty_like(x, memory_format=torch.contiguous_format)
        # Sines, cosines, s and g of every layer; the last g is the output's weights at every point.
        kept = [[x.new_empty(len(x), width) for _ in range(depth)] for _ in range(3)]
        kept.append([x.new_empty(len(x), width) for _ in range(depth - 1)])
        g_rows = [gradient, *kept[3], parameters[-2][:1].expand(len(x), -1)]

        def step(part: slice) -> None:
            sines, cosines, s_rows = ([rows[part] for rows in layers] for layers in kept[:3])
            h = x[part]
            for index in range(depth):
                z = torch.addmm(parameters[2 * index + 1], h, parameters[2 * index].t(), out=sines[index])
                torch.cos(z, out=cosines[index])
                h = z.sin_()
            torch.addmm(parameters[-1], h, parameters[-2].t(), out=output[part])
            for index in range(depth - 1, -1, -1):
                torch.mul(g_rows[index + 1][part], cosines[index], out=s_rows[index])
                torch.mm(s_rows[index], parameters[2 * index], out=g_rows[index][part])

        over_blocks(len(x), block_rows(width, x.device), lambda _: step, like=x)
        ctx.save_for_backward(x, *parameters, *itertools.chain(*kept))
        return output, gradient

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        x, depth = saved[0], len(ctx.needs_input_grad) // 2 - 1
        parameters = saved[1 : 2 * depth + 3]
        if torch.is_grad_enabled():
            output, jacobian = plain_jet(x, parameters, 1)
            return _differentiable_backward(
                ctx.needs_input_grad, (x, *parameters), (output, jacobian[:, 0]), cotangents
            )
        kept = saved[2 * depth + 3 :]
        output_bar, gradient_bar = cotangents
        # Autograd materialises cotangents that are not needed too.
        assert output_bar is not None
        assert gradient_bar is not None
        g_out = parameters[-2][:1].expand(len(x), -1)
        given = (output_bar, gradient_bar, x, *kept, g_out)
        x_bar = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        size = block_rows(parameters[-2].shape[1], x.device)
        # Sums over points are made of 16 parts, in their order: the same bits for any number of threads.
        share = max(size, -(-len(x) // 16))
        starts = range(0, len(x), share)
        bars = [torch.zeros(len(starts), *parameter.shape, dtype=x.dtype, device=x.device) for parameter in parameters]

        def prepare(_: int) -> Step:
            buffers = [x.new_empty(min(size, len(x)), width) for width in [parameters[-2].shape[1]] * (depth + 2)]

            def step(share_of: slice) -> None:
                for number in range(share_of.start, share_of.stop):
                    own = [bar[number] for bar in bars]
                    stop = min(starts[number] + share, len(x))
                    for start in range(starts[number], stop, size):
                        part = slice(start, min(start + size, stop))
                        rows = [tensor[part] for tensor in given]
                        _add_bars(own, None if x_bar is None else x_bar[part], rows, parameters, buffers)

            return step

        over_blocks(len(starts), 1, prepare, like=x)
        return (x_bar, *(bar.sum(dim=0) for bar in bars))


def _add_bars(
    bars: Sequence[Tensor],
    x_bar: Tensor | None,
    rows: Sequence[Tensor],
    parameters: Sequence[Tensor],
    buffers: Sequence[Tensor],
) -> None:
    """Add one block's share to the cotangents of the parameters, and write those of its points."""
    output_bar, gradient_bar, x = rows[:3]
    depth = len(parameters) // 2 - 1
    sines, cosines, s_rows, g_rows = (rows[3 + i * depth : 3 + (i + 1) * depth] for i in range(4))
    weights = parameters[0:-2:2]
    carried, (u_row, spare) = [b[: len(x)] for b in buffers[:depth]], [b[: len(x)] for b in buffers[depth:]]

    # Adjoint of the reverse sweep: one tangent forward.
    u = gradient_bar
    for index, v in enumerate(carried):
        torch.addmm(bars[2 * index], s_rows[index].t(), u, out=bars[2 * index])
        torch.mm(u, weights[index].t(), out=v)
        u = torch.mul(v, cosines[index], out=u_row)
        v.mul_(g_rows[index]).mul_(sines[index])
    torch.addmm(bars[-2], output_bar.t(), sines[-1], out=bars[-2])
    bars[-2][0] += u.sum(dim=0)
    bars[-1].add_(output_bar.sum(dim=0))

    # Adjoint of the value: the usual backward pass.
    h_bar = torch.mm(output_bar, parameters[-2], out=spare)
    for index in range(depth - 1, -1, -1):
        z_bar = h_bar.mul_(cosines[index]).sub_(carried[index])
        torch.addmm(bars[2 * index], z_bar.t(), sines[index - 1] if index else x, out=bars[2 * index])
        bars[2 * index + 1].add_(z_bar.sum(dim=0))
        if index:
            h_bar = torch.mm(z_bar, weights[index], out=u_row if z_bar is spare else spare)
        elif x_bar is not None:
            torch.mm(z_bar, weights[0], out=x_bar)


class _FusedJet(torch.autograd.Function):
    """Value and gradient of a SIREN of one output, and its backward pass, by fused kernels in IEEE float32."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, omega: float, gain: float, *parameters: Tensor) -> tuple[Tensor, Tensor]:
        from ..backend.kernels.launch import Network
        from ..backend.kernels.training import jet

        ctx.numbers = omega, gain
        ctx.save_for_backward(x, *parameters)
        return jet(x, Network.of(parameters, omega, gain))

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        from ..backend.kernels.launch import Network
        from ..backend.kernels.training import jet_backward

        (omega, gain), (x, *parameters) = ctx.numbers, ctx.saved_tensors
        value_bar, gradient_bar = cotangents
        assert value_bar is not None
        assert gradient_bar is not None
        if torch.is_grad_enabled():
            needed = [ctx.needs_input_grad[0], *ctx.needs_input_grad[3:]]
            output, jacobian = plain_jet(x, fold(parameters, omega, gain), 1)
            outputs = output[:, 0], jacobian[:, 0]
            x_bar, *own = _differentiable_backward(needed, (x, *parameters), outputs, cotangents)
        else:
            x_bar, own = jet_backward(x, Network.of(parameters, omega, gain), value_bar, gradient_bar)
        return x_bar, None, None, *own


def _differentiable_backward(
    needed: Sequence[bool], inputs: Sequence[Tensor], outputs: Sequence[Tensor], cotangents: Sequence[Tensor | None]
) -> tuple[Tensor | None, ...]:
    """Cotangents of the inputs that need one, by autograd, which can differentiate them again."""
    chosen = [tensor for tensor, need in zip(inputs, needed, strict=True) if need]
    found = iter(torch.autograd.grad(outputs, chosen, cotangents, create_graph=True, materialize_grads=True))
    return tuple(next(found) if need else None for need in needed)
