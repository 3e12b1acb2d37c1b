"""Tables as Markdown, CSV and JSON, and the page of results that holds all of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from mplicits.pipelines.training.progress import format_table

from .tables import Column, Row, Table, Value

NONE = "–"


@dataclass(frozen=True)
class Section:
    """What the page says about one table of the paper.

    Attributes:
        name: as after ``--table``.
        label: the paper's label, if it has one.
        summary: what it shows.
        tables: the table, and those behind it.
        plots: files, relative to the page, with their titles.
        sheets: contact sheets, likewise.
        methods: name, source and what differs, of every method behind the figures.
        failures: jobs that failed or were left out, one line each.
    """

    name: str
    label: str
    summary: str
    tables: tuple[Table, ...]
    plots: tuple[tuple[str, str], ...] = ()
    sheets: tuple[tuple[str, str], ...] = ()
    methods: tuple[tuple[str, str, str], ...] = ()
    failures: tuple[str, ...] = ()


def as_markdown(table: Table) -> str:
    """A table with the published figures in brackets beside ours, and the best of each column in bold."""
    lines = [_line(_heads(table)), "|" + "---|" + "---:|" * len(table.columns)]
    return "\n".join([*lines, *(_line(cells) for cells in _cells(table, best="**{}**", published="*({})*"))])


def as_text(table: Table) -> str:
    """The same for a terminal: title, aligned columns, notes."""
    rows = _cells(table, best="{}", published="({})")
    return "\n".join([table.title, format_table(_heads(table), rows), *table.notes])


def _heads(table: Table) -> list[str]:
    return [table.head, *(column.name for column in table.columns)]


def _cells(table: Table, *, best: str, published: str) -> list[list[str]]:
    """The words of every row; the best of a column and what the paper says are put into these forms."""
    lowest = [_best(table, index) for index in range(len(table.columns))]
    rows = []
    for row in table.rows:
        cells = [row.name]
        for index, column in enumerate(table.columns):
            text = _text(row.values[index], column)
            if row.competes and lowest[index] is not None and row.values[index] == lowest[index]:
                text = best.format(text)
            if row.published is not None and row.published[index] is not None:
                text += " " + published.format(_text(row.published[index], column))
            cells.append(text)
        rows.append(cells)
    return rows


def _best(table: Table, index: int) -> Value:
    """The value of a column to be set in bold; None where none is, or there is nothing to compare."""
    choose = {"lowest": min, "highest": max, None: None}[table.columns[index].best]
    values = [row.values[index] for row in table.rows if row.competes]
    numbers = [value for value in values if isinstance(value, int | float)]
    return choose(numbers) if choose is not None and len(numbers) > 1 else None


def _text(value: Value, column: Column) -> str:
    if value is None:
        return NONE
    return value if isinstance(value, str) else format(value, column.form)


def as_csv(table: Table) -> str:
    """One line per row: its name, ours and the published figure of every column, source, and what differs."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    heads = [name for column in table.columns for name in (column.name, f"{column.name} (paper)")]
    writer.writerow([table.head, *heads, "source", "differs"])
    for row in table.rows:
        published = row.published or (None,) * len(table.columns)
        figures = [value for pair in zip(row.values, published, strict=True) for value in pair]
        writer.writerow([row.name, *("" if value is None else value for value in figures), row.source, row.differs])
    return file.getvalue()


def as_dict(table: Table) -> dict[str, Any]:
    """A table as JSON, from which `from_dict` makes it again."""
    return {
        "name": table.name,
        "title": table.title,
        "head": table.head,
        "columns": [{"name": c.name, "form": c.form, "best": c.best} for c in table.columns],
        "rows": [
            {
                "name": row.name,
                "values": list(row.values),
                "published": None if row.published is None else list(row.published),
                "source": row.source,
                "differs": row.differs,
                "competes": row.competes,
            }
            for row in table.rows
        ],
        "notes": list(table.notes),
    }


def from_dict(pairs: Mapping[str, Any]) -> Table:
    """The inverse of `as_dict`."""
    rows = tuple(
        Row(
            row["name"],
            tuple(row["values"]),
            None if row["published"] is None else tuple(row["published"]),
            row["source"],
            row["differs"],
            row["competes"],
        )
        for row in pairs["rows"]
    )
    columns = tuple(Column(**column) for column in pairs["columns"])
    return Table(pairs["name"], pairs["title"], pairs["head"], columns, rows, tuple(pairs["notes"]))


def section_as_dict(section: Section) -> dict[str, Any]:
    """A section as JSON, from which `section_from_dict` makes it again."""
    return asdict(section) | {"tables": [as_dict(table) for table in section.tables]}


def section_from_dict(pairs: Mapping[str, Any]) -> Section:
    """The inverse of `section_as_dict`."""
    return Section(
        name=pairs["name"],
        label=pairs["label"],
        summary=pairs["summary"],
        tables=tuple(map(from_dict, pairs["tables"])),
        plots=tuple(map(tuple, pairs["plots"])),
        sheets=tuple(map(tuple, pairs["sheets"])),
        methods=tuple(map(tuple, pairs["methods"])),
        failures=tuple(pairs["failures"]),
    )


def with_missing(table: Table, missing: Mapping[str, str]) -> Table:
    """The table with one more row for each method that gave nothing at all, and the reason."""
    empty = (None,) * len(table.columns)
    rows = tuple(Row(f"{name}: {why}", empty, None, "", why, competes=False) for name, why in missing.items())
    return replace(table, rows=table.rows + rows)


def as_page(
    sections: Sequence[Section], *, title: str, command: str, machine: str, protocol: Sequence[str] = ()
) -> str:
    """The page of results.

    Args:
        sections: in order.
        title: of the page.
        command: that wrote it.
        machine: what it ran on.
        protocol: sentences.
    """
    methods = list(dict.fromkeys(method for section in sections for method in section.methods))
    parts = [f"# {title}", "Written by", f"    {command}"]
    parts.append("In *(brackets)*: what the paper prints. In **bold**: the best of a column here.")
    if protocol:
        parts += ["## Protocol", "\n".join(f"- {sentence}" for sentence in protocol)]
    parts.append(f"Machine: {machine}.")
    if methods:
        rows = "\n".join(["| method | source | what differs here |", "|---|---|---|", *map(_line, methods)])
        parts += ["## Methods", rows]
    for section in sections:
        parts += _section(section)
    return "\n\n".join(parts) + "\n"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _section(section: Section) -> list[str]:
    parts = [f"## {section.name}: {section.summary}"]
    if section.label:
        parts.append(f"The paper's `{section.label}`.")
    for table in section.tables:
        parts += [f"### {table.title}", as_markdown(table) if table.rows else "No figures yet."]
        if table.notes:
            parts.append("\n".join(f"- {note}" for note in table.notes))
    if section.plots:
        file, title = section.plots[0]
        parts.append(f"![{title}]({file})")
    if section.plots[1:]:
        parts.append("More plots: " + ", ".join(f"[{title}]({file})" for file, title in section.plots[1:]) + ".")
    parts += [f"![{title}]({file})" for file, title in section.sheets]
    if section.failures:
        parts.append("Not in these figures:\n\n" + "\n".join(f"- {line}" for line in section.failures))
    return parts
