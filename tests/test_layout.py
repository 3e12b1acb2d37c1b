"""Which room may import which, how light the lowest is, and that the wheel holds them all."""

import ast
import importlib
import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import mplicits
import numpy as np
import pytest
import torch
from mplicits import neural_fields
from mplicits.neural_fields import upward
from mplicits.pipelines.training.scaffold import environment

ROOT = Path(__file__).parent.parent
# From the ground up. A room imports from those above it in this list, never from those below.
FIELDS = ("backend", "fields", "networks", "volume", "tracing", "meshing", "spacetime")
PIPELINES = ("training", "surface", "fit", "texture", "mesh", "render", "web", "evolve", "reconstruct", "cli", "front")
ROOMS = (
    *(f"neural_fields/{name}" for name in FIELDS),
    *("neural_fields", "neural_fields/hosts", "datasets"),
    *(f"pipelines/{name}" for name in (*PIPELINES, "nerfstudio")),
)
FRONT = "pipelines/front"
FACE = ROOT / "neural_fields" / "__init__.py"  # which offers the names of all folders beside it
PLUGIN = "pipelines/nerfstudio"  # whose imports need nerfstudio
OUTSIDE = {"torch", "numpy", "safetensors"}  # what neural_fields may import
LATE = {"torchdiffeq", "trimesh"}  # and what only inside a function that needs it
# Where Triton may be imported; the files that do are imported late themselves.
KERNELS = ("neural_fields/backend/kernels", "neural_fields/tracing/picture.py")

# The same for benchmarks, which may import from any room above, by its installed name.
MEASURING = ("harness", "hosts", "peers", "shapes", "costs", "scenes", "motion", "paper", "cli")
BENCHMARKS = tuple(f"benchmarks/{name}" for name in MEASURING)


def sources() -> list[Path]:
    packages = ("neural_fields", "datasets", "pipelines")
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


def benchmarks() -> list[Path]:
    return sorted((ROOT / "benchmarks").rglob("*.py"))


def package_of(folder: str) -> str:
    """What a folder is imported as: the front door is ``mplicits`` itself."""
    return "mplicits" if folder == FRONT else "mplicits." + folder.replace("/", ".")


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
    found = []
    for level, module, names in imports(path):
        if level == 0:
            # The front door has another name when it is installed, so that relative imports would lead elsewhere.
            apart = path.parent == ROOT / FRONT or path.is_relative_to(ROOT / "benchmarks")
            assert apart or module.split(".")[0] != "mplicits", f"{path}: import {module} relatively"
            continue
        folder = path.parents[level - 1]
        assert folder != ROOT.parent, f"{path}: import leads out of mplicits"
        target = folder.joinpath(*module.split(".")) if module else folder
        for name in names:  # a name is a file of a folder, or stands in the file or in the folder's face
            choices = [target / f"{name}.py", target / name / "__init__.py", target.with_suffix(".py")]
            found.append(next(choice for choice in [*choices, target / "__init__.py"] if choice.is_file()))
    return found


def room(path: Path) -> str:
    inside = path.relative_to(ROOT).parent.as_posix()
    rooms = [name for name in (*ROOMS, *BENCHMARKS) if inside == name or inside.startswith(f"{name}/")]
    return max(rooms, key=len, default=inside)


def test_every_file_has_a_room() -> None:
    lost = {room(path) for path in [*sources(), *benchmarks()]} - {*ROOMS, *BENCHMARKS, "pipelines", "benchmarks"}
    assert not lost, f"no room in the order: {sorted(lost)}"


@pytest.mark.parametrize("name", [*ROOMS, *BENCHMARKS])
def test_rooms_import_from_rooms_before_them(name: str) -> None:
    """Benchmarks import the library as ``mplicits``, and nothing imports benchmarks."""
    order = ROOMS if name in ROOMS else ("benchmarks", *BENCHMARKS)
    allowed = order[: order.index(name) + 1]
    files = [path for path in [*sources(), *benchmarks()] if room(path) == name]
    assert files
    for path in files:
        assert not any(module.split(".")[0] == "benchmarks" for level, module, _ in imports(path) if level == 0)
        for other in imported(path):
            if path != FACE:
                assert room(other) in allowed, f"{path.relative_to(ROOT)} imports {other.relative_to(ROOT)}"


