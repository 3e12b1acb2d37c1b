"""Device and dtype fixtures. A stand-in takes the place of a GPU where there is no CUDA."""

import os
import signal
from importlib.util import find_spec

import pytest
import standin
import torch

if not torch.cuda.is_available():
    # Before Triton is imported by anything: its kernels run by its interpreter then, where a test asks for them.
    os.environ["TRITON_INTERPRET"] = "1"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # So a shell starts what is in the background. Tests send Ctrl-C to themselves and to children, which inherit this.
    signal.signal(signal.SIGINT, signal.default_int_handler)

ACCELERATORS = [standin.NAME if standin.AVAILABLE else "cuda"]
# What counts on the stand-in, or is about it.
collect_ignore = [] if standin.AVAILABLE else ["test_standin.py", "test_waits.py"]


@pytest.fixture(params=["cpu", *ACCELERATORS])
def device(request: pytest.FixtureRequest) -> torch.device:
    return torch.device(request.param)


@pytest.fixture(params=ACCELERATORS)
def accelerator(request: pytest.FixtureRequest) -> torch.device:
    """For tests that compare with the CPU, or count."""
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    return request.param


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the stand-in in float64: it computes on the CPU, so that only its refusals say something new."""
    again = [
        item
        for item in items
        if isinstance(item, pytest.Function)
        and hasattr(item, "callspec")
        and item.callspec.params.get("device") == standin.NAME
        and item.callspec.params.get("dtype") == torch.float64
    ]
    if again:
        config.hook.pytest_deselected(items=again)
        items[:] = [item for item in items if item not in set(again)]


def pytest_report_header() -> list[str]:
    devices = f"devices: cpu, {', '.join(ACCELERATORS)}"
    missing = "" if find_spec("triton") else "kernels: Triton is not installed, so that their tests are left out"
    return [devices + ("" if "cuda" in ACCELERATORS else " (no CUDA on this machine)"), *([missing] if missing else [])]
