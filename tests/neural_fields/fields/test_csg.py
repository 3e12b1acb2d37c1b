"""Solids put together: against set algebra, closed forms, and what a field may never do."""

import math
from collections.abc import Callable

import mplicits.neural_fields as nf
import numpy as np
import pytest
import torch
from fields import cube
from mplicits.neural_fields.fields.csg import Bounded, Placed
from mplicits.neural_fields.shape import in_one_frame

A = nf.Sphere(radius=0.5, center=(-0.25, 0.0, 0.0))
B = nf.Sphere(radius=0.4, center=(0.3, 0.0, 0.0))
C = nf.Box(half_size=(0.2, 0.6, 0.1))
PARTS = (A, B, C)
# One rounding of a float64 for each of a handful of operations on numbers up to 2.
ROUNDING = 16 * 2.0**-53 * 2


def test_membership_is_that_of_sets() -> None:
    x = cube(5000)
    a, b, c = (part(x) < 0 for part in PARTS)
    assert torch.equal(nf.Union(*PARTS)(x) < 0, a | b | c)
    assert torch.equal(nf.Intersection(A, C)(x) < 0, a & c)
    assert torch.equal(nf.Difference(*PARTS)(x) < 0, a & ~b & ~c)  # no point is on a surface
    assert torch.equal(nf.Shell(A, inside=0.1, outside=0.05)(x) < 0, (A(x) > -0.1) & (A(x) < 0.05))


COMBINED: dict[str, Callable[[], nf.Field]] = {
    "union": lambda: nf.Union(*PARTS),
    "intersection": lambda: nf.Intersection(*PARTS),
    "difference": lambda: nf.Difference(*PARTS),
    "smooth union": lambda: nf.Union(*PARTS, smooth=0.3),
    "smooth intersection": lambda: nf.Intersection(*PARTS, smooth=0.3),
    "smooth difference": lambda: nf.Difference(*PARTS, smooth=0.3),
    "offset": lambda: nf.Offset(nf.Torus(), -0.1),
    "shell": lambda: nf.Shell(nf.Box(), inside=0.1, outside=0.2),
    "placed": lambda: Placed(nf.Torus(), nf.Similarity((0.3, -0.2, 0.1), 0.4)),
    "bounded": lambda: Bounded(nf.Plane(offset=0.1), radius=0.6),
    "bounded box": lambda: Bounded(C, radius=0.6),
}


@pytest.mark.parametrize("name", COMBINED)
def test_none_is_steeper_than_its_parts(name: str) -> None:
    """|h(x) − h(y)| ≤ |x − y|: with the sign, that makes |h| a bound on the distance, which tracers need."""
    field = COMBINED[name]()
    x = 1.5 * cube(4000)
    near = x + 0.05 * cube(4000)
    for y in (1.5 * cube(4000), near):
        assert bool(((field(x) - field(y)).abs() <= (x - y).norm(dim=1) + ROUNDING).all())
    assert bool((field.jet(x).gradient.norm(dim=1) <= 1 + 1e-12).all())


@pytest.mark.parametrize("operation", [nf.Union, nf.Intersection, nf.Difference])
def test_a_blend_is_narrow_and_small(operation: type[nf.Union | nf.Intersection | nf.Difference]) -> None:
    width = 0.2
    x = cube(20_000)
    sharp, smooth = operation(A, B)(x), operation(A, B, smooth=width)(x)
    other = -B(x) if operation is nf.Difference else B(x)
    beside = (A(x) - other).abs() >= width
    assert set(beside.tolist()) == {True, False}
    assert torch.equal(sharp[beside], smooth[beside])
    grown = sharp - smooth if operation is nf.Union else smooth - sharp
    assert bool((grown >= -ROUNDING).all())
    assert bool((grown <= width / 4 + ROUNDING).all())
    middle = torch.tensor([[-0.25 + (0.55**2 + 0.5**2 - 0.4**2) / 1.1, 0.0, 0.0]], dtype=torch.float64)
    middle[0, 1] = (0.5**2 - (middle[0, 0] + 0.25) ** 2).sqrt()  # on both spheres
    if operation is not nf.Difference:
        assert abs(abs(float(operation(A, B, smooth=width)(middle))) - width / 4) < ROUNDING


