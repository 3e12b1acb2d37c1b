"""Training of a scene on a few rays of a painted sphere: schedule, interruption, time."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from mplicits.datasets.views.images import PosedImage, PosedImages
from mplicits.neural_fields import InputError, Similarity, fit_sphere
from mplicits.neural_fields.fields.losses import eikonal_loss
from mplicits.neural_fields.volume.weights import sphere_span
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct.measured import MeasuredDepths
from mplicits.pipelines.reconstruct.model import RayPool, build_scene
from mplicits.pipelines.reconstruct.objective import SceneObjective, Schedule, scene_trainer
from mplicits.pipelines.training.settings import ReconstructConfig
from mplicits.pipelines.training.trainer import Progress, StopFlag, Trainer
from reconstructions import QUICK, SMALL_PATCHES, TINY_SCENE, painted_sphere, scene_parts, weights, with_views, without
from torch import Tensor

TINY = replace(TINY_SCENE, steps=8, **QUICK)


@pytest.fixture(autouse=True)
def _short_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rough sphere will do to begin with."""
    monkeypatch.setattr(scene_model, "fit_sphere", partial(fit_sphere, steps=40, batch=256))


@pytest.fixture(scope="module")
def images() -> PosedImages:
    return painted_sphere(4, 16)


def make(images: PosedImages, config: ReconstructConfig, *, depths: bool = False) -> Trainer[SceneObjective]:
    """A training, with the terms of measured depths and of consistency that are wanted."""
    parts, others = scene_parts(images, config, depths=depths)
    return scene_trainer(*parts, **others)


def level(trainer: Trainer[SceneObjective]) -> int:
    return trainer.objective.level_at(trainer.fraction)


def train(trainer: Trainer[SceneObjective], *, until: int | None = None) -> list[tuple[int, int]]:
    """Train, to the end or until so many steps are done → (steps done, level) after every step."""
    flag, seen, begun = StopFlag(), [], trainer.step

    def report(progress: Progress) -> None:
        if progress.step > begun:
            seen.append((progress.step, level(trainer)))
            flag.requested = progress.step == until

    assert trainer.run(flag, report=report, report_every=1) is (until is None)
    return seen


def errors(trainer: Trainer[SceneObjective]) -> tuple[float, float]:
    """Mean absolute errors of colours and of opacities over many rays."""
    model = trainer.objective.model
    rays = trainer.objective.pool.draw(1500, torch.Generator().manual_seed(5))
    with torch.no_grad():
        seen = model.render(rays.origins, rays.directions, trainer.objective.sampling, level=level(trainer))
    target = torch.lerp(torch.ones(3).expand(1500, 3), rays.color, rays.mask[:, None])
    return float((seen.color - target).abs().mean()), float((seen.opacity - rays.mask).abs().mean())


def test_some_steps_lower_the_errors(images: PosedImages) -> None:
    trainer = make(images, replace(TINY, steps=60, rays=64, learning_rate=5e-3))
    color, opacity = errors(trainer)
    train(trainer)
    after = errors(trainer)
    assert after[0] < 0.9 * color
    assert after[1] < 0.5 * opacity
    assert set(trainer.losses) == {"color", "eikonal", "mask", "uncertainty"}


def test_a_step_has_fewer_rays_while_each_has_many_samples(images: PosedImages) -> None:
    trainer = make(images, replace(TINY, rays=32, jets=64, steps=20))
    objective = trainer.objective
    for samples, rays in ((0.0, 8), (100.0, 8), (4.0, 16), (1.0, 32)):
        objective.kept["lately"] = torch.tensor([samples, 0.1])
        assert objective.batch() == rays
    train(trainer, until=16)
    found, unsure = objective.kept["lately"].tolist()
    assert unsure == pytest.approx(1 / float(objective.model.inv_std.detach()), rel=0.05)  # a step later
    assert 1 < found < TINY.uniform + TINY.importance + 2
    assert objective.batch() == min(max(round(64 / found), 8), 32)
    assert make(images, replace(TINY, jets=0)).objective.batch() == TINY.rays


