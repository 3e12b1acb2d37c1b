"""The paper's ablations: exact distances, variants that are what they say, rows from made-up records, smoke jobs."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from imageio.v3 import imread
from mplicits.datasets import read_cloud
from mplicits.neural_fields import Box, Mesh, MultiscaleSDF, Siren, Sphere
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.samples import banded_sources
from mplicits.pipelines.fit.train import fit, prepare
from mplicits.pipelines.surface.distance import MeshDistance

from benchmarks.harness.jobs import make_folder
from benchmarks.harness.run import run_job
from benchmarks.paper import base as training
from benchmarks.paper.ablations import DELTA_FACTOR, LOSS_WEIGHTS
from benchmarks.paper.isolation import ISOLATION, IndependentLevels, isolation_tables, residuals_everywhere, steepness
from benchmarks.paper.judge import fit_config
from benchmarks.paper.methods import REGISTRY
from benchmarks.paper.sheets import write_sheets
from benchmarks.paper.speed import MARCHING_CUBES, NORMALS
from benchmarks.shapes.sampled_error import approximation_error, near_surface

HALF = np.array([0.5, 0.3, 0.4])
BLOCK = trimesh.creation.box(2 * HALF)
CUBOID = Mesh(np.asarray(BLOCK.vertices), np.asarray(BLOCK.faces))


def test_approximation_error_of_an_exact_and_of_a_shifted_field() -> None:
    points = near_surface(CUBOID, 4000, reach=0.05, seed=3)
    distances = MeshDistance(CUBOID).signed(points)
    assert 0.045 < np.abs(distances).max() <= 0.05
    assert 0.4 < (distances < 0).mean() < 0.6
    box = Box(half_size=(0.5, 0.3, 0.4))
    assert approximation_error(box, points, distances) < 1e-6
    grown = Box(half_size=(0.51, 0.31, 0.41))
    inside = (np.abs(points) < HALF).all(axis=1)
    assert approximation_error(grown, points[inside], distances[inside]) == pytest.approx(0.01, abs=1e-6)


def small() -> MultiscaleSDF:
    torch.manual_seed(0)
    return MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0) for _ in range(2)], [0.2, 0.1])


def test_without_bands_is_the_sum_of_all_levels_everywhere() -> None:
    field, x = small(), 2 * torch.rand(500, 3) - 1
    everywhere = training.without_bands(field)
    torch.testing.assert_close(everywhere.value(x), torch.stack([level.value(x) for level in field.levels]).sum(dim=0))
    gradients = torch.stack([level.jet(x).gradient for level in field.levels]).sum(dim=0)
    torch.testing.assert_close(everywhere.jet(x).gradient, gradients)
    assert not torch.allclose(everywhere.value(x), field.value(x))
    assert everywhere.in_band(x, level=2).all()


def test_independent_levels_hand_over_inside_their_bands() -> None:
    torch.manual_seed(1)
    base, middle, fine = Sphere(radius=0.5), Sphere(radius=0.55), Siren(16, 2, omega=5.0)
    field = IndependentLevels([base, middle], [0.2]).with_level(fine, delta=0.1)
    x = 1.6 * torch.rand(2000, 3) - 0.8
    first = base.value(x).abs() < 0.2
    second = first & (middle.value(x).abs() < 0.1)
    assert 50 < second.sum() < first.sum() < 1990
    value, gradient, features = field.jet(x)
    assert features.shape == (2000, 0)
    for rows, level in ((~first, base), (first & ~second, middle), (second, fine)):
        torch.testing.assert_close(field.value(x)[rows], level.value(x[rows]))
        torch.testing.assert_close(value[rows], level.value(x[rows]))
        torch.testing.assert_close(gradient[rows], level.jet(x[rows]).gradient)
    bands = torch.stack([field.in_band(x, level=level) for level in range(3)])
    assert torch.equal(bands, torch.stack((torch.ones_like(first), first, second)))
    torch.testing.assert_close(field.value(x, level=0), base.value(x))
    assert field.value(x[:6].reshape(2, 3, 3)).shape == (2, 3)
    assert field.value(x[:0]).shape == (0,)
    with pytest.raises(ValueError, match="expected one less"):
        IndependentLevels([base], [0.1])


def test_steepness_bounds_the_slope() -> None:
    assert steepness(Sphere(radius=0.5), margin=1.0) == 1.25
    siren = Siren(16, 1, omega=8.0)
    with torch.no_grad():
        siren.output.weight.mul_(100)
        slopes = siren.jet(2 * torch.rand(3000, 3) - 1).gradient.norm(dim=-1)
    assert slopes.max() > 1.25
    assert steepness(siren) > float(slopes.max())


@pytest.fixture(scope="module")
def base(ball: Path) -> training.Base:
    config = fit_config("smoke")
    cloud = read_cloud(ball)
    run = fit(cloud, config)
    return training.Base(run.field, run.similarity, config, prepare(cloud, config))


def test_a_level_trained_with_the_fits_own_weights_is_the_fits_own_level(base: training.Base) -> None:
    index, previous = base.index(), training.up_to(base.field, 0)
    delta = training.delta_after(index, previous, base.config)
    assert delta == pytest.approx(float(base.field.deltas[0]), rel=1e-6)
    generator = training.generator_for(base.config, 1)
    sources = banded_sources(index, previous, delta, base.config, generator=generator)
    network = training.train_level(1, sources, base.config, generator=generator)
    x = torch.from_numpy(base.cloud.points)
    again = previous.with_level(network, delta=delta)
    torch.testing.assert_close(again.value(x), base.field.value(x, level=1), atol=1e-5, rtol=0)
    assert not torch.allclose(again.value(x), previous.value(x), atol=1e-4)


def test_residual_levels_see_the_cloud_that_level_0_has_judged(base: training.Base) -> None:
    normals = base.cloud.normals.copy()
    normals[::40] *= -1
    flipped, coarse = dataclasses.replace(base.cloud, normals=normals), training.up_to(base.field, 0)
    np.testing.assert_array_equal(training.reviewed(flipped, coarse, base.config).normals, base.cloud.normals)
    trusting = dataclasses.replace(base.config, turn_normals=False)
    np.testing.assert_array_equal(training.reviewed(flipped, coarse, trusting).normals, normals)


def test_sources_of_the_variants(base: training.Base) -> None:
    index, previous = base.index(), training.up_to(base.field, 0)
    delta = training.delta_after(index, previous, base.config)
    banded = banded_sources(index, previous, delta, base.config, generator=torch.Generator())
    assert [source.name for source in banded] == ["surface", "offset", "band"]
    assert all(bool((previous.value(s.samples.points).abs() < delta).all()) for s in banded)
    assert banded[0].samples.value is not None
    for source, alone in zip(banded, training.on_its_own(banded), strict=True):
        assert alone.samples.value is alone.samples.gradient is None
        assert torch.equal(alone.samples.points, source.samples.points)
    surface, domain = training.domain_sources(index, previous, base.config, generator=torch.Generator())
    assert (len(surface.samples), len(domain.samples)) == (len(base.cloud), base.config.samples)
    assert float(domain.samples.distance.max()) > 0.6  # near the corners of the domain
    assert domain.data == pytest.approx(surface.data * base.config.domain_weight)


def test_a_residual_without_bands_learns_the_whole_domain(base: training.Base) -> None:
    field = residuals_everywhere(base)
    assert field.deltas.tolist() == [math.inf, math.inf]
    index = CloudDistance(torch.from_numpy(base.cloud.points), torch.from_numpy(base.cloud.normals))
    x = 1.6 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(5)) - 0.8
    exact = index.signed(x)
    assert float((field.value(x) - exact).abs().mean()) < float((base.field.base.value(x) - exact).abs().mean())


def record(method: str, outputs: list[dict[str, Any]], *, shape: str = "ball", **more: Any) -> dict[str, Any]:
    job = {"shape": shape, "method": method, "preset": "cpu", "noise": 0.0, "overrides": {}} | more.pop("job", {})
    return {"cell": job, "outputs": outputs, "deltas": [], "details": {}, "environment": {"device": "cpu"}} | more


def test_isolation_rows_are_means_over_shapes_beside_the_papers() -> None:
    def figures(name: str, chamfer: float | None, components: int) -> dict[str, Any]:
        found = {"hausdorff": 2 * (chamfer or 0), "shell_iou": 0.5, "iou": 0.9, "components": components}
        return {"name": name, "chamfer": chamfer} | (found if chamfer is not None else {})

    noisy = {"noise": 0.01}
    records = [
        record("ours", [figures("Ours coarse", 9.0, 9), figures("Ours fine", 9.0, 9)], job=noisy),
        record("isolation", [figures("a", 1.0, 1), figures("a without culling", 1.5, 1)], job=noisy),
        record("isolation", [figures("a", 3.0, 3)], shape="cube", job=noisy),
        record("isolation", [figures("a", 0.25, 1)]),
        record("isolation", [figures("b", 4.0, 2)], job=noisy),
        record("isolation", [figures("b", None, 0)], shape="cube", job=noisy),
        record("isolation", [figures("c", 5.0, 2), figures("c without culling", 50.0, 1234)], job=noisy),
    ]
    table, culling = isolation_tables(records)
    assert table.rows[0].values == pytest.approx((2.0, 2.0, 4.0, 0.5, 0.9, 2.0, 0.25, 0.25, 0.5, 0.5, 0.9, 1.0))
    assert table.rows[1].values[:6] == pytest.approx((4.0, 4.0, 8.0, 0.5, 0.9, 2.0))
    assert table.rows[1].values[6:] == (None,) * 6
    assert table.rows[0].published[:4] == (6.39e-5, 1.49e-5, 1.45e-3, 0.687)
    assert [row.values for row in culling.rows] == [(2.0, "1 to 3"), (1.5, "1"), (5.0, "2"), (50.0, "1,234")]
    assert culling.rows[3].published == (2.8e-1, "365 to 4,109")


def test_tables_of_nothing() -> None:
    for spec in (LOSS_WEIGHTS, DELTA_FACTOR, ISOLATION, MARCHING_CUBES, NORMALS):
        assert spec.tables([]) == ()
        failed = {**record(spec.name, []), "error": "out of memory"}
        assert spec.tables([failed]) == ()


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench") / "out"
    make_folder(path)
    return path


LONG = [pytest.param(spec, marks=pytest.mark.slow) for spec in (LOSS_WEIGHTS, DELTA_FACTOR, ISOLATION, MARCHING_CUBES)]


@pytest.mark.parametrize("spec", [*LONG, NORMALS], ids=lambda s: s.name)
def test_smoke(spec: Any, ball: Path, out: Path) -> None:
    planned = [job for job in spec.jobs([ball], "smoke") if spec is ISOLATION or not job.noise]
    jobs = [job for job in planned if dict(job.overrides).get("constraint", "sdf") == "sdf"]
    records = [run_job(job, out, REGISTRY) for job in jobs]
    tables = spec.tables(records)
    assert tables
    assert all("paper only" in row.name or any(v is not None for v in row.values) for row in tables[0].rows)
    if spec is ISOLATION:
        chamfers = [row.values[6] for row in tables[0].rows]
        assert all(isinstance(c, float) and c < 0.01 for c in chamfers)
        assert all(row.values[0] is not None for row in tables[1].rows)  # with and without culling
        sheets = write_sheets("isolation", dict(zip(jobs, records, strict=True)), out)
        assert [title for _, title in sheets] == ["isolation: ball", "isolation: ball + noise 0.01"]
        clean, noisy = (imread(out / file).shape for file, _ in sheets)
        assert noisy[0] > clean[0]  # a row more: what culling hides
    assert [run_job(job, out, REGISTRY) for job in jobs] == records
