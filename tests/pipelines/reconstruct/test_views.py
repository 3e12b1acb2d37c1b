"""Rendered views against exact pictures, and figures against closed forms."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from mplicits.datasets import SCENES, PosedImage, look_at, write_transforms
from mplicits.datasets.clouds.cleaning.orientation import fibonacci_directions
from mplicits.datasets.synthetic.scenes import pictures
from mplicits.neural_fields import Mesh, Similarity, Sphere, Union, extract_mesh, save_field
from mplicits.neural_fields.networks.grids import ValueGrid
from mplicits.neural_fields.volume.render import Sampling
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.reconstruct import views as posed
from mplicits.pipelines.surface.surface import Support, thinned, visible_part
from reconstructions import exact_model, painted_sphere

WHITE = torch.ones(3)


def picture(color: np.ndarray, mask: np.ndarray | None = None) -> PosedImage:
    height, width = color.shape[:2]
    camera = look_at((0, 0, 3), (0, 0, 0), width=width, height=height)
    return PosedImage("0.png", camera, color.astype(np.float32), None if mask is None else mask.astype(np.float32))


def rendered(color: np.ndarray) -> posed.ViewImage:
    shape = color.shape[:2]
    return posed.ViewImage(color.astype(np.float32), np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))


def noise(height: int = 20, width: int = 24, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.7, (height, width, 3))


@pytest.mark.parametrize(
    ("count", "every", "expected"),
    [(10, 0, []), (10, 3, [0, 3, 6, 9]), (10, 8, [0, 8]), (10, 20, [0]), (4, 1, [0, 2]), (2, 2, [0]), (1, 8, [])],
)
def test_every_nth_view_is_held_out(count: int, every: int, expected: list[int]) -> None:
    views = [replace(picture(noise(2, 2)), name=str(index)) for index in range(count)]
    train, test = posed.held_out(views, every)
    assert [int(view.name) for view in test] == expected
    assert [int(view.name) for view in train] == [index for index in range(count) if index not in expected]
    assert train


def test_the_first_few_views_are_spread_over_all() -> None:
    """Of n on a circle, no gap between the first k is more than the golden ratio's square times 1 / k, and one view."""
    views = [replace(picture(noise(2, 2)), name=str(index)) for index in range(34)]
    order = [int(view.name) for view in posed.spread(views)]
    assert sorted(order) == list(range(34))
    for few in range(1, 35):
        places = sorted(order[:few])
        gaps = [after - before for before, after in zip(places, [*places[1:], places[0] + 34], strict=True)]
        assert max(gaps) <= 34 / few * (1 + 5**0.5) ** 2 / 4 + 1
    assert posed.spread([]) == []


def test_the_psnr_of_a_constant_error_is_what_its_formula_says() -> None:
    color = noise()
    for error in (0.1, -0.02):
        figures = posed.measure(rendered(color + error), picture(color), WHITE)
        assert figures["psnr"] == pytest.approx(-20 * math.log10(abs(error)), abs=1e-3)
    assert "psnr_object" not in figures


def test_equal_pictures_have_an_ssim_of_one_and_different_ones_less() -> None:
    color = noise()
    assert posed.measure(rendered(color), picture(color), WHITE)["ssim"] == pytest.approx(1, abs=1e-5)
    assert posed.measure(rendered(noise(seed=1)), picture(color), WHITE)["ssim"] < 0.5


def test_the_psnr_of_the_object_does_not_depend_on_the_rest() -> None:
    color, mask = noise(), np.zeros((20, 24))
    mask[:, :6] = 1
    ours = color.copy()
    ours[:, :6] += 0.1
    ours[:, 6:] = 1.0 - 0.3  # the photograph counts as white there
    figures = posed.measure(rendered(ours), picture(color, mask), WHITE)
    assert figures["psnr_object"] == pytest.approx(20, abs=1e-3)
    assert figures["psnr"] == pytest.approx(-10 * math.log10(0.25 * 0.01 + 0.75 * 0.09), abs=1e-3)
    empty = posed.measure(rendered(ours), picture(color, np.zeros((20, 24))), WHITE)
    assert "psnr_object" not in empty


def test_photographs_are_judged_on_the_background_of_the_scene() -> None:
    color, share = noise(), np.random.default_rng(1).uniform(size=(20, 24))
    background = torch.tensor([0.0, 0.5, 1.0])
    expected = share[..., None] * color + (1 - share[..., None]) * background.numpy()
    np.testing.assert_allclose(posed.target_of(picture(color, share), background), expected, atol=1e-6)
    np.testing.assert_array_equal(posed.target_of(picture(color), background), color.astype(np.float32))


