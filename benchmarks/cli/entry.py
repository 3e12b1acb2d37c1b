"""``python -m benchmarks NAME …``: messages and exit codes are those of ``mplicits``."""

from __future__ import annotations

from collections.abc import Sequence

from mplicits.pipelines.cli.entry import Program

from .commands import COMMANDS

__all__ = ["BENCHMARKS", "main"]

OVERVIEW = """usage: python -m benchmarks NAME [arguments]

Measure what things cost and how near results come, beside peers in the same run. Runs from a checkout.

benchmarks:
{commands}

examples:
  python -m benchmarks fit armadillo.ply --time-budget 180
  python -m benchmarks paper meshes/ -o paper --table all

`python -m benchmarks NAME --help` says more about each."""

BENCHMARKS = Program("python -m benchmarks", COMMANDS, OVERVIEW)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark; see `Program.main`."""
    return BENCHMARKS.main(argv)
