"""Losses of a training for TensorBoard: ``--tensorboard DIR``, which needs ``mplicits[tensorboard]``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...neural_fields import InputError
from .report import Progress, Report


@contextmanager
def tensorboard_log(directory: str | Path) -> Iterator[Report]:
    """A receiver of progress that writes scalars for TensorBoard.

    Each loss term of a stage is ``STAGE/TERM`` over the steps of that stage, as "level 0/surface.data".

    Args:
        directory: of the event files; made where it is absent. An older run's stay, under their own names.

    Raises:
        InputError: tensorboard is not installed, or the directory cannot be made.
    """
    writer = _writer(Path(directory))
    try:
        yield _Log(writer)
    finally:
        writer.close()


class _Log:
    def __init__(self, writer: Any) -> None:
        self.writer = writer

    def __call__(self, progress: Progress, /) -> None:
        for name, value in progress.losses.items():
            self.writer.add_scalar(f"{progress.stage}/{name}", value, progress.step)


def _writer(directory: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise InputError("--tensorboard: needs tensorboard; pip install mplicits[tensorboard]") from error
    try:
        directory.mkdir(parents=True, exist_ok=True)
        return SummaryWriter(str(directory))
    except OSError as error:
        raise InputError(f"--tensorboard {directory}: cannot be written ({error.strerror or error})") from error
