"""The kernels by Triton's interpreter where there is no CUDA, which `tests/conftest.py` has switched on."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import pytest
import torch

# A conftest that skips (`pytest.importorskip`) would end a run of this folder alone.
if find_spec("triton") is None:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Where the kernels run, with them switched on."""
    if torch.cuda.is_available():
        monkeypatch.setenv("MPLICITS_KERNELS", "auto")
        return torch.device("cuda")
    monkeypatch.setenv("MPLICITS_KERNELS", "interpret")
    return torch.device("cpu")


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Any]]:
    """``watch(module, name, note)`` → a list, one for all functions, of ``note(arguments)`` of each call."""
    notes: list[Any] = []

    def begin(module: Any, name: str, note: Callable[..., Any]) -> list[Any]:
        original: Callable[..., Any] = getattr(module, name)

        def call(*arguments: Any, **options: Any) -> Any:
            notes.append(note(*arguments))
            return original(*arguments, **options)

        monkeypatch.setattr(module, name, call)
        return notes

    return begin
