"""Faults of simulated scans are what their formulas say: exactly, or as closely as their random numbers allow."""

import functools
import math

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets import ScanFaults, SimulatedScan, scan_with_truth, simulate_scan
from mplicits.datasets.synthetic.scanner import depth_jumps, kept_unevenly, quantised, rigid_motion, smeared
from mplicits.neural_fields import Similarity, Sphere, Union
from scipy.spatial.transform import Rotation

SURE = 5.0  # standard errors by which a statistic may be off: chance does that less than once in a million
DOUBLE = 64 * unit_roundoff(torch.float64)
RADIUS = 0.8
# Rays stop 2e-4 before the surface, which at a slope of 0.1, the least that is seen, is 2e-3 along the ray; two Newton
# steps of at most 8e-4 leave 4e-4 of it.
GRAZING = 4e-5
PLACE = Similarity((100.0, -20.0, 3.0), 50.0)


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def fan(side: int, step: float) -> np.ndarray:
    """Rays ``(side, side, 3)`` about the z axis, ``step`` radians apart at its foot."""
    tangent = np.tan(step * (np.arange(side) - (side - 1) / 2))
    rays = np.stack(np.broadcast_arrays(tangent[None, :], tangent[:, None], 1.0), axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def check_gaussian(values: np.ndarray, sigma: float) -> None:
    """Mean and variance ``(N,)``, whose standard errors are σ/√N and √2 σ²/√N."""
    count = len(values)
    assert abs(values.mean()) < SURE * sigma / math.sqrt(count)
    assert abs(np.square(values).mean() - sigma**2) < SURE * math.sqrt(2 / count) * sigma**2


def test_quantised_ranges_are_multiples_half_a_step_away_at_most():
    ranges, step = generator().uniform(2, 3, 20_000), 0.0125
    rounded = quantised(ranges, step)
    steps = rounded / step
    assert np.abs(steps - np.rint(steps)).max() < 240 * DOUBLE
    error = rounded - ranges
    assert np.abs(error).max() <= step / 2 + 3 * DOUBLE
    # Of a uniform error e, e² has the mean s²/12 and the variance s⁴ (1/80 − 1/144).
    assert abs(np.square(error).mean() - step**2 / 12) < SURE * step**2 * math.sqrt((1 / 80 - 1 / 144) / 20_000)
    assert quantised(ranges, 0.0) is ranges


@pytest.mark.parametrize(("incidence", "jumps"), [(0, False), (83, False), (85, True)])
@pytest.mark.parametrize("axis", [0, 1])
def test_what_is_steeper_than_a_scanner_sees_is_a_jump(incidence, jumps, axis):
    """Rays α = 1e-4 apart climb tan θ · α (1 + tan θ · α): the limit is right to 0.1 %, far less than a degree."""
    rays = fan(3, 1e-4)
    lean = math.radians(incidence)
    normal = np.zeros(3)
    normal[[1, 0][axis]], normal[2] = math.sin(lean), math.cos(lean)
    ranges = math.cos(lean) / (rays @ normal)
    assert (depth_jumps(ranges, rays, axis) == jumps).all()
    assert not depth_jumps(ranges, rays, 1 - axis).any()
    ranges[1, 1] = np.nan
    assert not np.moveaxis(depth_jumps(ranges, rays, axis), axis, 0)[:, 1].any()  # a reading is missing


def test_mixed_readings_lie_between_the_two_sides_of_a_jump():
    """A step from 2 to 2.5 across the middle column: the columns beside it mix, and no others."""
    side, share = 400, 0.3
    rays = fan(side, 1e-3)
    ranges = np.full((side, side), 2.0)
    ranges[:, side // 2 :] = 2.5
    found, mixed = smeared(ranges, rays, share, generator())
    beside = np.zeros((side, side), bool)
    beside[:, side // 2 - 1 : side // 2 + 1] = True
    assert np.array_equal(found[~mixed], ranges[~mixed])
    assert not mixed[~beside].any()
    count = int(beside.sum())
    assert abs(mixed[beside].mean() - share) < SURE * math.sqrt(share * (1 - share) / count)
    way = (np.abs(found - ranges) / 0.5)[mixed]
    assert 0 < way.min() < way.max() < 1
    assert abs(way.mean() - 0.5) < SURE / math.sqrt(12 * mixed.sum())
    assert ((found >= 2) & (found <= 2.5)).all()


def test_a_reading_mixes_with_the_neighbour_that_is_furthest_away():
    ranges = np.full((3, 3), 2.0)
    ranges[0, 1], ranges[1, 2], ranges[2, 1] = 2.5, 1.0, np.nan
    found, mixed = smeared(ranges, fan(3, 1e-3), 1.0, generator(1))
    assert (mixed[1, 1], mixed[1, 0]) == (True, False)
    assert 1.0 < found[1, 1] < 2.0
    assert np.isnan(found[2, 1])
    assert not smeared(ranges, fan(3, 1e-3), 0.0, generator())[1].any()


@pytest.mark.parametrize(("height", "share"), [(-1.0, 1.0), (0.0, 0.25), (1.0, 1 / 16)])
def test_density_falls_exponentially_along_a_direction(height, share):
    direction = np.array([0.6, 0.0, 0.8])
    kept = kept_unevenly(np.tile(height * direction, (40_000, 1)), direction, 16.0, generator())
    assert abs(kept.mean() - share) <= SURE * math.sqrt(share * (1 - share) / 40_000)


def test_motions_are_rigid_and_as_large_as_asked_for():
    size, count = 0.01, 4000
    random = generator()
    motions = np.stack([rigid_motion(size, random) for _ in range(count)])
    turns = motions[:, :3, :3]
    assert np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() < DOUBLE
    assert (np.linalg.det(turns) > 0).all()
    assert (motions[:, 3] == (0, 0, 0, 1)).all()
    check_gaussian(motions[:, :3, 3].ravel(), size)
    check_gaussian(Rotation.from_matrix(turns).as_rotvec().ravel(), size)
    assert np.array_equal(rigid_motion(0.0, generator()), np.eye(4))


@pytest.mark.parametrize(
    ("name", "value"),
    [("isotropic", -1.0), ("quantise", math.inf), ("misalign", math.nan), ("smear", 1.5), ("uneven", 0.5)],
)
def test_what_is_out_of_bounds_is_named(name, value):
    with pytest.raises(ValueError, match=f"{name}="):
        ScanFaults(**{name: value})


@functools.cache
def scan(**faults: float) -> SimulatedScan:
    noise = faults.pop("noise", 0.0)
    sizes = {"scanners": 6, "resolution": 48, "noise": noise, "placement": PLACE, "seed": 3}
    return scan_with_truth(Sphere(radius=RADIUS), faults=ScanFaults(**faults), **sizes)


def measured(found: SimulatedScan) -> np.ndarray:
    """Points before the registration's errors, ``R⁻¹(x − t)``."""
    motion = found.motions[found.scanner]
    return np.einsum("nji,nj->ni", motion[:, :3, :3], found.cloud.points - motion[:, :3, 3])


def along_rays(found: SimulatedScan, *, scale: float = PLACE.scale) -> np.ndarray:
    """How much too long each reading is, in units of the field; what is beside its ray is asserted to be nothing."""
    start = found.positions[found.scanner]
    ray = (found.exact - start) / np.linalg.norm(found.exact - start, axis=1, keepdims=True)
    off = measured(found) - found.exact
    along = (off * ray).sum(axis=1)
    assert np.abs(off - along[:, None] * ray).max() < 1000 * DOUBLE  # coordinates of some hundred
    return along / scale


def test_the_truth_is_on_the_surface():
    """See `GRAZING`; half of the rays meet a sphere at 45° and less, where Newton's method has converged."""
    found = scan(noise=0.002)
    exact = PLACE.to_unit(found.exact)
    length = np.linalg.norm(exact, axis=1)
    assert np.abs(length - RADIUS).max() < GRAZING
    assert np.median(np.abs(length - RADIUS)) < 1e-8
    assert np.abs(found.exact_normals - exact / length[:, None]).max() < 1e-9
    assert len(found.exact) == len(found.cloud) == len(found.scanner) == len(found.smeared)
    assert (np.diff(found.scanner) >= 0).all()


def test_noise_of_ranges_lies_along_the_rays():
    check_gaussian(along_rays(scan(noise=0.002)), 0.002)
    assert np.abs(along_rays(scan())).max() < 1000 * DOUBLE


def test_isotropic_noise_has_no_direction():
    """Of a Gaussian the covariances' standard errors are σ² √((1 + δ_ij)/N)."""
    found, sigma = scan(isotropic=0.003), 0.003
    off = (found.cloud.points - found.exact) / PLACE.scale
    covariance = off.T @ off / len(off)
    bound = SURE * sigma**2 * np.sqrt((1 + np.eye(3)) / len(off))
    assert (np.abs(covariance - sigma**2 * np.eye(3)) < bound).all()


def test_registration_moves_whole_scans_and_their_normals():
    straight, moved = scan(noise=0.001), scan(noise=0.001, misalign=0.01)
    np.testing.assert_allclose(measured(moved), straight.cloud.points, atol=1000 * DOUBLE)
    assert np.array_equal(moved.exact, straight.exact)
    turn = moved.motions[moved.scanner][:, :3, :3]
    expected = np.einsum("nij,nj->ni", turn, straight.cloud.normals)
    np.testing.assert_allclose(moved.cloud.normals, expected, atol=8 * unit_roundoff(torch.float32))
    assert np.array_equal(straight.motions, np.tile(np.eye(4), (6, 1, 1)))
    way = np.linalg.norm(moved.cloud.points - straight.cloud.points, axis=1) / PLACE.scale
    assert 0 < way.min() < way.max() < SURE * 0.01 * math.sqrt(3) * (1 + RADIUS)


def test_faults_leave_the_other_random_numbers_alone():
    plain, uneven = scan(noise=0.001), scan(noise=0.001, uneven=8.0)
    kept = np.isin(plain.exact[:, 0], uneven.exact[:, 0])
    assert 0.1 < kept.mean() < 0.9
    assert np.array_equal(plain.cloud.points[kept], uneven.cloud.points)
    assert not plain.smeared.any()
    same = simulate_scan(Sphere(radius=RADIUS), scanners=6, resolution=48, noise=0.001, placement=PLACE, seed=3)
    assert np.array_equal(same.points, plain.cloud.points)


def test_smeared_scans_say_which_readings_are_mixed():
    field = Union(Sphere(radius=0.3, center=(0.4, 0.0, 0.0)), Sphere(radius=0.3, center=(-0.4, 0.0, 0.0)))
    found = scan_with_truth(field, scanners=8, resolution=64, noise=0.0, faults=ScanFaults(smear=1.0), seed=1)
    value = field.value(torch.from_numpy(found.cloud.points)).numpy()
    assert found.smeared.sum() > 20
    assert np.abs(value[~found.smeared]).max() < GRAZING
    assert np.median(np.abs(value[found.smeared])) > 0.01  # a jump is 0.2 wide at least, and slopes are 0.1 at least
    assert np.abs(along_rays(found, scale=1.0)).max() < 2  # both sides of a jump are in the unit sphere
