"""What the demo shows and says: a picture that grows, and errors that are those of closed forms."""

import re
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from mplicits.datasets import STATUE_PLACEMENT, PointCloud, Statue, sample_sphere, sample_surface, write_cloud_ply
from mplicits.pipelines.cli import demo as module
from mplicits.pipelines.cli.entry import main

SMALL = "--widths 16 16 --depths 1 1 --omegas 5 8 --steps 200 50 --learning-rates 5e-3 1e-3 --batch 256 --samples 2000"


def figures(text: str) -> dict[str, list[float]]:
    """The rows of the table: rms, median and 95 %."""
    rows = re.findall(r"^(\S.*?)  +([\d.]+) +([\d.]+) +([\d.]+)$", text, re.MULTILINE)
    return {name: list(map(float, numbers)) for name, *numbers in rows}


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
    assert "off the statue" not in said  # which was not scanned


@pytest.mark.slow
def test_errors_are_those_of_closed_forms():
    """Of the statue itself they are 0, and of points beside it their distance."""
    statue = Statue()
    exact = sample_surface(statue, 5000)
    off = 5e-4
    points = STATUE_PLACEMENT.to_input(exact.points + off * exact.normals.astype(np.float64))
    scan = replace(exact, points=points, normals=None)
    table = figures(module._true_errors(scan, statue, STATUE_PLACEMENT))
    noise, at = table.values()
    # The step back along the normal at the point, and not at its foot, is off by the turn of the normal on the way.
    np.testing.assert_allclose(noise, off * STATUE_PLACEMENT.scale, rtol=0.02)
    # Values in float32 are off by their rounding, 1e-6 of the unit, and figures are printed to a thousandth.
    assert max(at) <= 1e-6 * STATUE_PLACEMENT.scale + 1e-3
    names = list(table)
    assert names[0] == "the scan's points themselves"
    assert names[1] == "level 0, at the scan's points"


@pytest.mark.slow
def test_every_level_is_nearer_to_the_statue(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 0
    table = figures(capsys.readouterr().out)
    levels = np.array([row for name, row in table.items() if re.fullmatch(r"level \d, at the scan's points", name)])
    assert levels.shape == (3, 3)
    assert (np.diff(levels, axis=0) < 0).all(), table