def test_a_sharp_sphere_looks_like_its_exact_picture() -> None:
    model = exact_model()
    (view,) = painted_sphere(1, 24).views
    color, camera = view.color, view.camera
    image = posed.render_camera(model, camera, Sampling())
    assert image.color.shape == image.normal.shape == (24, 24, 3)
    ((_, fine),) = pictures(SCENES["painted-sphere"](), [camera], samples=5)
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
    assert posed.measure(image, view, WHITE)["psnr_object"] > 30


def test_the_world_may_be_anywhere() -> None:
    (here,) = painted_sphere(1, 12).views
    world = Similarity((300.0, -40.0, 5.0), 25.0)
    pose = here.camera.world_from_camera.clone()
    pose[:3, 3] = torch.from_numpy(world.to_input(here.camera.eye.numpy()))
    there = replace(here, camera=replace(here.camera, world_from_camera=pose))
    near, far = (
        posed.render_camera(exact_model(), view.camera.moved(similarity), Sampling(32, 32)).color
        for view, similarity in ((here, Similarity.identity()), (there, world))
    )
    np.testing.assert_allclose(near, far, atol=2e-3)


def test_a_grid_of_values_finds_the_same_picture() -> None:
    model, grid = exact_model(60.0), ValueGrid(64)
    (view,) = painted_sphere(1, 12, 3).views
    grid.refresh(model.geometry)
    exact, by_grid = (
        posed.render_camera(model, view.camera, Sampling(32, 32), sdf_grid=sdf_grid).color for sdf_grid in (None, grid)
    )
    # Values of the grid are off by 3/8 K h² = 0.0015, a tenth of 1/s: samples lie elsewhere, sums hardly change.
    np.testing.assert_allclose(by_grid, exact, rtol=0, atol=0.02)


def test_a_sheet_shows_photograph_rendering_and_normals() -> None:
    first, second = noise(8, 10), noise(8, 6, seed=2)
    pairs = [(picture(color), rendered(1 - color)) for color in (first, second)]
    sheet = posed.comparison_sheet(pairs, WHITE)
    factor = 20
    assert sheet.dtype == np.uint8
    assert sheet.shape == (factor * 24, factor * 30, 3)  # two rows of 8 pixels, with 4 between
    small = sheet[::factor, ::factor] / 255
    assert np.allclose(small[:8, :10], first, atol=0.003)
    assert np.allclose(small[:8, 10:20], 1 - first, atol=0.003)
    assert np.allclose(small[:8, 20:30], 0.5, atol=0.003)  # normals of no length
    assert np.allclose(small[12:20, :6], second, atol=0.003)
    assert np.allclose(small[12:20, 18:], 1)


def test_a_reduced_view_sees_the_same_in_fewer_pixels() -> None:
    full = painted_sphere(1, 64).views[0]
    small = posed.reduced(full, 256)
    assert small.name == full.name
    assert torch.equal(small.camera.intrinsics, full.camera.resized(16, 16).intrinsics)
    assert small.color.shape == (16, 16, 3)
    np.testing.assert_allclose(small.mask, full.mask.reshape(16, 4, 16, 4).mean(axis=(1, 3)), atol=1e-6)
    assert posed.reduced(full, 4096) is full  # as many pixels as there are
    assert posed.reduced(picture(noise(7, 300)), 100).color.shape == (2, 65, 3)


RADIUS, DISTANCE = 0.5, 2.0


def photograph(eye: tuple[float, float, float], *, masked: bool = False) -> posed.MaskedCamera:
    """Of the unit sphere; its mask, if it has one, is the left half of the picture."""
    camera = look_at(eye, (0.0, 0.0, 0.0), fov=40, width=160, height=120)
    mask = np.zeros((120, 160), np.float32)
    mask[:, :80] = 1
    return camera, mask if masked else None


def share_visible(views: list[posed.MaskedCamera]) -> tuple[float, np.ndarray]:
    """Of the area of the sphere; and the points."""
    field = Sphere(radius=RADIUS)
    points, within = posed.visible_points(field, views)
    assert points.norm(dim=1).numpy() == pytest.approx(RADIUS, abs=2e-3)
    mesh = extract_mesh(field, resolution=64)
    _, missed = visible_part(mesh, Support(points.numpy(), within, visible=True))
    return 1 - missed, points.numpy()