def test_the_fillet_between_two_walls() -> None:
    """Two planes at a right angle: the middle of the fillet lies at (k/4, k/4), and its radius is k/√2."""
    k = 0.3
    field = nf.Union(nf.Plane(normal=(1, 0, 0)), nf.Plane(normal=(0, 1, 0)), smooth=k)
    x = torch.tensor([k / 4, k / 4, 0.1], dtype=torch.float64)
    jet = field.second_jet(x)
    assert abs(float(jet.value)) < ROUNDING
    slope = jet.gradient.norm()
    normal = jet.gradient / slope
    torch.testing.assert_close(normal, torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64) / 2**0.5)
    curvature = (jet.hessian.trace() - normal @ jet.hessian @ normal) / slope
    assert abs(float(curvature) + 2**0.5 / k) < 1e-12  # hollow, seen from outside


def violent(field: nf.Field) -> nf.MultiscaleSDF:
    """Two residuals that change every sign in their bands here and there."""
    one, two = (nf.FunctionField(lambda x, k=k: (k * x).sin().sum(dim=-1)) for k in (37.0, 53.0))
    return nf.MultiscaleSDF(field, [one, two], [0.1, 0.07])


VIOLENT: dict[str, Callable[[], nf.Field]] = {
    "union": lambda: nf.Union(violent(A), violent(B), C),
    "intersection": lambda: nf.Intersection(violent(A), violent(B)),
    "difference": lambda: nf.Difference(violent(A), violent(B)),
    "smooth union": lambda: nf.Union(violent(A), violent(B), violent(C), smooth=0.3),
    "smooth difference": lambda: nf.Difference(violent(A), violent(B), smooth=0.3),
    "grown": lambda: nf.Offset(violent(A), 0.08),
    "shrunk": lambda: nf.Offset(violent(A), -0.3),
    "wall": lambda: nf.Shell(violent(A), inside=0.2, outside=0.1),
    "small": lambda: Placed(violent(A), nf.Similarity((0.3, 0.0, 0.1), 0.5)),
    "large": lambda: Placed(violent(A), nf.Similarity((0.3, 0.0, 0.1), 2.0)),
    "bounded": lambda: Bounded(violent(A), radius=0.7),
}


@pytest.mark.parametrize("name", VIOLENT)
def test_no_surface_of_a_fine_level_is_lost(name: str) -> None:
    """The sign is what the finest levels of the parts say, also where a band ends before them; and so is the value."""
    field = VIOLENT[name]()
    x = cube(50_000)
    finest = field._join(x, [part(field._home(x)) for part in field.fields])
    assert torch.equal(field(x) < 0, finest < 0)
    inside = field.in_band(x, level=field.num_levels - 1)
    assert torch.equal(field(x)[inside], finest[inside])
    assert not torch.equal(field(x, level=0) < 0, finest < 0)


def rough(center: tuple[float, float, float]) -> nf.MultiscaleSDF:
    """A ball, and waves of a tenth of its band on it."""
    waves = nf.FunctionField(lambda x: 0.01 * (20 * x).sin().prod(dim=-1))
    return nf.MultiscaleSDF(nf.Sphere(radius=0.4, center=center), [waves], [0.1], taper=0.5)


@pytest.mark.parametrize(
    "make",
    [
        lambda a, b: nf.Union(a, b),
        lambda a, b: nf.Difference(a, b, smooth=0.1),
        lambda a, b: nf.Shell(nf.Union(a, b, smooth=0.1), inside=0.06),
        lambda a, b: nf.Offset(nf.Intersection(a, b), 0.08),
        lambda a, b: nf.Union(Placed(a, nf.Similarity((0.2, 0.0, 0.0), 0.5)), Bounded(b, radius=0.6)),
    ],
)
def test_skipping_by_bands_changes_nothing(make: Callable[[nf.Field, nf.Field], nf.Field]) -> None:
    field = make(rough((-0.25, 0.0, 0.0)), rough((0.25, 0.1, 0.0)))
    plain = nf.FunctionField(lambda x: field(x))
    assert field.num_levels == 2
    one, other = nf.extract_mesh(field, resolution=64), nf.extract_mesh(plain, resolution=64)
    assert np.array_equal(one.faces, other.faces)
    np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-6)
    origins = torch.nn.functional.normalize(torch.randn(300, 3), dim=1) * 2
    directions = 0.5 * torch.rand(300, 3) - 0.25 - origins
    with_levels, without = nf.sphere_trace(field, origins, directions), nf.sphere_trace(plain, origins, directions)
    assert int((with_levels.mask != without.mask).sum()) <= 2  # rays that graze within `resolution`
    both = with_levels.mask & without.mask
    assert int(both.sum()) > 150
    assert float(field(with_levels.position[both].double()).abs().max()) < 1e-4


