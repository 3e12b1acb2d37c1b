"""Held-out points: drawn by voxels, and a level that is worse at them is not kept."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fits import SMALL
from mplicits.datasets import PointCloud, sample_sphere
from mplicits.neural_fields import Siren, Sphere
from mplicits.neural_fields.fields.losses import pseudo_huber
from mplicits.pipelines.cli.fit import describe
from mplicits.pipelines.fit.level import (
    JUDGE,
    Error,
    Fall,
    Judge,
    LevelObjective,
    Verdict,
    held_out,
    noisy_points,
    standard_errors,
)
from mplicits.pipelines.fit.samples import RobustScales, Samples, Source, at_feet, with_previous
from mplicits.pipelines.fit.train import fit
from mplicits.pipelines.training.trainer import Group, StopFlag, Trainer

CPU = torch.device("cpu")
RADIUS, OFF = 0.5, 0.02
SPACING = 0.05  # of the thousand points below


def points(count: int) -> torch.Tensor:
    return torch.from_numpy(sample_sphere(count, radius=RADIUS).points).float()


def judge_of(sphere: float, *, data: float = 100.0, normal: float = 3.0, guessed: bool = False) -> Judge:
    """Of a sphere's points, by a frozen sphere of another radius."""
    x, frozen = points(1000), Sphere(radius=sphere)
    return Judge(x, x / RADIUS, frozen, 0.1, spacing=SPACING, data=data, normal=normal, guessed=guessed)


def zero_siren(bias: float) -> Siren:
    """A residual that is constant."""
    siren = Siren(8, 2, omega=10.0)
    torch.nn.init.zeros_(siren.output.weight)
    torch.nn.init.constant_(siren.output.bias, bias)
    return siren


def test_whole_voxels_are_held_out() -> None:
    x = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)).astype(np.float32)
    spacing = 0.1
    held = held_out(x, spacing, 0.03)
    size = np.bincount(np.unique(np.floor(x / (JUDGE.voxel * spacing)), axis=0, return_inverse=True)[1].reshape(-1))
    assert 600 <= held.sum() <= 600 + size.max()
    assert 600 <= held_out(x, spacing, 0.01).sum() <= 600 + size.max()  # a share would be two hundred
    assert 400 <= held_out(x[:8000], spacing, 0.01).sum() <= 400 + size.max()  # and six hundred too many
    cells = np.floor(x.astype(np.float64) / (JUDGE.voxel * spacing)).astype(np.int64)
    inside, outside = ({tuple(cell) for cell in cells[rows].tolist()} for rows in (held, ~held))
    assert not inside & outside
    assert (held_out(x, spacing, 0.03) == held).all()
    assert (held_out(x, spacing, 0.03, seed=1) != held).any()
    assert held_out(x[:3000], spacing, 0.01).sum() >= JUDGE.fewest  # fewer tell nothing
    for few, share in ((x, 0.0), (x[: 10 * JUDGE.fewest - 1], 0.03)):
        assert not held_out(few, spacing, share).any()


def test_the_loss_at_held_out_points_is_that_of_equation_4() -> None:
    judge = judge_of(RADIUS - OFF)
    assert judge.count == 1000
    # The normals agree, and the scale of the data is the median of their squares: s (√(1 + 2 e/s) − 1) at e = s.
    assert judge.before.loss == pytest.approx(100 * OFF**2 * (3**0.5 - 1), rel=1e-4)
    assert judge.before.distance == pytest.approx(OFF, rel=1e-4)
    assert judge.before.angle == pytest.approx(0, abs=1e-4)  # degrees, in float32
    assert judge.errors(zero_siren(-OFF)).mean().loss == pytest.approx(0, abs=1e-6)  # 3 (1 − cos), in float32
    assert judge.errors(zero_siren(OFF)).mean().loss == pytest.approx(100 * OFF**2 * 2, rel=1e-4)  # e = 4 s
    x = points(1000)
    outside = Judge(x, x, Sphere(radius=0.1), 0.1, spacing=SPACING, data=1.0, normal=1.0)  # of the band
    assert outside.count == 0
    assert not outside.verdict(outside.without, 1.0).better
    against = Judge(x, -x / RADIUS, Sphere(radius=RADIUS), 0.1, spacing=SPACING, data=1.0, normal=3.0)
    assert against.before.loss == pytest.approx(2 * 3.0, rel=1e-6)
    assert against.before.angle == pytest.approx(180, abs=0.1)


