"""The words of the command line, apart from what they mean: a mistake in them must not wait for torch."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .jobs import Preset

PRESETS: tuple[Preset, ...] = ("smoke", "cpu", "paper")

TABLES = (
    "comparison",
    "noise",
    "poisson",
    "banf",
    "isolation",
    "undertrained",
    "outliers",
    "deltas",
    "loss-weights",
    "delta-factor",
    "marching-cubes",
    "normals",
)

# Of these --methods chooses; the variants of our own that ablations train come with their tables.
METHODS = (
    "ours",
    "siren",
    "ingp-coarse",
    "ingp-fine",
    "idf",
    "bacon",
    "banf",
    "poisson",
    "poisson-trim",
    "poisson-smoothed",
)
