"""Pages that are made from the code when the site is built: every setting, and every command with its help."""

from __future__ import annotations

import dataclasses
import os
from typing import Any, get_type_hints

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mplicits.pipelines.cli.entry import MPLICITS
from mplicits.pipelines.training.settings import EvolveConfig, FitConfig, ReconstructConfig, TextureConfig

CONFIGS = {"fit": FitConfig, "texture": TextureConfig, "reconstruct": ReconstructConfig, "evolve": EvolveConfig}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages ``settings.md`` and ``commands.md``."""
    for name, text in (("settings.md", settings_page()), ("commands.md", commands_page())):
        files.append(File.generated(config, name, content=text))
    return files


def settings_page() -> str:
    """One table for each command that trains: name, default, allowed values and meaning of its settings."""
    parts = [
        "# Settings\n",
        "Each setting is a key of a YAML file (`--config FILE`), a flag of the command (`data_weight` is "
        "`--data-weight`), and a field of the Python class. Defaults are those of the preset `default`. "
        "Lengths are in the unit sphere unless the meaning says otherwise.\n",
    ]
    for name, kind in CONFIGS.items():
        parts += [f"## {name}: `{kind.__name__}`\n", "| setting | default | allowed | meaning |", "|---|---|---|---|"]
        hints = get_type_hints(kind)
        for field in dataclasses.fields(kind):
            meaning = str(field.metadata["help"]).replace("|", "\\|")
            shown = _shown(field.default)
            parts.append(f"| `{field.name}` | {shown} | {_allowed(hints[field.name], field.metadata)} | {meaning} |")
        parts.append("")
    return "\n".join(parts)


def commands_page() -> str:
    """The help of every command."""
    os.environ["COLUMNS"] = "80"
    parts = [
        "# Commands\n",
        "`mplicits COMMAND --help` prints the same. Exit codes: 0 done, 2 bad input, 130 stopped.\n",
    ]
    for name in MPLICITS.commands:
        parts += [f"## {name}\n", "```text", MPLICITS.parser(name).format_help().rstrip(), "```\n"]
    return "\n".join(parts)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return f"`{' '.join(map(str, value))}`"
    return "–" if value is None else f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _allowed(hint: Any, bounds: Any) -> str:
    choices = [choice for part in (hint, *getattr(hint, "__args__", ())) for choice in getattr(part, "__args__", ())]
    if words := [choice for choice in choices if isinstance(choice, str)]:
        return ", ".join(f"`{word}`" for word in words)
    signs = {"above": ">", "at_least": "≥", "at_most": "≤"}
    return ", ".join(f"{sign} {bounds[key]:g}" for key, sign in signs.items() if bounds[key] is not None) or "any"
