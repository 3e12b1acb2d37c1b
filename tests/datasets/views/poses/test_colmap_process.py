import sqlite3
from contextlib import closing
from itertools import combinations
from pathlib import Path

import pytest
from mplicits.datasets.views.poses import colmap_process


def test_progress_is_read_without_a_lock(tmp_path: Path) -> None:
    """While one process writes exclusively, others may not open the database: COLMAP would find it locked."""
    database = tmp_path / "a b?.db"
    assert colmap_process._rows(database, "keypoints") == 0
    with closing(sqlite3.connect(database, isolation_level=None)) as theirs:
        theirs.execute("CREATE TABLE keypoints (image INTEGER)")
        theirs.executemany("INSERT INTO keypoints VALUES (?)", [(1,), (2,)])
        theirs.execute("BEGIN EXCLUSIVE")
        assert colmap_process._rows(database, "keypoints") == 2
        theirs.execute("ROLLBACK")
        assert colmap_process._rows(database, "matches") == 0
    assert [file.name for file in tmp_path.iterdir()] == ["a b?.db"]


@pytest.mark.parametrize("count", [3, 11, 40])
def test_how_many_frames_of_a_film_are_matched(count: int) -> None:
    near = {*range(1, 11), *(2**power for power in range(10))}
    assert colmap_process.film_pairs(count) == sum(b - a in near for a, b in combinations(range(count), 2))
