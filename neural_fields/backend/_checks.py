"""Numbers that arguments may not fall below."""

from __future__ import annotations

__all__ = ["at_least", "positive"]


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
