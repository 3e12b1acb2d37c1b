"""What is learnt of each photograph: its exposure and its camera; and that both are found."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from mplicits.datasets.views.images import PosedImages
from mplicits.neural_fields import Jet, Similarity, Sphere
from mplicits.neural_fields.volume.render import Rendered, Sampling
from mplicits.pipelines.reconstruct.model import Exposures, PoseCorrections, RayPool, SceneModel, build_scene
from mplicits.pipelines.reconstruct.objective import SceneObjective
from mplicits.pipelines.reconstruct.train import reconstruct
from mplicits.pipelines.reconstruct.views import ViewImage, exposed_as, measure, render_camera
from reconstructions import TINY_SCENE, exact_model, painted_sphere, small_reconstructions
from torch import Tensor, nn

STEPS = {"steps": 6, "rays": 64, "uniform": 16, "importance": 8, "march_grid": 0, "start": "sphere", "texture_steps": 0}
TINY = replace(TINY_SCENE, exposure="affine", cameras="refined", **STEPS)
GAINS = (1.3, 0.65, 1.0, 1.3 / 1.0985)


@pytest.fixture(autouse=True)
def _small_reconstructions(monkeypatch: pytest.MonkeyPatch) -> None:
    small_reconstructions(monkeypatch)


@pytest.fixture(scope="module")
def images() -> PosedImages:
    return painted_sphere(4, 16, 2)


def test_colours_stay_those_of_the_usual_photograph() -> None:
    exposures = Exposures(5)
    with torch.no_grad():
        exposures.logs.normal_()
        exposures.shifts.normal_()
    gains, offsets = exposures()
    for mean in (gains.log().mean(dim=0), offsets.mean(dim=0)):
        torch.testing.assert_close(mean, torch.zeros(3), atol=1e-6, rtol=0)


def test_a_photograph_changes_the_object_and_not_a_known_background() -> None:
    """g (C) + α o + (1 − α) b of C = α c, the object's share."""
    model, opacity = exact_model(500.0, Exposures(2)), torch.tensor([1.0, 0.25, 0.0])
    share, color = opacity[:, None], torch.tensor([0.2, 0.4, 0.6])
    nothing = Rendered(*[torch.zeros(3)] * len(Rendered._fields))
    seen = nothing._replace(color=share * color + (1 - share), opacity=opacity)
    with torch.no_grad():
        model.exposures.logs[0], model.exposures.shifts[0] = math.log(4.0), torch.tensor([0.2, 0.0, -0.2])
    gain, offset = 2.0, torch.tensor([0.1, 0.0, -0.1])  # their means over both views are taken off
    shown = model.photographed(seen, torch.tensor([0, 0, 0]))
    assert torch.allclose(shown, share * (gain * color + offset) + (1 - share), atol=1e-6)
    other = model.photographed(seen, torch.tensor([1, 1, 1]))
    assert torch.allclose(other, share * (color / gain - offset) + (1 - share), atol=1e-6)
    assert exact_model().photographed(seen, torch.tensor([0, 0, 0])) is seen.color


def test_exposures_are_found_where_all_else_is_known() -> None:
    """From |photographed − photograph| of right colours, by Adam, to within the last of its falling steps."""
    random = torch.Generator().manual_seed(0)
    gains, offsets = torch.tensor(GAINS)[:, None].expand(4, 3), torch.tensor([[0.1], [-0.1], [0.05], [-0.05]])
    model = exact_model(500.0, Exposures(4))
    assert math.prod(GAINS) == pytest.approx(1, abs=1e-3)
    adam = torch.optim.Adam(model.exposures.parameters(), lr=0.1)
    for step in range(120):
        color, view = torch.rand(256, 3, generator=random), torch.randint(4, (256,), generator=random)
        seen = Rendered(*[color] * len(Rendered._fields))._replace(opacity=torch.ones(256))
        adam.param_groups[0]["lr"] = last = 0.1 * (1 - step / 120)
        adam.zero_grad()
        (model.photographed(seen, view) - gains[view] * color - offsets[view]).abs().mean().backward()
        adam.step()
    found, shift = model.exposures()
    assert torch.allclose(found, gains, atol=30 * last)
    assert torch.allclose(shift, offsets.expand(4, 3), atol=30 * last)


