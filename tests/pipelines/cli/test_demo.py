"""What the demo shows and says: a picture that grows."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
from mplicits.datasets import PointCloud, sample_sphere, write_cloud_ply
from mplicits.pipelines.cli import demo as module
from mplicits.pipelines.cli.entry import main

SMALL = "--widths 16 16 --depths 1 1 --omegas 5 8 --steps 200 50 --learning-rates 5e-3 1e-3 --batch 256 --samples 2000"


def test_the_picture_grows_level_by_level(tmp_path, monkeypatch, capsys):
    """It is in its place, and its path said, when a level is finished and the next one has not begun."""
    cloud = sample_sphere(500, radius=3.0)
    colored = PointCloud(cloud.points, cloud.normals, np.abs(cloud.points).astype("f4") / 3)
    write_cloud_ply(tmp_path / "ball.ply", colored)
    monkeypatch.setattr(module, "TILE", (24, 32))
    there, written, out = [], module.write_picture, tmp_path / "new" / "demo"

    def write(path: Path, image: np.ndarray) -> None:
        written(path, image)
        there.append((iio.imread(path).shape[1], (out / "run" / "resume.safetensors").exists()))

    monkeypatch.setattr(module, "write_picture", write)
    assert main(f"demo {tmp_path}/ball.ply -o {out} --resolution 24 {SMALL}".split()) == 0
    widths, unfinished = zip(*there, strict=True)
    assert widths == tuple(sorted(set(widths)))  # cloud and level 0; level 1 beside them; the mesh
    assert unfinished == (True, True, False)
    said = capsys.readouterr().out
    picture = out / "picture.png"
    assert f"{picture}: drawn up to level 0\n{picture}: drawn up to level 1\n" in said
