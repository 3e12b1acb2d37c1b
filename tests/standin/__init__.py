"""A stand-in accelerator for machines without one: ``torch.device("standin")``; see `device.py`, and `ledger.py`."""

from .device import NAME, StandInTensor
from .ledger import Ledger, counted

__all__ = ["NAME", "Ledger", "StandInTensor", "counted"]
