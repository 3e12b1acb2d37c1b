"""How long the mesh of a run should take, for progress displays; and a stage that is told when it begins and ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ..run.costs import Net, Speed, jets, values
from ..run.schedule import Progress, Report, Stage

__all__ = ["MESH", "mesh_stage", "meshing"]

MESH = "mesh"


def mesh_stage(nets: Sequence[Net], speed: Speed, *, resolution: int = 256, name: str = MESH) -> Stage:
    """How long a mesh of a field takes, by the rows that the mesher evaluates on an Armadillo.

    Args:
        nets: sizes of the field's levels.
        speed: of the machine.
        resolution: cells along each side.
        name: of the stage.
    """
    work = values(4 * resolution**2, nets) + jets(2 * resolution**2, nets)
    return Stage(name, "mesh", speed.points(work))


@contextmanager
def meshing(report: Report | None) -> Iterator[None]:
    """Tell ``report`` that a mesh is made inside, and that it is done."""
    tell = report or (lambda _: None)
    tell(Progress(MESH, 0, 0, 0.0, {}))
    yield
    tell(Progress(MESH, 0, 0, 1.0, {}))
