"""Device and dtype fixtures. A fake accelerator takes the place of a GPU where there is no CUDA."""

import os
import signal
from importlib.util import find_spec

import fake_accelerator
import pytest
import torch

if not torch.cuda.is_available():
    # Before Triton is imported by anything: its kernels run by its interpreter then, where a test asks for them.
    os.environ["TRITON_INTERPRET"] = "1"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # So a shell starts what is in the background. Tests send Ctrl-C to themselves and to children, which inherit this.
    signal.signal(signal.SIGINT, signal.default_int_handler)

ACCELERATORS = [fake_accelerator.NAME if fake_accelerator.AVAILABLE else "cuda"]
# Tests that need the fake accelerator.
collect_ignore = [] if fake_accelerator.AVAILABLE else ["test_fake_accelerator.py", "test_waits.py"]


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
    """Leave out the fake accelerator in float64: it computes on the CPU, so that only its errors differ."""
    params = {item: item.callspec.params for item in items if hasattr(item, "callspec")}
    fake = (fake_accelerator.NAME, torch.float64)
    again = {i for i, p in params.items() if (p.get("device"), p.get("dtype")) == fake}
    config.hook.pytest_deselected(items=list(again))
    items[:] = [item for item in items if item not in again]


def pytest_report_header() -> list[str]:
    missing = [] if find_spec("triton") else ["kernels: Triton is not installed, so that their tests are left out"]
    return [f"devices: cpu, {', '.join(ACCELERATORS)}", *missing]
