from pathlib import Path

import numpy as np
from mplicits.datasets.landmarks import read_landmarks, write_landmarks


def test_written_pairs_are_read(tmp_path: Path) -> None:
    before, after = np.random.default_rng(0).normal(scale=1e3, size=(2, 5, 3))
    write_landmarks(tmp_path / "pairs.txt", before, after)
    for found, expected in zip(read_landmarks(tmp_path / "pairs.txt"), (before, after), strict=True):
        np.testing.assert_allclose(found, expected, rtol=5e-9)  # nine digits
