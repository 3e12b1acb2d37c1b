"""What evolutions are taught: known samples, bounds and ends, against closed forms; and where shapes are put."""

import functools
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from fields import small_spacetime
from mplicits import neural_fields
from mplicits.neural_fields import Box, InputError, Moving, RigidMotion, Similarity, Sphere, Torus, Union, at_time
from mplicits.neural_fields.checkpoint import save_field
from mplicits.neural_fields.spacetime.field import spacetime_jet
from mplicits.neural_fields.spacetime.flow import Solver, trajectories
from mplicits.pipelines.evolve import problem as evolve_problem
from mplicits.pipelines.evolve.objective import EvolveObjective
from mplicits.pipelines.evolve.problem import Problem, between, build_problem, velocity_field
from mplicits.pipelines.evolve.shapes import Placed, Placement, StaticShape, aligned, into_unit_sphere, read_shape
from mplicits.pipelines.training.settings import EvolveConfig

from benchmarks.motion.figures import ShrinkingSphere

CONFIG = EvolveConfig(samples=2000)
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
TURN *= np.sign(np.linalg.det(TURN))


def built(**settings: Any) -> Problem:
    """The problem of exact shapes, and of few samples."""
    config = replace(CONFIG, **settings)
    return build_problem([read_shape(text) for text in config.shapes], config)


def shape_of(field, *, similarity: Similarity | None = None) -> StaticShape:
    mesh = neural_fields.extract_mesh(field, resolution=48)
    return StaticShape("made", field, similarity or Similarity.identity(), mesh)


def test_a_placement_and_its_inverse():
    there = Placement(TURN, 0.5, np.array([0.1, 0.2, -0.3]))
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert np.allclose(there.inverse().apply(there.apply(points)), points)
    other = Placement(TURN.T, 3.0, np.array([1.0, 0.0, 0.0]))
    assert np.allclose(there.then(other).apply(points), other.apply(there.apply(points)))
    again = Placement.from_dict(json.loads(json.dumps(there.as_dict())))
    assert np.array_equal(again.apply(points), there.apply(points))


def test_a_placed_field_is_the_moved_shape():
    placement = Placement(TURN, 0.5, np.array([0.1, 0.2, -0.3]))
    box = Box(half_size=(0.5, 0.3, 0.4)).double()
    placed = Placed(box, placement).double()
    x = 2 * torch.rand(500, 3, dtype=torch.float64) - 1
    moved = torch.from_numpy(placement.apply(x.numpy()))
    jet, expected = placed.jet(moved), box.jet(x)
    assert torch.allclose(jet.value, 0.5 * expected.value, atol=1e-6)
    assert torch.allclose(jet.gradient, expected.gradient @ torch.from_numpy(TURN).T, atol=1e-5)
    assert torch.equal(jet.value, placed.value(moved))


def test_exact_shapes_are_read():
    shape = read_shape("torus:0.4,0.15@0.1,0,-0.2")
    x = 2 * torch.rand(100, 3) - 1
    exact = Torus(major=0.4, minor=0.15).value(x - torch.tensor([0.1, 0.0, -0.2]))
    assert torch.allclose(shape.field.value(x), exact, atol=1e-6)
    assert shape.field.value(shape.points(300, 0)).abs().max() < 1e-4
    assert float(read_shape("sphere").field.value(torch.zeros(1, 3))) == -0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cube", "cube: no such run directory or file, and no exact shape"),
        ("sphere:big", "sphere:big: got 'big'"),
        ("torus:0.4", "torus:0.4: got '0.4', expected 2 numbers"),
        ("sphere:0.4@1,2", "got '1,2', expected 3 numbers"),
        ("sphere:-1", "sphere:-1: radius"),
        ("sphere:7", "sphere:7: has no surface"),
    ],
)
def test_bad_shapes_are_named(text: str, message: str):
    with pytest.raises(InputError, match=rf"^[^\n]*{message}[^\n]*$"):
        read_shape(text)


