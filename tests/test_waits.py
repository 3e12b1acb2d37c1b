"""What keeps the host waiting, held to what was reached; `waits.py` counts, and prints the table of the docs."""

from pathlib import Path

import fake_accelerator
import pytest
import torch
import waits
from mplicits.neural_fields import Sphere
from mplicits.neural_fields.tracing.cones import cone_starts
from reconstructions import small_reconstructions
from waits import Row


def per_unit(row: Row) -> float:
    return row.ledger.synchronisations / row.count


def test_the_tracer_is_looked_at_once_in_eight_passes() -> None:
    row = waits.tracing(300)
    assert row.count > 16
    assert per_unit(row) <= 1 / 8, row.ledger.report()


def test_cones_are_looked_at_once_for_each_size_of_tiles() -> None:
    """Where eight steps are enough for all of a size."""
    across = torch.linspace(-0.4, 0.4, 24)
    rows, columns = torch.meshgrid(across, across, indexing="ij")
    directions = torch.stack((columns, rows, torch.ones_like(rows)), dim=-1)
    field, origin = Sphere(radius=0.5), torch.tensor([0.0, 0.0, -2.2])
    near = cone_starts(field, origin, directions, tiles=(8, 4))
    there = [part.to(waits.DEVICE) for part in (field, origin, directions)]
    with fake_accelerator.counted() as ledger:
        ahead = cone_starts(*there, tiles=(8, 4))
    assert torch.equal(ahead.cpu(), near)
    looks = [times for (_, where), times in ledger.waits.items() if where.startswith("neural_fields/tracing/cones.py")]
    assert sum(looks) == 2, ledger.report()


@pytest.mark.parametrize("name", ["value", "jet"])
def test_fixed_shapes_need_no_wait(name: str) -> None:
    ask = getattr(waits.MultiscaleSDF, name)
    assert waits.evaluating(name, ask, fixed=True).ledger.synchronisations == 0
    assert waits.evaluating(name, ask).ledger.synchronisations == 2  # one for each residual


def test_training_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    small_reconstructions(monkeypatch)
    limits = {"`fit`": 0, "`reconstruct`, reconstruct": 3, "`reconstruct`, texture": 0}
    seen = set()
    for row in waits.trainings():
        (limit,) = [limit for name, limit in limits.items() if row.name.startswith(name)]
        assert per_unit(row) <= limit, f"{row}\n{row.ledger.report()}"
        seen.add(row.name)
    assert len(seen) == 5
