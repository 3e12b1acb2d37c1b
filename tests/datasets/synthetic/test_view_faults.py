"""One fault at a time, exactly as it says, and nothing else."""

import numpy as np
import pytest
import torch
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.synthetic.view_faults import VIEW_FAULTS, with_fault
from mplicits.datasets.views.images import PosedImages
from mplicits.neural_fields import Similarity
from mplicits.neural_fields.meshing.color_space import srgb_to_linear


@pytest.fixture(scope="module")
def images() -> PosedImages:
    return render_scene(SCENES["painted-sphere"](), views=40, size=8, samples=1)


def angles(first: PosedImages, second: PosedImages) -> np.ndarray:
    """Degrees that each camera was turned by."""
    pairs = zip(first.views, second.views, strict=True)
    traces = [
        torch.trace(a.camera.world_from_camera[:3, :3].T @ b.camera.world_from_camera[:3, :3]).item() for a, b in pairs
    ]
    return np.degrees(np.arccos(((np.array(traces) - 1) / 2).clip(-1, 1)))


def shifts(first: PosedImages, second: PosedImages) -> np.ndarray:
    pairs = zip(first.views, second.views, strict=True)
    return np.array([float((a.camera.eye - b.camera.eye).norm()) for a, b in pairs])


@pytest.mark.parametrize("fault", sorted(VIEW_FAULTS))
def test_faults_are_made_of_copies_and_keep_the_region(images: PosedImages, fault: str) -> None:
    before = [view.color.copy() for view in images.views]
    made = with_fault(images, fault)
    assert made.similarity == images.similarity
    assert [view.name for view in made.views] == [view.name for view in images.views]
    assert all(np.array_equal(view.color, old) for view, old in zip(images.views, before, strict=True))


def test_poses_are_off_by_what_is_said(images: PosedImages) -> None:
    wide = PosedImages(images.views, Similarity((0.0, 0.0, 0.0), 3.0), images.region, images.points, images.source)
    made = with_fault(wide, "poses", seed=4)
    # The mean of 120 squares of standard normal numbers is within 5 · sqrt(2 / 120) of 1, but once in a million seeds.
    for measured, expected in ((angles(wide, made), 0.5), (shifts(wide, made), 3 * 0.005)):
        assert abs(np.square(measured).sum() / (3 * len(measured) * expected**2) - 1) < 5 * (2 / 120) ** 0.5
    assert all(a.color is b.color for a, b in zip(wide.views, made.views, strict=True))


def test_one_pose_looks_past_the_object(images: PosedImages) -> None:
    made = with_fault(images, "pose")
    turned = angles(images, made)
    assert turned[2] == pytest.approx(30, abs=1e-5)
    assert (np.delete(turned, 2) < 1e-5).all()
    assert (shifts(images, made) == 0).all()


def test_one_photograph_is_another_s(images: PosedImages) -> None:
    made = with_fault(images, "image")
    changed = [i for i, view in enumerate(made.views) if not np.array_equal(view.color, images.views[i].color)]
    assert changed == [2]
    assert np.array_equal(made.views[2].color, images.views[1].color)


def test_mirrored_twice_is_as_before(images: PosedImages) -> None:
    made = with_fault(images, "mirrored")
    assert np.array_equal(made.views[5].color, images.views[5].color[:, ::-1])
    again = with_fault(made, "mirrored")
    assert all(np.array_equal(a.mask, b.mask) for a, b in zip(again.views, images.views, strict=True))


@pytest.mark.parametrize("fault", sorted(VIEW_FAULTS))
def test_depth_maps_go_with_their_pictures_and_cameras(fault: str) -> None:
    figure = render_scene(SCENES["figure"](), views=4, size=16, samples=1, depths=True)
    for view, right in zip(with_fault(figure, fault).views, figure.views, strict=True):
        assert view.depth is not None
        assert torch.equal(view.depth.camera.world_from_camera, view.camera.world_from_camera)
        assert view.mask is not None
        # One sample in the middle of each pixel: a depth is where the mask is, or was before it had a hole.
        assert right.mask is not None
        inside = (right.mask if fault == "holes" else view.mask) > 0.5
        assert np.array_equal(np.isfinite(view.depth.numbers), ~inside if fault == "masks" else inside)


def test_masks_are_inverted(images: PosedImages) -> None:
    for old, new in zip(images.views, with_fault(images, "masks").views, strict=True):
        assert old.mask is not None
        assert new.mask is not None
        assert np.allclose(old.mask + new.mask, 1)


def test_every_twelfth_mask_has_a_hole_in_its_middle() -> None:
    images = render_scene(SCENES["painted-sphere"](), views=15, size=30, samples=1)
    made = with_fault(images, "holes")
    cut = [a.mask != b.mask for a, b in zip(images.views, made.views, strict=True)]
    assert [index for index, hole in enumerate(cut) if hole.any()] == [2, 14]
    # The sphere is in the middle: a disc of radius 3 around it.
    y, x = np.indices((30, 30)) - 14.5
    assert all(np.array_equal(cut[index], x**2 + y**2 < 9) for index in (2, 14))
    assert all(a.color is b.color for a, b in zip(images.views, made.views, strict=True))


def test_every_other_photograph_has_half_of_the_light(images: PosedImages) -> None:
    made = with_fault(images, "exposure")
    for index, (old, new) in enumerate(zip(images.views, made.views, strict=True)):
        factor = 0.5 if index % 2 else 1.0
        assert np.allclose(srgb_to_linear(new.color), factor * srgb_to_linear(old.color), atol=1e-6)


def test_two_views_are_too_few_and_unknown_faults_are_refused() -> None:
    few = render_scene(SCENES["painted-sphere"](), views=2, size=8, samples=1)
    with pytest.raises(ValueError, match="2 views"):
        with_fault(few, "image")
    with pytest.raises(KeyError):
        with_fault(few, "rain")