def test_beyond_its_unit_sphere_a_fit_has_no_parts(tmp_path):
    file = tmp_path / "fit.safetensors"
    save_field(file, Union(Sphere(radius=0.3), Sphere(radius=0.2, center=(2.0, 0.0, 0.0))))
    field = read_shape(str(file)).field
    assert float(field.value(torch.tensor([[2.0, 0.0, 0.0]]))) > 0.9  # its way from the ball of radius 1.05
    x = torch.rand(50, 3) - 0.5
    assert torch.equal(field.value(x), Sphere(radius=0.3).value(x))


def test_a_field_that_moves_already_is_refused(tmp_path):
    save_field(tmp_path / "moving.safetensors", small_spacetime())
    with pytest.raises(InputError, match="moves already"):
        read_shape(str(tmp_path / "moving.safetensors"))


def test_alignment_none_keeps_input_coordinates():
    # Two fits of one ball of radius 5 around (10, 0, 0), each in a unit sphere of its own.
    first = shape_of(Sphere(radius=0.5), similarity=Similarity((10.0, 0.0, 0.0), 10.0))
    second = shape_of(Sphere(radius=0.25, center=(0.1, 0.0, 0.0)), similarity=Similarity((8.0, 0.0, 0.0), 20.0))
    _, moved = aligned([first, second], "none")
    x = 2 * torch.rand(200, 3) - 1
    assert torch.allclose(moved.field.value(x), first.field.value(x), atol=1e-6)
    assert np.abs(np.linalg.norm(moved.surface.vertices, axis=1) - 0.5).max() < 1e-3
    _, kept = aligned([first, second], "center")
    assert kept is second


def test_alignment_pca_turns_a_shape_back():
    """The shape has no symmetry, so that only one of the four ways round is right."""
    lump = Union(Box(half_size=(0.5, 0.3, 0.2)), Sphere(radius=0.2, center=(0.45, 0.3, 0.15)))
    first = shape_of(lump)
    second = shape_of(lump).placed(Placement(rotation=TURN))
    _, back = aligned([first, second], "pca")
    x = 2 * torch.rand(2000, 3) - 1
    assert (back.field.value(x) - first.field.value(x)).abs().mean() < 0.02
    assert (second.field.value(x) - first.field.value(x)).abs().mean() > 0.05


def test_what_reaches_too_far_is_shrunk():
    shapes, region = into_unit_sphere([read_shape("sphere:0.5@0.5,0,0")], np.array([[0.0, 0, 0], [3.0, 0, 0]]))
    assert region == Similarity((1.5, 0.0, 0.0), 1.5)
    x = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    unit = torch.from_numpy(region.to_unit(x.double().numpy())).float()
    assert torch.allclose(shapes[0].field.value(unit), torch.zeros(2), atol=1e-6)
    kept = [read_shape("sphere")]
    assert into_unit_sphere(kept, np.array([[1.0, 0.0, 0.0]])) == (kept, Similarity.identity())


def test_transport_by_rigid_motions_is_known_exactly_and_unions_too():
    problem = built(
        kind="transport",
        shapes=("sphere:0.3@-0.5,0,0", "torus:0.3,0.1@0.4,0,0"),
        velocity=(0.4, 0.0, 0.1, -0.3, 0.0, 0.0),
        angle=(0.0, 2.0),
        axis=(0.0, 0.0, 1.0, 1.0, 1.0, 0.0),
        center=(0.0, 0.0, 0.0, 0.4, 0.0, 0.0),
    )
    placed = Placed(Torus(major=0.3, minor=0.1), Placement(shift=np.array([0.4, 0.0, 0.0])))
    turning = RigidMotion(axis=(1.0, 1.0, 0.0), angle=2.0, center=(0.4, 0.0, 0.0), velocity=(-0.3, 0.0, 0.0))
    parts = [
        Moving(Sphere(radius=0.3, center=(-0.5, 0.0, 0.0)), RigidMotion(velocity=(0.4, 0.0, 0.1))),
        Moving(placed, turning),
    ]
    known = problem.known
    jets = [spacetime_jet(part, known.points) for part in parts]
    value, nearest = torch.stack([jet.value for jet in jets]).min(dim=0)
    assert (known.value - value).abs().max() < 1e-4
    gradients = torch.where((nearest == 0)[:, None], jets[0].gradient, jets[1].gradient)
    clear = (jets[0].value - jets[1].value).abs() > 1e-3
    assert (known.gradient - gradients)[clear].abs().max() < 5e-3
    assert problem.law is None
    assert not len(problem.bounds)
    assert (known.points[:, 3] == 0).float().mean() == pytest.approx(0.25, abs=0.05)
    for end in problem.ends:
        values = torch.stack([part.value(at_time(end.points, end.time)) for part in parts])
        assert values.amin(dim=0).abs().max() < 1e-3
    assert [end.time for end in problem.ends] == [0.0, 1.0]