def test_the_hash_encoding_has_its_own_rate_and_may_be_left_out(images: PosedImages) -> None:
    trainer = make(images, replace(TINY, color_rate=6.0, grid_rate=3.0))
    grid = trainer.objective.model.color.grid
    _, colors, _, own = trainer.objective.groups
    assert [p is grid.table for p in own.parameters] == [True]
    assert all(p is not grid.table for p in colors.parameters)
    assert own.rate(0.5) == pytest.approx(3 * colors.rate(0.5))
    before = grid.table.detach().clone()
    train(trainer, until=2)
    assert not torch.equal(grid.table, before)
    without = make(images, replace(TINY, color_grid=0))
    assert without.objective.model.color.grid is None
    assert len(without.objective.groups) == 3


def test_the_softplus_network_of_neus_is_trained_by_the_same_steps(images: PosedImages) -> None:
    trainer = make(images, replace(TINY, geometry="neus", steps=3, rays=16, march_grid=0))
    before = weights(trainer)
    assert [reached for _, reached in train(trainer)] == [0, 0, 0]
    assert all(0 <= value < 10 for value in trainer.losses.values())
    still = [name for name, tensor in weights(trainer).items() if torch.equal(tensor, before[name])]
    assert still == ["background"]


def test_levels_are_switched_on_at_their_starts(images: PosedImages) -> None:
    three = {"widths": (16,) * 3, "depths": (1,) * 3, "omegas": (10.0,) * 3}
    trainer = make(images, replace(TINY, **three, starts=(0.0, 0.25, 0.75)))
    assert level(trainer) == 0
    # After step k the level is that with which step k + 1 is made.
    assert [reached for _, reached in train(trainer)] == [0, 1, 1, 1, 1, 2, 2, 2]


def test_a_level_is_not_trained_before_its_start(images: PosedImages) -> None:
    trainer = make(images, TINY)
    geometry = trainer.objective.model.geometry
    residual = list(geometry.residuals.parameters())
    first, base = [p.detach().clone() for p in residual], geometry.base.output.weight.detach().clone()
    train(trainer, until=4)
    assert level(trainer) == 1
    assert all(parameter.grad is None for parameter in residual)
    assert all(torch.equal(p, before) for p, before in zip(residual, first, strict=True))
    assert not torch.equal(geometry.base.output.weight, base)
    train(trainer)
    assert all(parameter.grad is not None for parameter in residual)
    assert any(not torch.equal(p, before) for p, before in zip(residual, first, strict=True))


def test_bands_are_as_wide_as_the_surface_is_unsure(images: PosedImages) -> None:
    trainer = make(images, replace(TINY, band=3.0, least_delta=0.001))
    with torch.no_grad():
        trainer.objective.model.variance.fill_(0.4)
    expected = 3 / float(trainer.objective.model.inv_std.detach())
    train(trainer, until=1)
    assert trainer.objective.model.geometry.deltas.tolist() == pytest.approx([expected], rel=1e-5)


@pytest.mark.parametrize(("depths", "stop"), [(False, 3), (False, 6), (True, 3)])  # before and after level 1 begins
def test_a_stopped_training_continues_to_the_same_bits(images: PosedImages, depths: bool, stop: int) -> None:
    if depths:
        images, config = relative(), replace(TINY, cameras="refined")
    else:
        config = TINY
    whole, first, second = (make(images, config, depths=depths) for _ in range(3))
    train(whole)
    train(first, until=stop)
    state = {name: tensor.clone() for name, tensor in first.state().items()}
    with torch.no_grad():  # nothing of the new trainer may matter
        for parameter in second.objective.model.parameters():
            parameter.zero_()
    second.restore(state)
    assert (second.step, second.elapsed) == (stop, first.elapsed)
    assert [step for step, _ in train(second)] == list(range(stop + 1, 9))
    torch.testing.assert_close(weights(second), weights(whole), rtol=0, atol=0)
    assert second.losses == whole.losses


