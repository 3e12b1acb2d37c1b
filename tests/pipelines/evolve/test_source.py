"""What comes and goes between two shapes hangs together, in cases where the blend of their distances does not."""

import numpy as np
import pytest
import torch
from mplicits.neural_fields import Capsule, Field, Sphere, TimeSlice, Union, at_time
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.spacetime.velocity import CarriedKeyframes, VelocitySiren
from mplicits.pipelines.evolve.source import Pace, PacedKeyframes, _progress, pace_of
from mplicits.pipelines.evolve.topology import surface_of, topology_of
from torch import Tensor

TIMES = (0.0, 1.0)


def still() -> VelocitySiren:
    velocity = VelocitySiren(4, 1)
    with torch.no_grad():
        for parameter in velocity.siren.output.parameters():
            parameter.zero_()
    return velocity


def balls_with_a_bar(height: float) -> Field:
    """Two balls and a bar between them, which the blend of two such has nowhere if they are at different heights."""
    ends = [(-0.5, 0.0, 0.0), (0.5, 0.0, 0.0)]
    places = [(x, height, 0.0) for x in (-0.5, 0.5)]
    return Union(
        *(Sphere(radius=0.3, center=end) for end in ends), Capsule(start=places[0], end=places[1], radius=0.08)
    )


def ball() -> Field:
    return Sphere(radius=0.3, center=(-0.5, 0.0, 0.0))


def ball_with_a_foot() -> Field:
    """A foot that is thicker than what leads to it, so that the blend has it first."""
    return Union(
        ball(),
        Capsule(start=(-0.4, 0.0, 0.0), end=(0.5, 0.0, 0.0), radius=0.06),
        Sphere(radius=0.2, center=(0.5, 0, 0)),
    )


def most_pieces(field: Field) -> int:
    moments = torch.linspace(0, 1, 13).tolist()
    return max(topology_of(surface_of(TimeSlice(field, time), resolution=48)).components for time in moments)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (balls_with_a_bar(0.2), balls_with_a_bar(-0.2)),
        (ball(), ball_with_a_foot()),
        (ball_with_a_foot(), ball()),
        pytest.param(
            balls_with_a_bar(0.2),
            Union(balls_with_a_bar(-0.2), Sphere(radius=0.25, center=(0.0, 0.74, 0.0))),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["the link changes", "a foot comes", "a foot goes", "the link changes, and one piece more comes"],
)
def test_no_piece_comes_off(first: Field, second: Field) -> None:
    keys, velocity = Keyframes(TIMES, [first, second]), still()
    due = max(topology_of(surface_of(shape, resolution=48)).components for shape in (first, second))
    assert most_pieces(CarriedKeyframes(keys, velocity, steps=1)) == due + 1
    pace = pace_of([first, second], TIMES, velocity, cells=48)
    paced = PacedKeyframes(keys, velocity, [pace], steps=1)
    assert most_pieces(paced) == due
    x = torch.rand(500, 3) * 2 - 1
    for time, shape in zip(TIMES, (first, second), strict=True):
        assert torch.equal(paced.value(at_time(x, time)), keys.value(at_time(x, time)))
        near = at_time(x, abs(time - 1e-3))
        # Values change by their distance over the time that is left, and no faster than twice that.
        assert ((paced.value(near) < 0) == (shape.value(x) < 0))[shape.value(x).abs() > 0.01].all()


def test_a_limb_grows_from_its_root() -> None:
    """No faster than all of it, ways of up to 1.2 along the grid, in half the time; read from meshes to two cells."""
    shapes, velocity = [ball(), ball_with_a_foot()], still()
    field = PacedKeyframes(Keyframes(TIMES, shapes), velocity, [pace_of(shapes, TIMES, velocity, cells=48)], steps=1)
    tips = []
    for time in (0.0, 0.5, 0.7, 0.8, 0.9, 1.0):
        surface = surface_of(TimeSlice(field, time), resolution=48)
        assert surface is not None
        tips.append(surface.vertices[:, 0].max())
    assert tips == sorted(tips)
    assert max(np.diff(tips)[2:]) < 0.1 * 1.2 / 0.49 + 2 * 2 / 48


def test_where_the_blend_hangs_together_it_stays() -> None:
    shapes, velocity = [ball(), Sphere(radius=0.4, center=(-0.4, 0.0, 0.0))], still()
    assert pace_of(shapes, TIMES, velocity, cells=24) is None
    keys = Keyframes(TIMES, shapes)
    x = at_time(torch.rand(50, 3), torch.rand(50))
    carried, paced = CarriedKeyframes(keys, velocity), PacedKeyframes(keys, velocity, [None])
    assert torch.equal(paced.value(x), carried.value(x))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(paced.jet(x), carried.jet(x), strict=True))


def test_the_jet_is_that_of_the_value() -> None:
    shapes = [balls_with_a_bar(0.2), balls_with_a_bar(-0.2)]
    keys, velocity = Keyframes(TIMES, shapes).double(), still().double()
    pace = pace_of([shape.float() for shape in shapes], TIMES, velocity.float(), cells=48)
    field = PacedKeyframes(keys.double(), velocity.double(), [pace])
    x = torch.cat((torch.rand(200, 3) - 0.5, 0.1 + 0.8 * torch.rand(200, 1)), dim=1).double()
    jet, step = field.jet(x), 1e-7
    for axis in range(4):
        aside = step * torch.eye(4, dtype=torch.float64)[axis]
        slope = (field.value(x + aside) - field.value(x - aside)) / (2 * step)
        # Distances to unions, and the pace, have creases: a step of 2e-7 crosses few of them.
        assert ((slope - jet.gradient[:, axis]).abs() < 1e-5).double().mean() > 0.98
    assert torch.equal(jet.value, field.value(x))


def test_progress_goes_from_0_to_1_and_crosses_when_it_is_due() -> None:
    def at(s: float, coming: float, hurry: float) -> tuple[float, float]:
        one: Tensor = torch.ones((), dtype=torch.float64)
        waits = (coming * one, coming * one, hurry * one)
        comes = _progress(s * one, 0.3 * one, -0.7 * one, *waits)  # the blend has it come at 0.3
        goes = _progress((1 - s) * one, -0.7 * one, 0.3 * one, *waits)  # the same, backwards
        return float(comes), 1 - float(goes)

    for coming, hurry in ((0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 1.0), (0.2, 0.5), (0.9, 1.0), (-0.9, 0.0)):
        course = np.array([at(s, coming, hurry) for s in np.linspace(0, 1, 101)])
        assert course[:, 0] == pytest.approx(course[:, 1])
        assert course[0] == pytest.approx(0)
        assert course[-1] == pytest.approx(1)
        assert (np.diff(course, axis=0) >= -1e-12).all()
        due = min(max(0.3 + coming, 0.02), 0.98) / (1 + hurry)
        assert at(due, coming, hurry)[0] == pytest.approx(0.3)
    assert at(0.6, 0.0, 0.0)[0] == pytest.approx(0.6)


def test_a_grid_is_read_by_x_y_and_z() -> None:
    axis = torch.linspace(-1, 1, 5)
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    hurry = (1 + 0.5 * x + 0.2 * y - 0.1 * z) / 4
    pace = Pace(torch.stack((torch.zeros_like(x), torch.zeros_like(x), hurry)))
    points, early = torch.rand(20, 3) * 2 - 1, torch.full((20,), 0.25)
    share = pace.progress(points, early, torch.ones(20), -torch.ones(20))
    assert share.tolist() == pytest.approx((0.25 * (1 + (1 + points @ torch.tensor([0.5, 0.2, -0.1])) / 4)).tolist())
