"""Merging: exact means, sides kept apart; the same in pieces as whole, and from a file as from memory."""

from pathlib import Path

import mplicits.datasets.clouds.large as large_cloud
import numpy as np
import pytest
from mplicits.datasets import PointCloud, read_cloud, write_cloud_ply
from mplicits.datasets.clouds.large import Merging, merge_cloud
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.datasets.clouds.readers.columns import MemoryStream
from mplicits.datasets.clouds.readers.reading import open_stream
from mplicits.neural_fields import InputError
from mplicits.pipelines.fit.cloud import load_cloud
from mplicits.pipelines.training.folder import MERGED_FILE
from refusals import refused


def merged(cloud: PointCloud, limit: int = 100_000, **settings: float | None) -> tuple[PointCloud, Merging]:
    return merge_cloud(MemoryStream(cloud), limit, **settings)


def sheet(count: int, height: float, normal: tuple[float, float, float], seed: int = 0) -> PointCloud:
    """Points of the square [0, 1]² at one height; multiples of 2⁻²⁰, so that sums of them are exact."""
    flat = np.random.default_rng(seed).integers(0, 1 << 20, (count, 2)) / 2**20
    return PointCloud(np.column_stack((flat, np.full(count, height))), np.tile(np.float32(normal), (count, 1)))


def joined(*clouds: PointCloud) -> PointCloud:
    points, normals = ([getattr(cloud, name) for cloud in clouds] for name in ("points", "normals"))
    return PointCloud(np.concatenate(points), np.concatenate(normals))


def ordered(cloud: PointCloud) -> np.ndarray:
    rows = np.concatenate((cloud.points, cloud.normals), axis=1)
    return rows[np.lexsort(rows.round(9).T)]


def test_points_of_a_voxel_become_their_mean_exactly() -> None:
    """Four cells of edge 1/2, whose means are sums of binary fractions over whole numbers."""
    cloud = sheet(4000, 0.25, (0, 0, 1))
    corner = np.array([[0.0, 0.0, 0.25], [1 - 2**-20, 1 - 2**-20, 0.25]])
    cloud = joined(cloud, PointCloud(corner, np.float32([[0, 0, 1]] * 2)))
    found, report = merged(cloud, voxel=0.5)
    cells = np.floor(cloud.points[:, :2] / 0.5) @ [2, 1]
    expected = np.stack([cloud.points[cells == cell].mean(axis=0) for cell in range(4)])
    assert np.abs(np.sort(found.points, axis=0) - np.sort(expected, axis=0)).max() < 1e-15
    assert (found.points[:, 2] == 0.25).all()
    assert (report.read, report.kept, report.dropped_nan, report.dropped_isolated, report.voxel) == (4002, 4, 0, 0, 0.5)


def test_a_tilted_plane_keeps_its_points() -> None:
    flat = sheet(50_000, 0.0, (0, 0, 1)).points
    normal = np.array([0.48, 0.6, 0.64])  # its dominant axis hardly dominates
    points = flat - np.outer(flat @ normal, normal)
    found, _ = merged(PointCloud(points, np.tile(normal.astype(np.float32), (len(points), 1))), limit=2000)
    assert 300 < len(found) <= 2000
    assert np.abs(found.points @ normal).max() < 1e-14


def test_noise_averages_out() -> None:
    """Offsets of ±1 voxel: 100 points in each mean leave a tenth of the noise, or a little more at the rim."""
    cloud = sheet(100_000, 0.0, (0, 0, 1))
    noise = np.random.default_rng(1).normal(0, 0.02, len(cloud))
    points = cloud.points + noise[:, None] * [0, 0, 1]
    found, report = merged(PointCloud(points, cloud.normals), limit=2000)
    assert 0.02 < report.voxel < 0.1
    each = len(cloud) / len(found)
    assert each > 50
    assert np.sqrt((found.points[:, 2] ** 2).mean()) < 1.2 * 0.02 / np.sqrt(each)


def test_two_sides_of_a_thin_sheet_stay_apart() -> None:
    cloud = joined(sheet(20_000, 0.5, (0, 0, 1)), sheet(20_000, 0.49, (0, 0, -1), seed=1))
    found, report = merged(cloud, limit=2000)
    assert report.voxel > 0.02
    assert set(found.points[:, 2].round(12)) == {0.5, 0.49}
    assert (found.normals[:, 2] == np.where(found.points[:, 2] > 0.495, 1, -1)).all()


