"""Signs from points alone, on shapes whose in- and outside is known."""

from dataclasses import replace
from pathlib import Path

import fits
import numpy as np
import pytest
import torch
from mplicits.datasets import OrientedCloud, PointCloud, prepare_cloud, sample_sphere, sample_torus
from mplicits.neural_fields import load_field
from mplicits.pipelines.fit import FitConfig, Interrupted, fit, prepare
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.unoriented import SIGNING, STAGES, Places, Signs, fits_better, give_signs
from torch import Tensor

SMALL = replace(fits.SMALL, omegas=(20.0, 20.0), steps=(100, 30), normals="none")
CPU = torch.device("cpu")
# Of a smooth surface no point needs to be wrong; what noise there is in the evidence may spoil one in a hundred.
FEW = 0.01


@pytest.fixture(autouse=True)
def _less_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shapes as simple as these are clear after a quarter of the work."""
    for name, less in (("steps", 150), ("batch", 2048), ("samples", 20_000)):
        monkeypatch.setitem(vars(SIGNING), name, less)


def ball(count: int, radius: float, *, inward: bool = False) -> tuple[Tensor, Tensor]:
    cloud = sample_sphere(count, radius=radius)
    normals = torch.from_numpy(cloud.normals)
    return torch.from_numpy(cloud.points).float(), -normals if inward else normals


def joined(*parts: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    return torch.cat([points for points, _ in parts]), torch.cat([normals for _, normals in parts])


def prepared(part: tuple[Tensor, Tensor]) -> OrientedCloud:
    points, normals = part
    return prepare_cloud(PointCloud(points.double().numpy(), normals.numpy()), normals="file")


def turned(cloud: OrientedCloud, which: np.ndarray) -> OrientedCloud:
    """With some of the normals turned round."""
    return replace(cloud, normals=np.where(which[:, None], -cloud.normals, cloud.normals))


def scrambled(normals: Tensor) -> tuple[Tensor, np.ndarray]:
    """Normals with random signs, and which of them are wrong."""
    wrong = np.random.default_rng(0).uniform(size=len(normals)) < 0.5
    return torch.where(torch.from_numpy(wrong)[:, None], -normals, normals), wrong


def test_a_ball_gets_its_normals_back() -> None:
    points, normals = ball(5000, 0.6)
    assert not Places.around(CloudDistance(points, normals), seed=0).contested
    given, wrong = scrambled(normals)
    found = give_signs(points, given, SMALL, device=CPU)
    assert found.clear
    assert (found.turned == wrong).all()
    assert found.record()["turned_normals"] == wrong.sum()


def test_the_hollow_of_a_thick_wall_is_outside_though_normals_filled_it() -> None:
    """The usual fault of winding numbers: the inner wall points outward, so that the hollow is twice inside."""
    points, normals = joined(ball(5000, 0.8), ball(3000, 0.6, inward=True))
    given = normals.clone()
    given[5000:] *= -1
    found = give_signs(points, given, SMALL, device=CPU)
    assert found.turned[:5000].mean() < FEW
    assert found.turned[5000:].mean() > 1 - FEW


def test_signs_are_taken_where_winding_numbers_fit_better_with_them() -> None:
    cloud = prepared(joined(ball(2500, 0.8), ball(1500, 0.6, inward=True)))
    inner = np.arange(len(cloud)) >= 2500
    filled = turned(cloud, inner)
    assert fits_better(filled, Signs(inner, 1.0, "exterior"))
    assert not fits_better(cloud, Signs(inner, 1.0, "exterior"))
    some = np.random.default_rng(0).uniform(size=len(cloud)) < 0.07
    assert not fits_better(cloud, Signs(some, 1.0, "winding"))
    spotted = turned(cloud, some)
    assert fits_better(spotted, Signs(some, 1.0, "winding"))
    assert not fits_better(spotted, Signs(some != inner, 1.0, "winding"))  # a filled hollow costs more than spots
    assert not fits_better(cloud, Signs(np.zeros(len(cloud), bool), 1.0, "winding"))


def test_a_small_patch_of_a_large_cloud_is_turned() -> None:
    cloud = prepared(ball(20_000, 0.8))
    patch = cloud.points[:, 2] > 0.995 * cloud.points[:, 2].max()
    assert 0 < patch.mean() < 0.005
    assert fits_better(turned(cloud, patch), Signs(patch, 1.0, "winding"))
    assert not fits_better(cloud, Signs(patch, 1.0, "winding"))


def test_of_an_open_sheet_all_stays() -> None:
    """There is no outside that is not also on its other side."""
    random = np.random.default_rng(0)
    points = torch.from_numpy(np.column_stack((random.uniform(-0.7, 0.7, (4000, 2)), np.zeros(4000)))).float()
    given, _ = scrambled(torch.tensor([0.0, 0.0, 1.0]).expand(4000, 3))
    found = give_signs(points, given, SMALL, device=CPU)
    assert not found.clear
    assert not found.turned.any()


def test_a_fit_without_normals(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No sign is known, and the field is the torus all the same; interrupted anywhere, it comes out the same."""

    def spoilt(cloud: PointCloud, config: FitConfig) -> OrientedCloud:
        good = prepare(cloud, config)
        return turned(good, np.arange(len(good)) % 2 == 0)

    monkeypatch.setattr("mplicits.pipelines.fit.train.prepare", spoilt)
    cloud = PointCloud(sample_torus(2000, major=0.6, minor=0.25).points)
    config = replace(SMALL, batch=512, samples=4000)
    whole = fit(cloud, config)
    assert whole.record["signs"]["turned_normals"] == pytest.approx(1000, abs=FEW * 2000)
    assert whole.record["cleaning"]["oriented_by"] == "level"
    distance = whole.world.distance(np.array([[0.6, 0, 0], [0, 0, 0], [0, -0.6, 0], [1, 1, 1.0]]))
    assert (np.sign(distance) == [-1, 1, -1, 1]).all()

    for stage in (STAGES[1], "level 1"):
        with pytest.raises(Interrupted, match="checkpoint"):
            fit(cloud, config, out=tmp_path / stage, progress=fits.interrupt(stage, 20))
        resumed = fit(cloud, out=tmp_path / stage, resume=True)
        assert resumed.record["signs"] == whole.record["signs"]
        fits.assert_same(load_field(tmp_path / stage / "field.safetensors").field, whole.field)
