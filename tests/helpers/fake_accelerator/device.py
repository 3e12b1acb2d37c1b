"""A fake accelerator: it stores and computes on the CPU, and raises the errors that a GPU raises.

PyTorch lends a device type to backends ("PrivateUse1"); here it is ``standin``. Its tensors are shells of tensors of
the CPU, so that results are the CPU's to the last bit. Each operation on shells comes to `_run`, which counts launches
and waits (`ledger.py`). It refuses operands on two devices, generators of another device, `.numpy()`, and copies to
the host that do not wait. It cannot show other roundings, races of streams, or time.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

from .ledger import note_launch, note_wait

NAME = "standin"

# Operations after which the host knows a number of the device, and so has waited for it.
READS = {"_local_scalar_dense", "equal", "is_nonzero", "_linalg_check_errors"}
# The shape of their results depends on numbers.
SIZES = {"nonzero", "masked_select", "_unique", "_unique2", "unique_dim", "unique_consecutive", "bincount"}
INDEXED = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index", "_unsafe_index_put"}
# What an argument can be that is neither a tensor nor holds any.
PLAIN = {int, float, bool, str, complex, type(None), torch.dtype, torch.layout, torch.memory_format}
# They say how memory is to be read, or reserve some, and run nothing.
STILL = {"_unsafe_view", "_reshape_alias", "detach", "alias", "lift_fresh", "lift", "empty", "empty_like"}
STILL |= {"empty_strided", "new_empty", "new_empty_strided", "_local_scalar_dense"}
# Operations that are not tagged as pointwise but take a number of the host as CUDA does.
TAKE_NUMBERS = {"where", "masked_fill", "masked_fill_", "fill", "fill_", "lerp", "lerp_"}
# Reached by ways on which Python's own dispatch is switched off (`torch.tensor`): torch wants them by name.
BY_NAME = ("copy_", "fill_.Scalar", "detach", "_to_copy")


class FakeAcceleratorTensor(Tensor):
    """The shell of a tensor of the CPU, ``inner``, which it shares with its views."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> FakeAcceleratorTensor:
        shell = Tensor._make_wrapper_subclass(
            cls, inner.shape, inner.stride(), inner.storage_offset(), dtype=inner.dtype, device=f"{NAME}:0"
        )
        shell.inner = inner
        return shell

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, *args, **(kwargs or {}))

    def numpy(self, *, force: bool = False) -> Any:
        if force:
            return self.detach().cpu().numpy()
        raise TypeError(f"can't convert {self.device} device type tensor to numpy. Use Tensor.cpu() first.")

    def tolist(self) -> Any:
        return self.detach().cpu().tolist()

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec) if self.ndim == 0 else str(self)

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    @property
    def data(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.detach()

    @data.setter
    def data(self, other: Tensor) -> None:
        Tensor.data.__set__(self, other)
        assert isinstance(other, FakeAcceleratorTensor)
        self.inner = other.inner

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        # torch's own copies the storage of a tensor with an address, and a shell has none.
        copied = FakeAcceleratorTensor(self.inner.detach().clone()).requires_grad_(self.requires_grad)
        copied.__dict__.update({name: value for name, value in self.__dict__.items() if name != "inner"})
        memo[id(self)] = copied
        return copied

    def __reduce_ex__(self, protocol: Any) -> Any:
        """A file keeps the numbers; they come back to the CPU, as with ``torch.load(file, map_location="cpu")``."""
        return self.detach().cpu().__reduce_ex__(protocol)


class _Operation(NamedTuple):
    name: str  # without ``aten::`` and overload
    launches: bool  # whether it runs anything on the device
    numbers: bool  # whether it takes 0-dimensional tensors of the host for numbers
    written: tuple[tuple[int, str], ...]  # places and names of the arguments that it writes into and returns
    composite: bool  # whether it is made of others

    @classmethod
    @functools.cache
    def of(cls, func: torch._ops.OpOverload) -> _Operation:
        schema, name = func._schema, func._schema.name.split("::")[1]
        written = {
            tuple(sorted(argument.alias_info.before_set)): (place, argument.name)
            for place, argument in enumerate(schema.arguments)
            if argument.alias_info is not None and argument.alias_info.is_write
        }
        returned = tuple(
            written[tuple(sorted(result.alias_info.before_set))]
            for result in schema.returns
            if result.alias_info is not None and result.alias_info.is_write
        )
        return cls(
            name=name,
            launches=not func.is_view and name not in STILL,
            numbers=torch.Tag.pointwise in func.tags or name in TAKE_NUMBERS,
            written=returned,
            composite=torch._C._dispatch_has_kernel_for_dispatch_key(func.name(), "CompositeImplicitAutograd"),
        )


def _run(func: Any, *args: Any, **kwargs: Any) -> Any:
    """Do what a device would do, which is: refuse, note down, or run on the shells' inner tensors."""
    operation = _Operation.of(func)
    if operation.composite and torch.is_inference_mode_enabled():
        return func.decompose(*args, **kwargs)  # elsewhere PyTorch has done so before it comes here
    if operation.name == "_pin_memory":
        raise RuntimeError(f"cannot pin '{NAME}', only dense CPU tensors can be pinned")
    hosts: list[Tensor] = []
    opened = [_opened(value, hosts) for value in args]
    named = {name: _opened(value, hosts) for name, value in kwargs.items()}
    if operation.name in ("copy_", "_to_copy"):
        _note_copy(operation.name, args, kwargs)
    else:
        if hosts:
            _check_hosts(operation, args, kwargs, hosts)
        _note(operation, args, kwargs)
    result = func(*opened, **named)
    if operation.written:
        back = [_argument(args, kwargs, place) for place in operation.written]
        for shell in back:
            if isinstance(shell, FakeAcceleratorTensor) and shell.shape != shell.inner.shape:
                shell.data = FakeAcceleratorTensor(shell.inner)  # it was squeezed or resized
        return back[0] if len(back) == 1 else tuple(back)
    target = kwargs.get("device")
    return result if target is not None and torch.device(target).type != NAME else _shelled(result)


def _argument(args: Sequence[Any], kwargs: Mapping[str, Any], place: tuple[int, str]) -> Any:
    return args[place[0]] if place[0] < len(args) else kwargs.get(place[1])


def _check_hosts(operation: _Operation, args: Any, kwargs: Any, hosts: Sequence[Tensor]) -> None:
    """Refuse operands of the host beside those of the device, by a RuntimeError as CUDA raises it."""
    written = [_argument(args, kwargs, place) for place in operation.written]
    indices = args[1] if operation.name in INDEXED else ()
    for tensor in hosts:
        if any(tensor is index for index in indices):
            continue
        number = tensor.ndim == 0 and (operation.numbers or operation.name in INDEXED)
        if not number or any(tensor is shell for shell in written):
            where = f"{operation.name}, {tuple(tensor.shape)} on {tensor.device}"
            raise RuntimeError(f"Expected all tensors to be on the same device, {NAME}:0, but found {where}")


def _note_copy(name: str, args: Any, kwargs: Any) -> None:
    """Copies inside the device launch a kernel; others block, but for non-blocking ones from pinned memory."""
    if name == "copy_":
        target, source = args[:2]
        asked = args[2] if len(args) > 2 else kwargs.get("non_blocking", False)
        down, up = not isinstance(target, FakeAcceleratorTensor), not isinstance(source, FakeAcceleratorTensor)
    else:
        device, source = kwargs.get("device"), args[0]
        asked = kwargs.get("non_blocking", False)
        down = device is not None and torch.device(device).type != NAME
        up = not isinstance(source, FakeAcceleratorTensor)
    if down and asked:
        raise RuntimeError("non_blocking copy to the host: it may be read before it is there")
    if down or (up and not (asked and _is_pinned(source))):
        note_wait("download" if down else "upload")
    elif not up:
        note_launch(name)


def _note(operation: _Operation, args: Any, kwargs: Any) -> None:
    name = operation.name
    if operation.launches:
        note_launch(name)
    if name in READS:
        note_wait("item")
    elif name in SIZES or (name == "repeat_interleave" and _counts_unknown(args, kwargs)):
        note_wait("size")
    elif name in INDEXED:
        indices = [index for index in args[1] if index is not None]
        for index in indices:
            if not isinstance(index, FakeAcceleratorTensor):
                note_wait("upload")
        masks = [index for index in indices if index.dtype in (torch.bool, torch.uint8)]
        # One mask and one number: that is a masked fill, whose size does not matter.
        if masks and not (len(indices) == 1 and "put" in name and args[2].ndim == 0):
            note_launch("nonzero")
            note_wait("size")


def _counts_unknown(args: Any, kwargs: Any) -> bool:
    return kwargs.get("output_size") is None and not any(isinstance(value, int) for value in args[1:])


def _opened(value: Any, hosts: list[Tensor]) -> Any:
    """What the device sees as its own: inner tensors, and its name as the CPU's. Tensors of the host join ``hosts``."""
    kind = type(value)
    if kind is FakeAcceleratorTensor:
        return value.inner
    if kind in PLAIN:
        return value
    if kind is list or kind is tuple:
        return [_opened(item, hosts) for item in value]
    if isinstance(value, Tensor):
        hosts.append(value)
    elif kind is torch.device:
        return torch.device("cpu") if value.type == NAME else value
    elif kind is torch.Generator:
        raise RuntimeError(f"Expected a '{NAME}' device type for generator but found '{value.device.type}'")
    return value


def _shelled(result: Any) -> Any:
    if isinstance(result, Tensor):
        # What is seen of an ordinary tensor in inference mode is an ordinary tensor.
        if torch.is_inference_mode_enabled() and not result.is_inference():
            with torch.inference_mode(False):
                return FakeAcceleratorTensor(result)
        return FakeAcceleratorTensor(result)
    return type(result)(map(_shelled, result)) if isinstance(result, list | tuple) else result


def _pin(tensor: Tensor, device: torch.device | None = None) -> Tensor:
    """Memory of the host that the device can read by itself: here a copy that says so."""
    pinned = tensor.clone()
    pinned.__dict__["pinned"] = True
    return pinned


def _is_pinned(tensor: Tensor, device: torch.device | None = None) -> bool:
    return "pinned" in tensor.__dict__


class _Module(_DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16]


def _register() -> tuple[torch.library.Library, ...]:
    """Make ``torch.device("standin")`` known; once in a process, and not to be taken back."""
    _setup_privateuseone_for_python_backend(NAME, backend_module=_Module())
    everything, some = torch.library.Library("_", "IMPL"), torch.library.Library("aten", "IMPL")
    everything.fallback(_run, "PrivateUse1")
    for name in BY_NAME:
        packet, _, overload = name.partition(".")
        func: Callable[..., Any] = getattr(getattr(torch.ops.aten, packet), overload or "default")
        some.impl(name, functools.partial(_run, func), "PrivateUse1")
    some.impl("_pin_memory", _pin, "CPU")
    some.impl("is_pinned", _is_pinned, "CPU")
    return everything, some


# Not beside CUDA: PyTorch asks the backend of a process for streams and pinned memory, and there can be one of them.
AVAILABLE = not torch.cuda.is_available()
_LIBRARIES = _register() if AVAILABLE else ()  # they last as long as someone holds them
