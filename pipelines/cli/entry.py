"""The command line: ``mplicits COMMAND …``.

Bad input is one line on stderr and exit code 2; Ctrl-C is 130. torch is loaded by the command that needs
it, never for help or for a mistake in the arguments.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

from ..run.config import closest
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

GROUP = """usage: {program} {name} COMMAND [arguments]

commands:
{commands}

`{program} {name} COMMAND --help` says more about each."""
HELP = ("-h", "--help")


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
        known = set(re.findall(r"--[a-z][\w-]*", self.format_help()))
        for argument in arguments:
            if argument == "--":
                return
            flag = argument.split("=", 1)[0]
            if flag.startswith("--") and flag not in known:
                self.error(f"unknown flag {flag}{closest(flag, known)}")


@dataclass(frozen=True)
class Program:
    """A table of commands with its own name on the command line.

    Attributes:
        name: what is typed before a command.
        commands: by name.
        overview: what ``--help`` prints; ``{commands}`` is replaced by the list of commands.
    """

    name: str
    commands: Mapping[str, Command]
    overview: str

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
            print(self.overview.format(commands=self._listed(self.commands)))
            return 0 if arguments else 2
        group = self._group(arguments[0])
        if group and (len(arguments) < 2 or arguments[1] in HELP):
            print(GROUP.format(program=self.name, name=arguments[0], commands=self._listed(group)))
            return 0 if len(arguments) > 1 else 2
        if arguments[0] == "--version":
            from importlib.metadata import version  # late, as all that --help can do without

            print(f"mplicits {version('mplicits')}")
            return 0
        name, rest = self._choose(arguments)
        parser = self.parser(name)
        if not {*HELP} & set(rest):
            parser.check_flags(rest)
        given = parser.parse_args(rest)
        check_output(getattr(given, "json", None), (".json",))
        given.words = [*self.name.split(), *arguments]  # as they were typed, for pages of results
        code = self.commands[name].run(given)
        sys.stdout.flush()
        return code

    def _group(self, first: str) -> list[str]:
        """The commands of two words that begin with this one."""
        return [name for name in self.commands if name.startswith(f"{first} ")]

    def _listed(self, names: Collection[str]) -> str:
        """A line for each command, with what it does."""
        width = max(map(len, names))
        return "\n".join(f"  {name:<{width}}  {self.commands[name].summary}" for name in names)

    def _choose(self, arguments: list[str]) -> tuple[str, list[str]]:
        """The command that the first word names, or with ``bench`` the first two, and the other words."""
        for words in (2, 1):
            name = " ".join(arguments[:words])
            if name in self.commands:
                return name, arguments[words:]
        first = {name.split()[0] for name in self.commands}
        if arguments[0] in first:
            known = [name.split()[1] for name in self._group(arguments[0])]
            raise _UsageError(f"{arguments[0]}: unknown command {arguments[1]!r}{closest(arguments[1], known)}")
        raise _UsageError(f"unknown command {arguments[0]!r}{closest(arguments[0], first)}")

    def _fail(self, message: str) -> int:
        print(f"{self._short}: error: {' '.join(message.split())}", file=sys.stderr)
        return 2


MPLICITS = Program("mplicits", COMMANDS, OVERVIEW)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command of ``mplicits``; see `Program.main`."""
    return MPLICITS.main(argv)
