"""Landmarks: what a file may hold, where it lands, and that a ball turns which nothing else would turn."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evolutions import BRIEF
from mplicits.neural_fields import InputError, RigidMotion, flow
from mplicits.pipelines.evolve import shapes
from mplicits.pipelines.evolve.deform import learn_motion, match
from mplicits.pipelines.evolve.shapes import Landmarks, Placement, placed_landmarks, read_landmarks, read_shape
from mplicits.pipelines.evolve.train import evolve
from mplicits.pipelines.training.settings import EvolveConfig

BALL = "sphere:0.5"
TURN = RigidMotion(axis=(0.0, 0.0, 1.0), angle=0.8)
SMALL = replace(
    BRIEF,
    kind="deform",
    velocity=(0.0, 0.0, 0.0),
    shapes=(BALL, BALL),
    align="none",
    motion_steps=80,
    motion_width=16,
    motion_rate=2e-2,
)


def corners() -> torch.Tensor:
    """Six points of the ball, which a turn about z takes to six others."""
    return 0.5 * torch.cat((torch.eye(3), -torch.eye(3)))


def write(path: Path, before: torch.Tensor, after: torch.Tensor) -> str:
    np.savetxt(path, torch.cat((before, after), dim=1).numpy())
    return str(path)


def test_lines_commas_and_comments(tmp_path):
    (tmp_path / "marks.txt").write_text("# head, then tail\n1 2 3 4 5 6\n\n-1, 0,1e-3, 0,0,7 # tail\n")
    before, after = read_landmarks(tmp_path / "marks.txt")
    np.testing.assert_array_equal(before, [[1, 2, 3], [-1, 0, 1e-3]])
    np.testing.assert_array_equal(after, [[4, 5, 6], [0, 0, 7]])


@pytest.mark.parametrize(("text", "said"), [("1 2 3", "six"), ("1 2 3 4 5 x", "line 1"), ("# none", "no numbers")])
def test_other_lines_are_refused(tmp_path, text: str, said: str):
    (tmp_path / "marks.txt").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=said):
        read_landmarks(tmp_path / "marks.txt")


def test_nan_and_missing_files_are_refused_before_shapes_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr("mplicits.pipelines.evolve.train.read_shape", lambda _: pytest.fail("too late"))
    (tmp_path / "nan.txt").write_text("1 2 3 4 5 nan", encoding="utf-8")
    for name, said in (("nan.txt", "six finite"), ("none.txt", "none.txt")):
        with pytest.raises(InputError, match=said):
            evolve(replace(SMALL, landmarks=(str(tmp_path / name),)))


def test_one_file_for_each_two_shapes_of_a_deformation():
    with pytest.raises(ValueError, match="2 files for 2 shapes"):
        replace(SMALL, landmarks=("a", "b"))
    with pytest.raises(ValueError, match="kind morph"):
        EvolveConfig(shapes=(BALL, BALL), landmarks=("a",))


def test_they_go_where_their_shapes_go(tmp_path):
    path = write(tmp_path / "marks.txt", corners(), corners())
    placement = Placement(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), 0.5, np.array([0.1, 0, 0]))
    first, second = read_shape(BALL), read_shape(BALL).placed(placement)
    (found,) = placed_landmarks([path], [first, second])
    torch.testing.assert_close(found.before, corners())
    expected = torch.from_numpy(placement.apply(corners().double().numpy())).float()
    torch.testing.assert_close(found.after, expected)
    assert [len(own.before) for own in placed_landmarks([], [first, second, first])] == [0, 0]
    with pytest.raises(InputError, match="is not on sphere"):
        placed_landmarks([write(tmp_path / "off.txt", corners(), 2 * corners())], [first, first])


def test_landmarks_change_the_plan():
    """Of a ball on itself the cheapest plan moves nothing; landmarks turn it."""
    ball, after = read_shape(BALL), TURN.forward(corners(), 1.0)
    plans = (match(ball, ball, 0), match(ball, ball, 0, Landmarks(corners(), after)))
    still, turned = ((there - TURN.forward(x, 1.0)).norm(dim=1).mean() for x, there, *_ in plans)
    assert turned < 0.5 * still
    assert torch.equal(shapes.nearness(corners(), corners()).diagonal(), torch.ones(6))


def test_a_ball_turns(tmp_path):
    ball, after = read_shape(BALL), TURN.forward(corners(), 1.0)
    config = replace(SMALL, landmarks=(write(tmp_path / "marks.txt", corners(), after),))
    velocity = learn_motion([ball, ball], (0.0, 1.0), config)
    others = ball.points(300, 9)
    with torch.no_grad():
        marks, moved = (flow(velocity, points, 0.0, 1.0) for points in (corners(), others))
    way = float((after - corners()).norm(dim=1).mean())
    assert float((marks - after).norm(dim=1).mean()) < 0.25 * way
    # What lies between landmarks turns with them, as nothing else strains so little.
    truth = TURN.forward(others, 1.0)
    assert float((moved - truth).norm(dim=1).mean()) < 0.5 * float((others - truth).norm(dim=1).mean())
