"""Every example that a reader may copy runs: docstrings, the README's Python, and its command lines."""

import doctest
import importlib
import pkgutil
import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import mplicits.datasets
import mplicits.neural_fields
import mplicits.pipelines
import pytest
from mplicits.pipelines.cli.entry import MPLICITS

import benchmarks
from benchmarks.cli.entry import BENCHMARKS

ROOT = Path(__file__).parent.parent
DOCUMENTS = [
    *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "AGENTS")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
PLUGIN = "mplicits.pipelines.nerfstudio."  # whose modules, but for the export, load where nerfstudio is installed only
MODULES = [
    module.name
    for package in (mplicits.neural_fields, mplicits.datasets, mplicits.pipelines, benchmarks)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if find_spec("nerfstudio") or not module.name.startswith(PLUGIN) or module.name == f"{PLUGIN}export"
]


def blocks(language: str) -> list[str]:
    block = re.compile(rf"^```{language}\n(.*?)^```", re.MULTILINE | re.DOTALL)
    return [found for path in DOCUMENTS for found in block.findall(path.read_text(encoding="utf-8"))]


def commands() -> list[str]:
    """Every ``mplicits …`` and ``python -m benchmarks …`` line of the documents' shell blocks, without its comment."""
    lines = [line for block in blocks("sh") for line in block.splitlines()]
    return [line.partition("#")[0].strip() for line in lines if line.startswith(("mplicits ", "python -m benchmarks "))]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_there_are_examples() -> None:
    finder = doctest.DocTestFinder()
    found = [test for name in MODULES for test in finder.find(importlib.import_module(name)) if test.examples]
    assert len(found) > 5
    assert len(blocks("python")) >= 2
    assert len(commands()) >= 5


@pytest.mark.parametrize("block", blocks("python"))
def test_python_of_the_documents(block: str) -> None:
    exec(compile(block, "README.md", "exec"), {})


@pytest.mark.parametrize("line", commands())
def test_commands_of_the_documents_parse(line: str) -> None:
    program = MPLICITS if line.startswith("mplicits ") else BENCHMARKS
    name, *arguments = shlex.split(line.removeprefix(f"{program.name} "))
    parser = program.parser(name)
    parser.check_flags(arguments)
    parser.parse_args(arguments)


def anchors(path: Path) -> set[str]:
    """What the headings of a page are called in links, on the site as on GitHub."""
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


# Pages of the site that docs/api/reference.py writes while it is built; `mkdocs build` checks links to them.
GENERATED = ("commands.md", "settings.md", "formats.md")


def test_links_of_the_documents_lead_somewhere() -> None:
    for path in (*DOCUMENTS, ROOT / "CHANGELOG.md"):
        for target, _, anchor in re.findall(r"\]\((?!http)([^)#]*)(#([^)]*))?\)", path.read_text(encoding="utf-8")):
            page = path.parent / target if target else path
            if path.parent == ROOT / "docs" and target in GENERATED:
                continue
            assert page.exists(), f"{path.name} links to {target}"
            if anchor and page.suffix == ".md":
                assert anchor in anchors(page), f"{path.name} links to {target}#{anchor}"


def test_files_and_modules_that_the_documents_name_are_there() -> None:
    for path in DOCUMENTS:
        text = path.read_text(encoding="utf-8")
        for name in re.findall(r"`((?:neural_fields|datasets|pipelines|benchmarks|configs|tests)/[\w./-]*)`", text):
            assert (ROOT / name).exists(), f"{path.name} names {name}"
        for name in re.findall(r"`(mplicits(?:\.\w+)+)`", text) + re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE):
            assert pkgutil.resolve_name(name), f"{path.name} names {name}"
