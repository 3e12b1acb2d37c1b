"""What the coarse level tells of its points, and what a whole fit makes of strays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fits import SMALL
from mplicits.datasets import OrientedCloud, PointCloud, add_outliers, sample_sphere, sample_torus
from mplicits.neural_fields import InputError, Mesh, MultiscaleSDF, Plane, Siren, Sphere, Torus, extract_mesh
from mplicits.pipelines.fit import FitConfig, fit, prepare
from mplicits.pipelines.fit.review import review_points
from mplicits.pipelines.mesh.extract import MeshOptions, mesh_run
from mplicits.pipelines.surface.surface import read_support
from mplicits.pipelines.training.folder import SUPPORT_FILE, read_record

CPU = torch.device("cpu")


def tensors(cloud: PointCloud) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(cloud.points).float(), torch.from_numpy(cloud.normals)


def test_residuals_find_strays_and_gradients_find_flipped_normals() -> None:
    clean = sample_sphere(4000)
    cloud = add_outliers(PointCloud(clean.points + 1e-3 * np.sin(9 * clean.points[:, :1]), clean.normals), 0.02)
    points, normals = tensors(cloud)
    normals = normals.clone()
    normals[:200] *= -1
    found = review_points(points, normals, Sphere(radius=0.5), device=CPU, outliers=True, turn=True)
    assert not found.dropped[:4000].any()
    assert found.dropped[4000:].sum() > 40  # those with normals unlike the sphere's gradient
    assert found.turned[:200].all()
    assert not found.turned[200:4000].any()
    assert found.record()["turned_normals"] == found.turned.sum()
    nothing = review_points(points, normals, Sphere(radius=0.5), device=CPU, outliers=False, turn=False)
    assert not (nothing.dropped | nothing.turned).any()


def test_a_part_that_the_level_misses_is_no_outlier() -> None:
    """A thin rod: far from the coarse surface, at right angles to its gradient, but of one mind."""
    ball = sample_sphere(4000)
    angle, height = np.random.default_rng(0).uniform(0, 1, (2, 400)) * [[2 * np.pi], [0.4]]
    around = np.stack((np.cos(angle), np.sin(angle), np.zeros(400)), axis=1)
    points = np.concatenate((ball.points, 0.02 * around + np.stack((0 * height, 0 * height, 0.5 + height), axis=1)))
    normals = np.concatenate((ball.normals, around)).astype(np.float32)
    rod = tensors(PointCloud(points, normals))
    found = review_points(*rod, Sphere(radius=0.5), device=CPU, outliers=True, turn=True)
    assert found.dropped.sum() <= 4
    assert not found.turned.any()


def patch_of(points: torch.Tensor, radius: float) -> torch.Tensor:
    """Which points are within ``radius`` of the first."""
    return (points - points[0]).norm(dim=1) < radius


def test_a_patch_of_guessed_normals_that_all_round_it_contradict_is_turned() -> None:
    points, normals = tensors(sample_torus(6000))
    patch = patch_of(points, 0.15)
    assert 100 < patch.sum() < 600
    wrong = torch.where(patch[:, None], -normals, normals)
    coarse = Torus(minor=0.19)  # a level misses all points by a little
    found = review_points(points, wrong, coarse, device=CPU, outliers=False, turn=True, patches=True)
    assert found.turned.tolist() == patch.tolist()
    measured = review_points(points, wrong, coarse, device=CPU, outliers=False, turn=True)
    assert measured.turned.sum() < patch.sum() / 2  # its inner points have none but each other beside them
    # Right normals stay; so do those of a part that is inside out by itself, which no others beside it contradict.
    for right in (normals, -normals):
        found = review_points(points, right, coarse, device=CPU, outliers=False, turn=True, patches=True)
        assert not found.turned.any()


@pytest.mark.parametrize("thickness", [1e-4, 0.01, 0.1])
def test_the_far_side_of_a_plate_that_the_level_takes_for_one_sheet(thickness: float) -> None:
    """All of its normals oppose the gradient, and all are right."""
    random = np.random.default_rng(0)
    places = random.uniform(-0.5, 0.5, (4000, 3))
    side = np.where(np.arange(4000) % 2, 1.0, -1.0)
    places[:, 2] = side * thickness / 2
    points = torch.from_numpy(places).float()
    normals = torch.from_numpy(np.outer(side, [0.0, 0.0, 1.0])).float()
    found = review_points(points, normals, Plane(), device=CPU, outliers=False, turn=False, patches=True)
    assert not found.turned.any()


def test_a_fit_turns_what_its_first_level_contradicts(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = sample_torus(4000)

    def spoilt(cloud: PointCloud, config: FitConfig) -> OrientedCloud:
        good = prepare(cloud, config)
        patch = patch_of(torch.from_numpy(good.points), 0.2).numpy()
        counts.append(int(patch.sum()))
        return replace(good, normals=np.where(patch[:, None], -good.normals, good.normals))

    counts: list[int] = []
    monkeypatch.setattr("mplicits.pipelines.fit.train.prepare", spoilt)
    run = fit(PointCloud(raw.points), replace(SMALL, turn=0.0))  # slow learning averages over the patch
    review = run.record["stages"][0]["review"]
    assert counts[0] > 40
    assert abs(review["turned_normals"] - counts[0]) <= 0.1 * counts[0]
    gradient = run.world.normals(raw.points)
    assert (np.einsum("nd,nd->n", gradient, raw.normals) > 0).all()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    cloud = add_outliers(sample_sphere(3000), 0.05)
    cloud.normals[:300] *= -1
    fit(cloud, SMALL, out=directory)
    return directory


def test_strays_and_flipped_normals_do_not_show_in_the_fit(fitted: Path, tmp_path: Path) -> None:
    record = read_record(fitted)
    cleaning, stages = record["cleaning"], record["stages"]
    assert cleaning["dropped_outliers"] + stages[0]["review"]["dropped_outliers"] > 100
    assert cleaning["turned_normals"] > 280
    assert stages[1]["band"]["delta"] == stages[1]["delta"] < 0.1
    assert stages[1]["band"]["rule"] in ("maximum", "maximum but for strays")
    assert stages[0]["band"] is None
    mesh = mesh_run(fitted, tmp_path / "mesh.ply", MeshOptions(resolution=40))
    assert abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.05


def test_meshing_drops_what_no_points_support(fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = [extract_mesh(Sphere(radius=radius), resolution=24) for radius in (0.98, 0.2)]
    faces = np.concatenate((parts[0].faces, parts[1].faces + len(parts[0].vertices)))
    both = Mesh(np.concatenate([part.vertices for part in parts]), faces)
    monkeypatch.setattr("mplicits.pipelines.mesh.extract.extract_mesh", lambda *_, **__: both)
    said: list[str] = []
    mesh = mesh_run(fitted, tmp_path / "a.ply", say=said.append)
    assert len(mesh.faces) == len(parts[0].faces)
    assert said[0].startswith("removed 1 component that no points support")
    kept = mesh_run(fitted, tmp_path / "b.ply", MeshOptions(keep_unsupported=True), say=said.append)
    assert kept is both
    assert len(said) == 1


def test_support_of_a_run(fitted: Path, tmp_path: Path) -> None:
    record = read_record(fitted)
    support = read_support(fitted / "field.safetensors", record, 1)
    radii = np.linalg.norm(support.points, axis=1)
    assert np.quantile(abs(radii - 1), 0.95) < 1e-3
    assert support.radius > 3 * record["stages"][1]["rms_at_points"] / record["similarity"]["scale"]
    assert read_support(fitted / "field.safetensors", record, 2) is None  # still in training
    assert read_support(fitted / "other.safetensors", record, 1) is None
    assert read_support(tmp_path / "field.safetensors", record, 1) is None
    (tmp_path / SUPPORT_FILE).write_bytes(b"junk")
    with pytest.raises(InputError, match="damaged"):
        read_support(tmp_path / "field.safetensors", record, 1)


def test_everything_can_be_kept() -> None:
    config = replace(SMALL, steps=(3, 3), drop_outliers=False, turn_normals=False, isolation=None)
    run = fit(add_outliers(sample_sphere(2000), 0.05), config)
    assert run.record["cleaning"]["kept"] == 2100
    assert run.record["stages"][0]["review"]["dropped_outliers"] == 0


def test_level_zero_alone_judges() -> None:
    field = MultiscaleSDF(Sphere(radius=0.5), [Siren(8, 1)], [0.05])
    found = review_points(*tensors(sample_sphere(2000)), field, device=CPU, outliers=True, turn=True)
    assert not (found.dropped | found.turned).any()
