"""A page on this machine, and each new version of what it shows: ``mplicits view``, ``fit --watch`` and ``show()``.

The browser draws. The server sends the page, and events that name the newest field, which the page then fetches.

Every user and every visited page of a machine could reach the server. So all paths begin with a random token, which
only the printed address contains. No cookie is set, so another page's requests carry no rights.
"""

from __future__ import annotations

import errno
import hmac
import json
import secrets
import socket
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import Any
from urllib.parse import urlsplit

from ...neural_fields import InputError
from .assembly import field_file, fill_page
from .export import Packed

PORTS = range(8080, 8180)  # the first free one is taken
# No other page frames one of ours, caches it or learns its address.
HEADERS = {
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Cache-Control": "no-store",
}


class PageServer(AbstractContextManager["PageServer"]):
    """Serves what ``pack`` makes until it is closed, as a context manager; only under the secret path of its `url`.

    It listens at the address ``host``, on the ``port`` or on the first free one from 8080 upwards. ``keep`` is called
    with the JSON that the page posts to ``/landmarks``; None refuses it.

    Raises:
        InputError: what ``pack`` raises, or the address or the port cannot be had.
    """

    def __init__(
        self,
        pack: Callable[[], Packed],
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        keep: Callable[[Any], None] | None = None,
    ) -> None:
        self._pack, self.packed, self.keep = pack, pack(), keep
        self.clients: set[object] = set()
        self.closed = threading.Event()
        self.host, self.root = host, f"/{secrets.token_urlsafe(18)}/"
        self._server = _listen(host, port, self)
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """What a browser on this machine opens."""
        local = "127.0.0.1" if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://{f'[{local}]' if ':' in local else local}:{self.port}{self.root}"

    @property
    def num_clients(self) -> int:
        """The number of browsers that are connected."""
        return len(self.clients)

    def update(self) -> None:
        """Show the newest version to all browsers, from the same point of view; raises what ``pack`` raises."""
        self.packed = self._pack()

    def close(self) -> None:
        """Stop serving."""
        self.closed.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.close()


class _Server(ThreadingTCPServer):
    """The sockets of a `PageServer`, a thread for each request."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, address: tuple[Any, ...], family: int, page: PageServer) -> None:
        self.address_family, self.page = family, page
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that went away."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    timeout = 10  # seconds that a client may take to ask, or to read

    def do_GET(self) -> None:
        path, (header, data, _) = self._admitted(), self._page.packed
        if path == "":
            self._send(HTTPStatus.OK, fill_page(header, data, live=True).encode(), "text/html; charset=utf-8")
        elif path == "field.bin":
            self._send(HTTPStatus.OK, field_file(header, data), "application/octet-stream")
        elif path == "live":
            self._live(self._page)
        elif path is not None:
            self._refuse(HTTPStatus.NOT_FOUND, "There is nothing here.")

    def do_POST(self) -> None:
        keep = self._page.keep
        if (path := self._admitted()) is None:
            return
        length = self.headers.get("Content-Length", "")
        if path != "landmarks" or keep is None:
            self._refuse(HTTPStatus.NOT_FOUND, "There is nothing here.")
        elif not length.isdecimal() or int(length) > 1 << 20:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "Expected at most a megabyte.")
        else:
            try:
                keep(json.loads(self.rfile.read(int(length))))
            except ValueError as error:  # an InputError, too
                self._refuse(HTTPStatus.BAD_REQUEST, str(error))
            else:
                self._send(HTTPStatus.OK, b"", "text/plain")

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    @property
    def _page(self) -> PageServer:
        assert isinstance(self.server, _Server)
        return self.server.page

    def _admitted(self) -> str | None:
        """The path of the request below the secret one; None if it was refused."""
        path, root = urlsplit(self.path).path, self._page.root
        # In the same time for all, so that the token cannot be guessed letter by letter.
        if hmac.compare_digest(path[: len(root)].encode("utf-8", "replace"), root.encode()):
            return path[len(root) :]
        self._refuse(HTTPStatus.FORBIDDEN, "Open the whole address that the command has printed.")
        return None

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        self._send(status, f"{text}\n".encode(), "text/plain; charset=utf-8")

    def _send(self, status: HTTPStatus, body: bytes | None, kind: str) -> None:
        self.send_response(status)
        for name, text in (HEADERS | {"Content-Type": kind}).items():
            self.send_header(name, text)
        if body is not None:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body or b"")

    def _live(self, page: PageServer) -> None:
        """Name each new field by its checksum until the browser or the server is gone."""
        if page.num_clients >= 64:
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, "Too many browsers look at this already.")
            return
        self._send(HTTPStatus.OK, None, "text/event-stream")
        told = None
        page.clients.add(self)
        try:
            while not page.closed.wait(0.25):
                newest = page.packed.header["crc32"]
                # A comment shows whether the browser is still there.
                self.wfile.write(b": \n\n" if newest == told else f"data: {newest}\n\n".encode())
                told = newest
        except OSError:
            pass  # the browser is gone
        finally:
            page.clients.discard(self)


def _listen(host: str, port: int | None, page: PageServer) -> _Server:
    for candidate in PORTS if port is None else (port,):
        try:
            found = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
            return _Server(found[4], found[0], page)
        except OSError as error:
            if error.errno == errno.EADDRINUSE and port is None:
                continue
            if error.errno == errno.EADDRINUSE:
                raise InputError(f"--port {port}: is in use; leave out --port to take a free one") from error
            if error.errno == errno.EACCES:
                raise InputError(f"--port {port}: may not be used; take one above 1023") from error
            said = error.strerror or error
            raise InputError(f"--host {host}: cannot listen there ({said}); try 127.0.0.1") from error
    raise InputError(f"no port from {PORTS[0]} to {PORTS[-1]} is free; name one with --port")
