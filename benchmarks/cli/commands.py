"""The table of all benchmarks.

This module and those it imports load no torch, so that ``--help`` is quick.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from mplicits.pipelines.cli.common import Command

from .costs import COSTS
from .paper import PAPER
from .scenes import SCENES
from .shapes import SHAPES

__all__ = ["COMMANDS"]

COMMANDS: Mapping[str, Command] = MappingProxyType({**COSTS, **SHAPES, **SCENES, "paper": PAPER})