def test_transport_out_of_the_unit_sphere_shrinks_the_stage():
    problem = built(kind="transport", shapes=("sphere:0.5",), velocity=(2.0, 0.0, 0.0))
    scale = problem.similarity.scale
    assert scale == pytest.approx(1.5, abs=0.01)
    assert problem.similarity.center == pytest.approx((1.0, 0.0, 0.0), abs=0.01)
    points = problem.similarity.to_input(problem.ends[1].points.double().numpy())
    assert np.abs(np.linalg.norm(points - [2.0, 0.0, 0.0], axis=1) - 0.5).max() < 1e-3
    x = torch.from_numpy(problem.similarity.to_input(problem.known.points[:, :3].double().numpy())).float()
    travelled = torch.nn.functional.pad(2 * problem.known.points[:, 3:], (0, 2))
    assert (scale * problem.known.value - (Sphere(radius=0.5).value(x - travelled))).abs().max() < 1e-4


def test_a_twist_gives_surface_points_normals_and_signs():
    problem = built(kind="transport", shapes=("box:0.3,0.2,0.5",), twist=(1.5,))
    box = Box(half_size=(0.3, 0.2, 0.5))

    def untwisted(points: torch.Tensor) -> torch.Tensor:
        angle = -1.5 * points[:, 2] * points[:, 3]
        x, y, z, _ = points.unbind(dim=1)
        return torch.stack((angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y, z), dim=1)

    moving = problem.known.points[:, 3] > 0
    assert moving.any()
    assert box.value(untwisted(problem.known.points[moving])).abs().max() < 2e-3
    assert (problem.known.gradient.norm(dim=1) - 1).abs().max() < 1e-4
    # The normals are those of the transported function, by its own derivatives.
    points = problem.known.points[moving].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(box.value(untwisted(points)).sum(), points)
    cosine = torch.nn.functional.cosine_similarity(gradient[:, :3], problem.known.gradient[moving], dim=1)
    assert cosine.min() > 0.999
    value = box.value(untwisted(problem.bounds.points))
    assert bool(((problem.bounds.low == 0) == (value > 0)).all())
    assert bool(((problem.bounds.high == 0) == (value <= 0)).all())
    assert problem.law is not None


def test_the_velocity_of_a_twist_is_the_derivative_of_the_motion():
    velocity = velocity_field(RigidMotion(angle=0.5, velocity=(0.1, 0.0, 0.2)), 1.5)
    x0 = 2 * torch.rand(50, 3, dtype=torch.float64) - 1
    drift = torch.tensor([0.1, 0.0, 0.2], dtype=torch.float64)

    def position(t: float) -> torch.Tensor:
        angle = (0.5 + 1.5 * x0[:, 2]) * t
        x, y, z = x0.unbind(dim=1)
        turned = (angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y, z)
        return torch.stack(turned, dim=1) + drift * t

    t, h = 0.7, 1e-5
    expected = (position(t + h) - position(t - h)) / (2 * h)
    found = velocity(position(t), torch.full((50,), t, dtype=torch.float64))
    assert torch.allclose(found, expected, atol=1e-8)


def test_bounds_between_shapes():
    values = torch.tensor([[0.1, 0.3, 9.0], [0.1, -0.3, 9.0], [-0.1, -0.3, 9.0], [9.0, 0.2, 0.4], [9.0, -0.2, -0.1]])
    low, high = between(torch.tensor([0.1, 0.2, 0.3, 0.6, 0.9]), (0.0, 0.5, 1.0), values)
    inf = math.inf
    assert torch.allclose(low, torch.tensor([0.1, -inf, -inf, 0.2, -inf]))
    assert torch.allclose(high, torch.tensor([inf, inf, -0.1, inf, -0.1]))