def test_no_two_files_import_each_other() -> None:
    """Not even by way of others, nor late; files do not import the face of their own folder."""
    files = [*sources(), *benchmarks()]
    graph = {path: {other for other in imported(path) if other != path} for path in files}
    for path, others in graph.items():
        assert path.parent / "__init__.py" not in others, f"{path.relative_to(ROOT)} imports the face of its own folder"
    list(TopologicalSorter(graph).static_order())


def test_one_file_goes_up_by_name() -> None:
    named = {path.relative_to(ROOT).as_posix() for path in sources() if "import_module(" in path.read_text("utf-8")}
    # The face of neural_fields names files beside it, for names of earlier releases.
    assert named == {"neural_fields/upward.py", "neural_fields/__init__.py", f"{FRONT}/__init__.py"}
    for module, name in upward.OFFERED.values():
        assert callable(getattr(importlib.import_module(f"mplicits.{module}"), name))


def test_neural_fields_is_light() -> None:
    for path in (ROOT / "neural_fields").rglob("*.py"):
        for level, module, _ in imports(path):
            top = module.split(".")[0]
            if level == 0:
                triton = {"triton"} if path.relative_to(ROOT).as_posix().startswith(KERNELS) else set()
                assert top in OUTSIDE | LATE | triton | sys.stdlib_module_names, f"{path} imports {top}"
        early = LATE & {module for _, module, _ in imports(path, nested=False)}
        assert not early, f"{path} imports {early} too early"


LIGHT = "import {}, sys; assert not {{'torch', 'numpy', 'scipy'}} & set(sys.modules), sorted(sys.modules)"
FRESH = {
    "light": LIGHT.format("mplicits"),
    "light-help": LIGHT.format("mplicits.pipelines.cli"),
    "light-settings": LIGHT.format("mplicits.pipelines.training.settings"),
    # A user's own `datasets` folder, or Hugging Face's package, must never be shadowed.
    "no-top-level-name": "import mplicits.datasets, sys\n"
    "assert not {'datasets', 'pipelines', 'neural_fields'} & set(sys.modules)",
    "front-door": "import mplicits, sys\n"
    "assert mplicits.__version__ and not {'torch', 'numpy'} & set(sys.modules)\n"
    "assert all(getattr(mplicits, name) is not None and name in dir(mplicits) for name in mplicits.__all__)\n"
    "assert set(mplicits.HOMES) < set(mplicits.__all__)\n"
    "import mplicits.neural_fields, mplicits.pipelines.fit\n"
    "assert mplicits.Field is mplicits.neural_fields.Field and mplicits.fit is mplicits.pipelines.fit.fit",
}


@pytest.mark.parametrize("code", FRESH.values(), ids=FRESH)
def test_imports_in_a_fresh_process(code: str) -> None:
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/")


