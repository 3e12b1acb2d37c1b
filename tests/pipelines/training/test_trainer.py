"""The one loop: its schedule, when it reports, saves and stops, and that it continues to the same bits."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from mplicits.neural_fields import MultiscaleSDF, Siren
from mplicits.pipelines.training.trainer import (
    ErrorWeightedSampler,
    Group,
    Muon,
    Objective,
    Progress,
    StopFlag,
    Trainer,
    orthogonal,
    siren_groups,
    warm_cosine,
)
from torch import Tensor, nn

STEPS = 50
WARM = warm_cosine(0.1)


class Guess(Objective):
    """Numbers that shall be 1, drawn a few at a time; the last batch pulls on the next."""

    def __init__(self, seed: int = 0, rate: Callable[[float], float] = WARM) -> None:
        self.numbers = nn.Parameter(torch.zeros(8))
        network = nn.ParameterList([self.numbers, nn.Parameter(torch.zeros(1))])  # the second is not trained
        generator = torch.Generator().manual_seed(seed)
        super().__init__(network, [Group([self.numbers], rate)], generator, {"last": torch.zeros(3)})
        self.seen: list[tuple[int, float]] = []

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        self.seen.append((step, done))
        batch = self.numbers[torch.randint(8, (3,), generator=self.generator)]
        apart, moved = (batch - 1).square().sum(), (batch - self.kept["last"]).square().sum()
        self.kept["last"] = batch.detach()
        return {"apart": apart, "moved": moved}, apart + 0.1 * moved


def guess(steps: int = STEPS, **options: float) -> Trainer[Guess]:
    return Trainer(Guess(), stage="guess", steps=steps, **options)


def stop_at(step: int, flag: StopFlag) -> Callable[[Progress], None]:
    def report(progress: Progress) -> None:
        flag.requested = progress.step == step

    return report


def test_the_rate_warms_up_and_falls_as_a_cosine() -> None:
    rates = [warm_cosine(2.0)(done) for done in (0.0, 0.02, 0.5, 1.0)]
    assert rates == pytest.approx([2.0 * 0.05, 2.0, 1.0, 0.0], rel=0.01)


def test_the_rate_of_every_step_is_that_of_the_schedule() -> None:
    trainer = Trainer(Guess(rate=lambda done: 1e-3 * (1 + done)), stage="guess", steps=4)
    rates: list[float] = []
    trainer.run(report=lambda _: rates.append(trainer.adam.param_groups[0]["lr"]), report_every=1)
    assert rates[1:] == pytest.approx([1e-3, 1.25e-3, 1.5e-3, 1.75e-3])  # the first report comes before any step
    assert trainer.objective.seen == [(0, 0.0), (1, 0.25), (2, 0.5), (3, 0.75)]


def test_reports_come_at_the_beginning_every_so_many_steps_and_at_the_end() -> None:
    trainer, seen = guess(), []
    assert trainer.run(report=seen.append, report_every=20)
    assert {progress.stage for progress in seen} == {"guess"}
    assert [(progress.step, progress.fraction) for progress in seen] == [(0, 0.0), (20, 0.4), (40, 0.8), (50, 1.0)]
    assert seen[1].losses["apart"] > seen[-1].losses["apart"]
    assert trainer.losses == seen[-1].losses
    assert not trainer.ended_early


def test_checkpoints_come_by_the_clock_and_before_a_stop() -> None:
    trainer, saved, flag = guess(), [], StopFlag()
    assert not trainer.run(
        flag, report=stop_at(5, flag), save=lambda: saved.append(trainer.step), report_every=1, save_every=0.0
    )
    assert saved == [1, 2, 3, 4, 5, 5]  # it stops after the step under way, also when asked during its report
    assert not trainer.run(flag, save=lambda: saved.append(trainer.step))
    assert saved[-2:] == [5, 5]  # nothing more is done while the flag stands


def test_a_time_budget_or_no_steps_end_the_schedule() -> None:
    trainer = guess(10**9, seconds=0.2)
    last: list[Progress] = []
    assert trainer.run(report=last.append, report_every=10**9)
    assert trainer.ended_early
    assert 0.2 <= trainer.elapsed < 5
    assert [progress.fraction for progress in last] == [0.0, 1.0]
    none = guess(0)
    assert none.run()
    assert none.objective.numbers.eq(0).all()


@pytest.mark.parametrize("without", [None, "adam.0.exp_avg", "generator", "last", "model.0"])
def test_a_stopped_training_continues_to_the_same_bits_but_not_without_a_part_of_its_state(without: str | None) -> None:
    whole, first, second = (
        Trainer(Guess(seed), stage="guess", steps=STEPS, clip=1.0, network_name="model") for seed in (0, 0, 7)
    )
    fresh, flag = second.state() | {"adam.0.exp_avg": torch.zeros(8)}, StopFlag()
    whole.run()
    first.run(flag, report=stop_at(20, flag))
    state = {name: tensor.clone() for name, tensor in first.state().items()}
    assert set(state) == {
        *("model.0", "model.1", "adam.0.step", "adam.0.exp_avg", "adam.0.exp_avg_sq"),
        *("generator", "progress", "last"),
    }
    if without is not None:
        state[without] = fresh[without]
    second.restore(state)
    assert (second.step, second.elapsed) == (20, first.elapsed)
    second.run()
    assert torch.equal(second.objective.numbers, whole.objective.numbers) is (without is None)


@pytest.mark.parametrize("shape", [(24, 24), (16, 40), (40, 16)])
def test_singular_values_become_nearly_one_and_directions_stay(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    left, _, right = torch.linalg.svd(torch.randn(*shape, dtype=torch.float64), full_matrices=False)
    # Of a matrix of norm below 2, the least is 0.01 of the norm: its part grows 3.4-fold in each step, up to about 1.
    values = torch.linspace(0.02, 0.6, min(shape), dtype=torch.float64)
    # Of two at a time, each is made orthogonal by itself.
    found, other = orthogonal(torch.stack((left * values @ right, 1e-3 * left * values.flip(0) @ right)))
    found, other = (left.T @ each @ right.T for each in (found, other))
    assert torch.allclose(other, found.flip(0, 1))
    assert float(found.diag().min()) > 0.67
    assert float(found.diag().max()) < 1.21
    assert (found - found.diag().diag()).abs().max() < 1e-12
    assert orthogonal(torch.zeros(1, *shape)).eq(0).all()


def test_a_step_of_matrices_is_as_long_as_the_rate_in_all_directions() -> None:
    torch.manual_seed(0)
    matrix, target = nn.Parameter(torch.randn(12, 12)), torch.randn(12, 12)
    before, errors = matrix.detach().clone(), []
    optimiser = Muon([{"params": [matrix], "lr": 0.1}])
    for _ in range(100):
        optimiser.zero_grad()
        loss = (matrix - target).square().sum()
        loss.backward()
        optimiser.step()
        if not errors:
            lengths = torch.linalg.svdvals(matrix.detach() - before)
            assert 0.05 < float(lengths.min()) <= float(lengths.max()) < 0.121
        errors.append(float(loss.detach()))
    # The step of a constant rate ends where it is as long as the way: within 0.121 in each of twelve directions.
    assert errors[-1] < 12 * 0.25**2 < errors[0]


class _Constant(Objective):
    """Shall be 1 everywhere; the step of Adam's parameters is 0, that of matrices always at its peak."""

    def __init__(self, network: MultiscaleSDF, turn: float) -> None:
        others, *hidden = siren_groups(network, 1e-3, turn)
        self.rates = [max(map(group.rate, np.linspace(0, 1, 101))) for group in (others, *hidden)]
        pairs = zip(hidden, self.rates[1:], strict=True)
        peaks = [group._replace(rate=lambda _, rate=rate: rate) for group, rate in pairs]
        super().__init__(network, [others._replace(rate=lambda _: 0.0), *peaks], torch.Generator().manual_seed(0))
        self.field = network

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        loss = (self.field.value(torch.rand(256, 3, generator=self.generator)) - 1).square().mean()
        return {"loss": loss}, loss


