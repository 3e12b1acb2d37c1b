"""What the tests of evolutions share: small settings, a fit that takes no time, interruptions, bad input."""

import dataclasses
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from mplicits.neural_fields import MultiscaleSDF, Similarity, Siren, Sphere, save_field
from mplicits.pipelines.cli.entry import main as mplicits_command
from mplicits.pipelines.evolve import checks as evolve_checks
from mplicits.pipelines.evolve import deform
from mplicits.pipelines.evolve import problem as evolve_problem
from mplicits.pipelines.training.settings import EvolveConfig
from mplicits.pipelines.training.trainer import Progress

BRIEF = EvolveConfig(
    kind="transport",
    shapes=("sphere:0.4@-0.2,0,0",),
    velocity=(0.4, 0.0, 0.0),
    widths=(16, 16),
    depths=(1, 1),
    omegas=(5.0, 10.0),
    steps=(60, 30),
    learning_rates=(5e-3, 1e-3),
    data_weights=(100.0, 300.0),
    start_steps=40,
    batch=256,
    samples=2000,
    frames=3,
    resolution=24,
    least_delta=0.05,
)
ONE_LEVEL = {"widths": (32,), "depths": (2,), "omegas": (6.0,), "learning_rates": (5e-3,), "data_weights": (100.0,)}
QUICK = replace(BRIEF, **ONE_LEVEL, steps=(250,), batch=768, samples=8000)


def few_points(patch: pytest.MonkeyPatch) -> None:
    """Match, and check ends, on fewer points."""
    patch.setattr(evolve_problem, "END_POINTS", 1000)
    patch.setattr(evolve_problem, "REACH_POINTS", 200)
    patch.setattr(evolve_checks, "END_RESOLUTION", 32)
    patch.setattr(deform, "MOTION", dataclasses.replace(deform.MOTION, matched=200, pool=2000))


def ball(path: Path, radius: float, *, levels: bool = False) -> None:
    """A fit of a ball around (5, 0, 0), twice as large in input coordinates; a multiscale field with ``levels``."""
    siren = Siren(24, 2, omega=3.0)
    adam = torch.optim.Adam(siren.parameters(), lr=1e-2, betas=(0.9, 0.99))
    for step in range(200):
        x = 2 * torch.rand(1024, 3) - 1
        loss = (siren.value(x) - Sphere(radius=radius).value(x)).square().mean()
        adam.param_groups[0]["lr"] = 1e-2 * (1 - step / 200)
        adam.zero_grad()
        loss.backward()
        adam.step()
    field = MultiscaleSDF(siren, [], []) if levels else siren
    save_field(path, field, similarity=Similarity((5.0, 0.0, 0.0), 2.0))


def interrupt(stage: str, step: int) -> Callable[[Progress], None]:
    """A progress display that presses Ctrl-C, once, from a step of a stage on."""
    done = []

    def report(progress: Progress) -> None:
        if progress.stage == stage and progress.step >= step and not done:
            done.append(step)
            os.kill(os.getpid(), signal.SIGINT)

    return report


def fails(
    capsys: pytest.CaptureFixture[str], line: str, main: Callable[[Sequence[str]], int] = mplicits_command
) -> str:
    """Run a command that must fail as bad input does → its one line."""
    capsys.readouterr()
    assert main(line.split()) == 2
    output, error = capsys.readouterr()
    assert output == ""
    (message,) = error.splitlines()
    return message
