"""Damaged files, one after the other, in a process that may die of them: `python tests/fuzz/hunt.py --minutes 30`.

Prints a table. What is neither read nor refused in one line is kept in `tests/fuzz/found`, for the tests to replay.
"""

import argparse
import contextlib
import faulthandler
import io
import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from corpus import Specimen, specimens
from mplicits.neural_fields import InputError

SECONDS = 20
IDLE = 10  # times as long where nothing is done
SPARE = 256 << 20  # bytes that reading may take, beside three times the file
LONGEST_LINE = 700
BAD = ("traceback", "hang", "memory", "vague", "noise", "died")


class Outcome(NamedTuple):
    """What became of one case: "read", "refused", or one of `BAD`; and what was said."""

    number: int
    specimen: str
    kind: str
    said: str


class _Hang(BaseException):
    """Nothing that a reader could catch as an error of its own."""


def case(found: list[Specimen], seed: int, number: int) -> tuple[Specimen, bytes]:
    """The specimen of a case and its damaged bytes: always the same of the same numbers."""
    chance = random.Random(f"{seed}/{number}")
    specimen = found[number % len(found)]
    return specimen, specimen.damage(specimen.data, chance)


def outcome_of(number: int, specimen: Specimen, data: bytes, folder: Path) -> Outcome:
    """Write the file and what lies beside it, read it, and look at what is said, on every channel."""
    path = folder / specimen.name
    for name, content in {**specimen.beside, specimen.name: data}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    said = io.StringIO()
    kind, text = "read", ""
    try:
        with _stderr_of_all(folder / "stderr") as noise, contextlib.redirect_stdout(said), _limits(len(data)):
            try:
                specimen.read(path)
            except InputError as error:
                kind, text = "refused", str(error)
            except MemoryError:
                kind, text = "memory", traceback.format_exc()
            except Exception:  # what a user would see as a traceback
                kind, text = "traceback", traceback.format_exc()
    except _Hang:  # outside of the block too: the signal may come as reading ends
        return Outcome(number, specimen.name, "hang", traceback.format_exc())
    if kind == "refused" and ("\n" in text or len(text) > LONGEST_LINE or str(folder) not in text):
        kind = "vague"
    if kind in ("read", "refused") and (noise() or said.getvalue()):
        kind, text = "noise", noise() or said.getvalue()
    return Outcome(number, specimen.name, kind, text)


@contextlib.contextmanager
def _limits(size: int) -> Iterator[None]:
    """Limits on the seconds and the memory of the block."""

    def stop(*_: object) -> None:
        raise _Hang

    before = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + SPARE + 3 * size, before[1]))
    # Of work; and more by the clock, which goes on while the machine does other things, and begins anew after a pause.
    signal.signal(signal.SIGCONT, lambda *_: signal.setitimer(signal.ITIMER_REAL, IDLE * SECONDS))
    handlers = [(number, signal.signal(number, stop)) for number in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, IDLE * SECONDS)
    try:
        yield
    finally:
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
            signal.setitimer(timer, 0)
        for number, handler in [*handlers, (signal.SIGCONT, signal.SIG_DFL)]:
            signal.signal(number, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextlib.contextmanager
def _stderr_of_all(file: Path) -> Iterator[object]:
    """What Python and every library write to stderr meanwhile, as a function."""
    sys.stderr.flush()
    kept, target = os.dup(2), os.open(file, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(target, 2)
    try:
        yield lambda: (sys.stderr.flush(), file.read_text(errors="replace"))[1]
    finally:
        sys.stderr.flush()
        os.dup2(kept, 2)
        os.close(kept)
        os.close(target)


def _work(channel: Connection, seed: int, numbers: range) -> None:
    import warnings

    warnings.simplefilter("default")  # a user sees them
    faulthandler.enable()
    found = specimens()
    with TemporaryDirectory() as place:
        for number in numbers:
            folder = Path(place) / f"{number}"
            folder.mkdir()
            channel.send(number)
            channel.send(outcome_of(number, *case(found, seed, number), folder))
            shutil.rmtree(folder)
    channel.send(None)


def hunt(seed: int, numbers: range) -> Iterator[Outcome]:
    """The outcomes of the cases with these numbers; where reading kills the process, the next one goes on."""
    context = multiprocessing.get_context("spawn")
    names = [specimen.name for specimen in specimens()]
    while len(numbers):
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(theirs, seed, numbers), daemon=True)
        process.start()
        theirs.close()
        at: int | None = None
        while True:
            try:
                if not ours.poll(600 if at is None else 2 * IDLE * SECONDS):
                    process.kill()
                    raise EOFError
                told = ours.recv()
            except EOFError:
                process.join()
                assert at is not None, f"the process ended before its first case ({process.exitcode})"
                yield Outcome(at, names[at % len(names)], "died", f"exit code {process.exitcode}")
                numbers = range(at + 1, numbers.stop)
                break
            if told is None:
                process.join()
                return
            if isinstance(told, int):
                at = told
            else:
                yield told


def main() -> int:
    parser = argparse.ArgumentParser(description="Read damaged files, and say what became of them.")
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--keep", type=Path, default=Path(__file__).parent / "found")
    arguments = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    end, start, bad = time.monotonic() + 60 * arguments.minutes, 0, 0
    found = specimens()
    while time.monotonic() < end:
        for outcome in hunt(arguments.seed, range(start, start + 1000)):
            counts[outcome.specimen.rsplit("/", 1)[-1], outcome.kind] += 1
            if outcome.kind in BAD:
                bad += 1
                name = f"{arguments.seed}-{outcome.number}"
                print(f"{outcome.kind}: {outcome.specimen}, case {name}: {outcome.said.strip()[-200:]!r}")
                arguments.keep.mkdir(parents=True, exist_ok=True)
                specimen, data = case(found, arguments.seed, outcome.number)
                facts = {"name": specimen.name, "said": outcome.said[-2000:]}
                (arguments.keep / f"{name}.json").write_text(json.dumps(facts))
                (arguments.keep / f"{name}.bin").write_bytes(data)
        start += 1000
    kinds = ("read", "refused", *BAD)
    print("file".ljust(24), *(kind.rjust(10) for kind in kinds))
    for name in sorted({name for name, _ in counts}):
        print(name.ljust(24), *(f"{counts[name, kind]:10,}" for kind in kinds))
    print("all".ljust(24), *(f"{sum(counts[n, kind] for n, k in counts if k == kind):10,}" for kind in kinds))
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
