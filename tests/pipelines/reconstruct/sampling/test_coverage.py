"""How rare the rays are that see a place, against densities that are known."""

import pytest
import torch
from mplicits.neural_fields.networks.value_grid import ValueGrid
from mplicits.pipelines.reconstruct.sampling.coverage import CELLS, FORGET, MOST, Coverage

CPU = torch.device("cpu")
RAYS, STEPS = 256, 1500


def on_a_sphere(count: int, generator: torch.Generator) -> torch.Tensor:
    return 0.5 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def watched(above: float, *, again: float = 1.0) -> Coverage:
    """A sphere whose upper half has ``above`` times the rays of the lower one; ``again`` times that is drawn of it."""
    generator, coverage = torch.Generator().manual_seed(0), Coverage(CPU)
    for _ in range(STEPS):
        ends = on_a_sphere(RAYS, generator)
        upper = ends[:, 2] > 0
        kept = ~upper | (torch.rand(RAYS, generator=generator) < above * again)
        coverage.learn(coverage.around(ends[kept]), torch.where(upper, again, 1.0)[kept], torch.ones(int(kept.sum())))
    return coverage


def test_vertices_and_weights_are_those_of_a_trilinear_grid() -> None:
    grid = ValueGrid(CELLS)
    grid.kept.uniform_(generator=torch.Generator().manual_seed(0))
    points = 2.2 * torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) - 1.1  # some are outside
    rows, weights = Coverage(CPU).around(points)
    torch.testing.assert_close((grid.kept.view(-1)[rows] * weights).sum(dim=1), grid(points))
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(500))


@pytest.mark.parametrize("again", [1.0, 5.0])
def test_rays_are_as_rare_as_they_are_drawn_however_often_that_is(again: float) -> None:
    coverage = watched(0.1, again=again)
    generator = torch.Generator().manual_seed(2)
    upper, lower = (side * on_a_sphere(4000, generator).abs() for side in (1, -1))
    upper, lower = (half[half[:, 2].abs() > 0.1] for half in (upper, lower))  # off the rim between them
    above, below = (coverage.rarity(coverage.around(half)) for half in (upper, lower))
    # Of all that is remembered, as many rays as an even draw has.
    window = RAYS * (1 - (1 - FORGET) ** STEPS) / FORGET
    assert float(coverage.rays.sum()) == pytest.approx(0.5 * 1.1 * window, rel=0.02)
    # With d below and d / 10 above, the mean over rays is (1 + 0.1²) / 1.1 of d. Below some 40 rays are near a place:
    # d is known to a sixth there, and its mean over thousands of places much better. Above it is known to a half.
    assert float(below.mean()) == pytest.approx(1, abs=0.15)
    assert float(above.median()) == pytest.approx(1.01 / 0.11, rel=0.2)


def test_a_single_ray_is_rare_but_not_more_than_so_much() -> None:
    coverage = watched(1.0)
    lonely = coverage.around(torch.tensor([[0.0, 0.0, 0.9]]))
    assert coverage.rarity(lonely).item() == MOST
    before = coverage.rays.clone()
    coverage.learn(lonely, torch.ones(1), torch.ones(1))
    gained = coverage.rays - (1 - FORGET) * before
    assert float(gained.sum()) == pytest.approx(1, abs=1e-2)


def test_what_nobody_has_seen_yet_is_not_rare() -> None:
    coverage, ends = Coverage(CPU), on_a_sphere(50, torch.Generator().manual_seed(0))
    assert torch.equal(coverage.rarity(coverage.around(ends)), torch.ones(50))


def test_rays_that_pass_the_surface_end_nowhere() -> None:
    coverage, ends = Coverage(CPU), on_a_sphere(50, torch.Generator().manual_seed(0))
    coverage.learn(coverage.around(ends), torch.ones(50), torch.zeros(50))
    assert not coverage.rays.any()
    assert not coverage.usual.any()
