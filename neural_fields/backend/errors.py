"""The error type of bad input, checks of numbers, and earlier names of arguments."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])


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


def renamed(function: F, **names: str) -> F:
    """The function, which accepts arguments by their ``names`` of earlier releases too, with a warning."""

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        for old in names.keys() & options.keys():
            warnings.warn(f"{old} is now called {names[old]}", DeprecationWarning, stacklevel=2)
            options[names[old]] = options.pop(old)
        return function(*arguments, **options)

    return cast("F", call)