def test_the_angle_at_held_out_points_is_their_mean() -> None:
    x = points(1001)
    across = torch.nn.functional.normalize(torch.linalg.cross(x, torch.tensor([[0.3, 0.5, -0.8]])), dim=1)
    angle = torch.deg2rad(torch.linspace(0, 8, 1001) ** 2 / 8)[:, None]
    tilted = angle.cos() * x / RADIUS + angle.sin() * across
    judge = Judge(x, tilted, Sphere(radius=RADIUS), 0.1, spacing=SPACING, data=1.0, normal=1.0)
    assert judge.before.angle == pytest.approx(8 / 3, rel=1e-3)
    assert judge.before.loss == pytest.approx(float((1 - angle.cos()).mean()), rel=1e-3)


def test_large_errors_count_as_the_level_counts_them() -> None:
    x = points(1000)
    terms = {"data": 100.0, "normal": 3.0, "scales": RobustScales(data=1e-5, normal=1e-3)}
    judge = Judge(x, -x / RADIUS, Sphere(radius=RADIUS - OFF), 0.1, spacing=SPACING, **terms)
    turned, away = 1e-3 * ((1 + 4 / 1e-3) ** 0.5 - 1), 1e-5 * ((1 + 2 * OFF**2 / 1e-5) ** 0.5 - 1)  # 1 − cos = 2
    assert judge.before.loss == pytest.approx(3 * turned + 100 * away, rel=1e-4)


def objective(judge: Judge, target: float, turn: float = 0.0) -> LevelObjective:
    """Learns a constant ``target`` everywhere."""
    x = points(2000)
    samples = with_previous(Samples(x, torch.full((2000,), target)), Sphere(radius=RADIUS - OFF), 0.1, device=CPU)
    source = Source("surface", samples, 256, 1e4, 0.0, 0.0)
    generator = torch.Generator().manual_seed(0)
    return LevelObjective(zero_siren(0.0), [source], learning_rate=1e-2, generator=generator, judge=judge, turn=turn)


def test_the_best_weights_are_kept_and_checkpoints_keep_them() -> None:
    # Before: f = OFF at the points. The level learns f = −3 OFF there, and passes by the truth on its way.
    learner = objective(judge_of(RADIUS - OFF), -3 * OFF)
    trainer = Trainer(learner, stage="level 1", steps=80)
    trainer.run()
    last = learner.judge.errors(learner.siren).mean()
    other = objective(judge_of(RADIUS - OFF), -3 * OFF)
    resumed = Trainer(other, stage="level 1", steps=80)
    resumed.restore(trainer.state())
    verdict = learner.take_best()
    assert verdict.after.loss < last.loss
    assert 0 < verdict.at < 1
    assert learner.judge.errors(learner.siren).mean() == verdict.after
    assert other.take_best() == verdict


def test_a_stopped_level_continues_to_the_same_bits() -> None:
    def trainer() -> Trainer[LevelObjective]:
        torch.manual_seed(0)
        return Trainer(objective(judge_of(RADIUS - OFF), 0.0, turn=0.4), stage="level 1", steps=12)

    whole, first, second = trainer(), trainer(), trainer()
    whole.run()
    flag = StopFlag()
    first.run(flag, report=lambda progress: setattr(flag, "requested", progress.step == 5), report_every=1)
    state = {name: tensor.clone() for name, tensor in first.state().items()}
    second.restore(state)
    second.run()
    for mine, theirs in zip(second.trained, whole.trained, strict=True):
        assert torch.equal(mine, theirs)
    third = trainer()  # of a version that trained everything with Adam: its moments begin anew
    third.restore({name: tensor for name, tensor in state.items() if "momentum" not in name})
    third.run()
    assert any(not torch.equal(mine, theirs) for mine, theirs in zip(third.trained, whole.trained, strict=True))


