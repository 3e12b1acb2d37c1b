"""Damage: what happens to files on the way, and what somebody might do to them on purpose."""

import json
import random
import re
import struct
from typing import Any

NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORDS = (
    *(b"0", b"-1", b"2147483647", b"-2147483648", b"4294967295", b"9223372036854775807", b"1" + b"0" * 30),
    *(b"nan", b"inf", b"-inf", b"1e200", b"1e307", b"-1e308", b"1e-310", b"1e999", b"1.5", b"0x10", b"1_0"),
    *(b"", b"-", b"\xff\xfe", "½".encode(), b"\x00", b"9" * 400, b"[" * 5000, b"{" * 5000, b'"', b"null", b"../../x"),
)
INTEGERS = (0, 1, 2, 3, 255, 256, 65535, 2**27, 2**31 - 1, 2**31, 2**32 - 1)
LONG_INTEGERS = (0, 2**31, 2**40, 2**62, 2**63 - 1, 2**64 - 1)
FLOATS = (0.0, -0.0, 1e200, 1e307, 1.7e308, 1e-310, float("nan"), float("inf"), float("-inf"), -1.0)
STRUCTS = (
    *(("B", (0, 1, 127, 128, 255)), ("H", (0, 1, 2**15, 2**16 - 1))),
    *(("I", INTEGERS), ("Q", LONG_INTEGERS), ("d", FLOATS)),
)
VALUES: tuple[Any, ...] = (
    *(None, True, "", "x", "\u0000", "../../etc", [], {}, [[]], 0, -1, 1, 2.5, 10**6, 10**12, 2**63, 10**30, -(10**30)),
    *(1e-320, 1e30, 1e200, 1e308, float("nan"), float("inf"), [1e308] * 3, list(range(50)), {"a": {"b": []}}),
)


def damaged(data: bytes, chance: random.Random) -> bytes:
    """One to three damages of a file's bytes."""
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        data = chance.choice(DAMAGES)(data, chance)
    return data


def damaged_json(value: Any, chance: random.Random) -> Any:
    """The value with one of its parts, at any depth, replaced by another value or left out."""
    paths = list(_paths(value))
    path = chance.choice(paths)
    if not path:
        return chance.choice(VALUES)
    copy = json.loads(json.dumps(value))
    parent = copy
    for key in path[:-1]:
        parent = parent[key]
    if chance.random() < 0.15:
        del parent[path[-1]]
    else:
        parent[path[-1]] = chance.choice(VALUES)
    return copy


def _paths(value: Any, path: tuple[Any, ...] = ()) -> Any:
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value[:4]) if isinstance(value, list) else ()
    for key, part in items:
        yield from _paths(part, (*path, key))


def _cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def _flip(data: bytes, chance: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.choice((1, 4, 64))):
        if changed:
            changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


def _overwrite(data: bytes, chance: random.Random) -> bytes:
    """A whole number or a floating-point number that is more than anybody expects."""
    order = chance.choice("<>")
    kind, values = chance.choice(STRUCTS)
    word = struct.pack(order + kind, chance.choice(values))
    # Heads are short and bodies long: half of the damage goes to the first bytes.
    reach = len(data) if chance.random() < 0.5 else min(len(data), 512)
    at = chance.randrange(reach + 1)
    return data[:at] + word + data[at + len(word) :]


def _remove(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + data[at + chance.choice((1, 4, 100)) :]


def _repeat(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + data[at : at + chance.choice((1, 16, 200))] * chance.choice((2, 5)) + data[at:]


def _number(data: bytes, chance: random.Random) -> bytes:
    """Another word in the place of a number of a text, the head of a binary file included."""
    found = list(NUMBER.finditer(data[: 1 << 16]))
    if not found:
        return _overwrite(data, chance)
    place = chance.choice(found)
    return data[: place.start()] + chance.choice(WORDS) + data[place.end() :]


def _line(data: bytes, chance: random.Random) -> bytes:
    lines = data.split(b"\n")
    i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
    match chance.randrange(3):
        case 0:
            lines[i], lines[j] = lines[j], lines[i]
        case 1:
            lines.insert(i, lines[j])
        case _:
            del lines[i]
    return b"\n".join(lines)


DAMAGES = (_cut, _flip, _overwrite, _overwrite, _remove, _repeat, _number, _number, _line)
