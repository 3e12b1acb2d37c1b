"""Sums of softened dipoles, against the sums over all pairs in float64."""

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets.clouds.cleaning.dipoles import DIPOLES, DipoleField, DipoleSums

SOFTENING = 0.05
# A leaf of 48 points seen as one dipole from beyond its near leaves; see `NEAR` of `dipoles`.
FAR = 0.05


def sphere(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the sphere of radius 0.8 and their area-weighted normals, each ``(N, 3)``."""
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.8 * normals, normals * (4 * np.pi * 0.8**2 / count)


def pairs(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets p_j − p_i ``(N, N, 3)``, and |p_j − p_i|² + ε² ``(N, N)``."""
    offset = points[None] - points[:, None]
    return offset, (offset**2).sum(axis=2) + SOFTENING**2


def expected(points: np.ndarray, dipoles: np.ndarray, values: np.ndarray) -> dict[str, np.ndarray]:
    offset, squares = pairs(points)
    kernel = squares**-1.5 / (4 * np.pi)
    flux = np.einsum("ijd,jd->ij", offset, dipoles)
    return {
        "winding": (kernel * flux).sum(axis=1),
        "adjoint": np.einsum("ij,ijd,i->jd", kernel, offset, values),
        "descent": kernel @ dipoles - 3 * np.einsum("ij,ijd->id", kernel / squares * flux, offset),
    }


@pytest.mark.parametrize(("count", "relative"), [(DIPOLES.leaf, 0.0), (1500, FAR)])
def test_sums_are_those_over_all_pairs(count, relative):
    points, dipoles = sphere(count)
    values = 1 + points[:, 0]
    sums = DipoleSums(points, SOFTENING)
    found = {
        "winding": sums.winding(torch.from_numpy(dipoles).float()),
        "adjoint": sums.adjoint(torch.from_numpy(values).float()),
        "descent": sums.descent(torch.from_numpy(dipoles).float()),
    }
    # Squared distances are differences of squares, of order 1 beside ε².
    rounding = 16 * unit_roundoff(torch.float32) / SOFTENING**2
    for name, exact in expected(points, dipoles, values).items():
        off = np.linalg.norm(found[name].double().numpy() - exact) / np.linalg.norm(exact)
        assert off < relative + rounding, name


def test_descent_is_the_gradient_of_winding():
    """The far side of a point that has no dipole itself, moved to and fro."""
    points, dipoles = sphere(DIPOLES.leaf - 1)
    probe, step = np.array([0.1, 0.2, -0.3]), 1e-2

    def at(place: np.ndarray) -> tuple[float, np.ndarray]:
        sums = DipoleSums(np.vstack([points, place]), SOFTENING)
        mu = torch.from_numpy(np.vstack([dipoles, np.zeros(3)])).float()
        return float(sums.winding(mu)[-1]), sums.descent(mu)[-1].double().numpy()

    slopes = [(at(probe - step * axis)[0] - at(probe + step * axis)[0]) / (2 * step) for axis in np.eye(3)]
    # The third derivative of 1/r² at r > 0.4 is below 24 / r⁵, summed over an area of 8 and divided by 4π.
    assert at(probe)[1] == pytest.approx(np.array(slopes), abs=step**2 / 6 * 24 / 0.4**5 * 8 / (4 * np.pi))


def test_softening_may_change():
    points, dipoles = sphere(300)
    again = DipoleSums(points, 1.0)
    again.soften(SOFTENING)
    mu = torch.from_numpy(dipoles).float()
    assert torch.equal(again.winding(mu), DipoleSums(points, SOFTENING).winding(mu))


def test_leaf_means_count_no_point_twice():
    """1,000 points do not fill 32 leaves of 32."""
    points, _ = sphere(1000)
    sums = DipoleSums(points, SOFTENING)
    means = sums.leaf_means(torch.ones(1000))
    assert len(means) == 32
    assert torch.equal(means, torch.ones(32))


@pytest.mark.parametrize(("count", "relative"), [(1, FAR), (DIPOLES.leaf, 0.0), (3000, FAR)])
def test_a_field_of_dipoles_is_the_sum_over_all_of_them(count, relative):
    points, dipoles = sphere(count)
    places = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    softening = np.random.default_rng(2).uniform(SOFTENING, 2 * SOFTENING, count)
    offset = points[None] - places[:, None]
    squares = (offset**2).sum(axis=2) + softening**2
    exact = (np.einsum("ijd,jd->ij", offset, dipoles) * squares**-1.5).sum(axis=1) / (4 * np.pi)
    found = DipoleField(points, dipoles, softening).winding(places)
    rounding = 16 * unit_roundoff(torch.float32) / SOFTENING**2
    # A sum over all is of order 1; a single dipole is as large as its area over the square of its softening.
    assert np.abs(found - exact).max() < (relative + rounding) * max(1.0, np.abs(exact).max())


def test_winding_numbers_are_whole_close_to_the_sides_of_a_plate():
    """A plate a tenth as thick as a leaf is wide: its sides, merged by leaves, would cancel."""
    side = np.linspace(-0.5, 0.5, 60)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    top = np.stack((x, y, np.full_like(x, 0.01)), axis=1)
    points = np.concatenate((top, top * (1, 1, -1)))
    normals = np.zeros_like(points)
    normals[:, 2] = np.sign(points[:, 2])
    spacing, softening = side[1] - side[0], 0.003
    field = DipoleField(points, spacing**2 * normals, np.full(len(points), softening))
    # Of an infinite plate the number is 1 halfway through and 0 above it. What the rim leaves out is its solid angle;
    # dipoles on a square lattice waver by 4 e^(−2πz/h) of their own at the height z, and softened ones see less.
    rim, waver, soft = 2 * 0.01 / 0.3, 4 * np.exp(-2 * np.pi * 0.01 / spacing), 1 - 0.01 / np.hypot(0.01, softening)
    inner = np.random.default_rng(0).uniform(-0.2, 0.2, (500, 2))
    halfway, above = (np.column_stack((inner, np.full(500, z))) for z in (0.0, 0.03))
    assert rim + waver + soft + FAR < 0.3  # of 0.5, at which a side is taken for the other
    assert (np.abs(field.winding(halfway) - 1) < rim + waver + soft + FAR).all()
    assert (np.abs(field.winding(above)) < rim + waver + soft + FAR).all()


def test_no_place_has_no_winding_number():
    field = DipoleField(*sphere(200), np.full(200, SOFTENING))
    assert field.winding(np.empty((0, 3))).shape == (0,)


def test_leaves_of_a_large_cloud_are_no_more_than_so_many():
    points, dipoles = sphere(2 * DIPOLES.leaf * DIPOLES.most_leaves)
    found = DipoleField(points, dipoles, np.full(len(points), SOFTENING)).winding(np.array([[0.0, 0, 0], [0, 0, 0.95]]))
    assert np.abs(found - (1, 0)).max() < FAR
