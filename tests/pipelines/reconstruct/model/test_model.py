"""What a reconstruction learns: its uncertainty, its bands, its start and what is behind it."""

import math
from dataclasses import replace

import pytest
import torch
from mplicits.neural_fields import MultiscaleSDF, Sphere, ViewColor
from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.reconstruct.model import model as scene_model
from mplicits.pipelines.reconstruct.model.model import SceneModel, build_scene
from reconstructions import TINY_SCENE

SMALL = replace(TINY_SCENE, widths=(24, 16), depths=(2, 1))
PAPER = replace(SMALL, widths=(128, 256), depths=(4, 5), features=32)


@pytest.fixture
def no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the start as a sphere where a test is about something else."""
    monkeypatch.setattr(scene_model, "fit_sphere", lambda network, radius: None)


def exact_scene() -> SceneModel:
    return SceneModel(Sphere(radius=0.5), ViewColor(0, width=8, depth=1), None, torch.zeros(3))


def parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_uncertainty_begins_as_in_neus_and_can_be_trained() -> None:
    model = exact_scene()
    assert float(model.inv_std.detach()) == pytest.approx(math.exp(3), rel=1e-6)
    (slope,) = torch.autograd.grad(model.inv_std, model.variance)
    assert float(slope) == pytest.approx(10 * math.exp(3), rel=1e-5)
    assert model.variance in set(model.parameters())
    with torch.no_grad():
        model.variance.fill_(5.0)
    assert float(model.inv_std.detach()) == 1e6  # and not infinite


@pytest.mark.usefixtures("no_start")
def test_bands_follow_the_uncertainty_down_to_their_floor() -> None:
    model = build_scene(SMALL, has_masks=True)
    assert model.geometry.deltas.tolist() == pytest.approx([SMALL.radius])
    for inv_std, expected in ((20.0, 0.2), (100.0, 0.04), (400.0, 0.02), (1e5, 0.02)):
        with torch.no_grad():
            model.variance.fill_(math.log(inv_std) / 10)
        model.widen(4.0, 0.02)
        assert model.geometry.deltas.tolist() == pytest.approx([expected], rel=1e-4)


def test_fields_of_one_level_have_no_bands_to_widen() -> None:
    model = exact_scene()
    model.widen(4.0, 0.02)
    assert len(model.geometry.deltas) == 0


@pytest.mark.parametrize("geometry", ["multiscale", "neus"])
@pytest.mark.parametrize("radius", [0.4, 0.6])
def test_every_geometry_begins_as_a_sphere(geometry: str, radius: float) -> None:
    model = build_scene(replace(SMALL, geometry=geometry, radius=radius), has_masks=True)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    for level in range(model.geometry.num_levels):
        with torch.inference_mode():
            assert float(model.geometry.value(0.5 * radius * directions, level=level).max()) < 0
            assert float(model.geometry.value(min(1.0, 1.6 * radius) * directions, level=level).min()) > 0


def test_residuals_begin_near_zero() -> None:
    geometry = build_scene(SMALL, has_masks=True).geometry
    x = torch.rand(2000, 3) - 0.5
    with torch.inference_mode():
        change = (geometry.value(x, level=1) - geometry.value(x, level=0)).abs()
    assert 0 < float(change.max()) < 0.05


@pytest.mark.usefixtures("no_start")
def test_the_papers_geometry_is_more_than_a_third_smaller_than_that_of_neus() -> None:
    multiscale = build_scene(PAPER, has_masks=True).geometry
    neus = build_scene(replace(PAPER, geometry="neus"), has_masks=True).geometry
    assert isinstance(multiscale, MultiscaleSDF)
    assert isinstance(neus, NeusSDF)
    assert parameters(multiscale) <= (1 - 0.37) * parameters(neus)


@pytest.mark.usefixtures("no_start")
@pytest.mark.parametrize(
    ("background", "has_masks", "outside", "behind"),
    [
        ("auto", True, False, 1.0),
        ("auto", False, True, 0.0),
        ("black", True, False, 0.0),
        ("black", False, False, 0.0),
        ("white", False, False, 1.0),
        ("outside", True, True, 0.0),
    ],
)
def test_what_is_behind(background: str, has_masks: bool, outside: bool, behind: float) -> None:
    model = build_scene(replace(SMALL, background=background), has_masks=has_masks)
    assert (model.outside is not None) is outside
    assert model.background.tolist() == [behind] * 3
    assert "background" in model.state_dict()
    # A ray that passes the sphere sees it.
    origins, directions = torch.tensor([[0.0, 3.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    with torch.no_grad():
        seen = model.render(origins, directions, Sampling(4, 4, 1))
    assert float(seen.opacity) == pytest.approx(0, abs=1e-6)
    if not outside:
        assert seen.color[0].tolist() == pytest.approx([behind] * 3)


@pytest.mark.usefixtures("no_start")
def test_a_seed_decides_the_start_and_leaves_the_global_random_state() -> None:
    before = torch.get_rng_state()
    first, again, other = (build_scene(replace(SMALL, seed=seed), has_masks=True) for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    same, differ = first.state_dict(), other.state_dict()
    assert all(torch.equal(tensor, same[name]) for name, tensor in again.state_dict().items())
    assert any(not torch.equal(tensor, differ[name]) for name, tensor in same.items())


@pytest.mark.usefixtures("no_start")
@pytest.mark.parametrize("half", [False, True])
def test_everything_is_trained_by_one_picture(half: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # On a GPU products of colours are in half precision, which the CPU has too.
    monkeypatch.setattr(scene_model, "HALF_PRECISION", ("cpu",) if half else ())
    model = build_scene(replace(SMALL, background="outside"), has_masks=False)
    origins = torch.nn.functional.normalize(torch.randn(64, 3), dim=1) * 2
    directions = torch.nn.functional.normalize(0.5 * (torch.rand(64, 3) - 0.5) - origins, dim=1)
    seen = model.render(origins, directions, Sampling(16, 8, 1), cos_anneal=0.5)
    (seen.color.square().mean() + (seen.jet.gradient.norm(dim=-1) - 1).square().mean()).backward()
    missing = [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.isfinite().all())]
    assert missing == []
    assert model.variance.grad is not None
    assert float(model.variance.grad.abs()) > 0
