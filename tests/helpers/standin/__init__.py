"""A stand-in accelerator for machines without CUDA: ``torch.device("standin")``; see `device.py`, and `ledger.py`."""

import pytest

from .device import AVAILABLE, NAME, StandInTensor
from .ledger import Ledger, counted

__all__ = ["AVAILABLE", "NAME", "Ledger", "StandInTensor", "counted", "needed"]

# Of tests that count on it.
needed = pytest.mark.skipif(not AVAILABLE, reason="the stand-in takes the place of CUDA, which is there")