@pytest.mark.parametrize("masked", [True, False])
def test_photographs_are_compared_once_the_surface_exists(
    masked: bool, images: PosedImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SceneObjective, "patches", SMALL_PATCHES)
    images = images if masked else without(images, "mask")
    config = replace(TINY, consistency=0.5, background="auto" if masked else "black")
    whole, first, second = (make(images, config) for _ in range(3))
    train(first, until=1)
    assert "consistency" not in first.losses
    train(first, until=4)
    assert 0 < first.losses["consistency"] < 2
    assert 0 <= first.losses["flatness"] < 2
    state = {name: tensor.clone() for name, tensor in first.state().items()}
    second.restore(state)
    train(second)
    train(whole)
    torch.testing.assert_close(weights(second), weights(whole), rtol=0, atol=0)
    assert second.losses == whole.losses
    assert "consistency" not in make(images, replace(config, consistency=0.0)).objective.losses(0, 0.9)[0]


def relative() -> PosedImages:
    """With depth maps of unknown scale and shift, and without sparse points that would say them."""

    def loose(_: int, view: PosedImage) -> PosedImage:
        return replace(view, depth=replace(view.depth, numbers=2 * view.depth.numbers - 1, kind="relative"))

    return replace(with_views(painted_sphere(4, 16, depths=True), loose), points=None, observations=None)


def test_measured_depths_bring_the_surface_nearer() -> None:
    scene, config = painted_sphere(4, 16, depths=True), replace(TINY, steps=30, radius=0.4)
    off = []
    for weight in (0.0, 10.0):
        trainer = make(scene, replace(config, depth_weight=weight), depths=True)
        assert (trainer.objective.measured is not None) == (weight > 0)
        train(trainer)
        assert ("depth" in trainer.losses) == (weight > 0)
        points = torch.from_numpy(scene.points).float()
        off.append(float(trainer.objective.model.geometry.value(points).detach().abs().mean()))
    assert off[1] < 0.5 * off[0]


