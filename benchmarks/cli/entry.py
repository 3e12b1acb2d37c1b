"""``python -m benchmarks NAME …``: messages and exit codes are those of ``mplicits``."""

from __future__ import annotations

from mplicits.pipelines.cli.common import Program

from .costs import COSTS
from .paper import PAPER
from .scenes import SCENES
from .shapes import SHAPES

OVERVIEW = """usage: python -m benchmarks NAME [arguments]

Measure what things cost and how near results come, beside peers in the same run. Runs from a checkout.

benchmarks:
{commands}

examples:
  python -m benchmarks fit armadillo.ply --time-budget 180
  python -m benchmarks paper meshes/ -o paper --table all

`python -m benchmarks NAME --help` says more about each."""

# Nothing above loads torch, so that ``--help`` is quick.
BENCHMARKS = Program("python -m benchmarks", {**COSTS, **SHAPES, **SCENES, "paper": PAPER}, OVERVIEW)
main = BENCHMARKS.main
