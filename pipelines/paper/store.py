"""What a bench keeps between two runs: a JSON file per cell, meshes, fields and pictures."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ...neural_fields import InputError
from ...neural_fields.files import write_json
from .cell import Record

__all__ = ["make_folder", "read_record", "record_file", "write_record"]


def make_folder(out: Path) -> None:
    """Make the folder of a bench, and see that files can be written there, before the long work.

    Raises:
        InputError: a file stands in its place, its parent does not exist, or it cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder")
    if not out.absolute().parent.is_dir():
        raise InputError(f"{out}: the folder {out.absolute().parent} does not exist; make it first")
    try:
        for folder in (out, out / "cells", out / "meshes", out / "pictures"):
            folder.mkdir(exist_ok=True)
        probe = out / f".{os.getpid()}.partial"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another -o") from error


def record_file(out: Path, key: str) -> Path:
    """Where the record of a cell is."""
    return out / "cells" / f"{key}.json"


def read_record(out: Path, key: str) -> Record | None:
    """The record of a finished cell; None where there is none, it is damaged, or the cell failed."""
    try:
        record: dict[str, Any] = json.loads(record_file(out, key).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and "outputs" in record else None


def write_record(out: Path, key: str, record: Record) -> None:
    """Write a record, whole or not at all."""
    write_json(record_file(out, key), record)
