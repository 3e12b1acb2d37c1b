"""``mplicits bench …``: all of its commands."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from .bench_costs import COSTS
from .bench_paper import PAPER
from .bench_scenes import SCENES
from .bench_shapes import SHAPES
from .common import Command

__all__ = ["BENCH_COMMANDS"]

BENCH_COMMANDS: Mapping[str, Command] = MappingProxyType({**COSTS, **SHAPES, **SCENES, "bench paper": PAPER})
