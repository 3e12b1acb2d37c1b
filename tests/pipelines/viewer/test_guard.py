"""What browsers may send: bounds of messages, their rate, and a running viewer among hostile ones."""

import asyncio
import contextlib
import random
import threading
import time
import urllib.error
import urllib.request

import pytest
from mplicits.neural_fields import Siren
from mplicits.pipelines.viewer.client import Client, OneAtATime
from mplicits.pipelines.viewer.guard import BURST, LARGEST, Meter, fits

pytest.importorskip("viser")

import msgspec
import viser
from hostile import CAMERA, hello, hostile_messages
from mplicits.pipelines.viewer.server import Viewer, show_field
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Subprotocol

PROTOCOL = [Subprotocol(f"viser-v{viser.__version__}")]


def test_what_a_browser_sends_fits():
    assert fits(CAMERA) is True
    assert fits({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": True}}) is True
    assert fits({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 0.25}}) is True
    click = {"ray_origin": [0.0, 0, 1], "ray_direction": [0, 0, -1], "screen_pos": [[0.5, 0.5]], "modifier": None}
    assert fits({"type": "ScenePointerMessage", "event_type": "click", **click}) is True
    assert fits({"type": "SomethingNew", "x": 1}) is None


@pytest.mark.parametrize(
    "change",
    [
        {"fov": float("nan")},
        {"fov": 0.0},
        {"fov": "1"},
        {"position": [0.0, float("inf"), 0.0]},
        {"position": [0.0, 0.0]},
        {"position": [1e300, 0.0, 0.0]},
        {"wxyz": [0.0, 0.0, 0.0, 0.0]},
        {"wxyz": None},
        {"image_width": 10**9},
        {"image_width": -1},
        {"image_height": 1.5},
        {"near": "x"},
        {"type": 3},
    ],
)
def test_cameras_out_of_bounds_do_not_fit(change):
    assert fits(CAMERA | change) is False


def test_every_hostile_message_is_turned_away():
    random.seed(0)
    for raw in hostile_messages():
        try:
            message = msgspec.msgpack.decode(raw)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            continue
        assert len(raw) > LARGEST or not fits(message)


def test_a_meter_lets_a_burst_and_then_its_rate_through():
    now = [0.0]
    meter = Meter(10.0, 5.0, clock=lambda: now[0])
    assert [meter.take() for _ in range(7)] == [True] * 5 + [False] * 2
    now[0] = 0.25
    assert [meter.take() for _ in range(4)] == [True] * 2 + [False] * 2
    now[0] = 1e9
    assert sum(meter.take() for _ in range(50)) == 5


def test_work_asked_for_meanwhile_is_done_once_more():
    done, once = [], OneAtATime()

    def work() -> None:
        done.append(len(done))
        if len(done) == 1:
            once.run(work)
            once.run(work)

    once.run(work)
    assert done == [0, 1]
    with pytest.raises(ZeroDivisionError):
        once.run(lambda: 1 // 0)  # pyright: ignore[reportArgumentType]
    once.run(work)
    assert len(done) == 3


@pytest.fixture(scope="module")
def viewer():
    with Viewer(show_field(Siren(8, 1).requires_grad_(False), side=64)) as running:
        yield running


def status(url: str, **headers: str) -> int:
    try:
        return urllib.request.urlopen(urllib.request.Request(url, headers=headers)).status
    except urllib.error.HTTPError as error:
        return error.code


def test_pages_and_sockets_want_the_token_and_their_own_origin(viewer):
    bare = viewer.url.partition("?")[0]
    assert [status(viewer.url), status(bare), status(bare + "?token=x")] == [200, 403, 403]
    assert status(viewer.url, Origin="http://evil.example") == 403
    assert status(viewer.url, Host="evil.example") == 421

    async def try_all() -> None:
        address = viewer.url.replace("http", "ws")
        async with connect(address, subprotocols=PROTOCOL, origin=bare.rstrip("/")):
            pass
        for wrong, origin in (
            (address, "http://evil.example"),
            (address.partition("?")[0], None),
            (address + "x", None),
        ):
            with pytest.raises(InvalidStatus, match="403"):
                async with connect(wrong, subprotocols=PROTOCOL, origin=origin):
                    pass

    asyncio.run(try_all())


def test_the_hostile_are_disconnected_and_the_others_served(viewer, capfd):
    """Each hostile message ends its own connection, a flood too; who keeps to the bounds gets images throughout."""

    async def attack(raws: list[bytes]) -> bool:
        """Whether it was cut off."""
        with contextlib.suppress(ConnectionClosed):
            async with connect(viewer.url.replace("http", "ws"), subprotocols=PROTOCOL, compression=None) as socket:
                for raw in raws:
                    await socket.send(raw)
                async with asyncio.timeout(20):
                    while True:
                        await socket.recv()
        return True

    async def all_of_it() -> None:
        random.seed(1)
        async with connect(viewer.url.replace("http", "ws"), subprotocols=PROTOCOL, max_size=None) as good:
            await good.send(hello())
            ended = await asyncio.gather(
                *(attack([raw]) for raw in hostile_messages()), attack([hello()] * int(3 * BURST))
            )
            assert all(ended)
            await good.send(hello(position=(0.0, 0.5, 3.0)))
            async with asyncio.timeout(20):
                while b"BackgroundImageMessage" not in unpacked(await good.recv()):
                    pass

    asyncio.run(all_of_it())
    deadline = time.monotonic() + 20
    while viewer.num_clients:
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)
    assert capfd.readouterr().err == ""


def test_an_image_on_its_way_to_a_browser_that_has_just_left_is_no_failure(viewer, monkeypatch):
    """viser refuses what is sent to a closed connection some time before it says that the browser has left."""

    def refuse(_frame) -> None:
        raise UserWarning("never delivered")

    async def come_and_go() -> Client:
        async with connect(viewer.url.replace("http", "ws"), subprotocols=PROTOCOL, max_size=None) as socket:
            await socket.send(hello())
            async with asyncio.timeout(20):
                while not (clients := list(viewer._clients.values())) or clients[0]._last is None:
                    await asyncio.sleep(0.02)
            (client,) = clients
            monkeypatch.setattr(client, "_send", refuse)
            with pytest.raises(UserWarning, match="never delivered"):  # while it is there, an error is one
                client.show(client._last)
        return client

    client = asyncio.run(come_and_go())
    deadline = time.monotonic() + 20
    while viewer.num_clients:
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)
    monkeypatch.setattr(client, "_gone", threading.Event())  # as before it was said
    client.show(client._last)


def unpacked(raw: bytes | str) -> bytes:
    import zstandard

    assert isinstance(raw, bytes)
    return zstandard.ZstdDecompressor().decompress(raw[16 : 16 + int.from_bytes(raw[8:16], "little")])
