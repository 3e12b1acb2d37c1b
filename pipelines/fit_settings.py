"""The settings of a fit on the command line: a preset or a file, and a flag for every field."""

from __future__ import annotations

import argparse
from pathlib import Path

from .run.config import add_config_flags, given_flags, load_config, preset_names
from .run.settings import FitConfig

__all__ = ["add_fit_settings", "fit_settings", "were_given"]


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
