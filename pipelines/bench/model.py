"""How long a picture would take on a GPU that is not here: a model of it, from counts and published rates.

Counted, while a picture is traced on the CPU: FLOPs of matrix products, sines, bytes that operations read and write,
operations (each one a launch) and places where the host has to wait for a result; apart for networks, for what marches
and levels do around them, and for the rest of a picture. Published: what the device multiplies and moves in a second.
With these

    T = max(device, host) + waits · `WAIT`,      host = launches · `LAUNCH`
    device = max(products / rate, their bytes / memory) + max(sines · `SINE` / float32, other bytes / memory) + around

for PyTorch, where each operation is a kernel, with the bytes around the networks / memory. Fused, a march is one
launch, and so is a `MultiscaleSDF` evaluated at points; what was around the networks happens inside, and only the rest
is launched and waits:

    device = max(products / rate + sines · `SINE` / float32, bytes / memory, chain) + rest / memory.

No kernel reaches the published rates, so these are bounds from below. The chain is what cannot be shared out: a ray
takes one step after the other, each a tile's evaluation on one multiprocessor, which has its share of the rates. It
is counted as if one ray were behind every pass of the march in which a level was evaluated at all, which is no less
than the longest ray needs. `LAUNCH` and `WAIT` are assumptions: the host of the one H100 that was tried took 23 µs for
a launch, and pictures took 8 to 15 times as long as this says of fused kernels (docs/accelerators.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from ...neural_fields import Field, Jet, MultiscaleSDF, _parallel, cones, levels_of, siren, tracing
from .tables import Column, Figure, Table, tabulated

__all__ = ["DEVICES", "Device", "FrameCounts", "Prediction", "count_frame", "model_table", "predict"]

LAUNCH = 5e-6  # seconds of the host for one PyTorch operation; a common figure, not measured here
WAIT = 15e-6  # seconds from the end of a kernel until the host has the result and the device work again; likewise
SINE = 40  # float32 operations of one sine of libdevice, as Triton's compiler writes it
SPLIT = 3  # products on tensor cores that make one with split operands (tf32x3)
POINT, VALUE, JET = 12, 4, 16  # bytes of a point, of a value, of a value and its gradient
# Bytes of a ray at a pass of `kernels/paths.py`, all from and into caches: where it stands, there and back, its origin
# and direction, its place on a ring; and where it is only handed on from a level to the next.
STANDS, HANDED_ON = 132, 44
LISTED = 16  # of a row on the list of a band in `kernels/levels.py`, there and back
TILE = 64  # rows

_aten = torch.ops.aten
_PRODUCTS = (_aten.mm, _aten.addmm, _aten.addmm_, _aten.addmv, _aten.addmv_, _aten.mv)
_SINES = (_aten.sin, _aten.sin_, _aten.cos, _aten.cos_)
_WAITS = (_aten.nonzero, _aten._local_scalar_dense)
_FREE = (_aten.empty, _aten.empty_like, _aten.new_empty, _aten.empty_strided, _aten.new_empty_strided)


@dataclass(frozen=True)
class Device:
    """A device by its published figures.

    Attributes:
        words: what it is called.
        float32: FLOP/s outside tensor cores.
        tensor: FLOP/s of tensor cores in TF32, dense; 0 without.
        memory: bytes a second.
        processors: multiprocessors, which share the rates.
        fused: whether the fused kernels run on it.
        source: of the figures.
    """

    words: str
    float32: float
    tensor: float
    memory: float
    processors: int
    fused: bool
    source: str


DEVICES: Mapping[str, Device] = MappingProxyType(
    {
        "h100": Device(
            "H100 SXM5", 66.9e12, 494.7e12, 3.35e12, 132, True, "NVIDIA, H100 architecture whitepaper, 2022"
        ),
        "a100": Device("A100 SXM 80 GB", 19.5e12, 156e12, 2.039e12, 108, True, "NVIDIA, A100 datasheet, 2021"),
        "4090": Device("RTX 4090", 82.6e12, 82.6e12, 1.008e12, 128, True, "NVIDIA, Ada architecture whitepaper, 2022"),
        "m2": Device("Apple M2, 10 GPU cores", 3.6e12, 0.0, 0.1e12, 10, False, "Apple, M2 announcement, 2022"),
    }
)


@dataclass(frozen=True)
class FrameCounts:
    """What one picture asks of a device.

    Attributes:
        pixels: of the picture.
        products: FLOPs of the networks' matrix products.
        product_bytes: that those read and write.
        sines: and cosines.
        other_bytes: of the networks' operations beside products.
        launches: operations of the networks.
        around_bytes: that marches, and gathers between levels, read and write.
        around_launches: their operations.
        around_waits: how often the host waits for them.
        rest_bytes: of all else.
        rest_launches: its operations.
        rest_waits: how often the host waits for it.
        calls: how many launches fused kernels make: one for each march, and for each field evaluated outside of any.
        fused_bytes: that those read and write.
        chain: FLOPs of products in tiles one after the other.
        chain_sines: sines of them.
    """

    pixels: int
    products: float
    product_bytes: float
    sines: float
    other_bytes: float
    launches: int
    around_bytes: float
    around_launches: int
    around_waits: int
    rest_bytes: float
    rest_launches: int
    rest_waits: int
    calls: int
    fused_bytes: float
    chain: float
    chain_sines: float


@dataclass(frozen=True)
class Prediction:
    """Seconds of a picture, and of what.

    Attributes:
        device: its work, or the longest ray.
        host: its launches, beside that.
        waits: after it.
        chained: whether the longest ray takes longer than the work.
    """

    device: float
    host: float
    waits: float
    chained: bool = False

    @property
    def seconds(self) -> float:
        """All of it."""
        return max(self.device, self.host) + self.waits

    @property
    def limit(self) -> str:
        """What takes longest."""
        parts = {"longest ray" if self.chained else "work": self.device, "launches": self.host, "waits": self.waits}
        return max(parts, key=lambda name: parts[name])


def predict(counts: FrameCounts, device: Device, *, fused: bool, split: bool = False) -> Prediction:
    """The model; see this module.

    Args:
        counts: of a picture.
        device: where it would be made.
        fused: by the fused kernels.
        split: with products on tensor cores, as three of TF32.

    Raises:
        ValueError: the device has no tensor cores, or cannot run the kernels.
    """
    if (fused and not device.fused) or (split and not device.tensor):
        raise ValueError(f"{device.words}: no {'tensor cores' if split and not device.tensor else 'fused kernels'}")
    rate = device.tensor / SPLIT if split else device.float32
    rest, chained = counts.rest_bytes / device.memory, False
    if fused:
        work = counts.products / rate + counts.sines * SINE / device.float32
        chain = device.processors * (counts.chain / rate + counts.chain_sines * SINE / device.float32)
        networks = max(work, counts.fused_bytes / device.memory)
        chained, networks = chain > networks, max(chain, networks)
        launches, waits = counts.rest_launches + counts.calls, counts.rest_waits
    else:
        networks = max(counts.products / rate, counts.product_bytes / device.memory)
        networks += max(counts.sines * SINE / device.float32, counts.other_bytes / device.memory)
        networks += counts.around_bytes / device.memory
        launches = counts.launches + counts.around_launches + counts.rest_launches
        waits = counts.around_waits + counts.rest_waits
    return Prediction(networks + rest, launches * LAUNCH, waits * WAIT, chained)


def count_frame(field: Field, draw: Callable[[Field], object], pixels: int) -> FrameCounts:
    """Count what a picture asks for.

    Args:
        field: on the CPU, of SIRENs.
        draw: makes the picture with the field that it is given.
        pixels: of the picture.
    """
    watch = _Watch()
    levels = [_Level(level, watch, first=not index) for index, level in enumerate(levels_of(field))]
    same: Field = levels[0]
    if isinstance(field, MultiscaleSDF):
        same = MultiscaleSDF(levels[0], levels[1:], field.deltas, taper=field.taper)
    with _blocks_of_a_gpu(), _regions(watch), watch:
        draw(same)
    network, around, rest = watch.of_networks, watch.around, watch.rest
    return FrameCounts(
        pixels=pixels,
        products=network.products,
        product_bytes=network.product_bytes,
        sines=network.sines,
        other_bytes=network.other_bytes,
        launches=network.launches,
        around_bytes=around.product_bytes + around.other_bytes,
        around_launches=around.launches,
        around_waits=network.waits + around.waits,
        rest_bytes=rest.product_bytes + rest.other_bytes,
        rest_launches=rest.launches,
        rest_waits=rest.waits,
        calls=watch.calls,
        fused_bytes=watch.fused_bytes,
        chain=watch.chain,
        chain_sines=watch.chain_sines,
    )


@dataclass
class _Tally:
    """Counts of one kind of work so far."""

    products: float = 0.0
    product_bytes: float = 0.0
    sines: float = 0.0
    other_bytes: float = 0.0
    launches: int = 0
    waits: int = 0


class _Watch(TorchDispatchMode):
    """Counts operations, by where they come from.

    Attributes:
        of_networks: what networks do.
        around: what marches and fields of levels do around them.
        rest: all else.
        network: whether a network is at work.
        march: whether a march is.
        depth: of how many marches and fields of levels inside each other this is.
    """

    def __init__(self) -> None:
        super().__init__()
        self.of_networks, self.around, self.rest = _Tally(), _Tally(), _Tally()
        self.network = self.march = False
        self.depth = self.calls = 0
        self.fused_bytes = self.chain = self.chain_sines = 0.0

    @contextmanager
    def region(self, *, march: bool) -> Iterator[None]:
        """What would be one launch: a march, or a field evaluated, unless it is inside of another."""
        self.calls += self.depth == 0
        self.depth += 1
        before, self.march = self.march, self.march or march
        try:
            yield
        finally:
            self.depth, self.march = self.depth - 1, before

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        packet = func.overloadpacket
        if func.is_view or packet in _FREE:
            return result
        tally = self.of_networks if self.network else self.around if self.depth else self.rest
        tally.launches += 1
        # A mask as an index is turned into numbers of rows first, and how many there are the host has to know.
        masked = packet in (_aten.index, _aten.index_put, _aten.index_put_) and any(
            one is not None and one.dtype == torch.bool for one in args[1]
        )
        tally.waits += masked or packet in _WAITS
        moved = sum(one.numel() * one.element_size() for one in _tensors((args, kwargs, result)))
        if packet in _PRODUCTS:
            a, b = args[-2:] if packet in (_aten.mm, _aten.mv) else args[1:3]
            tally.products += 2 * a.numel() * math.prod(b.shape[1:])
            tally.product_bytes += moved
        else:
            tally.other_bytes += moved
            if packet in _SINES:
                tally.sines += args[0].numel()
        return result


class _Level(Field):
    """A level that says when it is evaluated, and counts what a fused kernel would move."""

    def __init__(self, inner: Field, watch: _Watch, *, first: bool) -> None:
        super().__init__()
        self.inner, self.in_dim, self.watch, self.first = inner, inner.in_dim, watch, first
        self.num_features = getattr(inner, "num_features", 0)
        weights = [parameter for parameter in inner.parameters() if parameter.ndim == 2]
        # Of one point: products of the sine layers and the output's first row, and the sines.
        self.flops = 2 * (sum(weight.numel() for weight in weights[:-1]) + weights[-1].shape[1])
        self.sines = sum(weight.shape[0] for weight in weights[:-1])

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        with self._inside(x, VALUE):
            return self.inner.value(x)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        with self._inside(x, JET):
            return self.inner.jet(x)

    @contextmanager
    def _inside(self, x: Tensor, result: int) -> Iterator[None]:
        watch, rows, first = self.watch, x.shape[:-1].numel(), self.first
        if watch.march:
            watch.fused_bytes += (STANDS if first else HANDED_ON) * rows
            if rows:
                watch.chain += TILE * self.flops
                watch.chain_sines += TILE * self.sines
        else:
            watch.fused_bytes += (POINT + result + (0 if first else LISTED + result)) * rows
        watch.network = True
        try:
            with watch.region(march=False):
                yield
        finally:
            watch.network = False


@contextmanager
def _regions(watch: _Watch) -> Iterator[None]:
    """Tell the watch when a march, cones or a field of levels begin and end."""

    def inside(function: Callable[..., Any], *, march: bool) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            with watch.region(march=march):
                return function(*arguments, **options)

        return call

    places = [
        (tracing, "march", True),
        (cones, "_until_all_stop", True),
        (MultiscaleSDF, "value", False),
        (MultiscaleSDF, "jet", False),
    ]
    before = [getattr(owner, name) for owner, name, _ in places]
    for (owner, name, march), function in zip(places, before, strict=True):
        setattr(owner, name, inside(function, march=march))
    try:
        yield
    finally:
        for (owner, name, _), function in zip(places, before, strict=True):
            setattr(owner, name, function)


def _tensors(values: Any) -> Iterator[Tensor]:
    """All tensors in arguments or results."""
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, Mapping):
        yield from _tensors(list(values.values()))
    elif isinstance(values, Sequence) and not isinstance(values, str):
        for value in values:
            yield from _tensors(value)


@contextmanager
def _blocks_of_a_gpu() -> Iterator[None]:
    """Blocks as large as on a GPU: those of a CPU would be launches that it does not make."""
    before = siren.BLOCK_FLOATS, _parallel.WANTED
    siren.BLOCK_FLOATS, _parallel.WANTED = siren.GPU_BLOCK_FLOATS, 1
    try:
        yield
    finally:
        siren.BLOCK_FLOATS, _parallel.WANTED = before


def _launches(counts: FrameCounts) -> int:
    """By PyTorch."""
    return counts.launches + counts.around_launches + counts.rest_launches


def model_table(items: Sequence[tuple[str, float, FrameCounts]], names: Sequence[str]) -> Table:
    """The model beside what was measured.

    Args:
        items: name, measured seconds and counts of pictures.
        names: of `DEVICES`.
    """

    def rate(name: str, *, fused: bool, split: bool = False) -> Callable[[tuple[float, FrameCounts]], float | None]:
        device = DEVICES[name]
        if (fused and not device.fused) or (split and not device.tensor):
            return lambda _: None
        return lambda item: 1 / predict(item[1], device, fused=fused, split=split).seconds

    def work(name: str) -> Callable[[tuple[float, FrameCounts]], float]:
        device = DEVICES[name]
        options = {"fused": device.fused, "split": device.fused and device.tensor > device.float32}
        return lambda item: 1 / predict(item[1], device, **options).device

    def limit(name: str) -> Callable[[tuple[float, FrameCounts]], str]:
        return lambda item: predict(item[1], DEVICES[name], fused=DEVICES[name].fused).limit

    figures: list[Figure[tuple[float, FrameCounts]]] = [
        (Column("measured here, fps", ".2f"), lambda item: 1 / item[0]),
        (Column("TFLOP", ".3f"), lambda item: item[1].products / 1e12),
        (Column("GB, PyTorch", ".2f"), lambda item: (item[1].product_bytes + item[1].other_bytes) / 1e9),
        (Column("GB, fused", ".3f"), lambda item: item[1].fused_bytes / 1e9),
        (Column("GB, around", ".2f"), lambda item: item[1].around_bytes / 1e9),
        (Column("GB, rest", ".2f"), lambda item: item[1].rest_bytes / 1e9),
        (Column("launches", "d"), lambda item: _launches(item[1])),
        (Column("fused", "d"), lambda item: item[1].calls + item[1].rest_launches),
        (Column("waits", "d"), lambda item: item[1].around_waits + item[1].rest_waits),
        (Column("fused", "d"), lambda item: item[1].rest_waits),
    ]
    for name in names:
        figures += [
            (Column(f"{name}: fps", ".0f"), rate(name, fused=False)),
            (Column("fused", ".0f"), rate(name, fused=True)),
            (Column("tf32x3", ".0f"), rate(name, fused=True, split=True)),
            (Column("held up by", "s"), limit(name)),
            (Column("work alone", ".0f"), work(name)),
        ]
    notes = (
        "A model, not a measurement: counts of this program, published rates, and no kernel slower than its device. "
        "On an H100, pictures took 8 to 15 times as long as it says of fused kernels.",
        f"Assumed: {1e6 * LAUNCH:.0f} µs of the host for a launch, {1e6 * WAIT:.0f} µs for a wait, {SINE} operations "
        "for a sine. held up by: what takes longest, fused. work alone: no launches, no waits, the fastest products.",
        *(f"{name}: {DEVICES[name].words}; {DEVICES[name].source}." for name in names),
    )
    rows = [(name, (seconds, counts)) for name, seconds, counts in items]
    return tabulated("model", "What a picture would take: a model", "shape, model", figures, rows, notes=notes)
