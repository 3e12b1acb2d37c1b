"""What commands share: flags, converters for argparse, checks before any work, and how a stopped one ends."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from ..training.settings import add_config_flags, closest, given_flags, input_error, load_config, preset_names, thing_of

if TYPE_CHECKING:
    from ..training.progress import Progress, Report

# How often an idle thread of GNU's OpenMP, which PyTorch uses on Linux, looks for its next share of work before it
# sleeps: 0.2 ms rather than several. Meanwhile it holds a core that another process, or a thread with blocks of its
# own, could use. Read when torch is loaded.
SPINS = ("GOMP_SPINCOUNT", "20000")
HELP = ("-h", "--help")
T = TypeVar("T")
Number = TypeVar("Number", int, float)


@dataclass(frozen=True)
class Command:
    """One command: texts of its help, what adds its arguments to a parser, and what runs it and returns an exit code.

    ``description`` is for its own help, where the summary is not enough.
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
    """Turn an interruption of the work inside into `Stopped`, whose message is "interrupted; " and ``kept``.

    ``at_any_time``: the message holds at every moment, not only after a training has written its checkpoint.
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
    """`stoppable` work with progress bars, unless it is ``quiet``, and a TensorBoard log in the folder ``board``."""
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
    """Warn, on stderr, of what a time budget or noise has changed, as ``record``, a part of ``run.json``, has it."""
    budget = record.get("budget", {})
    for note in budget.get("notes", []):
        limit = "" if budget["seconds"] is None else f"--time-budget {budget['seconds']:g}: "
        print(f"warning: {limit}{name}{note}", file=sys.stderr)


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


def picture_size(text: str) -> tuple[int, int]:
    """A converter: width and height in pixels, ``64`` or ``200x150``."""
    width, _, height = text.partition("x")
    return whole(8, 4096)(width), whole(8, 4096)(height or width)


positive = _converter(float, lambda number: 0 < number < math.inf, "a number > 0")
finite = _converter(float, math.isfinite, "a number")


# --- flags ---

AROUND = "degrees around the up axis from the front (30)"
# Flags of several commands. Help texts stand here where all commands mean the same by a flag, else where it is added.
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
    """Add some of the `FLAGS`, ``--out`` also as ``-o``, with ``of`` in front of their help.

    ``changed`` replaces options of theirs in this command, its ``help`` above all.
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
    """Add ``--resume`` or ``--force``, and ``--quiet``."""
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
    """The settings of ``--config`` or ``--preset`` with the flags given; raises the InputErrors of `load_config`."""
    return load_config(cls, arguments.config or arguments.preset or default, given_flags(arguments, cls))


def new_settings(arguments: argparse.Namespace, cls: type[T], *others: str) -> T | None:
    """The settings of a new run; None for a resumed one, which keeps its own and refuses flags and ``others``."""
    if not arguments.resume:
        return read_settings(arguments, cls)
    given = arguments.config or arguments.preset or given_flags(arguments, cls)
    if given or any(getattr(arguments, name) for name in others):
        raise input_error("--resume: continues with the run's own settings; leave out --preset, --config and the rest")
    return None


def refuse(arguments: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Raise an InputError about the first of these flags that was given; ``why`` follows its name in the message."""
    for name in names:
        if getattr(arguments, name, None) not in (None, False):
            raise input_error(f"--{name.replace('_', '-')}: {why}")


# --- before any work, and after it ---


def check_output(path: Path | None, suffixes: Sequence[str]) -> None:
    """Raise an InputError before any work if a file of one of the suffixes cannot be written at ``path``."""
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


# --- the program ---


class _UsageError(Exception):
    """A mistake in the arguments."""


class _Parser(argparse.ArgumentParser):
    """An argument parser that raises instead of exiting, and knows what a mistyped flag should have been."""

    def __init__(self, name: str, command: Command, *, program: str) -> None:
        super().__init__(
            prog=f"{program} {name}",
            description=command.description or command.summary,
            epilog=f"examples:\n{command.examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        # argparse takes -1e-3 for a flag; coordinates and tolerances are written so, and lengths as -2mm.
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?[a-z]*$")
        command.add_arguments(self)

    def error(self, message: str) -> NoReturn:
        raise _UsageError(f"{message} (see `{self.prog} --help`)")

    def check_flags(self, arguments: Sequence[str]) -> None:
        """Name the nearest flag of a mistyped one, before argparse complains of what is then missing."""
        known = {flag: action.help for flag, action in self._option_string_actions.items() if flag.startswith("--")}
        for argument in arguments:
            if argument == "--":
                return
            flag = argument.split("=", 1)[0]
            if flag.startswith("--") and flag not in known:
                shown = (name for name, text in known.items() if text != argparse.SUPPRESS)
                self.error(f"unknown flag {flag}{closest(flag, shown)}")


@dataclass(frozen=True)
class Program:
    """A table of commands with a name, and an overview that ``--help`` prints.

    ``{commands}`` in the overview is replaced by the list of commands.
    """

    name: str
    commands: Mapping[str, Command]
    overview: str

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run one command → 0, 1 (a check failed), 2 (bad input or arguments), 130 (interrupted), 141 (output closed).

        ``argv`` has no program name; None takes the arguments of the process.
        """
        os.environ.setdefault(*SPINS)
        try:
            return self._run(list(sys.argv[1:] if argv is None else argv))
        except SystemExit as stop:  # argparse's --help
            return int(stop.code or 0)
        except _UsageError as error:
            return self._fail(str(error))
        except Stopped as stop:
            print(stop, file=sys.stderr)
            return 130
        except KeyboardInterrupt:
            print(f"{self._short}: interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:
            # Whoever read our output has left, `head` say. Python would complain again when it flushes at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 141
        except OSError as error:
            if error.filename is None:
                raise
            reason = error.strerror or type(error).__name__
            return self._fail(f"{os.fsdecode(error.filename)}: {reason}; check the path and its permissions")
        except ValueError as error:
            from ...neural_fields import InputError

            if not isinstance(error, InputError):
                raise
            return self._fail(str(error))

    def parser(self, name: str) -> _Parser:
        """The parser of a command's arguments."""
        return _Parser(name, self.commands[name], program=self.name)

    @property
    def _short(self) -> str:
        """The name that messages begin with."""
        return self.name.split()[-1]

    def _run(self, arguments: list[str]) -> int:
        if arguments[:1] == ["help"]:
            arguments = [*arguments[1:], "--help"]
        if not arguments or arguments[0] in HELP:
            width = max(map(len, self.commands))
            listed = (f"  {name:<{width}}  {command.summary}" for name, command in self.commands.items())
            print(self.overview.format(commands="\n".join(listed)))
            return 0 if arguments else 2
        if arguments[0] == "--version":
            from importlib.metadata import version  # late, as all that --help can do without

            print(f"mplicits {version('mplicits')}")
            return 0
        name, *rest = arguments
        if name not in self.commands:
            raise _UsageError(f"unknown command {name!r}{closest(name, self.commands)}")
        parser = self.parser(name)
        if not {*HELP} & set(rest):
            parser.check_flags(rest)
        given = parser.parse_args(rest)
        check_output(getattr(given, "json", None), (".json",))
        given.words = [*self.name.split(), *arguments]  # as they were typed, for pages of results
        code = self.commands[name].run(given)
        sys.stdout.flush()
        return code

    def _fail(self, message: str) -> int:
        print(f"{self._short}: error: {' '.join(message.split())}", file=sys.stderr)
        return 2
