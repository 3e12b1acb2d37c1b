"""A notebook from a script in the percent format, written beside it: ``python tests/helpers/notebook.py SCRIPT.py``.

``# %%`` begins a cell, ``# %% [markdown]`` one of words. Jupyter is not needed.
"""

import json
import sys
from pathlib import Path
from typing import Any


def cells_of(script: str) -> list[tuple[str, str]]:
    """(kind, source) of the cells of a script, kind "markdown" or "code"."""
    found: list[tuple[str, list[str]]] = []
    for line in script.splitlines():
        if line.startswith("# %%"):
            found.append(("markdown" if "[markdown]" in line else "code", []))
        elif found:
            found[-1][1].append(line.removeprefix("#").removeprefix(" ") if found[-1][0] == "markdown" else line)
        else:
            raise ValueError(f"{line!r}: expected '# %%' first")
    return [(kind, "\n".join(lines).strip("\n")) for kind, lines in found]


def notebook_of(script: str) -> str:
    """The notebook, without outputs, as the content of its file (nbformat 4.5)."""

    def cell(index: int, kind: str, source: str) -> dict[str, Any]:
        made = {"cell_type": kind, "id": f"cell-{index}", "metadata": {}, "source": source.splitlines(keepends=True)}
        return made if kind == "markdown" else made | {"execution_count": None, "outputs": []}

    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    cells = [cell(index, kind, source) for index, (kind, source) in enumerate(cells_of(script))]
    content = {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for name in sys.argv[1:]:
        path = Path(name)
        path.with_suffix(".ipynb").write_text(notebook_of(path.read_text(encoding="utf-8")), encoding="utf-8")
