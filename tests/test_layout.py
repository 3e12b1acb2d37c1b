"""The house: which room may import which, how light the lowest is, and that the wheel holds them all.

Files import from rooms below their own, or from their own, and no two files import each other.
"""

import ast
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# From the ground up. A room imports from those above it in this list, never from those below.
ROOMS = (
    "neural_fields",
    "datasets",
    "pipelines/run",
    "pipelines/surface",
    "pipelines/fit",
    "pipelines/texture",
    "pipelines/mesh",
    "pipelines/render",
    "pipelines/viewer",
    "pipelines/evolve",
    "pipelines/reconstruct",
    "pipelines/bench",
    "pipelines/paper",
    "pipelines/cli",
)
OUTSIDE = {"torch", "numpy", "skimage", "safetensors"}  # what neural_fields may import
LATE = {"torchdiffeq"}  # and what only inside a function that needs it
LIGHT = "import {}, sys; assert not {{'torch', 'numpy', 'scipy'}} & set(sys.modules), sorted(sys.modules)"


def sources() -> list[Path]:
    return sorted(
        path for package in ("neural_fields", "datasets", "pipelines") for path in (ROOT / package).rglob("*.py")
    )


def imports(path: Path, *, nested: bool = True) -> list[tuple[int, str, list[str]]]:
    """(relative level, module, names) of every import statement, or of those that run on import."""
    found = []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree) if nested else tree.body:
        if isinstance(node, ast.ImportFrom):
            found.append((node.level, node.module or "", [alias.name for alias in node.names]))
        elif isinstance(node, ast.Import):
            found += [(0, alias.name, []) for alias in node.names]
    return found


def imported(path: Path) -> list[Path]:
    """The files of this project that a file imports from."""
    found = []
    for level, module, names in imports(path):
        if level == 0:
            assert module.split(".")[0] != "mplicits", f"{path}: import {module} relatively"
            continue
        folder = path.parents[level - 1]
        assert folder != ROOT.parent, f"{path}: import leads out of mplicits"
        target = folder.joinpath(*module.split(".")) if module else folder
        for name in names:  # a name is a file of a folder, or stands in the file or in the folder's face
            choices = (
                target / f"{name}.py",
                target / name / "__init__.py",
                target.with_suffix(".py"),
                target / "__init__.py",
            )
            found.append(next(choice for choice in choices if choice.is_file()))
    return found


def room(path: Path) -> str:
    inside = path.relative_to(ROOT).parent.as_posix()
    return next((name for name in ROOMS if inside == name or inside.startswith(f"{name}/")), inside)


def test_every_file_has_a_room() -> None:
    lost = {room(path) for path in sources()} - set(ROOMS) - {"pipelines"}
    assert not lost, f"no room in the order: {sorted(lost)}"


@pytest.mark.parametrize("name", ROOMS)
def test_rooms_import_from_rooms_before_them(name: str) -> None:
    files = [path for path in sources() if room(path) == name]
    assert files
    allowed = set(ROOMS[: ROOMS.index(name) + 1])
    for path in files:
        for other in imported(path):
            assert room(other) in allowed, f"{path.relative_to(ROOT)} imports {other.relative_to(ROOT)}"


def test_no_two_files_import_each_other() -> None:
    """Not even by way of others, nor late; a folder's face, which imports its files, may be asked by others only."""
    graph = {path: {other for other in imported(path) if other != path} for path in sources()}
    for path, others in graph.items():
        assert path.parent / "__init__.py" not in others, f"{path.relative_to(ROOT)} imports the face of its own folder"
    list(TopologicalSorter(graph).static_order())


def test_neural_fields_is_light() -> None:
    for path in (ROOT / "neural_fields").rglob("*.py"):
        for level, module, _ in imports(path):
            top = module.split(".")[0]
            if level == 0:
                assert top in OUTSIDE | LATE or top in sys.stdlib_module_names, f"{path} imports {top}"
        assert not LATE & {module for _, module, _ in imports(path, nested=False)}, (
            f"{path} imports one of {LATE} too early"
        )


@pytest.mark.parametrize("module", ["mplicits.pipelines.cli", "mplicits.pipelines.run.settings"])
def test_help_and_settings_do_not_load_torch(module: str) -> None:
    subprocess.run([sys.executable, "-c", LIGHT.format(module)], check=True, cwd="/")


def test_no_top_level_name_is_taken() -> None:
    """A user's own `datasets` folder, or Hugging Face's package, must never be shadowed."""
    code = "import mplicits.datasets, sys; assert not {'datasets', 'pipelines', 'neural_fields'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/")


def test_every_folder_with_python_in_it_is_packaged() -> None:
    """An editable install hides a folder that was forgotten; a wheel lacks it."""
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {path.parent.relative_to(ROOT).as_posix() for path in sources()} | {"configs"}
    assert {package: setuptools["package-dir"][package] for package in setuptools["packages"]} == {
        "mplicits." + folder.replace("/", "."): folder for folder in folders
    }
    for path in sources():
        assert (path.parent / "__init__.py").is_file(), f"{path.parent} has no __init__.py"


@pytest.mark.slow
def test_the_wheel_alone_holds_every_module(tmp_path: Path) -> None:
    """Built, installed into an environment of its own (what it depends on is borrowed), every module imported."""

    def run(*words: object) -> str:
        done = subprocess.run([str(word) for word in words], capture_output=True, text=True, cwd=tmp_path, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, ROOT)
    (wheel,) = tmp_path.glob("mplicits-*.whl")
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv")
    (python,) = [*tmp_path.glob("venv/bin/python"), *tmp_path.glob("venv/Scripts/python.exe")]
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel)
    (site,) = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").split()
    (here,) = run(sys.executable, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").split()
    Path(site, "borrowed.pth").write_text(here)  # its packages, but not its own .pth files, so no editable install
    wanted = sorted("mplicits." + ".".join(path.relative_to(ROOT).with_suffix("").parts) for path in sources())
    code = (
        "import importlib, pathlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    file = pathlib.Path(importlib.import_module(name.removesuffix('.__init__')).__file__)\n"
        "    assert 'venv' in file.parts, file\n"
        "print('all of them')"
    )
    assert run(python, "-c", code, *wanted) == "all of them\n"
