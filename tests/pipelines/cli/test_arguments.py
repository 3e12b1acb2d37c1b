"""Whatever is typed: exit code 2 and one line on stderr, from every command."""

import argparse
import os
import random
from pathlib import Path

import pytest
from mplicits.pipelines.cli.entry import MPLICITS, Program

from benchmarks.cli.entry import BENCHMARKS

# Those without an input that can be missing would begin to work where all their other arguments happen to be right.
NEED_NOTHING = {"doctor", "demo", "sample", "scene", "eta"}
JUNK = [
    "", " ", "-", "--", "nothing.ply", "nothing.npz", "nothing.safetensors", "nothing/", ".", "..", "/", "/dev/null",
    "a" * 300 + ".ply", "ä\u202e.obj", "x\ny.ply", "%s%n", "-1", "0", "1e400", "nan", "inf", "-inf", "1" * 400, "0x10",
    "3.5", "true", "none", "null", "1e-3", "[1,2]", "{", "auto", "$(id)", "--seed", "-o", "sphere:0.4@", "1.5.2",
]  # fmt: skip


def flags_of(program: Program, name: str) -> list[argparse.Action]:
    parser = argparse.ArgumentParser(add_help=False)
    program.commands[name].add_arguments(parser)
    return parser._actions


def line_of(program: Program, name: str, chance: random.Random) -> list[str]:
    """A command with inputs that are not there, and a few of its flags with whatever."""
    words = [name]
    for action in flags_of(program, name):
        if not action.option_strings:
            words += [chance.choice(JUNK) for _ in range(chance.randint(0, 2))]
        elif action.required or chance.random() < 0.15:
            words.append(chance.choice(action.option_strings))
            if action.nargs != 0:
                words += [chance.choice(JUNK) for _ in range(chance.choice((0, 1, 1, 1, 3)))]
    return words


WITH_INPUT = [
    pytest.param(program, name, id=f"{program.name.split()[-1]} {name}")
    for program in (MPLICITS, BENCHMARKS)
    for name in program.commands
    if name not in NEED_NOTHING and not all(action.option_strings for action in flags_of(program, name))
]


def one_line_and_2(program: Program, line: list[str], capfd) -> None:
    code = program.main(line)
    said = capfd.readouterr()
    assert (code, len(said.err.splitlines())) == (2, 1), (line, code, said.err[-2000:])
    assert said.err.startswith(f"{program.name.split()[-1]}: error: ")
    assert len(said.err) < 1500


@pytest.mark.parametrize(("program", "name"), WITH_INPUT)
def test_junk_is_refused_in_one_line(program: Program, name: str, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    chance = random.Random(name if program is MPLICITS else f"bench {name}")
    for _ in range(15):
        line = line_of(program, name, chance)
        if not {"-h", "--help"} & set(line):
            one_line_and_2(program, line, capfd)
    assert list(tmp_path.iterdir()) == []  # nothing was begun


@pytest.mark.parametrize(("program", "name"), WITH_INPUT)
def test_a_folder_that_one_may_not_enter_is_named(program: Program, name: str, tmp_path, monkeypatch, capfd):
    """As for a user who is not root: every look into it is refused."""
    closed = tmp_path / "closed"
    closed.mkdir()
    looks = {look: getattr(os, look) for look in ("stat", "open", "scandir", "listdir")}

    def refuse(look: str):
        def refused(path, *more, **options):
            if isinstance(path, str | os.PathLike) and Path(os.fsdecode(path)).parent == closed:
                raise PermissionError(13, "Permission denied", os.fspath(path))
            return looks[look](path, *more, **options)

        return refused

    for look in looks:
        monkeypatch.setattr(os, look, refuse(look))
    words = [name]
    for action in flags_of(program, name):
        if not action.option_strings:
            words += [str(closed / "scan.ply")] * (2 if action.nargs == 2 else 1)
        elif action.required:
            words += [action.option_strings[0], str(tmp_path / "out.ply")]
    one_line_and_2(program, words, capfd)
