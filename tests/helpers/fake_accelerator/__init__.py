"""A fake accelerator for machines without CUDA: ``torch.device("standin")``; see `device.py`, and `ledger.py`."""

import pytest

from .device import AVAILABLE, NAME, FakeAcceleratorTensor
from .ledger import Ledger, counted

__all__ = ["AVAILABLE", "NAME", "FakeAcceleratorTensor", "Ledger", "counted", "needed"]

# Marks tests that need it.
needed = pytest.mark.skipif(not AVAILABLE, reason="the fake accelerator replaces CUDA, which is available here")
