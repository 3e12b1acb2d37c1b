"""Pixels drawn by how wrong their strips were: as often as promised, and no pixel that is not there."""

import pytest
import torch
from mplicits.pipelines.training.focus import STRIP, Focus

PIXELS, DRAWS = 5 * STRIP + 3, 40_000
CPU = torch.device("cpu")


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_strips_are_drawn_by_their_errors_and_their_pixels_alike(share: float) -> None:
    focus = Focus(PIXELS, share, CPU)
    focus.errors = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.5, 0.5])
    focus.refresh()
    rows = focus.rows(DRAWS, generator())
    lengths = torch.tensor([STRIP] * 5 + [3])
    by_error = (focus.errors / focus.errors.sum() / lengths).repeat_interleave(lengths)
    chance = (1 - share) / PIXELS + share * by_error
    count = torch.bincount(rows, minlength=PIXELS)
    # Five standard deviations of a binomial count: of 83 of them one is outside in 20,000 seeds.
    assert len(count) == PIXELS
    assert ((count - DRAWS * chance).abs() <= 5 * (DRAWS * chance).sqrt()).all()


def test_errors_count_once_they_are_looked_at() -> None:
    focus = Focus(PIXELS, 1.0, CPU)
    focus.learn(torch.arange(STRIP, PIXELS), torch.zeros(PIXELS - STRIP))
    assert (focus.rows(1000, generator()) >= STRIP).any()
    for _ in range(60):  # each says nothing was wrong: the means of the others go to 0
        focus.learn(torch.arange(STRIP, PIXELS), torch.zeros(PIXELS - STRIP))
    focus.refresh()
    assert (focus.rows(1000, generator()) < STRIP).all()


def test_a_strip_has_the_mean_of_what_was_known_and_of_what_is_said() -> None:
    focus = Focus(PIXELS, 0.5, CPU)
    focus.learn(torch.tensor([0, 1, STRIP]), torch.tensor([0.2, 0.6, 3.0]))
    torch.testing.assert_close(focus.errors, torch.tensor([(1 + 0.2 + 0.6) / 3, 2.0, 1.0, 1.0, 1.0, 1.0]))


def test_without_a_share_pixels_are_drawn_by_chance_and_nothing_is_learnt() -> None:
    focus = Focus(PIXELS, 0.0, CPU)
    focus.learn(torch.arange(PIXELS), torch.zeros(PIXELS))
    assert (focus.errors == 1).all()
    assert torch.equal(focus.rows(50, generator()), torch.randint(PIXELS, (50,), generator=generator()))
