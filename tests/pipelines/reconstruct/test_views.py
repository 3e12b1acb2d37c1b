"""Rendered views against exact pictures, and figures against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from mplicits.datasets import look_at
from mplicits.datasets.synthetic.scenes import SCENES, render_scene, render_view, scene_cameras
from mplicits.datasets.views.images import PosedImage
from mplicits.neural_fields import Jet, Similarity
from mplicits.neural_fields.networks.value_grid import ValueGrid
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.reconstruct.model.model import SceneModel
from mplicits.pipelines.reconstruct.views import (
    ViewImage,
    comparison_sheet,
    held_out,
    measure,
    reduced,
    render_image,
    spread,
    target_of,
)
from torch import Tensor, nn

WHITE = torch.ones(3)


def picture(color: np.ndarray, mask: np.ndarray | None = None) -> PosedImage:
    height, width = color.shape[:2]
    camera = look_at((0, 0, 3), (0, 0, 0), width=width, height=height)
    return PosedImage("0.png", camera, color.astype(np.float32), None if mask is None else mask.astype(np.float32))


def rendered(color: np.ndarray) -> ViewImage:
    shape = color.shape[:2]
    return ViewImage(color.astype(np.float32), np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))


def noise(height: int = 20, width: int = 24, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.7, (height, width, 3))


class Paint(nn.Module):
    """The exact colours of a scene, from anywhere."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.scene = SCENES[name]()

    def forward(self, x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
        return torch.from_numpy(self.scene.color(x.double().numpy())).float()


def exact_model(name: str, *, inv_std: float = 2000.0) -> SceneModel:
    paint = Paint(name)
    model = SceneModel(paint.scene.field, paint, None, WHITE)  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        model.variance.fill_(math.log(inv_std) / 10)
    return model


# --- held-out views ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "every", "expected"),
    [(10, 0, []), (10, 3, [0, 3, 6, 9]), (10, 8, [0, 8]), (10, 20, [0]), (4, 1, [0, 2]), (2, 2, [0]), (1, 8, [])],
)
def test_every_nth_view_is_held_out(count: int, every: int, expected: list[int]) -> None:
    views = [replace(picture(noise(2, 2)), name=str(index)) for index in range(count)]
    train, test = held_out(views, every)
    assert [int(view.name) for view in test] == expected
    assert [int(view.name) for view in train] == [index for index in range(count) if index not in expected]
    assert train


def test_the_first_few_views_are_spread_over_all() -> None:
    """Of n on a circle, no gap between the first k is more than the golden ratio's square times 1 / k, and one view."""
    views = [replace(picture(noise(2, 2)), name=str(index)) for index in range(34)]
    order = [int(view.name) for view in spread(views)]
    assert sorted(order) == list(range(34))
    for few in range(1, 35):
        places = sorted(order[:few])
        gaps = [after - before for before, after in zip(places, [*places[1:], places[0] + 34], strict=True)]
        assert max(gaps) <= 34 / few * (1 + 5**0.5) ** 2 / 4 + 1
    assert spread([]) == []


# --- figures -----------------------------------------------------------------------------------------


def test_the_psnr_of_a_constant_error_is_what_its_formula_says() -> None:
    color = noise()
    for error in (0.1, -0.02):
        figures = measure(rendered(color + error), picture(color), WHITE)
        assert figures["psnr"] == pytest.approx(-20 * math.log10(abs(error)), abs=1e-3)
    assert "psnr_object" not in figures


def test_equal_pictures_have_an_ssim_of_one_and_different_ones_less() -> None:
    color = noise()
    assert measure(rendered(color), picture(color), WHITE)["ssim"] == pytest.approx(1, abs=1e-5)
    assert measure(rendered(noise(seed=1)), picture(color), WHITE)["ssim"] < 0.5


def test_the_psnr_of_the_object_knows_nothing_of_the_rest() -> None:
    color, mask = noise(), np.zeros((20, 24))
    mask[:, :6] = 1
    ours = color.copy()
    ours[:, :6] += 0.1
    ours[:, 6:] = 1.0 - 0.3  # the photograph counts as white there
    figures = measure(rendered(ours), picture(color, mask), WHITE)
    assert figures["psnr_object"] == pytest.approx(20, abs=1e-3)
    assert figures["psnr"] == pytest.approx(-10 * math.log10(0.25 * 0.01 + 0.75 * 0.09), abs=1e-3)
    empty = measure(rendered(ours), picture(color, np.zeros((20, 24))), WHITE)
    assert "psnr_object" not in empty


def test_photographs_are_judged_on_the_background_of_the_scene() -> None:
    color = noise()
    share = np.random.default_rng(1).uniform(size=(20, 24))
    background = torch.tensor([0.0, 0.5, 1.0])
    target = target_of(picture(color, share), background)
    expected = share[..., None] * color + (1 - share[..., None]) * background.numpy()
    assert np.allclose(target, expected, atol=1e-6)
    assert np.array_equal(target_of(picture(color), background), color.astype(np.float32))


# --- rendering ---------------------------------------------------------------------------------------


