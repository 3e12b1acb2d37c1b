"""Densification of clouds, against surfaces that are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fits import SMALL
from mplicits.datasets import PointCloud, sample_sphere, sample_torus
from mplicits.neural_fields import Torus
from mplicits.pipelines.fit import densification, fit
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.densification import DENSIFICATION, Densified, dense_distance, densified
from scipy.spatial import KDTree


def box(count: int, half: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Points uniform on a cube, with the exact normals of its faces."""
    random = np.random.default_rng(2)
    axis, sign = random.integers(0, 3, count), random.choice([-half, half], count)
    points = random.uniform(-half, half, (count, 3))
    points[np.arange(count), axis] = sign
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = np.sign(sign)
    return points, normals


def cube_grid(cells: int, half: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The vertices of a cube cut into squares, with the mean normals of their faces; how many faces each is on."""
    line = np.linspace(-half, half, cells + 1)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    on = np.abs(points) == half
    points, on = points[on.any(axis=1)], on[on.any(axis=1)]
    normals = np.sign(points) * on
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True), on.sum(axis=1)


def test_a_plane_is_filled_exactly() -> None:
    random = np.random.default_rng(0)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    points = random.uniform(-1, 1, (2000, 3)) * [1, 1, 0] @ turn
    normals = np.broadcast_to(turn[2], points.shape)
    found = densified(points, normals, 5000)
    assert len(found.points) > 4500  # but for some beyond the rim, where there are too few neighbours
    assert np.abs(found.points @ turn[2]).max() < 1e-14
    assert np.abs(found.new_normals - turn[2]).max() < 1e-14
    assert found.repaired == 0


def test_a_sphere_is_filled_to_second_order() -> None:
    radius, count = 0.6, 2000
    cloud = sample_sphere(count, radius=radius, seed=3)
    found = densified(cloud.points, cloud.points / radius, 5000)
    spacing = (4 * np.pi * radius**2 / count) ** 0.5
    assert len(found.points) > 4500
    # The planes of the points alone would be off by the sagitta of a spacing; their curvature takes most of it off.
    sagitta = spacing**2 / (2 * radius)
    height = np.linalg.norm(found.points, axis=1) - radius
    assert np.sqrt((height**2).mean()) < 0.05 * sagitta
    assert np.abs(height).max() < 0.5 * sagitta
    cosine = (found.new_normals * found.points).sum(axis=1) / np.linalg.norm(found.points, axis=1)
    assert np.quantile(np.arccos(np.clip(cosine, -1, 1)), 0.9) < 0.1 * spacing / radius


def test_saddles_are_filled_too() -> None:
    cloud = sample_torus(4000, seed=1)
    found = densified(cloud.points, cloud.normals, 5000)
    height = Torus().value(torch.from_numpy(found.points)).numpy()  # both have radii of 0.5 and 0.2
    spacing = (4 * np.pi**2 * 0.5 * 0.2 / 4000) ** 0.5
    assert len(found.points) > 4500
    assert np.sqrt((height**2).mean()) < 0.1 * spacing**2 / (2 * 0.2)


def test_edges_stay_sharp() -> None:
    points, normals = box(6000)
    found = densified(points, normals, 20_000)
    assert len(found.points) > 15_000
    assert np.abs(found.new_normals).max(axis=1).min() == pytest.approx(1)  # no normal but those of the faces
    face = np.abs(found.new_normals).argmax(axis=1)
    assert np.abs(np.abs(found.points[np.arange(len(face)), face]) - 0.5).max() < 1e-12
    spacing = (6 / 6000) ** 0.5
    beyond = np.abs(found.points).max(axis=1) - 0.5
    assert (beyond > 0.1 * spacing).mean() < 0.002  # where no point of the other face is among the nearest
    near = np.sort(np.abs(found.points), axis=1)[:, 1] > 0.5 - 0.2 * spacing  # the second largest coordinate
    assert near.mean() > 0.4 * 2 * 0.2 * spacing * 2  # 4 rims of each face, and about half of them are filled


def test_the_mean_normals_of_edges_become_those_of_a_side() -> None:
    points, normals, faces = cube_grid(24)
    found = densified(points, normals, 20_000)
    assert found.repaired == (faces > 1).sum()
    assert (found.normals[faces == 1] == normals[faces == 1]).all()
    assert np.abs(found.normals).max(axis=1).min() > 1 - 1e-9
    assert (found.normals * normals).sum(axis=1).min() > 3**-0.5 - 1e-9  # of a side that the point is on
    assert np.abs(found.new_normals).max(axis=1).min() > 1 - 1e-9
    # Points at random have their own face's normal, also beside an edge, and keep it.
    points, normals = box(6000)
    kept = (densified(points, normals, 0).normals == normals).all(axis=1)
    assert kept.mean() > 0.998


def test_faces_with_one_row_of_points_are_filled_and_nothing_beyond_them() -> None:
    """A plate two spacings thick, whose edges have the normals of its large faces."""
    half, thin, cells = 0.5, 0.05, 20
    line = np.linspace(-half, half, cells + 1)
    points = np.stack(np.meshgrid(line, line, [-thin, 0, thin], indexing="ij"), axis=-1).reshape(-1, 3)
    rim = np.abs(points[:, :2]) == half
    points, rim = points[rim.any(axis=1) | (points[:, 2] != 0)], rim[rim.any(axis=1) | (points[:, 2] != 0)]
    normals = np.zeros_like(points)
    normals[:, 2] = np.sign(points[:, 2])
    row = points[:, 2] == 0
    normals[row, :2] = np.sign(points[row, :2]) * rim[row]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = densified(points, normals, 20_000)
    outside = np.abs(found.points) - [half, half, thin]
    assert np.abs(outside.max(axis=1)).max() < 0.1 * thin  # on the plate, up to the corners' mean normals
    low = np.abs(found.points[:, 2]) < 0.8 * thin
    share = 4 * (2 * half) * (1.6 * thin) / (2 * (2 * half) ** 2 + 4 * (2 * half) * (2 * thin))
    assert low.mean() > 0.4 * share


def test_contradictions_are_not_filled() -> None:
    points = sample_sphere(2000).points
    random = np.random.default_rng(4).normal(size=points.shape)
    found = densified(points, random / np.linalg.norm(random, axis=1, keepdims=True), 5000)
    assert len(found.points) < 50
    few = densified(points[:10], points[:10] / 0.5, 100)
    assert len(few.points) == 0


def test_patches_are_not_followed_beyond_the_rim_of_a_strip() -> None:
    """All its points are as far away as the rim at least, and so is their mean: that bounds how far new ones go."""
    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (2000, 3)) * [1, 0.1, 0]
    found = densified(points, np.tile([0.0, 0.0, 1.0], (2000, 1)), 20_000).points
    beyond = np.linalg.norm((np.abs(found[:, :2]) - [1, 0.1]).clip(min=0), axis=1)
    fourth = np.asarray(KDTree(points).query(found, k=4)[0])[:, 3]
    assert (beyond < DENSIFICATION.one_sided * fourth).all()
    assert (beyond == 0).mean() > 0.5


def noisy_filling(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The points that fill in a cloud with noise and estimated normals."""
    given = (torch.from_numpy(a.astype(np.float32)) for a in (points, normals))
    index = dense_distance(*given, omega=1000.0, count=6000, noise=0.001, guessed=True)
    return index.points[index.given :].astype(np.float64)


def test_guessed_normals_do_not_lead_beyond_a_corner(monkeypatch: pytest.MonkeyPatch) -> None:
    """Winding numbers tell the corner of a solid, which nothing goes beyond, from the rim of an open sheet."""
    points, normals = box(2000)
    places, up = np.array([[0.1, 0.2, 0.5], [0.56, 0.56, 0.56]]), np.tile([0.0, 0.0, 1.0], (2, 1))
    monkeypatch.setattr(densification, "densified", lambda p, n, *_, **__: Densified(n, 0, places, up))
    assert np.allclose(noisy_filling(points, normals), places[:1])
    sheet = points * [1, 1, 0]
    assert np.allclose(noisy_filling(sheet, np.tile([0.0, 0.0, 1.0], (len(sheet), 1))), places)


def test_a_cloud_is_filled_in_where_it_is_sparse_for_the_frequency() -> None:
    """Half a sphere has nine times as many points as the other: only the other is filled in."""
    ball = torch.from_numpy(sample_sphere(9000).points).float()
    points = ball[(ball[:, 0] > 0) | (torch.arange(9000) % 9 == 0)]
    normals, plain = 2 * points, CloudDistance(points, 2 * points)
    right = points[:, 0].numpy() > 0
    dense, sparse = np.median(plain.gaps[right]), np.median(plain.gaps[~right])
    for omega, count in ((0.5 * DENSIFICATION.turn / dense, 4000), (80.0, len(points))):
        assert len(dense_distance(points, normals, omega=omega, count=count).points) <= max(count, len(points))
    hardly = dense_distance(points, normals, omega=0.5 * DENSIFICATION.turn / sparse, count=40_000)
    assert hardly.areas[hardly.given :].sum() < 0.01 * hardly.areas.sum()
    index = dense_distance(points, normals, omega=DENSIFICATION.turn / (sparse * dense) ** 0.5, count=40_000)
    assert index.given == len(points)
    assert np.array_equal(index.points[: index.given], points.numpy())
    new = index.points[index.given :]
    assert len(new) > 5000
    assert (new[:, 0] < 2 * sparse).mean() > 0.99
    assert index.gaps[index.given :].min() >= plain.gaps.min()
    # What fills it in lies on the sphere: distances are nearer to the truth than those to the discs of the points.
    x = 2 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) - 1
    truth = x.norm(dim=1) - 0.5
    assert (index.signed(x) - truth).abs().mean() < 0.5 * (plain.signed(x) - truth).abs().mean()


@pytest.mark.slow
def test_sharp_edges_do_not_roughen_the_faces() -> None:
    # Edges leave errors that no network can take away. Where those count squared, the faces are learnt last.
    points, normals = box(3000)
    levels = {"widths": (32, 96), "omegas": (15.0, 40.0), "steps": (150, 120), "learning_rates": (4e-3, 1e-3)}
    small = replace(SMALL, **levels, batch=2048, samples=10_000)
    faces, exact = box(4000)
    inner = np.sort(np.abs(faces), axis=1)[:, 1] < 0.4  # not beside an edge
    found = {}
    for robust in (True, False):
        cloud = PointCloud(points, normals.astype(np.float32), None, "box")
        run = fit(cloud, replace(small, robust_normals=robust))
        assert not run.record["stages"][1]["silenced"]
        cosine = (run.world.normals(faces[inner]) * exact[inner]).sum(axis=1)
        found[robust] = np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    assert found[True] < 0.8 * found[False]
