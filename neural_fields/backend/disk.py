"""The few operations by which this package changes what is on a disk for good.

All that shall be whole after a kill or a full disk goes through here, so that tests can make each of these operations
fail, or be the last one that a process comes to (`tests/faults.py`).
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

__all__ = ["make_folder", "remove", "remove_tree", "rename", "sync", "write"]


def write(path: Path, content: bytes) -> None:
    """Write a file, and wait until the disk has it."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync(folder: Path) -> None:
    """Wait until the disk has the names in a folder; where folders cannot be opened (Windows), it is not asked to."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename(path: Path, target: Path) -> None:
    """Give a file or folder another name; a file of that name is gone then."""
    path.replace(target)


def remove(path: Path) -> None:
    """Remove a file, if it is there."""
    path.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Make a folder, and those above it."""
    path.mkdir(parents=True, exist_ok=True)


def remove_tree(folder: Path) -> None:
    """Remove a folder with all in it, if it is there."""
    if folder.is_dir():
        shutil.rmtree(folder)