def test_two_cameras_side_by_side_see_a_cap() -> None:
    """From distance d a sphere is seen where its normal is within acos(r / d) of the eye, (1 − r / d) / 2 of it."""
    share, points = share_visible([photograph((x, 0.0, DISTANCE)) for x in (0.02, -0.02)])
    # The rim: two pixels' width, of 40° / 120 at 1.5 to 2, and as much again by which the points end before it, and the
    # places in which views are counted; of a circle around a sphere, in units of its area.
    pixel = 2 * 2 * math.tan(math.radians(20)) / 120 * DISTANCE
    rim = 2 * math.pi * RADIUS * (pixel + 1 / 32) / (4 * math.pi * RADIUS**2)
    assert share == pytest.approx((1 - RADIUS / DISTANCE) / 2, abs=rim)
    assert (points[:, 2] > RADIUS * RADIUS / DISTANCE - 1 / 32).all()


def test_what_one_camera_or_none_sees_is_not_visible() -> None:
    ahead, behind = (0.0, 0.0, DISTANCE), (0.0, 0.0, -DISTANCE)
    _, points = share_visible([photograph(ahead), photograph((0.05, 0.0, DISTANCE)), photograph(behind)])
    assert (points[:, 2] > 0).all()
    _, points = share_visible([photograph(ahead)])  # but a single one is all that there is
    assert len(points) > 100
    aside = look_at((50.0, 0.0, 0.0), (100.0, 0.0, 0.0), fov=20, width=16, height=12)
    points, _ = posed.visible_points(Sphere(radius=RADIUS), [(aside, None), (aside, None)])
    assert len(points) == 0


def test_pictures_of_few_pixels_meet_in_places_as_wide_as_those() -> None:
    few = [look_at((x, 0.0, DISTANCE), (0.0, 0.0, 0.0), fov=40, width=8, height=8) for x in (0.1, -0.1)]
    points, within = posed.visible_points(Sphere(radius=RADIUS), [(camera, None) for camera in few])
    # A pixel at the nearest point and at the rim, twice, of 40° / 8: the diagonal of a place is longer than the shift
    # between the two pictures, so that most of their pixels share one.
    nearest, rim = DISTANCE - RADIUS, math.sqrt(DISTANCE**2 - RADIUS**2)
    pixel = 2 * 2 * math.tan(math.radians(20)) / 8
    assert pixel * nearest < within < 1.1 * pixel * rim
    assert len(points) > 8


def test_masks_say_what_of_it_is_the_object() -> None:
    _, points = share_visible([photograph((x, 0.0, DISTANCE), masked=True) for x in (0.02, -0.02)])
    # One half of what is in the picture, but for the cameras' distance: the middle of each sees 0.02 · r / d to a side.
    assert max((points[:, 0] > -0.02).mean(), (points[:, 0] < 0.02).mean()) == 1
    assert np.abs(points[:, 0]).max() > 0.4


def test_the_visible_part() -> None:
    two = Union(Sphere(radius=0.2, center=(0.5, 0.0, 0.0)), Sphere(radius=0.2, center=(-0.5, 0.0, 0.0)))
    mesh = extract_mesh(two, resolution=64)
    right = mesh.vertices[mesh.vertices[:, 0] > 0].astype(np.float64)
    kept = thinned(right, visible_within=0.01)
    support = Support(kept["points"].double().numpy(), float(kept["seen_within"]), visible=True)
    part, missed = visible_part(mesh, support)
    assert missed == pytest.approx(0.5, abs=1e-3)
    assert (part.vertices[:, 0] > 0).all()
    assert len(part.faces) == len(mesh.faces) // 2
    assert visible_part(mesh, support._replace(points=np.array([[0.0, 0.0, 0.9]])))[0] is None


def test_seen_needs_a_run_of_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_field(tmp_path / "field.safetensors", Sphere(radius=RADIUS))
    assert main(["mesh", str(tmp_path), "-o", str(tmp_path / "a.ply"), "--seen"]) == 2
    assert "--seen: " in capsys.readouterr().err


BALLS = (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.5]))
RADII = (0.5, 0.3)


