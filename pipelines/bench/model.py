"""How long a picture would take on a GPU that is not here: a model of it, from counts and published rates.

Counted, while a picture is traced on the CPU: FLOPs of matrix products, sines, bytes that operations read and write,
operations (each one a launch) and places where the host has to wait for a result; for networks and for all else, the
march, apart. Published: what the device multiplies and moves in a second. With these

    T = max(device, host) + waits · `WAIT`,      host = launches · `LAUNCH`
    device = max(products / rate, their bytes / memory) + max(sines · `SINE` / float32, other bytes / memory) + march

for PyTorch, where each operation is a kernel, with the march's bytes / memory. Fused, a level evaluated is one launch,
which reads points and writes results:

    device = max(products / rate + sines · `SINE` / float32, bytes / memory) + march.

No kernel reaches the published rates, so device times are bounds from below; `LAUNCH` and `WAIT` are assumptions. A
model, to be confirmed or refuted by the first measurement.
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

from ...neural_fields import Field, Jet, MultiscaleSDF, levels_of, siren
from .tables import Column, Figure, Table, tabulated

__all__ = ["DEVICES", "Device", "FrameCounts", "Prediction", "count_frame", "model_table", "predict"]

LAUNCH = 5e-6  # seconds of the host for one PyTorch operation; a common figure, not measured here
WAIT = 15e-6  # seconds from the end of a kernel until the host has the result and the device work again; likewise
SINE = 40  # float32 operations of one sine of libdevice, as Triton's compiler writes it
SPLIT = 3  # products on tensor cores that make one with split operands (tf32x3)
POINT, VALUE, JET = 12, 4, 16  # bytes of a point, of a value, of a value and its gradient

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
        fused: whether the fused kernels run on it.
        source: of the figures.
    """

    words: str
    float32: float
    tensor: float
    memory: float
    fused: bool
    source: str


DEVICES: Mapping[str, Device] = MappingProxyType(
    {
        "h100": Device("H100 SXM5", 66.9e12, 494.7e12, 3.35e12, True, "NVIDIA, H100 architecture whitepaper, 2022"),
        "a100": Device("A100 SXM 80 GB", 19.5e12, 156e12, 2.039e12, True, "NVIDIA, A100 datasheet, 2021"),
        "4090": Device("RTX 4090", 82.6e12, 82.6e12, 1.008e12, True, "NVIDIA, Ada architecture whitepaper, 2022"),
        "m2": Device("Apple M2, 10 GPU cores", 3.6e12, 0.0, 0.1e12, False, "Apple, M2 announcement, 2022"),
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
        calls: how often a level was evaluated, a launch each where that is fused.
        fused_bytes: that those launches read and write.
        march_bytes: of all that is not a network.
        march_launches: its operations.
        waits: how often the host waits for the device.
    """

    pixels: int
    products: float
    product_bytes: float
    sines: float
    other_bytes: float
    launches: int
    calls: int
    fused_bytes: float
    march_bytes: float
    march_launches: int
    waits: int


@dataclass(frozen=True)
class Prediction:
    """Seconds of a picture, and of what: the device's work, the host's launches (beside it), the waits (after it)."""

    device: float
    host: float
    waits: float

    @property
    def seconds(self) -> float:
        """All of it."""
        return max(self.device, self.host) + self.waits

    @property
    def limit(self) -> str:
        """What takes longest."""
        parts = {"work": self.device, "launches": self.host, "waits": self.waits}
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
    products = counts.products / (device.tensor / SPLIT if split else device.float32)
    sines = counts.sines * SINE / device.float32
    if fused:
        networks = max(products + sines, counts.fused_bytes / device.memory)
    else:
        networks = max(products, counts.product_bytes / device.memory)
        networks += max(sines, counts.other_bytes / device.memory)
    launches = counts.march_launches + (counts.calls if fused else counts.launches)
    return Prediction(networks + counts.march_bytes / device.memory, launches * LAUNCH, counts.waits * WAIT)


def count_frame(field: Field, draw: Callable[[Field], object], pixels: int) -> FrameCounts:
    """Count what a picture asks for.

    Args:
        field: on the CPU, of SIRENs.
        draw: makes the picture with the field that it is given.
        pixels: of the picture.
    """
    watch = _Watch()
    levels = [_Level(level, watch) for level in levels_of(field)]
    same: Field = levels[0]
    if isinstance(field, MultiscaleSDF):
        same = MultiscaleSDF(levels[0], levels[1:], field.deltas, taper=field.taper)
    with _blocks_of_a_gpu(), watch:
        draw(same)
    network, march = watch.of_networks, watch.of_march
    return FrameCounts(
        pixels=pixels,
        products=network.products,
        product_bytes=network.product_bytes,
        sines=network.sines,
        other_bytes=network.other_bytes,
        launches=network.launches,
        calls=sum(level.calls for level in levels),
        fused_bytes=sum(level.bytes for level in levels),
        march_bytes=march.product_bytes + march.other_bytes,
        march_launches=march.launches,
        waits=network.waits + march.waits,
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
    """Counts operations, those of networks apart."""

    def __init__(self) -> None:
        super().__init__()
        self.of_networks, self.of_march = _Tally(), _Tally()
        self.inside = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        packet = func.overloadpacket
        if func.is_view or packet in _FREE:
            return result
        tally = self.of_networks if self.inside else self.of_march
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
    """A level that says when it is evaluated, and counts how often and what a fused kernel would move."""

    def __init__(self, inner: Field, watch: _Watch) -> None:
        super().__init__()
        self.inner, self.in_dim, self.watch = inner, inner.in_dim, watch
        self.calls = self.bytes = 0

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
        self.calls += 1
        self.bytes += (POINT + result) * x.shape[:-1].numel()
        self.watch.inside = True
        try:
            yield
        finally:
            self.watch.inside = False


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
    before = siren.BLOCK_FLOATS
    siren.BLOCK_FLOATS = siren.GPU_BLOCK_FLOATS
    try:
        yield
    finally:
        siren.BLOCK_FLOATS = before


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
        (Column("GB, march", ".2f"), lambda item: item[1].march_bytes / 1e9),
        (Column("launches", "d"), lambda item: item[1].launches + item[1].march_launches),
        (Column("fused", "d"), lambda item: item[1].calls + item[1].march_launches),
        (Column("waits", "d"), lambda item: item[1].waits),
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
        "The fused kernels have not run on a GPU.",
        f"Assumed: {1e6 * LAUNCH:.0f} µs of the host for a launch, {1e6 * WAIT:.0f} µs for a wait, {SINE} operations "
        "for a sine. held up by: what takes longest, fused. work alone: no launches, no waits, the fastest products.",
        *(f"{name}: {DEVICES[name].words}; {DEVICES[name].source}." for name in names),
    )
    rows = [(name, (seconds, counts)) for name, seconds, counts in items]
    return tabulated("model", "What a picture would take: a model", "shape, model", figures, rows, notes=notes)
