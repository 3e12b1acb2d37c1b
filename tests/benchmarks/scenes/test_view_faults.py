"""One fault at a time, exactly as it says, and nothing else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import PosedImages, read_posed_images
from mplicits.datasets.views.writing import write_neus
from mplicits.neural_fields import Similarity
from mplicits.neural_fields.meshing.color_space import srgb_to_linear

from benchmarks.cli import main
from benchmarks.cli.scenes import FAULTS
from benchmarks.scenes.view_faults import VIEW_FAULTS, with_fault


@pytest.fixture(scope="module")
def images() -> PosedImages:
    return render_scene(SCENES["painted-sphere"](), views=40, size=8, samples=1)


def angles_and_shifts(first: PosedImages, second: PosedImages) -> tuple[np.ndarray, np.ndarray]:
    """Degrees that each camera was turned by, and the way that it was moved."""
    pairs = [(a.camera, b.camera) for a, b in zip(first.views, second.views, strict=True)]
    turns = torch.stack([a.world_from_camera[:3, :3].T @ b.world_from_camera[:3, :3] for a, b in pairs])
    cosine = (turns.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    shifts = np.array([float((a.eye - b.eye).norm()) for a, b in pairs])
    return np.degrees(np.arccos(cosine.numpy().clip(-1, 1))), shifts


@pytest.mark.parametrize("fault", sorted(VIEW_FAULTS))
def test_faults_are_made_of_copies_and_depth_maps_go_with_their_pictures(fault: str) -> None:
    figure = render_scene(SCENES["figure"](), views=4, size=16, samples=1, depths=True)
    before = [view.color.copy() for view in figure.views]
    made = with_fault(figure, fault)
    assert made.similarity == figure.similarity
    assert [view.name for view in made.views] == [view.name for view in figure.views]
    assert all(np.array_equal(view.color, old) for view, old in zip(figure.views, before, strict=True))
    for view, right in zip(made.views, figure.views, strict=True):
        assert torch.equal(view.depth.camera.world_from_camera, view.camera.world_from_camera)
        # One sample in the middle of each pixel: a depth is where the mask is, or was before it had a hole.
        inside = (right.mask if fault == "holes" else view.mask) > 0.5
        assert np.array_equal(np.isfinite(view.depth.numbers), ~inside if fault == "masks" else inside)


def test_poses_are_off_by_what_is_said(images: PosedImages) -> None:
    wide = replace(images, similarity=Similarity((0.0, 0.0, 0.0), 3.0))
    made = with_fault(wide, "poses", seed=4)
    # The mean of 120 squares of standard normal numbers is within 5 · sqrt(2 / 120) of 1, but once in a million seeds.
    for measured, expected in zip(angles_and_shifts(wide, made), (0.5, 3 * 0.005), strict=True):
        assert abs(np.square(measured).sum() / (3 * len(measured) * expected**2) - 1) < 5 * (2 / 120) ** 0.5
    assert all(np.array_equal(a.color, b.color) for a, b in zip(wide.views, made.views, strict=True))


def test_one_pose_looks_past_the_object_and_one_photograph_is_another_s(images: PosedImages) -> None:
    turned, shifted = angles_and_shifts(images, with_fault(images, "pose"))
    assert turned[2] == pytest.approx(30, abs=1e-5)
    assert (np.delete(turned, 2) < 1e-5).all()
    assert (shifted == 0).all()
    made = with_fault(images, "image")
    for index, view in enumerate(made.views):
        assert np.array_equal(view.color, images.views[1 if index == 2 else index].color)


def test_pictures_are_mirrored_masks_inverted_and_light_halved(images: PosedImages) -> None:
    mirrored, masks, exposure = (with_fault(images, name) for name in ("mirrored", "masks", "exposure"))
    again = with_fault(mirrored, "mirrored")
    for index, old in enumerate(images.views):
        assert np.array_equal(mirrored.views[index].color, old.color[:, ::-1])
        assert np.array_equal(again.views[index].mask, old.mask)
        assert np.allclose(old.mask + masks.views[index].mask, 1)
        light = (0.5 if index % 2 else 1.0) * srgb_to_linear(old.color)
        assert np.allclose(srgb_to_linear(exposure.views[index].color), light, atol=1e-6)


def test_every_twelfth_mask_has_a_hole_in_its_middle() -> None:
    images = render_scene(SCENES["painted-sphere"](), views=15, size=30, samples=1)
    made = with_fault(images, "holes")
    cut = [a.mask != b.mask for a, b in zip(images.views, made.views, strict=True)]
    assert [index for index, hole in enumerate(cut) if hole.any()] == [2, 14]
    # The sphere is in the middle: a disc of radius 3 around it.
    y, x = np.indices((30, 30)) - 14.5
    assert all(np.array_equal(cut[index], x**2 + y**2 < 9) for index in (2, 14))


def test_two_views_are_too_few_and_unknown_faults_are_refused(images: PosedImages) -> None:
    with pytest.raises(ValueError, match="2 views"):
        with_fault(replace(images, views=images.views[:2]), "image")
    with pytest.raises(KeyError):
        with_fault(images, "rain")
    assert set(FAULTS) == set(VIEW_FAULTS)  # what the command offers


def test_the_command_makes_a_fault_of_a_data_set_and_refuses_what_is_too_small(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for views in (3, 2):
        write_neus(tmp_path / f"{views}", render_scene(SCENES["painted-sphere"](), views=views, size=24, samples=1))
    assert main(["fault", f"{tmp_path}/3", "mirrored", "-o", f"{tmp_path}/wrong"]) == 0
    right, wrong = (read_posed_images(tmp_path / name).views for name in ("3", "wrong"))
    assert all(np.array_equal(b.color, a.color[:, ::-1]) for a, b in zip(right, wrong, strict=True))
    capsys.readouterr()
    assert main(["fault", f"{tmp_path}/2", "mirrored", "-o", f"{tmp_path}/none"]) == 2
    assert f"{tmp_path}/2: 2 photographs" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