def test_a_field_beyond_its_ball() -> None:
    wild = nf.FunctionField(lambda x: torch.where(x.norm(dim=-1) > 1, -1.0, 0.3 - x[..., 2]))  # garbage beyond 1
    field = Bounded(wild, radius=1.0)
    x = 2.0 * cube(5000)
    within = x.norm(dim=1) < 1
    assert torch.equal(field(x)[within] < 0, wild(x)[within] < 0)
    assert bool((field(x)[~within] > 0).all())
    ball = nf.Sphere(radius=0.3, center=(0.4, 0.0, 0.0))
    bound, exact = Bounded(ball, radius=0.8)(x), ball(x)
    assert bool((bound <= exact + ROUNDING).all())
    assert torch.equal(bound[x.norm(dim=1) < 0.8], exact[x.norm(dim=1) < 0.8])
    far = 1000 * torch.nn.functional.normalize(x, dim=1)
    assert bool((Bounded(ball, radius=0.8)(far) > 999).all())


CENTER = np.array([500_000.25, 4_100_000.5, 120.0])


def world(offset: tuple[float, float, float], radius: float, scale: float) -> nf.WorldField:
    x, y, z = CENTER + offset
    return nf.WorldField(nf.Sphere(radius=radius / scale), nf.Similarity((x, y, z), scale))


def test_solids_of_different_unit_spheres() -> None:
    a, b = world((0, 0, 0), 10.0, 20.0), world((12, 0, 0), 6.0, 7.0)
    offsets = np.random.default_rng(0).uniform(-20, 20, (2000, 3))
    first, second = np.linalg.norm(offsets, axis=1) - 10, np.linalg.norm(offsets - [12, 0, 0], axis=1) - 6
    rounding = 16 * 2.0**-24 * 60  # float32, in a frame with a diameter below 60 m
    for shape, exact in (
        (a.union(b), np.minimum(first, second)),
        (a.intersection(b), np.maximum(first, second)),
        (a.difference(b), np.maximum(first, -second)),
        (a.offset(2.5), first - 2.5),
        (a.offset(-2.5), first + 2.5),
        (a.shell(inside=1.0, outside=0.5), np.abs(first + 0.25) - 0.75),
        (a.union(b).difference(world((0, 0, 0), 3.0, 4.0)), np.maximum(np.minimum(first, second), 3 - (first + 10))),
    ):
        np.testing.assert_allclose(shape.distance(CENTER + offsets), exact, atol=rounding)
    touching = a.union(b, smooth=4.0)
    on_both = np.array([(10**2 - 6**2 + 12**2) / 24, 0.0, 0.0])
    on_both[1] = math.sqrt(10**2 - on_both[0] ** 2)
    assert abs(float(touching.distance(CENTER + on_both)) + 1.0) < rounding  # smooth / 4
    mesh = a.offset(2.5).mesh(48)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTER, axis=1), 12.5, atol=1e-3)


def test_frames_hold_all_and_what_was_learned_ends_at_its_ball() -> None:
    a, b = world((0, 0, 0), 1.0, 2.0), nf.WorldField(nf.Siren(8, 1), nf.Similarity((*CENTER[:2], 130.0), 3.0))
    fields, frame = in_one_frame([a, b], margin=0.5)
    assert frame.center == (*CENTER[:2], (118.0 + 133.0) / 2)
    assert abs(frame.scale - (7.5 + 0.5)) < 1e-12
    assert [type(field.fields[0]) for field in fields] == [nf.Sphere, Bounded]
    alone, same = in_one_frame([b])
    assert alone == [b.field]
    assert same == b.similarity
