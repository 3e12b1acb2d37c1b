"""How often an accelerator keeps the host waiting, on the fake accelerator: ``python tests/helpers/waits.py``.

A row is one workload, per pass, picture, call or training step. With ``--where``, the lines that wait most.
"""

import argparse
import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import fake_accelerator
import torch
from fields import solve_sphere
from mplicits.datasets import sample_torus, write_cloud_ply
from mplicits.datasets.cameras import look_at
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.writing import write_neus
from mplicits.neural_fields import Field, MultiscaleSDF, sphere_trace
from mplicits.neural_fields.backend.fixed_shapes import fixed_shapes
from mplicits.pipelines.cli.entry import main as command
from mplicits.pipelines.render.trace import trace_view
from mplicits.pipelines.training.trainer import Trainer
from torch import Tensor

DEVICE = torch.device(fake_accelerator.NAME)
FIT = "--widths 16 16 16 --depths 1 1 1 --omegas 5 10 20 --steps 40 20 20 --learning-rates 1e-2 1e-3 1e-3"
FIT += " --batch 128 --samples 500 --quiet"
RECONSTRUCT = "--widths 16 16 --depths 1 1 --color-width 16 --color-depth 1 --color-grid 8 --steps 20 --rays 16"
RECONSTRUCT += " --uniform 8 --importance 4 --texture-steps 20 --quiet"


@dataclass
class Row:
    """Counts of one workload, over ``count`` units."""

    name: str
    unit: str
    count: int
    ledger: fake_accelerator.Ledger

    def __str__(self) -> str:
        waits, kernels = (part / self.count for part in (self.ledger.synchronisations, self.ledger.kernels))
        return f"| {self.name} | {self.count} × {self.unit} | {waits:.2f} | {kernels:.0f} |"


def three_levels() -> MultiscaleSDF:
    """A sphere of radius ½ with two untrained residuals of the paper's sizes, small, in bands that most rays enter."""
    torch.manual_seed(0)
    sizes, omegas, deltas = [(128, 2), (256, 2), (400, 2)], [10, 45, 100], [0.03, 0.015]
    field = MultiscaleSDF.from_widths(sizes, omegas=omegas, deltas=deltas, residual_gain=0.01)
    solve_sphere(field.base)
    return field.requires_grad_(False)


def some_rays(count: int) -> tuple[Tensor, Tensor]:
    """From all sides towards a ball a little larger than the sphere."""
    generator = torch.Generator().manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1) * 2
    aims = 0.35 * torch.randn(count, 3, generator=generator)
    return origins, torch.nn.functional.normalize(aims - origins, dim=-1)


@contextlib.contextmanager
def passes_of(field: type[Field]) -> Iterator[list[int]]:
    """The numbers of rows of the evaluations of ``field`` inside the ``with``."""
    asked, value = [], field.value

    def watched(self: Field, x: Tensor, *, level: int = -1) -> Tensor:
        asked.append(len(x))
        return value(self, x, level=level)

    with mock.patch.object(field, "value", watched):
        yield asked


def tracing(count: int = 500) -> Row:
    """One trace of ``count`` rays; its unit is a pass: an evaluation of all rays under way."""
    field = three_levels().to(DEVICE)
    origins, directions = (part.to(DEVICE) for part in some_rays(count))
    with passes_of(MultiscaleSDF) as asked, fake_accelerator.counted() as ledger:
        sphere_trace(field, origins, directions)
    return Row(f"`sphere_trace`, {count} rays, three levels", "pass", len(asked), ledger)


def drawing(size: int = 64) -> Row:
    """The rays of one picture, tiles first, and what they see."""
    field = three_levels().to(DEVICE)
    camera = look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov=30.0, width=size, height=size)
    with fake_accelerator.counted() as ledger:
        trace_view(field, camera, device=DEVICE)
    return Row(f"`trace_view`, {size}², three levels", "picture", 1, ledger)


def evaluating(name: str, ask: Callable[[MultiscaleSDF, Tensor], object], *, fixed: bool = False) -> Row:
    """One evaluation, in fixed shapes or not."""
    field = three_levels().to(DEVICE)
    x = some_rays(1000)[0].to(DEVICE) * torch.linspace(0.2, 0.3, 1000, device=DEVICE)[:, None]
    with fake_accelerator.counted() as ledger, fixed_shapes() if fixed else contextlib.nullcontext():
        ask(field, x)
    return Row(name, "call", 1, ledger)


@contextlib.contextmanager
def counted_steps() -> Iterator[dict[str, list[fake_accelerator.Ledger]]]:
    """The counts of each training step inside the ``with``, by stage."""
    step, stages = Trainer._step, {}

    def watched(self: Trainer) -> object:
        with fake_accelerator.counted() as ledger:
            result = step(self)
        stages.setdefault(self.stage, []).append(ledger)
        return result

    with mock.patch.object(Trainer, "_step", watched):
        yield stages


def training(words: str, name: str) -> list[Row]:
    with counted_steps() as stages, contextlib.redirect_stdout(io.StringIO()):
        assert command([*words.split(), "--device", fake_accelerator.NAME]) == 0
    rows = []
    for stage, steps in stages.items():
        together = fake_accelerator.Ledger()
        for ledger in steps:
            together.waits.update(ledger.waits)
            together.launches.update(ledger.launches)
        rows.append(Row(f"{name}, {stage}", "step", len(steps), together))
    return rows


def rows() -> Iterator[Row]:
    yield tracing()
    yield drawing()
    for name, ask in (("value", MultiscaleSDF.value), ("jet", MultiscaleSDF.jet)):
        yield evaluating(f"`MultiscaleSDF.{name}`", ask)
        yield evaluating(f"`MultiscaleSDF.{name}` in `fixed_shapes`", ask, fixed=True)
    yield from trainings()


def trainings() -> Iterator[Row]:
    write_cloud_ply(Path("scan.ply"), sample_torus(400))
    yield from training(f"fit scan.ply -o run {FIT}", "`fit`")
    write_neus(Path("photos"), render_scene(SCENES["painted-sphere"](), views=6, size=12, samples=2))
    yield from training(f"reconstruct photos -o photographed {RECONSTRUCT}", "`reconstruct`")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--where", action="store_true", help="the lines that wait most")
    arguments = parser.parse_args()
    print("| work | counted over | waits | launches |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for row in rows():
            print(row, flush=True)
            if arguments.where:
                print(row.ledger.report(12), file=sys.stderr)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
