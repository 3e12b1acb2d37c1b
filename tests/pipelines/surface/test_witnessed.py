"""Distances by how many photographs see a place: exact means of parts, and what is left out."""

import numpy as np
import pytest
from mplicits.pipelines.surface.measure import evaluate_surfaces, format_metrics
from mplicits.pipelines.surface.surface import Surface
from mplicits.pipelines.surface.witnessed import WITNESSED, Ways, seen_figures, seen_lines


def square(height: float, side: float = 1.0) -> Surface:
    corners = [(0.0, 0.0, height), (side, 0.0, height), (side, 1.0, height), (0.0, 1.0, height)]
    return Surface(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]))


def test_means_are_of_the_parts() -> None:
    counts = np.array([0, 1, 2, 3, 9])
    mesh = Ways(np.array([1.0, 2.0, 3.0]), np.array([0, 2, 4]), np.array([10.0, 20.0, 30.0, 50.0, 70.0]))
    floor = Ways(np.array([0.1]), np.array([3]), np.full(5, 0.2))
    seen = seen_figures(counts, mesh, floor)
    assert [part.share for part in seen.parts] == [0.2, 0.2, 0.4, 0.0, 0.2]
    assert [part.completeness for part in seen.parts] == [10, 20, 40, None, 70]
    # Of the mesh the first sample is next to what nobody sees.
    assert seen.chamfer == pytest.approx((2 + 3) / 2 + (30 + 50 + 70) / 3)
    assert seen.chamfer_floor == pytest.approx(0.1 + 0.2)
    assert seen_lines(seen)[4][0].split() == ["seen", "by", "4", "to", "7"]
    assert "n/a" in seen_lines(seen)[4]


def test_every_number_of_photographs_has_one_part() -> None:
    for count in range(12):
        assert sum(least <= count and (most is None or count <= most) for least, most in WITNESSED) == 1


def test_what_no_photograph_sees_does_not_count() -> None:
    """Half of a square is missing, and nobody has seen that half."""
    truth, asked = square(3.0), []

    def witnesses(surface: Surface, points: np.ndarray) -> np.ndarray:
        assert surface is truth
        asked.append(points)
        return np.where(points[:, 0] < 0.49, 5, 0)

    metrics = evaluate_surfaces(square(3.0, side=0.5), truth, samples=4000, witnesses=witnesses)
    assert np.allclose(asked[0][:, 2], 3.0)  # in the reference's own coordinates
    assert metrics.seen is not None
    assert metrics.chamfer_floor is not None
    assert metrics.seen.chamfer is not None
    # The missing half is up to 1/2 away, in units of the square's radius 1/√2: half has a mean of 2 (1/2)² / 3.
    assert metrics.completeness == pytest.approx(0.5 * 0.5**2 / 3 * 2, rel=0.1)
    # Samples of half a square are twice as dense as those of a whole one, so both are within two of its floors.
    assert metrics.seen.chamfer < 2 * metrics.chamfer_floor
    assert "seen by 4 to 7" in format_metrics(metrics)


def test_a_cloud_has_no_witnesses() -> None:
    cloud = Surface(np.random.default_rng(0).normal(size=(10, 3)), np.zeros((0, 3), np.int64))
    with pytest.raises(ValueError, match="points hide nothing"):
        evaluate_surfaces(square(0.0), cloud, samples=10, witnesses=lambda _, points: np.zeros(len(points), np.int64))
