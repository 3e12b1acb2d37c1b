"""Pages that are made from the code when the site is built: settings, commands with their help, and file formats."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
from collections.abc import Callable, Mapping
from typing import Any, get_type_hints

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mplicits.datasets.clouds.readers.las import read_las
from mplicits.datasets.clouds.readers.reading import MESH_READERS, TABLE_READERS
from mplicits.datasets.depth.camera import read_intrinsics
from mplicits.datasets.depth.frame import read_poses
from mplicits.datasets.depth.images import DEPTH_SUFFIXES
from mplicits.datasets.textured.reading import TEXTURED_READERS
from mplicits.datasets.views.formats.shots import IMAGE_SUFFIXES
from mplicits.datasets.views.images import read_cameras
from mplicits.datasets.views.poses.find_cameras import FILM_SUFFIXES
from mplicits.neural_fields.fields.similarity import FRAMES
from mplicits.pipelines.cli.entry import MPLICITS
from mplicits.pipelines.training.settings import EvolveConfig, FitConfig, ReconstructConfig, TextureConfig

CONFIGS = {"fit": FitConfig, "texture": TextureConfig, "reconstruct": ReconstructConfig, "evolve": EvolveConfig}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    for name, page in (("settings", settings_page), ("commands", commands_page), ("formats", formats_page)):
        files.append(File.generated(config, f"{name}.md", content=page()))
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


RUN_FILES = {
    "field.safetensors": "all levels, their bands, the similarity to input coordinates; `load_field` reads it alone",
    "run.json": "the settings, the cloud, the steps and times, the errors of each level",
    "texture.safetensors": "the colours, for this field alone",
    "radiance.safetensors": "the colours by direction and the background, of `reconstruct`",
    "support.safetensors": "points where the surface is visible; parts of a mesh far from them are removed",
    "velocity.safetensors": "the motion, of `evolve --kind deform`",
    "cloud.ply": "the cloud made of depth maps",
    "resume.safetensors": "the state of a training that is not finished; `--resume` goes on from it",
}


def formats_page() -> str:
    """Every file that is read or written, by its extension."""
    readers: dict[str, Mapping[str, Callable[..., Any]]] = {
        "Clouds, and meshes as clouds": {**MESH_READERS, **TABLE_READERS, ".las": read_las, ".laz": read_las},
        "Meshes with colours": TEXTURED_READERS,
    }
    parts = [
        "# File formats\n",
        "Extensions may be in upper case. `mplicits info FILE` says what was read.\n",
    ]
    for title, table in readers.items():
        parts += [f"## {title}\n", "| extension | what is read |", "|---|---|"]
        texts: dict[str, list[str]] = {}
        for extension, read in table.items():
            texts.setdefault(_about(read).partition("\n\n")[0].replace("\n", " "), []).append(f"`{extension}`")
        parts += [f"| {', '.join(extensions)} | {text} |" for text, extensions in texts.items()]
        parts.append("")
    parts += [
        "## Depth maps\n",
        f"Images: {_list(DEPTH_SUFFIXES)}.\n",
        _about(read_intrinsics),
        "",
        _about(read_poses),
        "",
    ]
    parts += [
        "## Photographs\n",
        f"Images: {_list(IMAGE_SUFFIXES)}. Films, for `find-cameras`: {_list(FILM_SUFFIXES)}.\n",
    ]
    parts += [
        _about(read_cameras),
        "",
        "## Meshes that are written\n",
        "| extension | up axis | unit |",
        "|---|---|---|",
    ]
    for extension, frame in FRAMES.items():
        up, unit = ("", "") if frame.always else (" with `--up`", " with `--unit`")
        parts.append(f"| `{extension}` | {frame.up}{up} | {frame.unit}{unit} |")
    parts += ["", "Without these flags PLY, OBJ and STL have the coordinates of the input."]
    parts += ["", "## A run directory\n", "| file | what it holds |", "|---|---|"]
    parts += [f"| `{name}` | {text} |" for name, text in RUN_FILES.items()]
    return "\n".join([*parts, ""])


def _about(function: Callable[..., Any]) -> str:
    """A docstring without its sections of arguments and errors, as Markdown."""
    text = re.split(r"\n(?:Args|Returns|Raises|Example):\n", inspect.getdoc(function) or "")[0]
    return text.replace("``", "`").strip()


def _list(words: tuple[str, ...]) -> str:
    return ", ".join(f"`{word}`" for word in words)


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
