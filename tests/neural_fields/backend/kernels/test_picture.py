"""A picture in a dozen launches: the same pixels, depths and normals as by PyTorch."""

import os
from collections.abc import Callable
from typing import Any
from unittest import mock

import mplicits.neural_fields.tracing.picture as fused
import pytest
import torch
from fields import solve_sphere
from mplicits.datasets.cameras import Camera, look_at
from mplicits.neural_fields import Field, MultiscaleSDF, Siren, Sphere
from mplicits.pipelines.render.trace import PRECISION, Seen, pixel_size, trace_view


@pytest.fixture
def counted(watch: Callable[..., list[tuple[int, int]]]) -> list[tuple[int, int]]:
    """The sizes of the pictures that were drawn at once."""
    return watch(fused, "draw", lambda field, traced, shown, setting, view: (setting.width, setting.height))


def waves(place: torch.device, taper: float = 0.0) -> MultiscaleSDF:
    """A ball with two residuals, each of which moves its surface by several pixels."""
    base = Siren(16, 2, omega=8.0)
    solve_sphere(base, radius=0.5)
    residuals = [Siren(12, 2, omega=15.0, output_gain=0.03), Siren(17, 1, omega=25.0, output_gain=0.02)]
    return MultiscaleSDF(base, residuals, [0.06, 0.04], taper=taper).to(place).requires_grad_(False)


def camera(width: int = 24, height: int = 18, **options: Any) -> Camera:
    return look_at((1.6, 0.9, 2.0), (0.0, 0.0, 0.0), fov=40.0, width=width, height=height, **options)


def both(field: Field, view: Camera, **options: Any) -> tuple[Seen, Seen]:
    place = next(field.parameters()).device
    ours = trace_view(field, view, device=place, **options)
    with mock.patch.dict(os.environ, MPLICITS_KERNELS="off"):
        return ours, trace_view(field, view, device=place, **options)


def assert_same(ours: Seen, theirs: Seen, view: Camera) -> None:
    """Rounding may decide of single pixels at a silhouette; other hits are a Newton step from within the tolerance."""
    size = pixel_size(view)
    kept, others = torch.isin(ours.pixel, theirs.pixel), torch.isin(theirs.pixel, ours.pixel)
    assert int((~kept).sum()) + int((~others).sum()) <= 1
    assert bool((ours.pixel.diff() > 0).all())  # in their order
    assert float((ours.depth[kept] - theirs.depth[others]).abs().max()) <= PRECISION.tolerance * size
    assert float((ours.position[kept] - theirs.position[others]).norm(dim=-1).max()) <= PRECISION.tolerance * size
    assert float((ours.direction[kept] - theirs.direction[others]).abs().max()) <= 1e-6
    off = (ours.normal[kept] - theirs.normal[others]).norm(dim=-1)
    assert float(off.median()) <= 1e-4
    assert float((ours.normal.norm(dim=-1) - 1).abs().max()) <= 1e-6
    assert ours.size == theirs.size


@pytest.mark.parametrize("taper", [0.0, pytest.param(0.5, marks=pytest.mark.slow)])
def test_pictures_are_pytorchs(taper: float, place: torch.device, counted: list[tuple[int, int]]) -> None:
    field, view = waves(place, taper), camera()
    ours, theirs = both(field, view)
    assert len(theirs.pixel) > 50
    assert_same(ours, theirs, view)
    coarse, expected = both(field, view, level=0)
    assert_same(coarse, expected, view)
    assert counted == [(24, 18)] * 2
    # Normals of the finest level on the surface of the coarsest, which takes no Newton step.
    mapped, expected = both(field, view, level=0, normal_level=2)
    assert_same(mapped, expected, view)
    assert float((mapped.normal - coarse.normal).norm(dim=-1).max()) > 1e-2


def test_other_views(place: torch.device, counted: list[tuple[int, int]]) -> None:
    """A strip of an image, an eye inside the shape, and one that looks away from it."""
    field = waves(place).base
    strip = camera(20, 40).strip(13, 11)
    assert_same(*both(field, strip), strip)
    inside = look_at((0.1, 0.0, 0.0), (1.0, 0.3, 0.0), fov=60.0, width=9, height=7)
    ours, theirs = both(field, inside)
    assert len(ours.pixel) == 63
    assert_same(ours, theirs, inside)
    away = look_at((1.6, 0.9, 2.0), (3.2, 1.8, 4.0), fov=40.0, width=9, height=7)
    nothing, _ = both(field, away)
    assert len(nothing.pixel) == 0
    assert nothing.normal.shape == (0, 3)
    assert counted == [(20, 11), (9, 7), (9, 7)]


def test_a_second_picture_reads_the_weights_of_its_time(place: torch.device) -> None:
    """The memory of the first is used again, and what it gave stays as it was."""
    field, view = waves(place).base, camera()
    before = trace_view(field, view, device=place)
    kept = before.depth.clone()
    field.output.bias.sub_(0.1)  # a larger ball
    ours, theirs = both(field, view)
    assert len(fused._pictures[field]) == 1
    assert len(ours.pixel) > len(before.pixel)
    assert_same(ours, theirs, view)
    assert torch.equal(before.depth, kept)


def test_few_pictures_are_kept(place: torch.device, counted: list[tuple[int, int]]) -> None:
    field = waves(place).base
    for width in range(4, 4 + fused.GRAPHS + 2):
        trace_view(field, camera(width, 4), device=place)
    assert len(fused._pictures[field]) == fused.GRAPHS
    assert len(counted) == fused.GRAPHS + 2


def test_what_is_not_drawn_at_once(place: torch.device, counted: list[tuple[int, int]]) -> None:
    """A lens with distortion, the paper's fixed steps, fields that are no networks, and networks in float64."""
    view = camera(8, 6)
    bent = Camera(view.intrinsics, view.world_from_camera, 8, 6, distortion=(0.01,))
    field = waves(place)
    trace_view(field, bent, level=0, device=place)
    trace_view(field, view, budget=(5, 2, 2), device=place)
    trace_view(Sphere(radius=0.5).to(place), view, device=place)
    with pytest.raises(TypeError, match="float64"):  # a camera's rays are float32
        trace_view(field.double(), view, device=place)
    assert counted == []
