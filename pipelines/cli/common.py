"""What commands share: flags, converters for argparse, checks before any work, and how a stopped one ends."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ..training.settings import add_config_flags, given_flags, input_error, load_config, preset_names, thing_of

if TYPE_CHECKING:
    from ..training.progress import Progress, Report

__all__ = [
    "Command",
    "Stopped",
    "add_begin",
    "add_flags",
    "add_new_run",
    "add_settings",
    "between",
    "check_output",
    "finite",
    "new_settings",
    "positive",
    "read_settings",
    "refuse",
    "stoppable",
    "tell_budget",
    "training",
    "whole",
    "write_json",
]

T = TypeVar("T")
Number = TypeVar("Number", int, float)


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        summary: a few words for the list of commands.
        examples: lines for the end of its help.
        add_arguments: tells a parser what it takes.
        run: does it → exit code.
        description: for its help, where the summary does not say enough.
    """

    summary: str
    examples: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    description: str = ""


class Stopped(Exception):  # noqa: N818  what happened is no error
    """A command was interrupted; the message, of one line, says what is kept and how to go on: exit code 130."""


@contextmanager
def stoppable(kept: str = "", *, at_any_time: bool = False) -> Iterator[None]:
    """Let an interruption of the work inside end the command.

    Args:
        kept: what is said then, after "interrupted; ".
        at_any_time: whether that is true of any moment, and not only after a training has written its checkpoint.

    Raises:
        Stopped: it was interrupted.
    """
    from ..training.trainer import Interrupted

    try:
        yield
    except (Interrupted, KeyboardInterrupt) as stop:
        if isinstance(stop, KeyboardInterrupt) and not at_any_time:
            raise
        raise Stopped(f"interrupted; {kept}" if kept else "interrupted") from stop


@contextmanager
def training(
    kept: str = "", *, quiet: bool = False, at_any_time: bool = False, board: Path | None = None
) -> Iterator[Report | None]:
    """`stoppable` work with progress bars, unless it is to be ``quiet``.

    Args:
        kept: see `stoppable`.
        quiet: no bars.
        at_any_time: see `stoppable`.
        board: folder for a TensorBoard log, or None.

    Raises:
        InputError: see `tensorboard_log`.
    """
    from ..training.progress import progress_bars

    with ExitStack() as stack:
        stack.enter_context(stoppable(kept, at_any_time=at_any_time))
        listeners: list[Report] = []
        if board is not None:
            from ..training.progress import tensorboard_log

            listeners.append(stack.enter_context(tensorboard_log(board)))
        if not quiet:
            listeners.append(stack.enter_context(progress_bars()))

        def tell(progress: Progress, /) -> None:
            for listener in listeners:
                listener(progress)

        yield tell if listeners else None


def tell_budget(record: Mapping[str, Any], name: str = "") -> None:
    """Warn, on stderr, of what a time budget has changed, as ``record``, a part of ``run.json``, has it."""
    budget = record.get("budget", {})
    for note in budget.get("notes", []):
        print(f"warning: --time-budget {budget['seconds']:g}: {name}{note}", file=sys.stderr)


# --- converters for argparse ---


def _converter(kind: type[Number], allows: Callable[[Number], bool], allowed: str) -> Callable[[str], Number]:
    def convert(text: str) -> Number:
        try:
            number = kind(text)
        except ValueError:
            number = None
        if number is None or not allows(number):
            raise argparse.ArgumentTypeError(f"got {text!r}, expected {allowed}")
        return number

    return convert


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """A converter: whole numbers from ``low`` to ``high``."""
    limit = math.inf if high is None else high
    allowed = f"a whole number from {low}" + (f" to {high}" if high is not None else "")
    return _converter(int, lambda number: low <= number <= limit, allowed)


def between(low: float, high: float) -> Callable[[str], float]:
    """A converter: numbers from ``low`` to ``high``."""
    return _converter(float, lambda number: low <= number <= high, f"a number from {low:g} to {high:g}")


positive = _converter(float, lambda number: 0 < number < math.inf, "a number > 0")
finite = _converter(float, math.isfinite, "a number")


# --- flags ---