def test_a_sharp_sphere_looks_like_its_exact_picture() -> None:
    model = exact_model("painted-sphere")
    scene = SCENES["painted-sphere"]()
    camera = scene_cameras(scene, views=1, size=24, seed=3)[0]
    color, mask = render_view(scene, camera, samples=1)
    view = PosedImage("0.png", camera, color, mask)
    told: list[tuple[int, int]] = []
    image = render_image(
        model, view, Similarity.identity(), Sampling(), progress=lambda done, count: told.append((done, count))
    )
    assert image.color.shape == image.normal.shape == (24, 24, 3)
    _, fine = render_view(scene, camera, samples=5)
    inner, outer = fine == 1, fine == 0  # without the pixels that the outline crosses
    assert inner.sum() > 100
    assert outer.sum() > 50
    assert abs(image.color - color)[inner].max() < 0.05
    assert abs(image.color - color)[inner].mean() < 0.005
    assert np.allclose(image.color[outer], 1, atol=1e-4)
    assert image.opacity[inner].min() > 0.99
    assert image.opacity[outer].max() < 1e-3
    # Normals of a sphere point away from its centre: those in the middle, at the eye.
    towards = camera.eye.numpy() / np.linalg.norm(camera.eye.numpy())
    assert image.normal[11:13, 11:13].reshape(-1, 3).mean(axis=0) @ towards > 0.99
    assert measure(image, view, WHITE)["psnr_object"] > 30
    assert told[-1][0] == told[-1][1] > 0


def test_the_world_may_be_anywhere() -> None:
    scene, model = SCENES["painted-sphere"](), exact_model("painted-sphere")
    camera = scene_cameras(scene, views=1, size=12, seed=3)[0]
    here = PosedImage("0.png", camera, *render_view(scene, camera, samples=1))
    world = Similarity((300.0, -40.0, 5.0), 25.0)
    pose = camera.world_from_camera.clone()
    pose[:3, 3] = torch.from_numpy(world.to_input(camera.eye.numpy()))
    there = replace(here, camera=replace(camera, world_from_camera=pose))
    sampling = Sampling(32, 32)
    near, far = (
        render_image(model, here, Similarity.identity(), sampling),
        render_image(model, there, world, sampling),
    )
    assert np.allclose(near.color, far.color, atol=2e-3)


def test_a_grid_of_values_finds_the_same_picture() -> None:
    scene, model = SCENES["painted-sphere"](), exact_model("painted-sphere", inv_std=60.0)
    (view,) = render_scene(scene, views=1, size=12).views
    grid = ValueGrid(64)
    grid.refresh(model.geometry)
    asked, guided = (
        render_image(model, view, Similarity.identity(), Sampling(32, 32), guide=guide) for guide in (None, grid)
    )
    # Values of the grid are off by 3/8 K h² = 0.0015, a tenth of 1/s: samples lie elsewhere, sums hardly change.
    assert abs(asked.color - guided.color).max() < 0.02


def test_samples_of_little_weight_can_be_left_out() -> None:
    scene, model = SCENES["painted-sphere"](), exact_model("painted-sphere", inv_std=60.0)
    (view,) = render_scene(scene, views=1, size=12).views
    whole, light = (
        render_image(model, view, Similarity.identity(), Sampling(16, 16), least_weight=least) for least in (0.0, 1e-4)
    )
    assert abs(whole.color - light.color).max() < 33 * 1e-4
    assert np.array_equal(whole.opacity, light.opacity)


# --- sheets ------------------------------------------------------------------------------------------


def test_a_sheet_shows_photograph_rendering_and_normals() -> None:
    first, second = noise(8, 10), noise(8, 6, seed=2)
    pairs = [(picture(color), rendered(1 - color)) for color in (first, second)]
    sheet = comparison_sheet(pairs, WHITE)
    assert sheet.dtype == np.uint8
    factor = sheet.shape[1] // 30
    assert factor == 20
    assert sheet.shape == (factor * 24, factor * 30, 3)  # two rows of 8 pixels, with 4 between
    small = sheet[::factor, ::factor] / 255
    assert np.allclose(small[:8, :10], first, atol=0.003)
    assert np.allclose(small[:8, 10:20], 1 - first, atol=0.003)
    assert np.allclose(small[:8, 20:30], 0.5, atol=0.003)  # normals of no length
    assert np.allclose(small[12:20, :6], second, atol=0.003)
    assert np.allclose(small[12:20, 18:], 1)


def test_large_pictures_keep_their_size() -> None:
    color = noise(4, 700)
    assert comparison_sheet([(picture(color), rendered(color))], WHITE).shape == (8, 2100, 3)


def test_a_reduced_view_sees_the_same_in_fewer_pixels() -> None:
    full = render_scene(SCENES["painted-sphere"](), views=1, size=64, samples=1).views[0]
    small = reduced(full, 256)
    assert small.name == full.name
    assert torch.equal(small.camera.intrinsics, full.camera.resized(16, 16).intrinsics)
    assert small.color.shape == (16, 16, 3)
    assert full.mask is not None
    assert small.mask is not None
    assert np.allclose(small.mask, full.mask.reshape(16, 4, 16, 4).mean(axis=(1, 3)), atol=1e-6)
    assert reduced(full, 4096) is full  # as many pixels as there are
    assert reduced(picture(noise(7, 300)), 100).color.shape == (2, 65, 3)
