"""Sums of softened dipoles, against the sums over all pairs in float64."""

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets.clouds.dipoles import LEAF, DipoleSums

SOFTENING = 0.05
# A leaf of 48 points seen as one dipole from beyond its near leaves; see `mplicits.datasets.clouds.dipoles.NEAR`.
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


@pytest.mark.parametrize(("count", "relative"), [(LEAF, 0.0), (1500, FAR)])
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
    points, dipoles = sphere(LEAF - 1)
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
