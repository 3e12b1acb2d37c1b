"""``mplicits info``: what a run, a checkpoint, a mesh or a cloud is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...neural_fields import Mesh, Siren, load_field
from ...neural_fields.networks.multiscale import levels_of
from ..surface.surface import components, is_closed, read_described
from ..training.folder import RECORD_FILE, find_field, is_field, read_record, resumes_with
from ..training.settings import command_line
from ..training.trainer import parameter_count

__all__ = ["describe"]

Rows = list[tuple[str, str]]


def describe(path: str | Path) -> str:
    """A few lines about ``path``.

    Raises:
        InputError: it is nothing that we can read.
    """
    rows = _describe_field(Path(path)) if is_field(path) else _describe_surface(*read_described(path))
    width = max(len(name) for name, _ in rows)
    return "\n".join([str(path), *(f"  {name:<{width}}  {text}".rstrip() for name, text in rows)])


def _describe_field(path: Path) -> Rows:
    file = find_field(path)
    field, similarity, metadata = load_field(file)
    record = metadata.get("run", {})
    if path.is_dir() and (path / RECORD_FILE).is_file():
        record = read_record(path)
    rows: Rows = [
        (
            "kind",
            f"{type(field).__name__}, {field.num_levels} level{'s' * (field.num_levels > 1)}, in {field.in_dim}-D",
        ),
        ("parameters", f"{parameter_count(field):,} ({file.stat().st_size / 1024:,.0f} KiB on disk)"),
    ]
    stages = {stage.get("level"): stage for stage in record.get("stages", [])}
    for index, level in enumerate(levels_of(field)):
        stage = stages.get(index, {})
        rows.append((f"level {index}", _describe_level(level, stage)))
        judged = stage.get("held_out")
        if judged and stage["silenced"] == (judged["after"] >= judged["before"]):
            rows.append(("  held out", judged["verdict"]))
        elif stage.get("silenced"):
            rows.append(("  held out", f"level {index} set to zero: further from the points than the level before it"))
        if index < len(field.deltas):
            delta = float(field.deltas[index])
            rows.append((f"  band {index}", f"δ = {delta:.5g} ({delta * similarity.scale:.5g} input units)"))
    center = ", ".join(f"{number:.9g}" for number in similarity.center)
    rows.append(("input frame", f"center ({center}), 1 unit = {similarity.scale:.9g} input units"))
    return rows + _describe_record(record, path)


def _describe_level(level: Any, stage: dict[str, Any]) -> str:
    text = type(level).__name__
    if isinstance(level, Siren):
        text = f"({level.width}, {level.depth}), ω₀ = {level.omega:g}, {parameter_count(level):,} parameters"
    if "training_seconds" in stage:
        text += f"; {stage['steps']:,} steps in {stage['training_seconds']:.1f} s"
    review = stage.get("review", {})
    for name, what in (("dropped_outliers", "strays dropped"), ("turned_normals", "normals turned round")):
        if review.get(name):
            text += f"; by it {review[name]:,} {what}"
    if "rms_at_points" in stage:
        text += f"; rms at the points {stage['rms_at_points']:.4g} input units"
    return text


def _describe_record(record: dict[str, Any], path: Path) -> Rows:
    if not record:
        return []
    rows: Rows = [("fitted to", str(record.get("cloud", "?")))]
    cleaning, environment = record.get("cleaning", {}), record.get("environment", {})
    if record.get("reading"):
        rows.append(("read", record["reading"]))
    if cleaning:
        points = f"{cleaning['kept']:,} of {cleaning['read']:,}, normals {cleaning['normals_source']}"
        for name, what in (("dropped_outliers", "strays dropped"), ("turned_normals", "normals turned round")):
            if cleaning.get(name):
                points += f", {cleaning[name]:,} {what}"
        rows.append(("points", points))
    signs = record.get("signs")
    if signs:
        rows.append(("signs", _describe_signs(signs, cleaning.get("kept", 0))))
    rows.append(("state", _describe_state(record, path)))
    texture = record.get("texture")
    if texture and not texture.get("finished", True):
        rows.append(("texture", f"unfinished: {command_line('texture', path, texture['source'], '--resume')}"))
    if "training_seconds" in record:
        rows.append(("time", f"{record['training_seconds']:.1f} s"))
    if environment:
        versions = ", ".join(f"{name} {version}" for name, version in environment.get("versions", {}).items())
        rows.append(("made with", f"{versions}, Python {environment.get('python', '?')}"))
        rows.append(("on", f"{environment.get('device', '?')}, {environment.get('threads', '?')} threads"))
    if "seed" in record.get("config", {}):
        rows.append(("seed", str(record["config"]["seed"])))
    return rows


def _describe_state(record: dict[str, Any], path: Path) -> str:
    """Whether the training is finished, and what to type if not."""
    if record.get("finished"):
        return "finished"
    if not path.is_dir():
        return "unfinished"
    again = resumes_with(path, record)
    return f"unfinished: {again}" if again else "unfinished, with nothing to resume from: begin again with --force"


def _describe_signs(signs: dict[str, Any], count: int) -> str:
    if signs["clear"]:
        what = f"level 0, which was not told, turned {signs['turned_normals']:,} of {count:,} normals"
    else:
        what = "level 0, which was not told, saw no in- and outside: normals stay as they were oriented"
    return f"{what} (slope along them {signs['slope']:.2f})"


def _describe_surface(surface: Mesh, reading: str) -> Rows:
    points = surface.used_vertices()
    low, high = points.min(axis=0), points.max(axis=0)
    rows: Rows = []
    if len(surface.faces):
        rows.append(("kind", "mesh"))
        rows.append(("vertices, faces", f"{len(surface.vertices):,}, {len(surface.faces):,}"))
        rows.append(("closed", "yes" if is_closed(surface) else "no: it has open or badly oriented edges"))
        rows.append(("components", f"{components(surface):,}"))
    else:
        rows.append(("kind", "point cloud"))
        rows.append(("points", f"{len(surface.vertices):,}"))
        rows.append(("read", reading))
        rows.append(("normals", "no" if surface.normals is None else "yes"))
    rows.append(("bounds", "  ".join(f"{axis} {a:.9g} … {b:.9g}" for axis, a, b in zip("xyz", low, high, strict=True))))
    rows.append(("diagonal", f"{float(np.linalg.norm(high - low)):.6g}"))
    rows.append(("colors", "no" if surface.colors is None else "yes"))
    return rows
