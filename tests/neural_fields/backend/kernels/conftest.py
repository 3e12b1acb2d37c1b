"""The kernels by Triton's interpreter where there is no CUDA, which `tests/conftest.py` has switched on."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import pytest
import torch

# Not pytest.importorskip: a folder's conftest that skips ends the run where the folder is named on the command line.
# `tests/conftest.py` says at the top of the run what is left out.
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
    """``watch(module, name, note)`` → a list of what ``note`` returns of the arguments of each call of a function.

    A test sees by it that it tested the kernels. All functions that it watches share the list.
    """
    notes: list[Any] = []

    def begin(module: Any, name: str, note: Callable[..., Any]) -> list[Any]:
        original: Callable[..., Any] = getattr(module, name)

        def call(*arguments: Any, **options: Any) -> Any:
            notes.append(note(*arguments))
            return original(*arguments, **options)

        monkeypatch.setattr(module, name, call)
        return notes

    return begin