def test_a_step_changes_phases_by_the_turn_whatever_the_frequency_and_width() -> None:
    torch.manual_seed(0)
    sizes = [(16, 3), (64, 3), (8, 1)]
    field = MultiscaleSDF.from_widths(sizes, omegas=(5.0, 80.0, 9.0), deltas=[10.0, 10.0])
    learner = _Constant(field, 0.4)
    _, *hidden = learner.groups
    grouped = [id(parameter) for group in learner.groups for parameter in group.parameters]
    assert sorted(grouped) == sorted(id(parameter) for parameter in field.parameters())
    assert [[matrix.shape for matrix in group.parameters] for group in hidden] == [[(w, w)] * 2 for w, _ in sizes[:2]]
    assert [group.matrices for group in learner.groups] == [False, True, True]
    assert learner.rates == pytest.approx([1e-3, 0.4 / 5, 0.4 / 80], rel=1e-2)
    before = [matrix.detach().clone() for group in hidden for matrix in group.parameters]
    Trainer(learner, stage="constant", steps=1).run()
    omegas = (5.0, 5.0, 80.0, 80.0)
    after = [matrix.detach() for group in hidden for matrix in group.parameters]
    for omega, old, new in zip(omegas, before, after, strict=True):
        change = omega * torch.linalg.svdvals(new - old).max()  # of phases, over the norm of the input
        assert 0.25 < float(change) < 1.21 * 0.4


def test_frozen_levels_and_networks_without_hidden_matrices_are_left_to_nobody_and_to_adam() -> None:
    field = MultiscaleSDF.from_widths([(8, 2), (8, 2)], omegas=(5.0, 9.0), deltas=[1.0])
    field.base.requires_grad_(False)
    others, hidden = siren_groups(field, 1e-3, 0.4)
    found = {id(parameter) for group in (others, hidden) for parameter in group.parameters}
    assert found == {id(parameter) for parameter in field.levels[1].parameters()}
    for network, turn in ((field, 0.0), (Siren(8, 1), 0.4), (nn.Linear(8, 8), 0.4)):
        (alone,) = siren_groups(network, 1e-3, turn)
        assert not alone.matrices


