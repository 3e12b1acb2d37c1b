"""The one error type that means: what the user gave us cannot be used."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input: a file, a field in it, or a flag.

    The message is one line that names the file (or flag), what is wrong with it, and the fix.
    The command line prints it as it is and exits with code 2; anything else is a defect of ours.
    """


def at_least(least: float, **numbers: float) -> None:
    """Refuse numbers below a bound.

    Raises:
        ValueError: names the first that is.
    """
    for name, number in numbers.items():
        if not number >= least:
            raise ValueError(f"{name}={number}: expected at least {least}")


def positive(**numbers: float) -> None:
    """Refuse numbers that are not above 0.

    Raises:
        ValueError: names the first that is not.
    """
    for name, number in numbers.items():
        if not number > 0:
            raise ValueError(f"{name}={number}: expected > 0")