AROUND = "degrees around the up axis from the front (30)"
# Flags of several commands. What each command means by one is said where it is added, unless all mean the same.
FLAGS: Mapping[str, dict[str, Any]] = {
    "run": {"metavar": "RUN", "help": "run directory or .safetensors file"},
    "--out": {"required": True, "type": Path, "metavar": "FILE"},
    "--json": {"type": Path, "metavar": "FILE", "help": "write the figures as JSON as well"},  # `main` checks it
    "--quiet": {"action": "store_true", "help": "no progress bars"},
    "--level": {"type": whole(0), "metavar": "L", "help": "0 is the coarsest (default: the finest)"},
    "--normal-level": {"type": whole(0), "metavar": "L"},
    "--time": {"type": between(0, 1), "metavar": "T", "help": "the moment from 0 to 1, of a run that moves"},
    "--resolution": {"type": whole(8, 2048), "metavar": "N"},
    "--size": {"type": whole(1, 16384), "nargs": "+", "metavar": "N"},
    "--up": {"choices": ("y", "z"), "help": "the axis that points up (y)"},
    "--azimuth": {"type": between(-3600, 3600), "metavar": "A", "help": AROUND},
    "--elevation": {"type": between(-90, 90), "metavar": "E", "help": "degrees above the horizon (15)"},
    "--zoom": {"type": positive, "metavar": "Z"},
    "--samples": {"type": whole(1, 8), "metavar": "N", "help": "rays per pixel and direction (2)"},
    "--frames": {"type": whole(1, 100_000), "metavar": "N"},
    "--fps": {"type": positive, "metavar": "F", "help": "frames per second of a film (24)"},
    "--device": {"default": "auto", "help": "where to evaluate the field: auto, cpu, cuda, ... (auto)"},
    "--seed": {"type": whole(0), "default": 0, "metavar": "N"},
}


def add_flags(parser: argparse.ArgumentParser, *names: str, of: str = "", **changed: Any) -> None:
    """Add some of the `FLAGS`.

    Args:
        parser: gets them.
        names: which, ``--out`` also as ``-o``.
        of: what each is about, in front of its help.
        changed: what is different from `FLAGS` in this command, its ``help`` above all.
    """
    for name in names:
        options = {**FLAGS[name], **changed}
        options["help"] = of + options["help"]
        parser.add_argument(*(["-o"] if name == "--out" else []), name, **options)


def add_begin(
    parser: argparse.ArgumentParser,
    resume: str = "continue the interrupted run in RUN, with its settings",
    force: str = "overwrite the run in RUN",
) -> None:
    """Add ``--resume`` and ``--force``, of which one may be given, and ``--quiet``."""
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--resume", action="store_true", help=resume)
    begin.add_argument("--force", action="store_true", help=force)
    add_flags(parser, "--quiet")


def add_new_run(parser: argparse.ArgumentParser, out: str = "directory of the run") -> None:
    """Add ``-o RUN``, how it begins, and ``--tensorboard``."""
    add_flags(parser, "--out", metavar="RUN", help=out)
    add_begin(parser)
    what = "write the losses for TensorBoard into this folder; needs mplicits[tensorboard]"
    parser.add_argument("--tensorboard", type=Path, metavar="DIR", help=what)


def add_settings(
    parser: argparse.ArgumentParser, cls: type, *, default: str = "default", about: str = "each overrides the preset"
) -> None:
    """Add ``--preset``, ``--config`` and one flag per field of ``cls``."""
    source = parser.add_mutually_exclusive_group()
    names = ", ".join(preset_names(thing_of(cls)))
    source.add_argument("--preset", metavar="NAME", help=f"one of {names} (default: {default})")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(parser, cls, about=about)


def read_settings(arguments: argparse.Namespace, cls: type[T], *, default: str = "default") -> T:
    """What the arguments say.

    Raises:
        InputError: see `load_config`.
    """
    return load_config(cls, arguments.config or arguments.preset or default, given_flags(arguments, cls))


def new_settings(arguments: argparse.Namespace, cls: type[T], *others: str) -> T | None:
    """What the arguments say of a new run; None of a resumed one, which has its own settings.

    Raises:
        InputError: a resumed run got settings, or one of the flags named ``others``; see `load_config`.
    """
    if not arguments.resume:
        return read_settings(arguments, cls)
    given = arguments.config or arguments.preset or given_flags(arguments, cls)
    if given or any(getattr(arguments, name) for name in others):
        raise input_error("--resume: continues with the run's own settings; leave out --preset, --config and the rest")
    return None


def refuse(arguments: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Refuse the first of these flags that was given.

    Args:
        arguments: of the command.
        names: of flags that do not go with others.
        why: what the message says after the flag.

    Raises:
        InputError: one was.
    """
    for name in names:
        if getattr(arguments, name, None) not in (None, False):
            raise input_error(f"--{name.replace('_', '-')}: {why}")


# --- before any work, and after it ---


def check_output(path: Path | None, suffixes: Sequence[str]) -> None:
    """Refuse an output file that could not be written, before the long work and not after it.

    Raises:
        InputError: another extension, a directory stands in its place, or none can come to be there (`check_place`).
    """
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise input_error(f"{path}: unknown extension {path.suffix!r}; known: {', '.join(suffixes)}")
    if path.is_dir():
        raise input_error(f"{path}: is a directory; name a file")
    from ...neural_fields.backend.files import check_place

    check_place(path)


def write_json(path: Path | None, data: Any) -> None:
    """Write figures through a temporary file beside the target; nothing without a path."""
    if path is None:
        return
    from ...neural_fields.backend import files

    files.write_json(path, data)