def test_a_level_that_gets_worse_is_trained_to_its_end_and_not_kept() -> None:
    """Most gains come late, so nothing that held-out points say on the way ends a training."""
    wrong = objective(judge_of(RADIUS - OFF), 0.0)
    torch.manual_seed(0)
    wrong.siren.load_state_dict(Siren(8, 2, omega=10.0).state_dict())  # far from the truth, in distance and in angle
    wrong.groups = [Group(list(wrong.siren.parameters()), lambda _: 0.0)]
    trainer = Trainer(wrong, stage="level 1", steps=80)
    assert trainer.run()
    assert trainer.step == 80
    assert not wrong.take_best().better


def test_what_chance_may_have_done_is_not_sure() -> None:
    falls, apart = torch.tensor([0.0, 2.0]).repeat(50), torch.arange(100)
    # Their mean is 1, and their standard deviation √(100 / 99).
    assert standard_errors(falls, apart) == pytest.approx(1 / (100 / 99) ** 0.5 * 10, rel=1e-6)
    assert standard_errors(-falls, apart) == pytest.approx(-standard_errors(falls, apart))
    for fall, expected in ((1.0, math.inf), (-1.0, -math.inf), (0.0, 0.0), (math.nan, -math.inf)):
        assert standard_errors(torch.full((100,), fall), apart) == expected
    assert standard_errors(torch.zeros(0), torch.zeros(0, dtype=torch.int64)) == 0


