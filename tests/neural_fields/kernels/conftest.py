"""The kernels by Triton's interpreter where there is no CUDA, which `tests/conftest.py` has switched on."""

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not installed: pip install 'mplicits[kernels]' on Linux")


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Where the kernels run, with them switched on."""
    if torch.cuda.is_available():
        monkeypatch.setenv("MPLICITS_KERNELS", "auto")
        return torch.device("cuda")
    monkeypatch.setenv("MPLICITS_KERNELS", "interpret")
    return torch.device("cpu")