def test_maps_without_a_scale_are_fitted_to_the_surface_and_fade(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make(relative(), replace(TINY, steps=8, depth_weight=1.0), depths=True)
    fitted: list[int] = []
    align = MeasuredDepths.align

    def counted(self: MeasuredDepths, distance: Callable[[Tensor], Tensor]) -> None:
        fitted.append(trainer.step)
        align(self, distance)

    monkeypatch.setattr(MeasuredDepths, "align", counted)
    monkeypatch.setattr(SceneObjective, "schedule", Schedule(align_every=2))
    train(trainer)
    assert fitted == [0, 2]  # not in the second half, where they do not count
    assert bool((trainer.objective.kept["affine"][:, 0] > 0).any())
    terms, measured = [], trainer.objective.measured
    for trainer.objective.done in (0.0, 0.4, 0.5, 1.0):
        terms.append(float(trainer.objective.depth_term(measured, 1).detach()))
    assert terms[0] > 0
    assert terms[1] < 0.5 * terms[0]  # a fifth, but of other rays
    assert terms[2:] == [0.0, 0.0]


def test_the_grid_that_rays_march_on_is_that_of_the_coarse_level(images: PosedImages) -> None:
    trainer = make(images, TINY)
    points = 0.5 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    before = trainer.objective.model.geometry.value(points, level=0).detach()
    train(trainer, until=1)  # which looks at all of it, and then takes a step
    grid = trainer.objective.grid
    # An eighth of the cube is 0.25 across: for the curvature 2/r of a sphere at r ≥ 0.1, 3/8 · h² · 10.
    assert float((grid(points) - before)[points.norm(dim=1) > 0.1].abs().max()) < 3 / 8 * 0.25**2 * 10
    assert torch.equal(trainer.state()["march"], grid.kept)


@pytest.mark.parametrize("march_grid", [0, 8])
def test_a_training_that_has_diverged_ends_with_a_line(images: PosedImages, march_grid: int) -> None:
    trainer = make(images, replace(TINY, steps=1000, march_grid=march_grid))
    with torch.no_grad():
        next(trainer.objective.model.geometry.parameters()).fill_(torch.nan)
    with pytest.raises(InputError, match=r"diverged before step 15; .* lower --learning-rate"):
        trainer.run()


def test_the_grid_is_left_alone_while_the_surface_rests(images: PosedImages) -> None:
    objective = make(images, TINY).objective
    geometry = objective.model.geometry
    looked = []

    def take(step: int) -> None:
        objective.refresh_grid(step, step / 1000)
        if (step + 1) % 16 == 0:
            objective.read_back(step, torch.tensor(3.0))

    for step in range(600):
        before = int(objective.kept["looks"][0])
        take(step)
        if int(objective.kept["looks"][0]) != before:
            looked.append(step)
    assert looked == [16, 48, 112, 240, 368, 496]  # after that at 0; twice as long each time, 128 steps at most
    with torch.no_grad():  # a surface that has moved by 1/s, and then goes on moving
        for step in range(600, 768):
            geometry.base.output.bias[0] += 1 / (16 * objective.model.inv_std)
            take(step)
    assert objective.kept["looks"][1] == 16
    again = make(images, TINY)
    again.objective.kept = dict(objective.kept)
    again.objective.refresh_grid(768, 0.768)
    assert torch.equal(again.objective.grid.kept, objective.grid.kept)


def test_skipping_nothing_is_the_training_without_it(images: PosedImages) -> None:
    plain, every = (
        make(images, replace(TINY, skip=skip, skip_share=1.0, march_grid=0)).objective.losses(0, 0.0)[0]
        for skip in (0.0, 1e-3)
    )
    torch.testing.assert_close(every, plain, rtol=1e-5, atol=0)


def test_masks_are_trained_for_only_where_they_are(images: PosedImages) -> None:
    bare = make(without(images, "mask"), replace(TINY, background="black"))
    for trainer in (bare, make(images, replace(TINY, mask_weight=0.0))):
        terms, _ = trainer.objective.losses(0, 0.0)
        assert "mask" not in terms


def narrow(images: PosedImages) -> Similarity:
    """A region that is too small for the pictures: rays pass it, some of them through the object."""
    return replace(images.similarity, scale=images.similarity.scale / 3)


@pytest.mark.slow
def test_what_lies_beside_the_region_is_learnt(images: PosedImages) -> None:
    views = without(images, "mask").views
    config = replace(TINY, steps=60, rays=64, learning_rate=5e-3, background="outside")
    pool = RayPool(views, narrow(images), torch.device("cpu"), whole=True)
    trainer = scene_trainer(build_scene(config, has_masks=False), pool, config)
    rays = pool.draw(1500, torch.Generator().manual_seed(5))
    near, far = sphere_span(rays.origins, rays.directions)
    past = far <= near
    assert 0.2 < float(past.float().mean()) < 0.98

    def wrong() -> float:
        with torch.no_grad():
            seen = trainer.objective.model.render(rays.origins, rays.directions, trainer.objective.sampling)
        assert not seen.counts[past].any()
        return float((seen.color - rays.color)[past].abs().mean())

    before = wrong()
    train(trainer)
    assert wrong() < 0.5 * before


def test_rays_that_miss_the_region_leave_the_eikonal_term_alone(images: PosedImages) -> None:
    config = replace(TINY, background="outside", march_grid=0, skip=0.0, focus=0.0, jets=0)
    pool = RayPool(images.views, narrow(images), torch.device("cpu"), whole=True)
    objective = scene_trainer(build_scene(config, has_masks=True), pool, config).objective
    terms, _ = objective.losses(0, 0.5)
    generator = torch.Generator().manual_seed(config.seed)  # the same rays, and the same samples
    rays = pool.draw(objective.batch(), generator, objective.sampler)
    near, far = sphere_span(rays.origins, rays.directions)
    hits = far > near
    assert 0 < int(hits.sum()) < len(hits)
    level = objective.level_at(0.5)
    seen = objective.model.render(*rays[:2], objective.sampling, level=level, generator=generator)
    torch.testing.assert_close(terms["eikonal"], eikonal_loss(seen.jet.gradient[hits]).mean())


def test_what_an_older_version_did_not_keep_begins_anew(images: PosedImages) -> None:
    before, after = make(images, TINY), make(images, TINY)
    train(before, until=3)
    state = before.state()
    assert state.pop("looks").tolist() == [0, 16, 1]
    after.restore(state)
    assert after.objective.kept["looks"].tolist() == [0, 16, 0]
    assert torch.equal(after.objective.kept["march"], before.objective.kept["march"])
    train(after)
