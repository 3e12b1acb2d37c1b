"""The command line: ``mplicits COMMAND …``.

Bad input is one line on stderr and exit code 2; Ctrl-C is 130. torch is loaded by the command that needs
it, never for help or for a mistake in the arguments.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NoReturn

from ..training.settings import closest
from .commands import COMMANDS
from .common import Command, Stopped, check_output

__all__ = ["MPLICITS", "Program", "main"]

# How often an idle thread of GNU's OpenMP, which PyTorch uses on Linux, looks for its next share of work before it
# sleeps: 0.2 ms rather than several. Meanwhile it holds a core that another process, or a thread with blocks of its
# own, could use. Read when torch is loaded.
SPINS = ("GOMP_SPINCOUNT", "20000")

OVERVIEW = """usage: mplicits COMMAND [arguments]

Fit a multiscale neural signed distance field to a point cloud, draw it, mesh it, and measure the result.

commands:
{commands}

examples:
  mplicits sample -o scan.ply                       write the bundled scan of a statue
  mplicits fit scan.ply -o runs/statue              fit it (about three minutes on two cores)
  mplicits render runs/statue -o statue.png --up z  draw it; turntable.mp4 goes around it
  mplicits mesh runs/statue -o statue.ply --resolution 512
  mplicits evaluate statue.ply reference.ply

`mplicits COMMAND --help` says more about each; `mplicits --version` prints the version."""

HELP = ("-h", "--help")
MOVED = {"bench": "benchmarks are not in the package; run `python -m benchmarks NAME` in a checkout of mplicits"}


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
    """A table of commands with its own name on the command line.

    Attributes:
        name: what is typed before a command.
        commands: by name.
        overview: what ``--help`` prints; ``{commands}`` is replaced by the list of commands.
        moved: commands of earlier versions, each with what to run instead.
    """

    name: str
    commands: Mapping[str, Command]
    overview: str
    moved: Mapping[str, str] = field(default_factory=dict)

    def main(self, argv: Sequence[str] | None = None) -> int:
        """Run one command.

        Args:
            argv: arguments without the program's name; those of the process by default.

        Returns:
            Exit code: 0, 1 (a check failed), 2 (bad input or arguments) or 130 (interrupted).
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
            print(self.overview.format(commands=self._listed()))
            return 0 if arguments else 2
        if arguments[0] == "--version":
            from importlib.metadata import version  # late, as all that --help can do without

            print(f"mplicits {version('mplicits')}")
            return 0
        name, *rest = arguments
        if name in self.moved:
            raise _UsageError(f"{name}: {self.moved[name]}")
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

    def _listed(self) -> str:
        """A line for each command, with what it does."""
        width = max(map(len, self.commands))
        return "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in self.commands.items())

    def _fail(self, message: str) -> int:
        print(f"{self._short}: error: {' '.join(message.split())}", file=sys.stderr)
        return 2


MPLICITS = Program("mplicits", COMMANDS, OVERVIEW, MOVED)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command of ``mplicits``; see `Program.main`."""
    return MPLICITS.main(argv)
