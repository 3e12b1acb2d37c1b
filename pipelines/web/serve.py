"""``mplicits view``: the page of a run on this machine, and each new checkpoint of it by a WebSocket.

The browser draws. What is served is the page of `web_run` with one script more, and the bytes of new fields: nothing is
evaluated here but what a page needs once, and nothing that a browser says is listened to.
"""

from __future__ import annotations

import logging
import threading
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from ...neural_fields import InputError
from ..viewer.gate import Gate, Verdict
from ..viewer.server import free_port
from .assembly import field_file, fill_page
from .export import Packed, WebOptions, pack_run

__all__ = ["PageServer", "import_websockets"]

MOST_CLIENTS = 64
LARGEST = 1 << 10  # bytes of a message; there should be none
LOOK = 0.25  # seconds between looks at whether there is something new for a browser
LIVE = "/live"


class PageServer:
    """A run's page, served until it is closed; a context manager.

    Only who knows the token in its `url` is let in, and no other page than its own (`Gate`). A browser that says
    anything at all is disconnected: the page does not.

    Args:
        run: run directory or .safetensors file.
        options: what the page shows.
        host: the address to listen on.
        port: the port, or None for the first free one from 8080 upwards.

    Raises:
        NoShaderError: no shader knows this kind of field.
        InputError: there is no such run, it has no surface, websockets is not installed, or the address or the port
            cannot be had.
    """

    def __init__(
        self, run: str | Path, options: WebOptions | None = None, *, host: str = "127.0.0.1", port: int | None = None
    ) -> None:
        websockets = import_websockets()
        self._run, self._options = run, options or WebOptions()
        self._packed = pack_run(run, self._options)
        self._clients: set[Any] = set()
        self._lock = threading.Lock()
        port = free_port(host, port)
        self.gate = Gate(host, port)
        self._server = websockets.serve(
            self._tell, host, port, process_request=self._answer, max_size=LARGEST, logger=_silent_logger()
        )
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """What a browser on this machine opens."""
        return self.gate.url

    @property
    def num_clients(self) -> int:
        """How many browsers look."""
        return len(self._clients)

    @property
    def packed(self) -> Packed:
        """What is shown now."""
        return self._packed

    def update(self) -> None:
        """Show the run as it is now to all browsers, from where they stand.

        Raises:
            InputError: it is not there, or has no surface.
        """
        self._packed = pack_run(self._run, self._options)

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            client.close_socket()
        self._thread.join()

    def __enter__(self) -> PageServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer(self, connection: Any, request: Any) -> Any:
        """The answer to a request; None lets the handshake of a WebSocket go on."""
        verdict = self.gate.admit(request.path, request.headers)
        path = urlsplit(request.path).path
        shakes_hands = "websocket" in request.headers.get("Upgrade", "").lower()
        if not verdict.admitted:
            return _response(connection, verdict, verdict.body)
        if shakes_hands and path == LIVE:
            if self.num_clients < MOST_CLIENTS:
                return None
            verdict = Verdict(HTTPStatus.SERVICE_UNAVAILABLE, "", verdict.headers)
            return _response(connection, verdict, "Too many browsers look at this already.\n")
        if shakes_hands or path != "/":
            return _response(connection, Verdict(HTTPStatus.NOT_FOUND, "", verdict.headers), "There is nothing here.\n")
        header, data, _ = self._packed
        kind = {"Content-Type": "text/html; charset=utf-8"}
        verdict = verdict._replace(headers={**verdict.headers, **kind})
        return _response(connection, verdict, fill_page(header, data, live=True))

    def _tell(self, connection: Any) -> None:
        """Send a browser each field that it does not have; runs in a thread of its own."""
        from websockets.exceptions import ConnectionClosed

        had = parse_qs(urlsplit(connection.request.path).query).get("have", [""])[0]
        with self._lock:
            self._clients.add(connection)
        try:
            while True:
                packed = self._packed
                if str(packed.header["crc32"]) != had:
                    connection.send(field_file(packed.header, packed.data))
                    had = str(packed.header["crc32"])
                try:
                    connection.recv(timeout=LOOK)
                except TimeoutError:
                    continue
                connection.close(1008, "not a message of this page")
        except ConnectionClosed:
            pass
        finally:
            with self._lock:
                self._clients.discard(connection)


def import_websockets() -> Any:
    """What serves: the threads of websockets.

    Raises:
        InputError: it is not installed.
    """
    try:
        import websockets.sync.server
    except ModuleNotFoundError as error:
        raise InputError("the viewer needs websockets; pip install mplicits[view]") from error
    return websockets.sync.server


def _response(connection: Any, verdict: Verdict, body: str) -> Any:
    response = connection.respond(verdict.status, body)
    for name, text in verdict.headers.items():
        if name in response.headers:
            del response.headers[name]
        response.headers[name] = text
    return response


def _silent_logger() -> logging.Logger:
    """Where websockets says what clients did wrong: nowhere."""
    logger = logging.getLogger("mplicits.web")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger
