"""Fifty browsers look at a viewer, forty of them hostile: `make clients MINUTES=10`.

The viewer is a process of its own. Ten clients move their cameras, and wait for an image of each position; the others
send damaged messages, floods, large messages, messages of other pages and without the token, connect and leave at once,
read nothing, or press every button that they can name. At the end: how many images each of the ten got and how long it
waited for them, and the viewer's memory. Exit code 1 if one of the ten got none for a minute, if memory grew by more
than 64 MB from one half to the other, or if the viewer said anything on stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import random
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import viser
import zstandard
from hostile import hello, hostile_messages
from mplicits.neural_fields import Siren, save_field
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

GOOD, HOSTILE = 10, 40
PROTOCOL = [Subprotocol(f"viser-v{viser.__version__}")]
LONGEST = 60.0  # seconds that one of the good may wait for an image
GROWTH = 64.0  # MB
UUID = re.compile(rb"[0-9a-f]{8}-[0-9a-f-]{27}")


def unpacked(raw: bytes | str) -> bytes:
    """What viser sends, decompressed, without arrays."""
    assert isinstance(raw, bytes)
    return zstandard.ZstdDecompressor().decompress(raw[16 : 16 + int.from_bytes(raw[8:16], "little")])


def position(chance: random.Random) -> list[float]:
    """Somewhere around the shape."""
    return [chance.uniform(-0.3, 0.3), chance.uniform(-0.3, 0.3), chance.uniform(2.5, 3.5)]


async def good(address: str, seed: int, until: float) -> list[float]:
    """Move the camera, wait for an image, again → seconds that each took."""
    chance, waits = random.Random(seed), []
    async with connect(
        address, subprotocols=PROTOCOL, max_size=None, open_timeout=LONGEST, ping_interval=None
    ) as socket:
        while time.monotonic() < until:
            await socket.send(hello(position(chance)))
            begun = time.monotonic()
            with contextlib.suppress(asyncio.TimeoutError):
                async with asyncio.timeout(LONGEST):
                    while b"BackgroundImageMessage" not in unpacked(await socket.recv()):
                        pass
            waits.append(time.monotonic() - begun)
            await asyncio.sleep(chance.uniform(0.1, 1.0))
    return waits


async def hostile(address: str, seed: int, until: float, attacks: list[int]) -> None:
    """One attack after the other, each on a new connection."""
    chance, messages = random.Random(seed), hostile_messages()
    while time.monotonic() < until:
        attack = chance.choice((_message, _flood, _silent, _churn, _stranger, _buttons, _large))
        with contextlib.suppress(WebSocketException, OSError, asyncio.TimeoutError):
            async with asyncio.timeout(20):
                try:
                    await attack(address, chance, messages)
                except AttributeError as error:  # how websockets' client closes what the server has cut off already
                    if "call_soon" not in str(error):
                        raise
        attacks[0] += 1
        await asyncio.sleep(chance.uniform(0.0, 0.5))


async def _message(address: str, chance: random.Random, messages: list[bytes]) -> None:
    async with connect(address, subprotocols=PROTOCOL, max_size=None) as socket:
        await socket.send(hello(position(chance)))
        await socket.send(chance.choice(messages))
        await socket.wait_closed()


async def _flood(address: str, chance: random.Random, _: list[bytes]) -> None:
    async with connect(address, subprotocols=PROTOCOL, max_size=None) as socket:
        for _ in range(5000):
            await socket.send(hello(position(chance)))


async def _silent(address: str, chance: random.Random, _: list[bytes]) -> None:
    """Asks all the time, and reads nothing."""
    async with connect(address, subprotocols=PROTOCOL, max_size=None, max_queue=1) as socket:
        for _ in range(100):
            await socket.send(hello(position(chance)))
            await asyncio.sleep(0.1)


async def _churn(address: str, chance: random.Random, _: list[bytes]) -> None:
    for _ in range(10):
        async with connect(address, subprotocols=PROTOCOL, max_size=None) as socket:
            await socket.send(hello(position(chance)))


async def _stranger(address: str, chance: random.Random, _: list[bytes]) -> None:
    """Another page, or nobody who was told the address."""
    wrong = [(address, "http://evil.example"), (address.partition("?")[0], None), (f"{address}x", None)]
    where, origin = chance.choice(wrong)
    async with connect(where, subprotocols=PROTOCOL, origin=origin):  # pyright: ignore[reportArgumentType]
        raise AssertionError("was let in")


async def _buttons(address: str, chance: random.Random, _: list[bytes]) -> None:
    """Every control that the viewer has told of, set to whatever passes its bounds."""
    import msgspec

    async with connect(address, subprotocols=PROTOCOL, max_size=None) as socket:
        await socket.send(hello(position(chance)))
        known: set[bytes] = set()
        for _ in range(40):
            with contextlib.suppress(asyncio.TimeoutError):
                async with asyncio.timeout(0.1):
                    known |= set(UUID.findall(unpacked(await socket.recv())))
            for uuid in chance.sample(sorted(known), min(3, len(known))):
                value = chance.choice((True, False, 0, 1, -1, 8192, 1e6, "0", "mesh", "traced", "z", "9", "", "none"))
                message = {"type": "GuiUpdateMessage", "uuid": uuid.decode(), "updates": {"value": value}}
                await socket.send(msgspec.msgpack.encode(message))


async def _large(address: str, chance: random.Random, _: list[bytes]) -> None:
    async with connect(address, subprotocols=PROTOCOL, max_size=None) as socket:
        await socket.send(chance.randbytes(30 << 20))
        await socket.wait_closed()


async def _all(address: str, minutes: float, number: int) -> tuple[list[list[float]], list[float], int]:
    """Everybody at once → waits of the good, memory of the viewer in MB, and the number of attacks."""
    until, memory, attacks = time.monotonic() + 60 * minutes, list[float](), [0]

    async def watch() -> None:
        while time.monotonic() < until:
            memory.append(_resident(number))
            await asyncio.sleep(2.0)

    async with asyncio.TaskGroup() as group:
        ours = [group.create_task(good(address, seed, until)) for seed in range(GOOD)]
        for seed in range(HOSTILE):
            group.create_task(hostile(address, 100 + seed, until, attacks))
        group.create_task(watch())
    return [task.result() for task in ours], memory, attacks[0]


def _resident(number: int) -> float:
    pages = int(Path(f"/proc/{number}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> int:
    """Start a viewer, let them all at it, and say what came of it."""
    parser = argparse.ArgumentParser(description="Fifty browsers, forty of them hostile.")
    parser.add_argument("--minutes", type=float, default=10)
    arguments = parser.parse_args()
    with TemporaryDirectory() as place:
        file = Path(place) / "field.safetensors"
        save_field(file, Siren(16, 1))
        line = [
            sys.executable,
            "-c",
            "import sys; from mplicits.pipelines.cli import main; sys.exit(main())",
            "view",
            str(file),
            "--port",
            "0",
            "--size",
            "64",
        ]
        with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as viewer:
            assert viewer.stdout is not None
            found = re.search(r"http://\S+", viewer.stdout.readline())
            assert found is not None, "the viewer did not start"
            try:
                address = found[0].replace("http", "ws")
                waits, memory, attacks = asyncio.run(_all(address, arguments.minutes, viewer.pid))
            finally:
                viewer.terminate()
                said = viewer.communicate()[1]
    half = len(memory) // 2
    growth = statistics.median(memory[half:]) - statistics.median(memory[:half])
    print(f"{attacks:,} attacks by {HOSTILE}; images of the other {GOOD}: {[len(each) for each in waits]}")
    print("median and longest wait, s:", [f"{statistics.median(each):.2f}/{max(each):.1f}" for each in waits])
    tenths = memory[:: max(1, len(memory) // 10)]
    print("memory, MB:", [round(each) for each in tenths], f"most {max(memory):.0f}; second half {growth:+.0f}")
    print(f"lines on stderr: {len(said.splitlines())}", *said.splitlines()[:5], sep="\n")
    return int(max(map(max, waits)) >= LONGEST or growth > GROWTH or bool(said))


if __name__ == "__main__":
    raise SystemExit(main())
