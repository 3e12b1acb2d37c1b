"""The page of a run on this machine: who gets it, and each new checkpoint, to whoever looks."""

import json
import socket
import struct
import time
import urllib.error
import urllib.request

import pytest
import torch
from mplicits.neural_fields import MultiscaleSDF, Siren, Sphere, save_field
from mplicits.neural_fields.networks.sphere_init import solve_sphere
from mplicits.pipelines.web.networks import NoShaderError
from mplicits.pipelines.web.serve import PageServer
from mplicits.pipelines.web.watch import Watcher
from pages import rendered, until

pytest.importorskip("websockets")
from mplicits.datasets.cameras import look_at
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect


def grown(radius, levels):
    torch.manual_seed(0)
    base = Siren(16, 1, omega=4.0)
    solve_sphere(base, radius)
    residuals = [Siren(8, 1, omega=5.0, output_gain=0.05) for _ in range(levels - 1)]
    return MultiscaleSDF(base, residuals, [0.2] * (levels - 1)).requires_grad_(False)


def checkpoint(run, radius=0.4, levels=1):
    save_field(run / "field.safetensors", grown(radius, levels))


@pytest.fixture
def server(tmp_path):
    checkpoint(tmp_path)
    # A port of its own: browsers keep a connection ready, and would meet the server before this one.
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with PageServer(tmp_path, port=port) as server:
        yield server


def asked(server, path, **headers):
    """Status, headers and body of an answer, with the token."""
    address = f"http://127.0.0.1:{server.gate.port}{path}?token={server.gate.token}"
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=30) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read().decode()


def live(server, have="", origin=None, token=None):
    token = server.gate.token if token is None else token
    return connect(f"ws://127.0.0.1:{server.gate.port}/live?token={token}&have={have}", origin=origin)


def header_of(message):
    start = len(b"mplicits-field\n") + 4
    (length,) = struct.unpack("<I", message[start - 4 : start])
    return json.loads(message[start : start + length])


def test_the_page_is_served_to_who_knows_the_token(server):
    status, headers, body = asked(server, "/")
    assert status == 200
    assert headers["Content-Type"].startswith("text/html")
    assert headers["X-Frame-Options"] == "SAMEORIGIN"
    assert "connect-src 'self'" in body
    assert '"format":"mplicits-web"' in body
    assert asked(server, "/field.safetensors")[0] == 404
    assert asked(server, "/", Origin="http://evil.example")[0] == 403
    assert asked(server, "/", Host="evil.example")[0] == 421
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(f"http://127.0.0.1:{server.gate.port}/", timeout=30)


@pytest.mark.parametrize(("origin", "token"), [("http://evil.example", None), ("null", None), (None, "wrong")])
def test_other_pages_hear_nothing(server, origin, token):
    with pytest.raises(InvalidStatus, match="403"):
        live(server, origin=origin, token=token)
    assert server.num_clients == 0


def test_each_checkpoint_is_sent_once_to_who_looks(tmp_path, server):
    first = server.packed.header["crc32"]
    own = f"http://127.0.0.1:{server.gate.port}"
    with Watcher(tmp_path, server=server, look_every=0.01) as watcher, live(server, first, own) as browser:
        with pytest.raises(TimeoutError):
            browser.recv(timeout=0.6)  # it has that one
        checkpoint(tmp_path, levels=2)
        header = header_of(browser.recv(timeout=30))
        assert len(header["levels"]) == 2
        assert header["crc32"] == server.packed.header["crc32"] != first
        with pytest.raises(TimeoutError):
            browser.recv(timeout=0.6)
        assert watcher.shown == 1
        with live(server, first) as late:  # a page that was loaded before
            assert header_of(late.recv(timeout=30)) == header


def test_nothing_is_made_while_nobody_looks(tmp_path, server):
    with Watcher(tmp_path, server=server, look_every=0.01) as watcher:
        checkpoint(tmp_path, levels=2)
        time.sleep(0.2)
        assert watcher.shown == 0
        with live(server):
            until(lambda: watcher.shown == 1)


def test_a_browser_that_speaks_is_disconnected(server):
    with live(server) as browser:
        browser.recv(timeout=30)
        browser.send("hello")
        with pytest.raises(ConnectionClosed) as closed:
            browser.recv(timeout=30)
        assert closed.value.rcvd.code == 1008
    with live(server) as browser:
        browser.recv(timeout=30)
        browser.send(b"x" * 5000)
        with pytest.raises(ConnectionClosed) as closed:
            browser.recv(timeout=30)
        assert closed.value.rcvd.code == 1009
    until(lambda: server.num_clients == 0)


def test_a_field_that_no_shader_knows_is_told_apart(tmp_path):
    save_field(tmp_path / "ball.safetensors", Sphere(radius=0.5))
    with pytest.raises(NoShaderError, match="not a Sphere"):
        PageServer(tmp_path / "ball.safetensors")


@pytest.mark.parametrize("kind", ["WebGL 2", "WebGPU"])
def test_a_page_shows_a_run_that_grows(browser, tmp_path, server, kind):
    """From where one stands, at the finest level there is; and says when the server has ended."""
    camera = look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), fov=30.0, width=32, height=32)
    with Watcher(tmp_path, server=server, look_every=0.05):
        browser.get(f"{server.url}&pixel=16&camera=70,10{'&webgl' if kind == 'WebGL 2' else ''}")
        until(lambda: browser.execute_script("return document.documentElement.dataset.live") == "yes")
        until(lambda: browser.execute_script("return window.mplicits?.renderer?.kind") == kind)
        small = (rendered(browser, camera)[0][..., 3] > 0).sum()
        checkpoint(tmp_path, radius=0.7, levels=2)
        until(lambda: browser.execute_script("return window.mplicits.header.levels.length") == 2)
        assert browser.find_element("id", "level").get_attribute("value") == "1"
        until(lambda: browser.execute_script("return window.mplicits.renderer.kind") == kind)
        assert (rendered(browser, camera)[0][..., 3] > 0).sum() > 2 * small > 100
        assert not browser.find_element("id", "message").is_displayed()
    until(lambda: "server has ended" in browser.find_element("id", "state").text)