def test_a_morph_knows_its_shapes_and_bounds_what_is_between():
    problem = built(shapes=("sphere:0.4", "sphere:0.7"))
    for time, radius in ((0.0, 0.4), (1.0, 0.7)):
        here = problem.known.take((problem.known.points[:, 3] == time).nonzero()[:, 0])
        assert len(here) == 1000
        assert torch.allclose(here.value, here.points[:, :3].norm(dim=1) - radius, atol=1e-5)
    # Any sphere in between obeys the bounds.
    length = problem.bounds.points[:, :3].norm(dim=1)
    for radius in (0.4, 0.55, 0.7):
        assert bool((length - radius >= problem.bounds.low - 1e-5).all())
        assert bool((length - radius <= problem.bounds.high + 1e-5).all())
    assert bool(((length < 0.4) | (length > 0.7)).all())
    assert len(problem.bounds) > 500
    # The law of concentric spheres: r grows by 0.3 in unit time; the distance falls by as much everywhere.
    growing = ShrinkingSphere(radius=0.5, alpha=-1e-9)
    jet = spacetime_jet(growing, 0.1 + 0.8 * torch.rand(100, 4))
    assert torch.allclose(problem.law.rate(jet), torch.full((100,), -0.3), atol=1e-4)


def test_the_law_counts_per_interval_between_keys():
    problem = built(shapes=("sphere:0.4", "sphere:0.7"))
    assert problem.keys == (0.0, 1.0)

    def law(keys: tuple[float, ...]) -> float:
        generator = torch.Generator().manual_seed(0)
        field = neural_fields.SpaceTimeSDF.from_widths([(8, 1)], omegas=[30])
        with torch.no_grad():
            for parameter in field.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator))
        objective = EvolveObjective(field, replace(problem, keys=keys), CONFIG, level=0, generator=generator)
        return float(objective.losses(0, 0.0)[0]["law"].detach())

    once = law((0.0, 1.0))
    assert once > 0
    assert law((0.0, 0.5, 1.0)) == pytest.approx(once / 4)  # halves of a half: exact
    assert once / 16 < law((0.0, 0.25, 1.0)) < once * 9 / 16


def test_smoothing_is_bounded_by_the_sphere_around_the_shape():
    problem = built(kind="smooth", shapes=("sphere:0.8",), alpha=0.12)
    truth = ShrinkingSphere(radius=0.8, alpha=0.12)
    value = truth.value(problem.bounds.points)
    assert len(problem.bounds) > 500
    assert bool((value >= problem.bounds.low - 1e-3).all())
    assert bool((problem.known.points[:, 3] == 0).all())
    jet = spacetime_jet(truth, at_time(1.1 * problem.ends[0].points, 0.5), order=2)
    assert problem.law.residual(jet).abs().max() < 1e-4
    assert not len(built(kind="smooth", shapes=("sphere:0.8",), alpha=-0.01).bounds)


@pytest.mark.parametrize(("kind", "count"), [("morph", 1), ("smooth", 2), ("transport", 0)])
def test_the_number_of_shapes_is_checked(kind, count: int):
    with pytest.raises(InputError, match=f"{count} shapes for kind {kind}; expected"):
        built(kind=kind, shapes=("sphere",) * count)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"shapes": ("a", "b"), "times": (0.0, 0.5)}, r"times: \(0.0, 0.5\)"),
        ({"shapes": ("a", "b"), "times": (0.0,)}, "times: 1 numbers"),
        ({"velocity": (1.0, 2.0)}, "velocity: 2 numbers"),
        ({"axis": (0.0, 0.0, 0.0)}, r"axis: \(0.0, 0.0, 0.0\)"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict, message: str):
    with pytest.raises(ValueError, match=message):
        EvolveConfig(**settings)


def test_a_motion_that_cannot_be_followed_is_bad_input(monkeypatch):
    soon = functools.partial(trajectories, solver=Solver(max_steps=50))
    monkeypatch.setattr(evolve_problem, "trajectories", soon)
    with pytest.raises(InputError, match=r"the motion cannot be followed .*reached time"):
        built(kind="transport", shapes=("sphere",), angle=(1e7,))