def test_a_step_that_is_not_taken_changes_neither_matrix_nor_momentum() -> None:
    torch.manual_seed(0)
    matrix, lazy = nn.Parameter(torch.randn(6, 6)), nn.Parameter(torch.randn(6, 6))
    optimiser = Muon([{"params": [matrix, lazy], "lr": 0.1}])
    for skipped in (False, True, False):
        before = matrix.detach().clone(), optimiser.state[matrix].get("momentum", torch.zeros(6, 6)).clone()
        optimiser.found_inf = torch.tensor(float(skipped))
        matrix.grad = torch.randn(6, 6)
        optimiser.step()
        after = matrix.detach(), optimiser.state[matrix]["momentum"]
        assert all(torch.equal(old, new) is skipped for old, new in zip(before, after, strict=True))
    assert lazy not in optimiser.state  # without a gradient, as of a level that is not yet switched on


STRIP = 16
PIXELS, DRAWS = 5 * STRIP + 3, 40_000
CPU = torch.device("cpu")


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_strips_are_drawn_by_their_errors_and_their_pixels_alike(share: float) -> None:
    sampler = ErrorWeightedSampler(PIXELS, share, CPU)
    sampler.errors = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.5, 0.5])
    sampler.refresh()
    rows = sampler.rows(DRAWS, generator())
    lengths = torch.tensor([STRIP] * 5 + [3])
    by_error = (sampler.errors / sampler.errors.sum() / lengths).repeat_interleave(lengths)
    chance = (1 - share) / PIXELS + share * by_error
    count = torch.bincount(rows, minlength=PIXELS)
    # Five standard deviations of a binomial count: of 83 of them one is outside in 20,000 seeds.
    assert len(count) == PIXELS
    assert ((count - DRAWS * chance).abs() <= 5 * (DRAWS * chance).sqrt()).all()


def test_errors_count_once_they_are_looked_at() -> None:
    sampler = ErrorWeightedSampler(PIXELS, 1.0, CPU)
    sampler.learn(torch.arange(STRIP, PIXELS), torch.zeros(PIXELS - STRIP))
    assert (sampler.rows(1000, generator()) >= STRIP).any()
    for _ in range(60):  # without errors the means of the others go to 0
        sampler.learn(torch.arange(STRIP, PIXELS), torch.zeros(PIXELS - STRIP))
    sampler.refresh()
    assert (sampler.rows(1000, generator()) < STRIP).all()


def test_a_strip_has_the_mean_of_what_was_known_and_of_what_is_said() -> None:
    sampler = ErrorWeightedSampler(PIXELS, 0.5, CPU)
    sampler.learn(torch.tensor([0, 1, STRIP]), torch.tensor([0.2, 0.6, 3.0]))
    torch.testing.assert_close(sampler.errors, torch.tensor([(1 + 0.2 + 0.6) / 3, 2.0, 1.0, 1.0, 1.0, 1.0]))


def test_probabilities_are_updated_in_place_every_sixteen_steps() -> None:
    sampler, kept = ErrorWeightedSampler(PIXELS, 0.5, CPU), {}
    kept |= sampler.kept
    bounds = sampler.bounds
    sampler.at_step(0, kept).learn(torch.arange(STRIP), torch.zeros(STRIP))
    for step in range(1, 16):
        assert sampler.at_step(step, kept).bounds.tolist() == [1, 2, 3, 4, 5, 6]
    first = 1 / (1 + STRIP)
    expected = torch.arange(6, dtype=torch.float64) + first
    torch.testing.assert_close(sampler.at_step(16, kept).bounds, expected, atol=1e-6, rtol=0)
    assert sampler.bounds is bounds  # which recorded steps read


def test_state_of_other_strips_begins_anew() -> None:
    old, sampler = (ErrorWeightedSampler(PIXELS, 0.5, CPU, strip=strip) for strip in (STRIP, 4 * STRIP))
    kept = {name: tensor + 1 for name, tensor in old.kept.items()}
    rows = sampler.at_step(1, kept).rows(1000, generator())
    assert kept["errors"].tolist() == [1, 1]
    assert 0 <= int(rows.min()) < STRIP < PIXELS - STRIP < int(rows.max()) < PIXELS


def test_without_a_share_pixels_are_drawn_by_chance_and_nothing_is_learnt() -> None:
    sampler = ErrorWeightedSampler(PIXELS, 0.0, CPU)
    sampler.learn(torch.arange(PIXELS), torch.zeros(PIXELS))
    assert (sampler.errors == 1).all()
    assert torch.equal(sampler.rows(50, generator()), torch.randint(PIXELS, (50,), generator=generator()))
