"""The tutorials run from an empty folder, and leave what they promise; the notebook is its script, cell by cell."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import mplicits
import pytest
import trimesh
from notebook import cells_of, notebook_of

FOLDER = Path(__file__).parent.parent / "docs" / "tutorials"
NOTEBOOK = FOLDER / "what_a_field_answers.ipynb"
# As the table of the index says.
LEAVES = {
    "scan_to_mesh": ("scan.ply", "run", "mesh.ply", "picture.png"),
    "photographs": ("statue", "mesh.glb", "picture.png"),
    "own_training_loop": ("field.safetensors", "mesh.ply"),
    "shape_interpolation": ("morph", "halfway.ply", "morph.gif"),
    "what_a_field_answers": ("joined.stl", "joined.png", "joined.safetensors"),
}


def run(words: list[str], folder: Path) -> str:
    """Run Python in a folder, with one thread, away from this tree."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    environment.pop("PYTHONPATH", None)
    words = [sys.executable, "-W", "error::DeprecationWarning:__main__", *words]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def check_kept(folder: Path) -> None:
    """Whatever was kept can be read, and shows something."""
    for path in folder.iterdir():
        if path.suffix in (".ply", ".stl", ".glb") and path.name != "scan.ply":
            assert trimesh.load_mesh(path).area > 0
        elif path.suffix == ".png":
            picture = cv2.imread(str(path))
            assert picture.min() < 200 < 255 == picture.max()  # a shape before white
        elif path.suffix == ".safetensors":
            assert mplicits.load(path).mesh(24).vertices.size


# The cells of the notebook are those of the last one.
LONG = ("photographs", "shape_interpolation")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in LEAVES if name != NOTEBOOK.stem],
)
def test_a_tutorial_runs_in_an_empty_folder(name: str, tmp_path: Path) -> None:
    out = run([str(FOLDER / f"{name}.py"), "--small"], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(LEAVES[name])
    assert LEAVES[name][1].split(".")[0] in out or LEAVES[name][-1] in out  # what was kept is printed
    check_kept(tmp_path)


@pytest.mark.slow
def test_a_scan_of_ones_own(tmp_path: Path) -> None:
    mplicits.datasets.write_cloud_ply(tmp_path / "mine.ply", mplicits.datasets.sample_torus(500))
    run([str(FOLDER / "scan_to_mesh.py"), "mine.ply", "--small"], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mesh.ply", "mine.ply", "picture.png", "run"]


def test_the_notebook_is_its_script() -> None:
    script = NOTEBOOK.with_suffix(".py").read_text(encoding="utf-8")
    assert NOTEBOOK.read_text(encoding="utf-8") == notebook_of(script), (
        "python tests/helpers/notebook.py docs/tutorials/*.py"
    )
    assert sum(kind == "markdown" for kind, _ in cells_of(script)) >= 5


@pytest.mark.slow
def test_the_cells_of_the_notebook_run(tmp_path: Path) -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    assert "SMALL" in code
    (tmp_path / "cells.py").write_text(f"import os\nos.environ['SMALL'] = '1'\n{code}", encoding="utf-8")
    run(["cells.py"], tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"cells.py", *LEAVES["what_a_field_answers"]}


def test_the_index_names_them_all() -> None:
    index = (FOLDER / "index.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\((\w+)\.py\)", index)) == set(LEAVES) == {path.stem for path in FOLDER.glob("*.py")}
    for names in LEAVES.values():
        assert all(f"`{name}" in index for name in names if name != "scan.ply")
