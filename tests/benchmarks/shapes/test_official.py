"""The protocol of the paper's code, on a folder made as its archive."""

import json
from pathlib import Path

import pytest
from benches import SMALL
from mplicits.datasets import read_cloud
from mplicits.neural_fields import Similarity, Torus, extract_mesh
from mplicits.pipelines.fit import fit
from mplicits.pipelines.fit.official import export_official
from mplicits.pipelines.mesh.files import write_mesh
from refusals import refused

from benchmarks.cli import main
from benchmarks.shapes.official import INPUTS, NOISY, VERIFIED, OfficialBench, add_shapes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ring in place of the archive, and a checkpoint of it."""
    made = tmp_path_factory.mktemp("archive")
    write_mesh(made / "ring.ply", extract_mesh(Torus(), resolution=48), Similarity((5.0, 0.0, 1.0), 3.0))
    add_shapes(made, [made / "ring.ply"])
    fit(read_cloud(made / INPUTS / "ring.ply"), SMALL, out=made / "run")
    export_official(made / "run", made / "results" / "ring")
    return made


def test_ours_and_theirs_are_measured_alike(folder: Path, tmp_path: Path) -> None:
    words = [str(folder), "-o", str(tmp_path / "out"), "--official", str(folder / "results")]
    sizes = ["--widths", "32", "32", "--depths", "2", "2", "--omegas", "10", "15", "--steps", "120", "40"]
    small = [*sizes, "--learning-rates", "4e-3", "1e-3", "--batch", "1024", "--samples", "10000", "--device", "cpu"]
    asked = ["--resolution", "48", "--eval-samples", "3000", "--json", str(tmp_path / "figures.json")]
    assert main(["official", *words, *small, *asked]) == 0
    summary, each = json.loads((tmp_path / "figures.json").read_text())["tables"]
    names = [row["values"][0] for row in each["rows"]]
    assert names[:2] == ["ours coarse", "ours medium"]
    assert names[-3:] == ["official coarse", "official medium", "official fine, fixed bands"]
    chamfer = {(row["name"], row["values"][0]): row["values"][1] for row in each["rows"]}
    floor = each["rows"][0]["values"][2]
    # Both are the same networks, and one sampling more or less of the surface.
    assert chamfer["ring", "official coarse"] == pytest.approx(chamfer["ring", "ours coarse"], rel=0.3)
    assert all(number < 20 * floor for number in chamfer.values())
    printed = {row["name"] for row in summary["rows"] if row["published"] is not None}
    assert printed == {f"{name}{' + noise' * noisy}" for noisy, name in VERIFIED}


def test_added_shapes_are_as_in_the_archive(folder: Path) -> None:
    clean, noisy = (read_cloud(folder / part / "ring.ply").points for part in (INPUTS, NOISY))
    assert (clean**2).sum(axis=1).max() == pytest.approx(1, abs=1e-5)
    moved = ((noisy - clean) ** 2).sum(axis=1) ** 0.5
    diagonal = ((clean.max(axis=0) - clean.min(axis=0)) ** 2).sum() ** 0.5
    assert 0.9 < moved.max() / (0.01 * diagonal) <= 1 + 1e-4


def test_mistakes_cost_no_work(folder: Path, tmp_path: Path) -> None:
    with refused(tmp_path, "--add"):
        OfficialBench(folder=tmp_path, config=SMALL).jobs()
    with refused("--shapes", "ring"):
        OfficialBench(folder=folder, config=SMALL, shapes=["lucy"]).jobs()
    with refused("ring.ply", "exists"):
        add_shapes(folder, [folder / "ring.ply"])
