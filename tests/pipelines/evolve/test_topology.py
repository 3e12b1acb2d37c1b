"""Changes of topology against closed forms: when spheres touch, and when a torus closes."""

import pytest
import torch
from mplicits.neural_fields import FunctionField, TimeSlice
from mplicits.neural_fields.meshing.extract import surface_of
from mplicits.pipelines.evolve.checks import check_evolution, warnings
from mplicits.pipelines.evolve.problem import End
from mplicits.pipelines.evolve.topology import CHANGES, Topology, find_changes, topology_of
from torch import Tensor

RESOLUTION = 32
CELL = 2 / RESOLUTION


def meeting(x: Tensor) -> Tensor:
    """Two balls of radius 0.25 whose centres come nearer on a diagonal: they touch at t = 0.6."""
    middle, way = torch.tensor([0.1, 0.2, 0.0]), torch.tensor([0.6, 0.8, 0.0])
    apart = (0.55 - 0.5 * x[..., 3:]) * way
    return torch.stack([(x[..., :3] - middle - side * apart).norm(dim=-1) - 0.25 for side in (1, -1)]).amin(dim=0)


def closing(x: Tensor) -> Tensor:
    """A torus of radius 0.4, its tube 0.15 + 0.4 t: the hole closes at t = 0.625."""
    y = x[..., :3] - torch.tensor([0.02, -0.01, 0.03])
    return torch.hypot(y[..., :2].norm(dim=-1) - 0.4, y[..., 2]) - 0.15 - 0.4 * x[..., 3]


def changes_of(field: FunctionField, times: list[float]):
    found = [topology_of(surface_of(TimeSlice(field, time), resolution=RESOLUTION)) for time in times]
    return find_changes(field, times, found, resolution=RESOLUTION)


@pytest.mark.parametrize(
    ("function", "when", "before", "after", "speed"),
    [
        (meeting, 0.6, Topology(2, 0), Topology(1, 0), 0.5),
        (closing, 0.625, Topology(1, 1), Topology(1, 0), 0.4),
    ],
)
def test_a_change_is_found_when_it_is(function, when, before, after, speed):
    (change,) = changes_of(FunctionField(function, in_dim=4), [0.0, 0.35, 1.0])
    assert (change.before, change.after) == (before, after)
    assert change.within <= CHANGES.one
    # A gap or neck thinner than a cell's diagonal is not seen; both sides of a gap come nearer with ``speed``.
    assert abs(change.time - when) < 3**0.5 * CELL / speed / 2 + CHANGES.one


def test_what_stays_has_no_changes():
    assert changes_of(FunctionField(meeting, in_dim=4), [0.0, 0.2, 0.4]) == []


def test_what_vanishes_is_found():
    def shrinking(x: Tensor) -> Tensor:
        return (x[..., :3] - 0.3).norm(dim=-1) - 0.4 + 0.5 * x[..., 3]

    (change,) = changes_of(FunctionField(shrinking, in_dim=4), [0.0, 1.0])
    assert (change.before, change.after) == (Topology(1, 0), Topology(0, 0))
    assert abs(change.time - 0.8) < CELL / 0.5 * 3**0.5 + CHANGES.narrow  # a ball within a cell is not seen


def test_changes_are_recorded():
    field = FunctionField(meeting, in_dim=4)
    ends = [End(name, time, torch.eye(3), 0.9 * torch.eye(3)) for name, time in (("a", 0.0), ("b", 1.0))]
    checks = check_evolution(field, ends, frames=3, resolution=24)
    (change,) = checks["changes"]
    assert change["before"] == {"components": 2, "holes": 0}
    assert [frame["holes"] for frame in checks["frames"]] == [0, 0, 0]
    assert not any("pieces" in line for line in checks["warnings"])


def test_more_pieces_than_at_either_end_are_warned_about():
    frames = [{"time": t, "components": n} for t, n in ((0.0, 1), (0.5, 3), (1.0, 2))]
    ends = [{"name": "a", "time": t, "ratio": 1.0} for t in (0.0, 1.0)]
    (line,) = warnings({"frames": frames, "ends": ends})
    assert line.startswith("3 pieces at t = 0.5, and 2 at most where shapes are met")
    assert not warnings({"frames": frames, "ends": ends[:1]})