def test_points_of_one_voxel_count_once() -> None:
    falls = torch.from_numpy(np.random.default_rng(0).normal(0.3, 1.0, 100))
    alone = standard_errors(falls, torch.arange(100))
    assert standard_errors(falls.repeat(4), torch.arange(100).repeat(4)) == pytest.approx(alone, rel=1e-12)
    assert standard_errors(falls.repeat(4), torch.arange(400)) == pytest.approx(alone * (399 / 99) ** 0.5, rel=1e-12)
    # In one voxel, a wave cancels itself.
    waves = 0.1 + torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(50)
    assert standard_errors(waves, torch.arange(100) // 2) > 1e6 > 2 > standard_errors(waves, torch.arange(100))


def test_a_level_gets_the_best_mean_of_its_weights() -> None:
    learner = objective(judge_of(RADIUS - OFF), 0.0)
    share = 1 - math.exp(-0.25 / JUDGE.averaged)  # of the mean, after a quarter of the schedule
    means = [0.0]
    for bias, done in ((-1.1 * OFF, 0.25), (-0.95 * OFF, 0.5), (-0.5 * OFF, 0.75)):
        torch.nn.init.constant_(learner.siren.output.bias, bias)
        learner.look(done)
        means.append(means[-1] + share * (bias - means[-1]))
    verdict = learner.take_best()
    assert verdict.at == 0.5
    assert float(learner.siren.output.bias.detach()) == pytest.approx(means[2], rel=1e-5)
    assert verdict.after.distance == pytest.approx(OFF + means[2], rel=1e-3)


@pytest.mark.parametrize("guessed", [True, False])
def test_a_few_far_points_send_no_level_back(guessed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of a thousand points 998 come to be exact, and two so far off that the mean square is above that at the start.
    learner = objective(judge_of(RADIUS - OFF, guessed=guessed), 0.0)
    judge = learner.judge
    few = torch.where(torch.arange(1000) < 2, 30 * OFF, 0.0)
    assert few.square().mean() > judge.without.distance.square().mean()

    def errors(siren: Siren) -> Any:
        distance = few if float(siren.output.bias.detach()) < -0.75 else 0.98 * judge.without.distance
        loss = judge.data * pseudo_huber(distance.square(), judge.scales.data)
        return judge.without._replace(loss=loss, distance=distance)

    monkeypatch.setattr(judge, "errors", errors)
    for bias, done in ((-0.5, 0.5), (-1.0, 1.0)):
        torch.nn.init.constant_(learner.siren.output.bias, bias)
        learner.look(done)
    verdict = learner.take_best()
    assert verdict.at == 1.0
    assert verdict.better


def verdict_of(distance: float, angle: float, at: float = 1.0) -> Verdict:
    """With falls of so many standard errors."""
    return Verdict(500, Error(2.0, 0.01, 3.0), Error(1.0, 0.002, 1.5), at, Fall(distance, angle))


def test_a_level_is_kept_if_it_is_surely_better() -> None:
    guessed, learnt, hardly, alone = {"guessed": True}, {"learnt": 0.79}, {"learnt": 0.81}, {"learnt": 0.1}
    worse = {"after": Error(2.1, 0.002, 1.5)}  # the loss weighs both, where they surely contradict each other
    for known, kept, silenced in (
        ({}, [(3.0, 3.0), (3.0, -3.0), (-3.0, 3.0), (math.inf, 0.0)], [(1.5, 1.5), (1.5, -3.0)]),
        (worse, [(3.0, -1.0)], [(5.0, -3.0), (-3.0, 5.0)]),
        (guessed, [(5.0, -3.0), (-1.0, 3.0)], [(1.5, -3.0), (-3.0, 5.0)]),  # angles to guesses do not count against it
        (learnt, [(1.5, 1.5)], []),  # a large gain at the training points decides where held-out points are not sure
        (hardly, [], [(1.5, 1.5)]),
        (alone, [], [(1.5, -0.1), (-0.1, 1.5)]),
    ):
        assert all(verdict_of(*falls)._replace(**known).better for falls in kept)
        assert not any(verdict_of(*falls)._replace(**known).better for falls in silenced)


def test_a_level_is_unsettled_if_it_is_not_better_and_one_of_its_errors_not_significantly_worse() -> None:
    worse = Error(2.1, 0.002, 3.5)
    unsure = [verdict_of(*falls)._replace(after=worse) for falls in ((5.0, -3.0), (1.5, -3.0), (-3.0, 0.0))]
    assert all(verdict.unsettled for verdict in unsure)
    assert not any(verdict._replace(noisy=True, guessed=True).unsettled for verdict in unsure)
    assert not verdict_of(-3.0, -5.0)._replace(after=worse).unsettled
    assert not any(verdict_of(*falls).unsettled for falls in ((5.0, -3.0), (3.0, 0.0)))  # better


def test_noisy_points_judge_by_their_mean_distance_beyond_the_band_too() -> None:
    # Heights uniform in ±h and an error e of the surface have the mean |f| = (h² + e²) / 2h.
    high, x = 2 * OFF, points(1000)
    heights = high * (2 * (torch.arange(1000) * 0.618034 % 1) - 1)  # evenly spread, by the golden ratio
    noisy, about = x * (1 + heights[:, None] / RADIUS), {"spacing": SPACING, "data": 1.0, "normal": 0.0}
    judge = Judge(noisy, x / RADIUS, Sphere(radius=RADIUS - OFF), OFF, guessed=True, noisy=True, **about)
    assert judge.count == 1000  # half of them are outside of the band
    for error, kept in ((0.1 * OFF, True), (-0.9 * OFF, True), (-1.05 * OFF, True), (1.5 * OFF, False)):
        verdict = judge.verdict(judge.errors(zero_siren(error - OFF)), 1.0)
        assert verdict.before.distance == pytest.approx((high**2 + OFF**2) / 2 / high, rel=0.01)
        assert verdict.after.distance == pytest.approx((high**2 + error**2) / 2 / high, rel=0.01)
        assert verdict.better is kept


def test_feet_are_on_the_surface_and_keep_their_distances() -> None:
    x = points(100) * (0.4 + 1.2 * torch.arange(100)[:, None] / 100)
    feet = at_feet(Samples(x), Sphere(radius=RADIUS), device=CPU)
    torch.testing.assert_close(feet.points.norm(dim=1), torch.full((100,), RADIUS), rtol=1e-6, atol=0)
    torch.testing.assert_close(feet.value, x.norm(dim=1) - RADIUS, rtol=0, atol=1e-6)


def test_noisy_points_judge_the_last_weights() -> None:
    # The best of several looks would be better by chance.
    x, normals = points(1000), points(1000) / RADIUS
    about = {"spacing": SPACING, "data": 1.0, "normal": 0.0, "guessed": True, "noisy": True}
    learner = objective(Judge(x, normals, Sphere(radius=RADIUS - OFF), 0.1, **about), 0.0)
    for bias, done in ((-OFF, 0.3), (-0.5 * OFF, 0.6)):
        torch.nn.init.constant_(learner.siren.output.bias, bias)
        learner.look(done)
    verdict = learner.take_best()
    assert (verdict.at, verdict.better) == (1.0, True)
    assert verdict.after.distance == pytest.approx(0.5 * OFF, rel=0.01)


@pytest.mark.parametrize(("count", "share", "apart"), [(10_000, 0.01, 500), (10_000, 0.1, 1000), (3999, 0.1, 400)])
def test_noisy_points_are_a_twentieth_or_more(count: int, share: float, apart: int) -> None:
    assert noisy_points(count, share) == apart
    assert noisy_points(count, 0.0) == noisy_points(1000, share) == 0


def test_a_verdict_in_words_and_numbers() -> None:
    verdict = verdict_of(3.0, 0.0, 0.5)
    words = verdict.words(2, scale=10.0)
    for part in (
        "level 2",
        "loss 2 → 1",
        "50%",
        "0.1 → 0.02 (significantly less)",
        "3 → 1.5° (no significant difference)",
    ):
        assert part in words
    together = verdict._replace(until=2).words(1)
    assert together.startswith("levels 1 to 2 kept")
    assert "loss" not in together
    assert "0.70" in verdict_of(1.5, 1.5)._replace(learnt=0.7).words(1)
    record = verdict.record(1, scale=10.0)
    assert (record["before"], record["after"], record["kept"]) == (2, 1, True)
    assert (record["distance"], record["angle"]) == ([0.1, 0.02], [3.0, 1.5])
    assert record["fall_in_standard_errors"] == {"distance": 3.0, "angle": 0.0}


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_no_level_of_a_fit_is_worse_at_held_out_points_than_the_one_before(noise: float, tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    directions = sample_sphere(4000, radius=1.0, seed=2).points
    x = directions * (0.5 + noise * random.normal(size=(4000, 1)))
    tilted = directions + 10 * noise * random.normal(size=(4000, 3))  # of noisy points the normals are noisy too
    normals = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    levels = {"widths": (24, 64), "omegas": (8.0, 80.0), "steps": (150, 60), "learning_rates": (4e-3, 4e-3)}
    config = replace(SMALL, **levels, samples=5000, smooth_noise=False, drop_outliers=False)
    run = fit(PointCloud(x, normals.astype(np.float32), None, "ball"), config, out=tmp_path / "run")
    stage = run.record["stages"][1]
    judged = stage["held_out"]
    assert judged["points"] >= JUDGE.fewest / 2
    assert math.isfinite(judged["before"])
    falls = judged["fall_in_standard_errors"].values()
    learns = min(falls) > 0 and judged["learnt"] < JUDGE.learnt
    assert stage["silenced"] == ((max(falls) <= 2 or judged["after"] >= judged["before"]) and not learns)
    assert judged["verdict"].startswith(f"level 1 {'set to zero' if stage['silenced'] else 'kept'}")
    assert judged["verdict"] in describe(tmp_path / "run")
    if noise:  # a sphere and noise: there is nothing that waves of this frequency could add to it
        assert stage["silenced"]
        x = torch.rand(500, 3) - 0.5
        assert torch.equal(run.field.value(x), run.field.value(x, level=0))
