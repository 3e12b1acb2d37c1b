"""Access control of a local server, which every user and every visited page of a machine could reach.

Each request is checked by its Host header, its Origin header and its token.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections.abc import Mapping
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

# No other page frames one of ours, caches it or learns its address.
HEADERS: Mapping[str, str] = {
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Cache-Control": "no-store",
}
ASKING = """<!doctype html><meta charset="utf-8"><title>mplicits</title>
<body style="font: 16px sans-serif; margin: 20vh auto; max-width: 30em">
<p>Open the address that the command has printed, or give its token:</p>
<form><input name="token" size="24" autofocus autocomplete="off"> <button>Open</button></form>
"""


class Verdict(NamedTuple):
    """The decision about a request: 200 admits it, any other status and the body answer it; headers are always sent."""

    status: HTTPStatus
    body: str
    headers: Mapping[str, str]

    @property
    def admitted(self) -> bool:
        """Whether the request is let in."""
        return self.status == HTTPStatus.OK


class Gate:
    """The checks of one server, by its address, its port and its token, which is random if it is None."""

    def __init__(self, host: str, port: int, token: str | None = None) -> None:
        self.host, self.port, self.token = host, port, token or secrets.token_urlsafe(18)
        self._name = f"mplicits-{port}"  # browsers keep cookies by host, whatever the port

    @property
    def url(self) -> str:
        """The address for a browser on this machine."""
        local = "127.0.0.1" if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://{f'[{local}]' if ':' in local else local}:{self.port}/?token={self.token}"

    def admit(self, path: str, headers: Mapping[str, str]) -> Verdict:
        """Decide about a request by its path, with query, and its headers.

        A token in the address is answered with a cookie, which the page's own requests send.
        """
        host, origin = headers.get("Host", ""), headers.get("Origin")
        if _is_loopback(self.host) and not _is_loopback(_name_of(host)):
            return _refused(HTTPStatus.MISDIRECTED_REQUEST, "This server answers to names of its own machine only.\n")
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return _refused(HTTPStatus.FORBIDDEN, "This server answers to its own page only.\n")
        if self._is_token(parse_qs(urlsplit(path).query).get("token", [""])[0]):
            cookie = f"{self._name}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return Verdict(HTTPStatus.OK, "", {**HEADERS, "Set-Cookie": cookie})
        if self._is_token(self._kept(headers.get("Cookie", ""))):
            return Verdict(HTTPStatus.OK, "", HEADERS)
        return _refused(HTTPStatus.FORBIDDEN, ASKING)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())  # in the same time for all

    def _kept(self, cookies: str) -> str:
        try:
            kept = SimpleCookie(cookies).get(self._name)
        except CookieError:
            return ""
        return "" if kept is None else kept.value


def _refused(status: HTTPStatus, body: str) -> Verdict:
    kind = "text/html; charset=utf-8" if body.startswith("<") else "text/plain; charset=utf-8"
    return Verdict(status, body, {**HEADERS, "Content-Type": kind})


def _name_of(host: str) -> str:
    """The name in a Host header, without port and brackets; tunnels change the port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _is_loopback(host: str) -> bool:
    if host.rstrip(".").lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
