"""What measured rays carve out of a grid, against an exact sphere."""

from dataclasses import replace

import pytest
import torch
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.datasets.views.images import PosedImages
from mplicits.pipelines.reconstruct.data.measured import MeasuredDepths
from mplicits.pipelines.reconstruct.initialisation.free_space import seen_through

RADIUS = 0.6  # of the painted sphere


@pytest.fixture(scope="module")
def images() -> PosedImages:
    """A sphere with depth maps and sparse points, and without masks."""
    scene = render_scene(SCENES["painted-sphere"](), views=8, size=24, samples=1, depths=True)
    return replace(scene, views=tuple(replace(view, mask=None) for view in scene.views))


def measured_of(images: PosedImages, *, maps: bool = True) -> MeasuredDepths:
    some = images if maps else replace(images, views=tuple(replace(view, depth=None) for view in images.views))
    return MeasuredDepths(some.views, some, torch.device("cpu"))


@pytest.mark.parametrize("kind", ["maps", "points"])
def test_rays_carve_what_is_outside_and_nothing_inside(images: PosedImages, kind: str) -> None:
    resolution = 24
    empty = seen_through(measured_of(images, maps=kind == "maps"), resolution)
    axis = torch.linspace(-1, 1, resolution + 1)
    length = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0)
    cell = 2 / resolution
    # Places of a ray, which is outside, are rounded to the next vertex: half a diagonal away at most.
    assert not bool(empty[length < RADIUS - 0.5 * 3**0.5 * cell].any())
    beyond = (length > RADIUS + 3 * cell) & (length < 0.95)
    assert float(empty[beyond].float().mean()) > (0.5 if kind == "maps" else 0.15)


def test_one_wrong_measurement_carves_no_hole(images: PosedImages) -> None:
    measured = measured_of(images)
    measured.numbers[0] *= 2  # through the sphere and far behind it
    right, wrong = seen_through(measured_of(images), 24), seen_through(measured, 24)
    axis = torch.linspace(-1, 1, 25)
    inside = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0) < RADIUS - 0.08
    assert not bool((wrong & inside).any())
    assert int((wrong != right).sum()) < 25
