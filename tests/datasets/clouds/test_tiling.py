"""Tiles of a cloud: boxes that cover space once, and files that hold what each needs."""

from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets import PointCloud, read_cloud
from mplicits.datasets.clouds import tiling
from mplicits.datasets.clouds.readers.columns import MemoryStream
from mplicits.datasets.clouds.tiling import TILING, TilePlan, plan_tiles, tile_name, write_tiles
from refusals import refused


def field_and_tower(count: int = 40_000, *, normals: bool = True) -> PointCloud:
    """A field of 100 × 60 in map coordinates, and a tower that has as many points."""
    random = np.random.default_rng(0)
    parts = [random.random((count // 2, 3)) * size for size in ([100, 60, 0.1], [10, 10, 20])]
    points = np.concatenate(parts) + np.array([4.5e5, 5.4e6, 0])
    up = np.tile(np.float32([0, 0, 1]), (count, 1)) if normals else None
    return PointCloud(points, up, source="field")


def boxes(plan: TilePlan, margin: float = 0.0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Lowest and highest corner of each tile's box, wider by ``margin``."""
    found = [(np.full(3, -np.inf), np.full(3, np.inf)) for _ in range(plan.num_tiles)]

    def walk(node: int, low: np.ndarray, high: np.ndarray) -> None:
        if node < 0:
            found[-1 - node] = (low - margin, high + margin)
            return
        cut = plan.cuts[node]
        axis = np.arange(3) == cut.axis
        walk(cut.below, low, np.where(axis, cut.place, high))
        walk(cut.above, np.where(axis, cut.place, low), high)

    walk(0 if plan.cuts else -1, *found[0])
    return found


@pytest.mark.parametrize(("size", "points"), [(None, 5000), (25.0, None)])
def test_every_point_is_in_one_box_and_boxes_are_not_narrow(size: float | None, points: int | None) -> None:
    cloud = field_and_tower()
    plan, _ = plan_tiles(MemoryStream(cloud), size=size, points=points)
    assert plan.num_tiles >= 8
    owner = np.full(len(cloud), -1)
    for number, rows in plan.rows(cloud.points, margin=0.0):
        assert (owner[rows] == -1).all()
        owner[rows] = number
    assert set(owner) == set(range(plan.num_tiles))
    counts = []
    for number, (low, high) in enumerate(boxes(plan)):
        inside = ((cloud.points >= low) & (cloud.points < high)).all(axis=1)
        assert (inside == (owner == number)).all()
        assert (high - low).min() > 4 * plan.blend  # so at most two tiles meet along an axis
        assert inside.sum() >= TILING.fewest
        if size is not None:  # a cut along another axis may be left, whose smaller side would have too few points
            assert np.ptp(cloud.points[inside], axis=0).max() <= 1.5 * size
        counts.append(inside.sum())
    assert points is None or np.median(counts) <= points


def test_files_hold_what_is_near_and_nothing_else(tmp_path: Path) -> None:
    cloud = field_and_tower()
    stream = MemoryStream(cloud)
    plan, frame = plan_tiles(stream, points=5000)
    told: list[tuple[int, int]] = []
    counts = write_tiles(stream, plan, frame, tmp_path / "points", report=lambda *step: told.append(step))
    assert told[-1] == (40_000, 40_000)
    for number, (low, high) in enumerate(boxes(plan, 2 * plan.blend)):
        rows = np.load(tmp_path / "points" / tile_name(number))
        near = ((cloud.points >= low) & (cloud.points < high)).all(axis=1)
        assert len(rows) == counts[number]
        assert abs(len(rows) - near.sum()) <= 1  # a point at a border may round to either side
        assert np.abs(rows[:, 3:] - [0, 0, 1]).max() == 0
        read = read_cloud(tmp_path / "points" / tile_name(number), columns="x,y,z,nx,ny,nz")
        assert np.abs(read.points - rows[:, :3]).max() == 0
    assert sum(counts) > 40_000


def test_without_normals(tmp_path: Path) -> None:
    stream = MemoryStream(field_and_tower(normals=False))
    plan, frame = plan_tiles(stream, size=200.0)
    assert (plan.cuts, plan.num_tiles, plan.normals) == ((), 1, False)
    assert write_tiles(stream, plan, frame, tmp_path / "points") == [40_000]
    assert np.load(tmp_path / "points" / tile_name(0)).shape == (40_000, 3)


def test_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    same = PointCloud(np.ones((50, 3)), None, source="one place")
    with refused("one place", "coincide"):
        plan_tiles(MemoryStream(same))
    stream = MemoryStream(field_and_tower())
    plan, frame = plan_tiles(stream)
    monkeypatch.setattr(tiling.shutil, "disk_usage", lambda _: type("", (), {"free": 1000}))
    with refused(tmp_path / "points", "GiB, and 0.0 are free"):
        write_tiles(stream, plan, frame, tmp_path / "points")
    assert not (tmp_path / "points").exists()
