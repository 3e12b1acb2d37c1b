"""A disk that fails, or a process that is killed, at a chosen operation of `neural_fields.backend.files`.

- "killed": that operation and all after it do not happen, as after SIGKILL or a power cut.
- "torn": half of it happens, if it is a write, and nothing after it.
- "full": it raises that the disk is full, once. What follows works.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mplicits.neural_fields.backend import files as disk

__all__ = ["KINDS", "Faults", "Killed"]

KINDS = ("killed", "torn", "full")
OPERATIONS = ("write", "sync", "rename", "remove")


class Killed(BaseException):
    """The process is no more; only a test sees this."""


class Faults:
    """Operations of a block, counted; the one with the number ``at`` goes wrong, if there is one."""

    def __init__(self, at: int | None = None, kind: str = "killed") -> None:
        self.at, self.kind, self.count, self.dead = at, kind, 0, False

    @contextmanager
    def injected(self) -> Iterator[Faults]:
        with pytest.MonkeyPatch.context() as patch:
            for name in OPERATIONS:
                patch.setattr(disk, name, self._instead(name, getattr(disk, name)))
            yield self

    def _instead(self, name: str, operation: Callable[..., None]) -> Callable[..., None]:
        def run(path: Path, *more: Any) -> None:
            if self.dead:
                raise Killed
            now, self.count = self.count, self.count + 1
            if now != self.at:
                operation(path, *more)
            elif self.kind == "full":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            else:
                self.dead = True
                if self.kind == "torn" and name == "write":
                    operation(path, more[0][: len(more[0]) // 2])
                raise Killed

        return run