def test_a_view_that_was_not_trained_on_is_measured_at_its_own_exposure(images: PosedImages) -> None:
    view = images.views[0]
    white = (1 - view.mask)[..., None]
    image = ViewImage(view.mask[..., None] * view.color + white, np.zeros_like(view.color), view.mask)
    darker = replace(view, color=(0.5 * view.color + 0.1).astype(np.float32))
    assert measure(image, darker, torch.ones(3))["psnr"] < 25
    met = exposed_as(image, darker, torch.ones(3))
    assert np.abs(met.color - (view.mask[..., None] * darker.color + white)).max() < 1e-5
    assert np.allclose(met.color[view.mask == 0], 1)
    flat = replace(image, color=np.full_like(image.color, 0.3), opacity=np.ones_like(view.mask))
    bare = replace(darker, mask=None)
    assert np.allclose(exposed_as(flat, bare, torch.ones(3)).color, darker.color.mean(axis=(0, 1)), atol=1e-6)


def test_a_run_says_what_it_found(images: PosedImages) -> None:
    run = reconstruct(images, replace(TINY, test_every=4))
    for part in ("exposures", "poses"):
        assert list(run.record[part]) == [view.name for view in images.views[1:]]
    assert not {"exposures", "poses"} & set(reconstruct(images, replace(TINY, exposure="off", cameras="given")).record)
    model = build_scene(TINY, has_masks=False, views=3)
    assert model.outside is not None
    seen = render_camera(model, images.views[0].camera, Sampling(4, 0))
    assert seen.color.shape == (16, 16, 3)


class Waves(nn.Module):
    """A smooth colour of every point, whose slope autograd knows."""

    def forward(self, x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
        return 0.5 + 0.4 * torch.sin(x @ x.new_tensor([[5.0, 0, 2], [0, 6, 3], [4, 1, -5]]))


def test_a_corrected_ray_is_turned_about_its_eye() -> None:
    """By the angle |ω| around ω/|ω|: exact for a quarter turn; the mean of both corrections is taken off."""
    poses = PoseCorrections(2)
    with torch.no_grad():
        poses.turns[0], poses.shifts[0] = torch.tensor([0.0, 0.0, math.pi]), torch.tensor([0.2, 0.0, 0.0])
    origins, directions = torch.tensor([[0.0, 0.0, 2.0]] * 2), torch.tensor([[1.0, 0.0, 0.0]] * 2)
    eyes, turned = poses.moved(origins, directions, torch.tensor([0, 1]))
    assert torch.allclose(eyes, torch.tensor([[0.1, 0, 2.0], [-0.1, 0, 2.0]]), atol=1e-6)
    assert torch.allclose(turned, torch.tensor([[0.0, 1, 0], [0, -1, 0]]), atol=1e-6)
    same, ahead = PoseCorrections(1).moved(origins, directions, torch.tensor([0, 0]))
    assert torch.equal(same, origins)
    assert torch.equal(ahead, directions)


def test_cameras_astray_are_brought_back(images: PosedImages) -> None:
    """Two of four are off by 2°, each the other way; surface and colours are known, so that pixels tell by how much."""
    model = SceneModel(Sphere(radius=0.6), Waves(), None, torch.ones(3), None, PoseCorrections(4))  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        model.variance.fill_(math.log(60.0) / 10)
    wrong = torch.zeros(4, 3)
    wrong[1, 2], wrong[2, 2] = math.radians(2.0), -math.radians(2.0)
    views = []
    for view, turn in zip(images.views, wrong, strict=True):
        seen = render_camera(model, view.camera, Sampling(32, 16))
        pose, camera = view.camera.world_from_camera.clone(), view.camera
        spin = torch.linalg.matrix_exp(turn[2] * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]))
        pose[:3, :3] = spin.to(pose) @ pose[:3, :3]
        views.append(replace(view, color=seen.color, mask=None, camera=replace(camera, world_from_camera=pose)))
    pool = RayPool(views, Similarity.identity(), torch.device("cpu"))
    settings = replace(TINY, exposure="off", cameras="refined", uniform=24, importance=12, skip=0.0, anneal=0.0)
    objective = SceneObjective(model, pool, settings)
    adam = torch.optim.Adam([model.poses.turns], lr=4e-3)
    for step in range(100):
        adam.param_groups[0]["lr"] = 4e-3 * (1 - step / 100)
        _, total = objective.losses(step, 1.0)
        adam.zero_grad()
        total.backward()
        adam.step()
    assert (model.poses()[0] + wrong).norm() < 0.25 * wrong.norm()