def hidden_by(eye: np.ndarray, points: np.ndarray, margin: float) -> np.ndarray:
    """Whether the way from an eye to points meets a ball of a radius that is larger by ``margin``."""
    found = np.zeros(len(points), dtype=bool)
    for center, radius in zip(BALLS, RADII, strict=True):
        way = points - eye
        length = np.linalg.norm(way, axis=1)
        along = ((center - eye) * way).sum(axis=1) / length
        off = np.linalg.norm(eye + along[:, None] * way / length[:, None] - center, axis=1)
        on_it = np.abs(np.linalg.norm(points - center, axis=1) - radius) < 1e-2
        # The far side of its own ball: the way enters it before it gets there. A larger margin hides more.
        found |= np.where(on_it, along - margin < length, (off < radius + margin) & (along < length))
    return found


@pytest.mark.parametrize("size", [64, 512])  # both are looked at in 512 pixels
def test_counts_are_those_of_the_closed_form(size: int) -> None:
    eyes = [(0.0, 0.0, 4.0), (4.0, 0.5, 0.0), (0.3, 3.0, -2.0)]
    cameras = [look_at(eye, (0, 0, 0.6), up=(0, 1, 0), fov=40, width=size, height=size) for eye in eyes]
    parts = [trimesh.creation.icosphere(4, radius=r).apply_translation(c) for r, c in zip(RADII, BALLS, strict=True)]
    both = trimesh.util.concatenate(parts)
    surface = Mesh(np.asarray(both.vertices), np.asarray(both.faces))
    middle = surface.vertices[surface.faces].mean(axis=1)
    told: list[tuple[int, int]] = []
    views = [(camera, None) for camera in cameras]
    counts = posed.count_views(views, surface, middle, finest=512, progress=lambda *done: told.append(done))
    assert told == [(1, 3), (2, 3), (3, 3)]
    sure = np.ones(len(middle), dtype=bool)
    exact = np.zeros(len(middle), dtype=int)
    for camera, eye in zip(cameras, eyes, strict=True):
        # A pixel is 0.006 at that distance, and near a rim a place counts that is up to ten beyond it.
        least, most = (~hidden_by(np.array(eye), middle, margin) for margin in (0.06, -0.06))
        framed = camera.in_view(middle)[2]
        sure &= least == most
        exact += least & framed
    assert sure.mean() > 0.4
    assert np.array_equal(counts[sure], exact[sure])
    assert set(np.unique(exact)) >= {0, 1, 2}
    # A mask of the left half: what falls on the other half is not seen.
    mask = np.zeros((size, size), np.float32)
    mask[:, : size // 2] = 1
    masked = posed.count_views([(cameras[0], mask)], surface, middle, finest=512)
    left = cameras[0].in_view(middle)[0][:, 0] < size // 2 - 0.5
    assert np.array_equal(masked, posed.count_views(views[:1], surface, middle, finest=512) * left)


@pytest.mark.slow
def test_evaluate_tells_how_near_the_mesh_is_where_photographs_see(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = painted_sphere(4, 64)
    write_transforms(tmp_path / "photos", images)
    truth, cloud, figures = (tmp_path / name for name in ("ball.ply", "cloud.xyz", "figures.json"))
    trimesh.creation.icosphere(2, radius=0.6).export(truth)
    some = ["--photos", str(tmp_path / "photos"), "--samples", "2000", "--json", str(figures)]
    assert main(["evaluate", str(truth), str(truth), *some]) == 0
    printed = capsys.readouterr().out
    # A camera at four radii sees where the cosine is above 1 / 4; some 40 samples of 2000 are beside a rim.
    eyes = torch.stack([torch.nn.functional.normalize(view.camera.eye, dim=0) for view in images.views])
    once = (fibonacci_directions(20_000) @ eyes.T.numpy() > 0.25).any(axis=1).mean()
    visible = json.loads(figures.read_text())["visible"]
    assert visible["share"] == pytest.approx(once, abs=0.05)
    assert f"{visible['share']:.2%}" in printed
    assert all(f"{distance:.4g}" in printed for distance in visible["distances"].values())
    # The mesh is the reference: its distances are those of a sampling.
    assert visible["distances"] == pytest.approx(visible["floors"], rel=0.1)
    np.savetxt(cloud, np.random.default_rng(0).normal(size=(50, 3)))
    assert main(["evaluate", str(truth), str(cloud), *some]) == 2
    assert f"{cloud}: holds points" in capsys.readouterr().err
    assert main(["evaluate", str(truth), str(truth), "--photos", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