def test_not_finite_repeated_and_isolated_points() -> None:
    cloud = sheet(20_000, 0.5, (0, 0, 1))
    places = np.array([[0.5, 0.5, 0.9], [np.nan, 0, 0], [0, np.inf, 0]])
    stray = PointCloud(places, np.array([[1, 0, 0]] * 3, np.float32))
    found, report = merged(joined(cloud, stray, cloud), limit=500)
    assert (report.dropped_nan, report.dropped_isolated) == (2, 1)
    once, _ = merged(cloud, voxel=report.voxel)
    assert np.allclose(ordered(found), ordered(once), atol=1e-12)
    kept, report = merged(joined(cloud, stray), limit=500, isolation=None)
    assert report.dropped_isolated == 0
    assert (kept.points[:, 2] > 0.8).sum() == 1


def test_in_pieces_as_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where voxels turn out too small under way: doubling them later is doubling them before."""
    random = np.random.default_rng(0)
    normals = unit_rows(random.normal(size=(30_000, 3)))
    cloud = PointCloud(normals * 0.5 + 1e6, normals.astype(np.float32), random.random((30_000, 3)).astype(np.float32))
    whole, report = merged(cloud, limit=3000, voxel=0.004)
    monkeypatch.setattr(large_cloud, "MERGE", large_cloud.MergeOptions(rows=1000))
    pieces, again = merged(cloud, limit=3000, voxel=0.004)
    assert again.voxel == report.voxel > 0.004
    assert np.allclose(ordered(pieces), ordered(whole), atol=1e-9)
    assert abs(float(whole.colors.mean()) - 0.5) < 0.02


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.npy", "cloud.las"])
def test_a_mapped_file_is_the_file_read(tmp_path: Path, name: str) -> None:
    cloud = sheet(5000, 0.5, (0, 0, 1))
    path = tmp_path / name
    colors = np.random.default_rng(0).integers(0, 256, (5000, 3))
    if name.endswith(".ply"):
        write_cloud_ply(path, PointCloud(cloud.points, cloud.normals, (colors / 255).astype(np.float32)))
    elif name.endswith(".npy"):
        np.save(path, np.concatenate((cloud.points, cloud.normals, colors), axis=1))
    else:
        laspy = pytest.importorskip("laspy")
        header = laspy.LasHeader(point_format=3)
        header.scales = np.full(3, 2.0**-20)
        las = laspy.LasData(header)
        las.x, las.y, las.z = cloud.points.T
        las.red, las.green, las.blue = colors.T * 256
        las.write(path)
    stream, read = open_stream(path), read_cloud(path)
    assert stream.count == 5000
    pieces = list(stream.pieces(700))
    assert [len(piece.points) for piece in pieces] == [700] * 7 + [100]
    assert (np.concatenate([piece.points for piece in pieces]) == read.points).all()
    if read.normals is not None:
        assert (np.concatenate([piece.normals for piece in pieces]) == read.normals).all()
    (mapped, _), (whole, _) = merge_cloud(stream, 100), merge_cloud(MemoryStream(read), 100)
    assert (mapped.points == whole.points).all()
    assert np.abs(mapped.colors - whole.colors).max() < 1e-6


def test_files_that_are_read_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    assert open_stream(path) is None
    write_cloud_ply(path, sheet(100, 0.0, (0, 0, 1)))
    path.write_bytes(path.read_bytes()[:-7])
    with refused(path, "100 rows"):
        open_stream(path)
    with pytest.raises(InputError, match="all 50"):
        load_cloud(PointCloud(np.ones((50, 3))), limit=20)


def test_a_cloud_is_merged_once(tmp_path: Path) -> None:
    path, run = tmp_path / "cloud.ply", tmp_path / "run"
    write_cloud_ply(path, sheet(5000, 0.5, (0, 0, 1)))
    as_it_is, nothing = load_cloud(path, limit=5000, cache=run)
    assert (len(as_it_is), nothing, run.exists()) == (5000, None, False)
    first, report = load_cloud(path, limit=500, cache=run)
    assert len(first) == report.kept <= 500
    kept = (run / MERGED_FILE).read_bytes()
    second, again = load_cloud(path, limit=500, cache=run)
    assert again == report  # its seconds, too: nothing was done
    assert (second.points == first.points).all()
    assert len(load_cloud(path, limit=100, cache=run)[0]) <= 100
    (run / MERGED_FILE).write_bytes(kept[:1000])
    assert len(load_cloud(path, limit=500, cache=run)[0]) == report.kept
