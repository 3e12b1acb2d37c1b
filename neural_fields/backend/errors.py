"""The error type of bad input, and checks of numbers."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input: a file, a field in it, or a flag.

    The message is one line that names the file or flag, the fault and the fix. The command line prints it and exits
    with code 2.
    """


def at_least(least: float, **numbers: float) -> None:
    """Raise ValueError for the first of ``numbers`` that is below ``least``."""
    for name, number in numbers.items():
        if not number >= least:
            raise ValueError(f"{name}={number}: expected at least {least}")


def positive(**numbers: float) -> None:
    """Raise ValueError for the first of ``numbers`` that is not above 0."""
    for name, number in numbers.items():
        if not number > 0:
            raise ValueError(f"{name}={number}: expected > 0")
