"""What a command of the command line is, and the checks that several of them share.

The settings of a fit on the command line: a preset or a file, and a flag for every field.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..run.config import add_config_flags, given_flags, input_error, load_config, preset_names
from ..run.settings import FitConfig

__all__ = [
    "Command",
    "add_fit_settings",
    "add_json",
    "check_output",
    "fit_settings",
    "positive",
    "were_given",
    "whole",
    "write_json",
]


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        summary: a few words for the list of commands.
        examples: lines for the end of its help.
        add_arguments: tells a parser what it takes.
        run: does it → exit code.
        description: for its help, where the summary does not say enough.
    """

    summary: str
    examples: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    description: str = ""


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """A converter for argparse: whole numbers from ``low`` to ``high``."""

    def convert(text: str) -> int:
        allowed = f"a whole number from {low}" + (f" to {high}" if high is not None else "")
        try:
            number = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"got {text!r}, expected {allowed}") from None
        if number < low or (high is not None and number > high):
            raise argparse.ArgumentTypeError(f"got {text!r}, expected {allowed}")
        return number

    return convert


def positive(text: str) -> float:
    """A converter for argparse: finite numbers above zero."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number > 0")
    return number


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json FILE``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON as well")


def check_output(path: Path | None, suffixes: Sequence[str]) -> None:
    """Refuse an output file that could not be written, before the long work and not after it.

    Raises:
        InputError: another extension, no such folder, or a directory stands in its place.
    """
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise input_error(f"{path}: unknown extension {path.suffix!r}; known: {', '.join(suffixes)}")
    if not path.absolute().parent.is_dir():
        raise input_error(f"{path}: the folder {path.absolute().parent} does not exist; make it first")
    if path.is_dir():
        raise input_error(f"{path}: is a directory; name a file")


def write_json(path: Path | None, data: Any) -> None:
    """Write figures through a temporary file beside the target; nothing without a path."""
    if path is None:
        return
    from ...neural_fields import files

    files.write_json(path, data)


def add_fit_settings(parser: argparse.ArgumentParser) -> None:
    """Add ``--preset``, ``--config`` and one flag per field of `FitConfig`."""
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--preset", metavar="NAME", help=f"one of {', '.join(preset_names('fit'))} (default: default)")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(parser, FitConfig)


def fit_settings(arguments: argparse.Namespace) -> FitConfig:
    """What the arguments say.

    Raises:
        InputError: see `load_config`.
    """
    source = arguments.config or arguments.preset or "default"
    return load_config(FitConfig, source, given_flags(arguments, FitConfig), thing="fit")


def were_given(arguments: argparse.Namespace) -> bool:
    """Whether any setting was given."""
    return bool(arguments.config or arguments.preset or given_flags(arguments, FitConfig))
