"""The kernels by Triton's interpreter where there is no CUDA, which `tests/conftest.py` has switched on."""

from importlib.util import find_spec

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
