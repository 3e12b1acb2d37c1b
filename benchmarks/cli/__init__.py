"""The command line: ``python -m benchmarks NAME …``."""

from .entry import main

__all__ = ["main"]
