"""Deformations: a motion is learnt that takes each shape to the next, and the run keeps it."""

import time
from dataclasses import replace

import pytest
import torch
from evolutions import BRIEF, interrupt
from mplicits.neural_fields import at_time, flow, load_field
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.spacetime.velocity import CarriedKeyframes, VelocitySiren
from mplicits.pipelines.evolve import deform
from mplicits.pipelines.evolve.deform import carried_samples, learn_motion, match
from mplicits.pipelines.evolve.shapes import read_shape
from mplicits.pipelines.evolve.train import evolve
from mplicits.pipelines.training.folder import VELOCITY_FILE, load_motion
from mplicits.pipelines.training.scaffold import Budget
from mplicits.pipelines.training.trainer import Interrupted

LEFT, RIGHT = "sphere:0.25@-0.45,0,0", "sphere:0.25@0.45,0,0"
SMALL = replace(
    BRIEF,
    kind="deform",
    velocity=(0.0, 0.0, 0.0),
    shapes=(LEFT, RIGHT),
    align="none",
    motion_steps=60,
    motion_width=16,
    motion_rate=2e-2,
    widths=(16,),
    depths=(1,),
    omegas=(5.0,),
    steps=(10,),
    learning_rates=(1e-3,),
    data_weights=(100.0,),
    start_steps=5,
    batch=128,
    samples=1000,
    frames=2,
    resolution=16,
)


def test_points_of_a_moved_shape_are_matched_with_their_own_images():
    x, there, y, back = match(read_shape(LEFT), read_shape(RIGHT), seed=0)
    shift = torch.tensor([0.9, 0.0, 0.0])
    # A mean of partners within the blur, √0.003, and half the spacing of 200 points on the sphere, √(4π 0.25² / 200).
    near = 0.055 + 0.063 / 2
    assert (there - x - shift).norm(dim=1).mean() < near
    assert (back - y + shift).norm(dim=1).mean() < near


def test_a_sphere_travels_where_a_blend_of_distances_has_nothing():
    shapes = [read_shape(text) for text in (LEFT, RIGHT)]
    velocity = learn_motion(shapes, (0.0, 1.0), SMALL)
    fields = [shape.field for shape in shapes]
    blended = Keyframes((0.0, 1.0), fields)
    middle = at_time(torch.zeros(1, 3), 0.5)
    assert blended.value(middle) == pytest.approx(0.2)  # 0.45 − 0.25 from both
    assert CarriedKeyframes(blended, velocity).value(middle) < -0.1
    # All points come nearer to the other end than a tenth of their way.
    start = shapes[0].points(500, 5)
    assert fields[1].value(flow(velocity, start, 0.0, 1.0)).abs().max() < 0.09


def test_samples_lie_on_the_carried_surface_and_signs_are_those_of_its_sides():
    shapes = [read_shape(text) for text in (LEFT, RIGHT)]
    velocity = VelocitySiren(4, 1)
    with torch.no_grad():
        velocity.siren.output.weight.zero_()
        velocity.siren.output.bias.copy_(torch.tensor([0.9, 0.0, 0.0]))
    carried = CarriedKeyframes(Keyframes((0.0, 1.0), [shape.field for shape in shapes]), velocity)
    known, bounds = carried_samples(carried, shapes, 2000, seed=0)
    between = (known.points[:, 3] > 0) & (known.points[:, 3] < 1)
    assert between.sum() > 500

    def from_center(points: torch.Tensor) -> torch.Tensor:
        return points[:, :3] - torch.tensor([-0.45, 0.0, 0.0]) - points[:, 3:] * torch.tensor([0.9, 0.0, 0.0])

    offsets = from_center(known.points)
    # Newton's steps end below 1e-3, and a normal errs by that over the radius.
    assert (offsets.norm(dim=1) - 0.25)[between].abs().max() < 2e-3
    cosines = (torch.nn.functional.normalize(offsets, dim=1) * known.gradient).sum(dim=1)
    assert cosines[between].min() > 1 - 1e-3
    truth = from_center(bounds.points).norm(dim=1) - 0.25
    clear = truth.abs() > 2e-3
    assert ((bounds.low == 0) == (truth > 0))[clear].all()
    assert ((bounds.high == 0) == (truth < 0))[clear].all()


def test_a_run_keeps_its_motion_and_resumes_to_the_same_bits(tmp_path, monkeypatch):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    few = replace(SMALL, motion_steps=6, samples=300)
    run = evolve(few, out=whole)
    assert len(run.record["motion"]) == 1
    with pytest.raises(Interrupted):
        evolve(few, out=broken, progress=interrupt("level 0", 0))
    with monkeypatch.context() as patch:
        patch.setattr(deform, "match", lambda *_: pytest.fail("the motion is learnt already"))
        evolve(few, out=broken, resume=True)
    for load in (lambda run: load_field(run / "field.safetensors").field, load_motion):
        torch.testing.assert_close(load(broken).state_dict(), dict(load(whole).state_dict()), rtol=0, atol=0)
    evolve(replace(few, kind="morph"), out=broken)
    assert not (broken / VELOCITY_FILE).exists()


def test_a_time_budget_shortens_the_motion():
    budget, config = Budget(1.0), replace(SMALL, motion_steps=10**6)
    started = time.monotonic()
    learn_motion([read_shape(text) for text in config.shapes], (0.0, 1.0), config, budget=budget)
    assert time.monotonic() - started < 60  # on any machine: it is not a day
    (note,) = budget.notes
    assert note.endswith("steps of the motion instead of 1000000")
