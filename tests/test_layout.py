"""Imports run pipelines → datasets → neural_fields and never back."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BELOW = {"neural_fields": set(), "datasets": {"neural_fields"}, "pipelines": {"neural_fields", "datasets"}}
OUTSIDE = {"torch", "numpy", "skimage", "safetensors"}  # what neural_fields may import
LATE = {"torchdiffeq"}  # and what only inside a function that needs it


def imports(path: Path, *, nested: bool = True) -> list[tuple[int, str]]:
    """(relative level, module) of every import statement, or of those that run on import."""
    found = []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree) if nested else tree.body:
        if isinstance(node, ast.ImportFrom):
            found.append((node.level, node.module or ""))
        elif isinstance(node, ast.Import):
            found += [(0, alias.name) for alias in node.names]
    return found


@pytest.mark.parametrize("package", BELOW)
def test_import_direction(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    for path in files:
        depth = len(path.relative_to(ROOT).parts)  # as many dots lead out of the package
        for level, module in imports(path):
            assert not (level == 0 and module.split(".")[0] == "mplicits"), f"{path}: import {module} relatively"
            assert level <= depth, f"{path}: import leads out of mplicits"
            if level == depth:
                assert module.split(".")[0] in BELOW[package], f"{path}: {package} must not import {module}"


def test_neural_fields_is_light() -> None:
    for path in (ROOT / "neural_fields").rglob("*.py"):
        for level, module in imports(path):
            top = module.split(".")[0]
            if level == 0:
                assert top in OUTSIDE | LATE or top in sys.stdlib_module_names, f"{path} imports {top}"
        assert not LATE & {module for _, module in imports(path, nested=False)}, (
            f"{path} imports one of {LATE} too early"
        )


def test_no_top_level_name_is_taken() -> None:
    """A user's own `datasets` folder, or Hugging Face's package, must never be shadowed."""
    code = "import mplicits.datasets, sys; assert not {'datasets', 'pipelines', 'neural_fields'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/")
