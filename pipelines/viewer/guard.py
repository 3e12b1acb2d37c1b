"""What may come in through the viewer's WebSocket: from whom, what, how much of it and how often.

viser believes its clients: any page may connect, any attribute of a control may be set to anything, and whatever does
not fit ends in a traceback. So every handshake passes a `Gate`, and every message is looked at before viser sees it:
those of kinds that no browser of ours sends are dropped, and a client that sends too much or what is out of bounds is
disconnected.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from http import HTTPStatus
from typing import Any
from unittest import mock

from ...neural_fields import InputError
from .gate import Gate, Verdict

__all__ = ["MOST_CLIENTS", "Meter", "connection_of_this_task", "fits", "guarded"]

MOST_CLIENTS = 64
# A camera that is moved, and a slider beside it, send at the rate of the screen.
RATE, BURST = 240.0, 480.0
CLICK_RATE, CLICK_BURST = 10.0, 20.0
LARGEST = 1 << 14  # bytes of a message
LARGEST_PICTURE = 1 << 25  # of one that was asked for
FARTHEST = 1e6  # coordinates, in units of the scene, which is a sphere of radius 1
LONGEST = 256  # letters
WIDEST = 1 << 14  # pixels of a window

_connection: ContextVar[Any] = ContextVar("connection", default=None)
_patching = threading.Lock()


class Meter:
    """So many a second, and a burst of so many; what is not used is kept up to that burst.

    Args:
        rate: a second.
        burst: at most at once.
        clock: seconds.
    """

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._left, self._then = burst, clock()

    def take(self) -> bool:
        """Take one, if one is left."""
        now = self._clock()
        self._left = min(self._burst, self._left + (now - self._then) * self._rate)
        self._then = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


def _is_number(value: object, most: float = FARTHEST) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= most  # not NaN


def _is_vector(value: object, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(_is_number, value))


def _is_camera(message: Mapping[str, Any]) -> bool:
    size = (message.get("image_width"), message.get("image_height"))
    turned = message.get("wxyz")
    return (
        all(_is_vector(message.get(name), 3) for name in ("position", "look_at", "up_direction"))
        and _is_vector(turned, 4)
        and math.hypot(*turned) > 1e-3  # pyright: ignore[reportOptionalIterable]
        and _is_number(message.get("fov"), math.pi)
        and message["fov"] > 1e-3
        and all(_is_number(message.get(name), math.inf) for name in ("near", "far"))
        and all(isinstance(pixels, int) and 0 <= pixels <= WIDEST for pixels in size)
    )


def _is_control(message: Mapping[str, Any]) -> bool:
    updates = message.get("updates")
    if not isinstance(message.get("uuid"), str) or not isinstance(updates, dict) or set(updates) != {"value"}:
        return False
    value = updates["value"]
    return isinstance(value, bool) or _is_number(value) or (isinstance(value, str) and len(value) <= LONGEST)


def _is_click(message: Mapping[str, Any]) -> bool:
    places = message.get("screen_pos")
    return (
        message.get("event_type") == "click"
        and all(_is_vector(message.get(name), 3) for name in ("ray_origin", "ray_direction"))
        and math.hypot(*message["ray_direction"]) > 1e-3
        and isinstance(places, list)
        and len(places) <= 2
        and all(_is_vector(place, 2) for place in places)
    )


def _is_picture(message: Mapping[str, Any]) -> bool:
    return isinstance(message.get("payload"), bytes) and isinstance(message.get("render_uuid"), str)


# What the page of the viewer sends; all else that viser knows of is for controls that it has not.
KNOWN: Mapping[str, Callable[[Mapping[str, Any]], bool]] = {
    "ViewerCameraMessage": _is_camera,
    "GuiUpdateMessage": _is_control,
    "ScenePointerMessage": _is_click,
    "GetRenderResponseMessage": _is_picture,
}


def fits(message: object) -> bool | None:
    """Whether a decoded message of a client is within its bounds; None for one that is of no use here."""
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        return False
    check = KNOWN.get(message["type"])
    return None if check is None else check(message)


def connection_of_this_task() -> Any:
    """The guarded connection whose message is being handled; None outside of any."""
    return _connection.get()


@contextmanager
def guarded(gate: Gate) -> Iterator[None]:
    """A block in which a `viser.ViserServer` is made, whose clients shall pass the gate and keep to the bounds.

    viser has no place for such checks; the server of websockets has, and viser starts that one.

    Raises:
        InputError: viser did not start it in a way that we know, so that nothing would be checked.
    """
    import websockets.asyncio.server as websockets

    begin, begun = websockets.serve, []
    live: set[Any] = set()

    def serve(handler: Callable[[Any], Awaitable[None]], host: str, port: int, **options: Any) -> Any:
        begun.append(port)
        answer = options.get("process_request")

        async def handle(connection: Any) -> None:
            live.add(connection)
            _connection.set(connection)
            # What a client sent that no check here foresaw is no news for the terminal.
            asyncio.get_running_loop().set_exception_handler(lambda _loop, _context: None)
            try:
                await handler(connection)
            finally:
                live.discard(connection)

        def process(connection: Any, request: Any) -> Any:
            verdict = gate.admit(request.path, request.headers)
            shakes_hands = "websocket" in request.headers.get("Upgrade", "").lower()
            if verdict.admitted and shakes_hands and len(live) >= MOST_CLIENTS:
                verdict = Verdict(HTTPStatus.SERVICE_UNAVAILABLE, "Too many browsers look at this already.\n", {})
            if not verdict.admitted:
                response = connection.respond(verdict.status, verdict.body)
            elif answer is None or (response := answer(connection, request)) is None:
                return None
            for name, text in verdict.headers.items():
                if name in response.headers:
                    del response.headers[name]
                response.headers[name] = text
            return response

        ours = {
            "process_request": process,
            "create_connection": _guarded_connection(),
            "max_size": LARGEST,
            "max_queue": 8,
            "close_timeout": 1.0,  # those who were cut off seldom say goodbye
            "logger": _silent_logger(),
        }
        return begin(handle, host, port, **{**options, **ours})

    with _patching, mock.patch.object(websockets, "serve", serve):
        yield
    if not begun:
        raise InputError("the viewer does not know this viser, so it cannot keep others out; pip install viser==1.1.1")


def _guarded_connection() -> Any:
    """A connection of websockets that hands on only what fits."""
    import msgspec
    from websockets.asyncio.server import ServerConnection
    from websockets.protocol import State

    class Guarded(ServerConnection):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self._meter, self._clicks = Meter(RATE, BURST), Meter(CLICK_RATE, CLICK_BURST)

        @property
        def has_left(self) -> bool:
            """Whether the browser has gone, or is being cut off; viser hears of it a little later."""
            return self.state is not State.OPEN

        @contextmanager
        def awaiting_picture(self) -> Iterator[None]:
            """A block that waits for a picture, which may be larger than other messages."""
            name = "max_message_size" if hasattr(self.protocol, "max_message_size") else "max_size"  # before 16
            before = getattr(self.protocol, name)
            setattr(self.protocol, name, LARGEST_PICTURE)
            try:
                yield
            finally:
                setattr(self.protocol, name, before)

        async def recv(self, decode: bool | None = None) -> Any:
            while True:
                raw = await super().recv(decode)  # raises, once the connection is closed
                if not self._meter.take():
                    await self.close(1008, "too many messages")
                    continue
                try:
                    message = msgspec.msgpack.decode(raw) if isinstance(raw, bytes) else None
                except (msgspec.MsgspecError, ValueError, RecursionError):
                    message = None
                fitting = fits(message)
                if fitting is False:
                    await self.close(1008, "not a message of this page")
                elif fitting and (message["type"] != "ScenePointerMessage" or self._clicks.take()):  # pyright: ignore
                    return raw

    return Guarded


def _silent_logger() -> logging.Logger:
    """Where websockets says what clients did wrong: nowhere."""
    logger = logging.getLogger("mplicits.viewer")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger
