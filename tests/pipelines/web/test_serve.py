"""The page of a run on this machine: who gets it, and each new checkpoint, to whoever looks."""

import contextlib
import json
import re
import socket
import struct
import time
import urllib.error
import urllib.request

import pytest
from mplicits.datasets.cameras import look_at
from mplicits.neural_fields import InputError, save_field
from mplicits.pipelines.web.export import pack
from mplicits.pipelines.web.serve import PageServer
from mplicits.pipelines.web.watch import Watcher
from pages import open_page, rendered, round_field, until


def checkpoint(run, radius=0.4, levels=1):
    save_field(run / "field.safetensors", round_field(radius, levels=levels))


@pytest.fixture
def server(tmp_path):
    checkpoint(tmp_path)
    # A port of its own: browsers keep a connection ready, and would meet the server before this one.
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with PageServer(lambda: pack(tmp_path), port=port) as server:
        yield server


def asked(server, path, **headers):
    """Status, headers and body of an answer below the secret path."""
    try:
        with urllib.request.urlopen(urllib.request.Request(server.url + path, headers=headers), timeout=30) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read().decode()


@contextlib.contextmanager
def live(server):
    """The lines of events that the server sends."""
    with urllib.request.urlopen(f"{server.url}live", timeout=30) as answer:
        yield (int(line.split()[1]) for line in answer if line.startswith(b"data"))


def field_of(server):
    """The header of what the server has now."""
    with urllib.request.urlopen(f"{server.url}field.bin", timeout=30) as answer:
        message = answer.read()
    (length,) = struct.unpack_from("<I", message, len(b"mplicits-field\n"))
    return json.loads(message[19 : 19 + length])


def test_the_page_is_served_to_who_knows_the_address(server):
    status, headers, body = asked(server, "")
    assert status == 200
    assert headers["Content-Type"].startswith("text/html")
    assert headers["X-Frame-Options"] == "SAMEORIGIN"
    assert "connect-src 'self'" in body
    assert '"format":"mplicits-web"' in body
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Set-Cookie"] is None
    assert asked(server, "field.safetensors")[0] == 404


@pytest.mark.parametrize("path", ["", "live", "field.bin", "{token}x/live", "{half}/live", "%C3%A4%00%F0/", "?{token}"])
@pytest.mark.parametrize("data", [None, b"[]"])
def test_nobody_else_gets_or_changes_anything(server, path, data):
    token = server.root.strip("/")
    path = path.format(token=token, half=token[:-1])
    with pytest.raises(urllib.error.HTTPError, match="403") as refused:
        urllib.request.urlopen(f"http://127.0.0.1:{server.port}/{path}", data, timeout=30)
    assert token not in refused.value.read().decode()
    assert server.num_clients == 0


def test_addresses_are_secret_and_say_where_a_browser_finds_them(server):
    with PageServer(lambda: server.packed, host="0.0.0.0") as other:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/", other.url)
        assert other.root != server.root


def test_each_checkpoint_is_named_once_to_who_looks(tmp_path, server):
    first = server.packed.header["crc32"]
    with Watcher(tmp_path, server=server, look_every=0.01) as watcher, live(server) as events:
        assert next(events) == first
        assert field_of(server)["crc32"] == first
        checkpoint(tmp_path, levels=2)
        newest = next(events)
        assert newest == server.packed.header["crc32"] != first
        assert len(field_of(server)["levels"]) == 2
        time.sleep(0.6)
        assert watcher.shown == 1
        with live(server) as late:
            assert next(late) == newest
    until(lambda: server.num_clients == 0)


def test_nothing_is_made_while_nobody_looks(tmp_path, server):
    with Watcher(tmp_path, server=server, look_every=0.01) as watcher:
        checkpoint(tmp_path, levels=2)
        time.sleep(0.2)
        assert watcher.shown == 0
        with live(server) as events:
            next(events)
            until(lambda: watcher.shown == 1)


def test_broken_requests_end_nothing(server, capfd):
    place = ("127.0.0.1", server.port)
    long = b"GET /" + b"x" * 100_000 + b" HTTP/1.1\r\n\r\n"
    for data in (b"\x00\xff\r\n\r\n", long, b"POST / HTTP/1.1\r\n\r\n", b""):
        with socket.create_connection(place, timeout=10) as client, contextlib.suppress(OSError):
            client.sendall(data)
            client.shutdown(socket.SHUT_WR)
            while client.recv(1 << 16):
                pass
    assert asked(server, "")[0] == 200
    assert capfd.readouterr().err == ""


def test_ports(server):
    with pytest.raises(InputError, match=f"--port {server.port}: is in use"):
        PageServer(lambda: server.packed, port=server.port)
    with pytest.raises(InputError, match=r"--host 203\.0\.113\.1: cannot listen"):
        PageServer(lambda: server.packed, host="203.0.113.1")


@pytest.mark.parametrize("kind", ["WebGL 2", "WebGPU"])
def test_a_page_shows_a_run_that_grows(browser, tmp_path, server, kind):
    """From where one stands, at the finest level there is; and says when the server has ended."""
    camera = look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov=30.0, width=32, height=32)
    with Watcher(tmp_path, server=server, look_every=0.05):
        open_page(browser, server.url, "camera=70,10", kind=kind)
        until(lambda: browser.execute_script("return document.documentElement.dataset.live") == "yes")
        small = (rendered(browser, camera)[0][..., 3] > 0).sum()
        checkpoint(tmp_path, radius=0.7, levels=2)
        until(lambda: browser.execute_script("return window.mplicits.header.levels.length") == 2)
        assert browser.find_element("id", "level").get_attribute("value") == "1"
        until(lambda: browser.execute_script("return window.mplicits.renderer.kind") == kind)
        assert (rendered(browser, camera)[0][..., 3] > 0).sum() > 2 * small > 100
        assert not browser.find_element("id", "message").is_displayed()
    until(lambda: "server has ended" in browser.find_element("id", "state").text)