def test_every_folder_with_python_in_it_is_packaged() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {path.parent.relative_to(ROOT).as_posix() for path in sources()} | {"configs"}
    packaged = {package: setuptools["package-dir"][package] for package in setuptools["packages"]}
    assert packaged == {package_of(folder): folder for folder in folders}
    for path in sources():
        assert (path.parent / "__init__.py").is_file(), f"{path.parent} has no __init__.py"


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_dependencies_are_those_that_are_imported() -> None:
    """Each carries weight, in the package or in what an extra is for; and nothing is imported by way of another."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    homes = {module: [plain(home) for home in there] for module, there in packages_distributions().items()}

    def names(requirements: list[str]) -> set[str]:
        return {plain(re.split(r"[^\w-]", line)[0]) for line in requirements}

    def used(files: list[Path]) -> set[str]:
        tops = {name.split(".")[0] for path in files for level, name, _ in imports(path) if level == 0}
        return tops - {"mplicits", *sys.stdlib_module_names}

    ours = [
        path for path in benchmarks() if room(path) != "benchmarks/hosts"
    ]  # where a host's own modules are imported
    own, all_used = used(sources()), used([*sources(), *ours])
    needed = names(project["dependencies"])
    optional = set().union(*(names(lines) for extra, lines in extras.items() if extra not in ("dev", "docs")))
    unknown = {name for name in all_used if not {*homes.get(name, [name])} & (needed | optional | {"imageio-ffmpeg"})}
    assert not unknown, f"imported, but in no list of pyproject.toml: {sorted(unknown)}"
    found = {home for name in own for home in homes.get(name, [name])}
    assert needed <= found, f"in pyproject.toml, but never imported: {sorted(needed - found)}"
    recorded = set(environment(torch.device("cpu"))["versions"]) - {"mplicits"}
    assert recorded <= needed, f"the record of a run asks for versions of {sorted(recorded - needed)}"


needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="there is no make")


@needs_make
def test_the_demo_installs_nothing_but_the_package() -> None:
    for target, expected in (("demo", ["-e ."]), ("lint", ["-e .", "-e '.[dev]'"])):
        words = ["make", "-n", target, "VENV=none"]
        lines = subprocess.run(words, check=True, cwd=ROOT, capture_output=True, text=True).stdout.splitlines()
        installed = [line for line in lines if " pip install " in line]
        assert [line[line.index("-e ") :] for line in installed] == expected
        assert all(" -c constraints.txt " in line for line in installed)


@needs_make
def test_make_keeps_what_python_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    rule = f"kept:\n\t@'{sys.executable}' -c 'import sys; print(sys.dont_write_bytecode)'\n"
    words = ["make", "--no-print-directory", "-f", "Makefile", "-f", "-", "kept"]  # whoever runs the tests may be make
    done = subprocess.run(words, check=True, cwd=ROOT, capture_output=True, text=True, input=rule)
    assert done.stdout == "False\n"


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
    # The packages of this environment, but not its .pth files, so no editable install.
    Path(site, "borrowed.pth").write_text("\n".join(folder for folder in sys.path if "site-packages" in folder))
    wanted = sorted(
        package_of(path.parent.relative_to(ROOT).as_posix()) + ("" if path.stem == "__init__" else f".{path.stem}")
        for path in sources()
        if room(path) != PLUGIN or path.stem == "__init__" or importlib.util.find_spec("nerfstudio")
    )
    code = (
        "import importlib, pathlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    file = pathlib.Path(importlib.import_module(name).__file__)\n"
        "    assert 'venv' in file.parts, file\n"
    )
    assert wanted
    run(python, "-c", code, *wanted)


def test_names_of_earlier_releases() -> None:
    for module, names in neural_fields._MOVED.items():
        for name, _, new in (pair.partition("=") for pair in names.split()):
            home = f"mplicits.neural_fields.{module}"
            with pytest.warns(DeprecationWarning, match=home):
                assert getattr(neural_fields, name) is getattr(importlib.import_module(home), new or name)
    for module in (neural_fields, mplicits):
        with pytest.raises(AttributeError, match="no attribute 'feild'"):
            module.feild  # noqa: B018


def test_a_run_through_the_front_door(tmp_path: Path) -> None:
    ball = mplicits.WorldField(mplicits.Siren(8, 1), mplicits.Similarity((5.0, 0.0, -1.0), 20.0))
    mplicits.save(tmp_path / "ball.safetensors", ball)
    again = mplicits.load(tmp_path / "ball.safetensors")
    points = np.random.default_rng(0).uniform(-20, 20, (10, 3))
    assert (again.distance(points) == ball.distance(points)).all()
    assert again.similarity == ball.similarity
    with pytest.raises(mplicits.InputError, match="other"):
        mplicits.load(tmp_path / "other")


def test_every_training_returns_a_run(tmp_path: Path) -> None:
    kind = importlib.import_module("mplicits.pipelines.reconstruct.train").Reconstruction
    assert issubclass(kind, mplicits.Run)
    field = mplicits.Sphere(radius=0.5)
    run = mplicits.Run(field, mplicits.Similarity((1.0, 0.0, 0.0), 4.0), tmp_path, {})
    assert run.directory == tmp_path
    assert float(run.shape().distance(np.array([4.0, 0.0, 0.0]))) == pytest.approx(1.0)
    assert run.mesh(16).vertices[:, 0].mean() == pytest.approx(1.0, abs=0.1)
