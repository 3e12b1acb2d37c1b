"""What a hostile browser sends to the viewer, for tests and for `tests/clients.py`."""

import math
import random
from collections.abc import Sequence
from typing import Any

import msgspec

__all__ = ["CAMERA", "hello", "hostile_messages"]

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": [0.0, 0.0, 1.0, 0.0],
    "position": [0.0, 0.0, 3.0],
    "fov": 0.6,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 64,
    "image_width": 80,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 1.0, 0.0],
}


def hello(position: Sequence[float] = (0.0, 0.0, 3.0)) -> bytes:
    """A camera in its bounds."""
    return msgspec.msgpack.encode(CAMERA | {"position": list(position)})


def hostile_messages() -> list[bytes]:
    """One of each kind that must be turned away, all of them ends of a connection."""
    control = {"type": "GuiUpdateMessage", "uuid": "x"}
    click = {"type": "ScenePointerMessage", "event_type": "click", "screen_pos": [], "modifier": None}
    messages: list[Any] = [
        *(CAMERA | {"fov": value} for value in (math.nan, 0.0, -1.0, 1e9, "x", None, [1])),
        *(CAMERA | {"position": value} for value in ([math.nan] * 3, [1e308] * 3, [], "abc", None, [[0]] * 3)),
        CAMERA | {"wxyz": [0.0] * 4},
        *(CAMERA | {"image_width": value} for value in (2**40, -5, 2.5, math.inf, "9")),
        {"type": "ViewerCameraMessage"},
        control | {"updates": {"removed": True}},
        control | {"updates": {"update_cb": [1]}},
        control | {"updates": {"value": "a" * 5000}},
        control | {"updates": {"value": math.nan}},
        control | {"updates": {"value": 1e300}},
        control | {"updates": {"value": [[1]] * 100}},
        control | {"updates": 7},
        {"type": "GuiUpdateMessage", "uuid": 3, "updates": {"value": 1}},
        click | {"ray_origin": [math.nan] * 3, "ray_direction": [0, 0, 1]},
        click | {"ray_origin": [0, 0, 3], "ray_direction": [0, 0, 0]},
        click | {"ray_origin": None, "ray_direction": None},
        {"type": "GetRenderResponseMessage", "payload": 1, "render_uuid": "x"},
        {"type": 5},
        {},
        [],
        None,
        7,
        "text",
    ]
    nested: Any = 1
    for _ in range(400):
        nested = [nested]
    raw = [msgspec.msgpack.encode(message) for message in [*messages, nested]]
    raw += [b"", b"\xc1", b"\xdd\xff\xff\xff\xff", b"\x91" * 10_000, bytes(range(256)), random.randbytes(3000)]
    return [*raw, msgspec.msgpack.encode(CAMERA | {"more": b"x" * (1 << 20)})]
