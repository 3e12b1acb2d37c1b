"""``mplicits view``: a field in the browser, traced while one looks at it."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import math
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from ...datasets.cameras import UP_AXES
from ...datasets.clouds.readers.reading import check_cloud_path
from ...neural_fields import InputError, Similarity, TextureField, load_field
from ...neural_fields.fields.function import FieldLike, as_field
from ...neural_fields.spacetime.evolution import VectorField
from ..texture.transport import start_texture
from ..training.folder import find_field, fitted_cloud
from ..training.motion import load_motion
from .camera import first_eye
from .client import Client, Shown
from .frames import Frame, FrameScheduler
from .gate import Gate
from .guard import connection_of_this_task, guarded
from .paint import Painter
from .picks import Picks
from .scene import Shapes

__all__ = ["FIRST_PORT", "Viewer", "free_port", "import_viser", "open_run", "show_field"]

FIRST_PORT = 8080
PORTS = 100
FOV = math.radians(30)


class Viewer:
    """A running viewer; `close` it, or use it as a context manager.

    Only who knows the token in its `url` is let in, and no other page than its own (`Gate`); what browsers send is
    bounded in size, rate and values (`guarded`).

    Args:
        shown: what to show.
        host: the address to listen on.
        port: the port, or None for the first free one from 8080 upwards.
        up: the axis that points up, "y" or "z".

    Raises:
        InputError: viser is not installed, or the address or the port cannot be had.
    """

    def __init__(self, shown: Shown, *, host: str = "127.0.0.1", port: int | None = None, up: str = "y") -> None:
        viser = import_viser()
        port = free_port(host, port)
        shown.painter.warm_up()
        self._clients: dict[int, Client] = {}
        self._lock = threading.Lock()
        self._shown = shown
        self._scheduler = FrameScheduler(shown.painter, self._deliver, self._fail)
        gate = Gate(host, port)
        with _silent(), guarded(gate):
            self._server: Any = viser.ViserServer(host=host, port=port, label=shown.name, verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()  # beside the image, not on it
        self._server.scene.set_up_direction(UP_AXES[up])
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.fov = first_eye(up, FOV), (0.0, 0.0, 0.0), FOV
        camera.up = UP_AXES[up]
        if self._server.get_port() != port:  # somebody else took it just now; viser then takes another
            self._server.stop()
            raise InputError(f"--port {port}: is in use; leave out --port to take a free one")
        self.url = gate.url

        @self._server.on_client_connect
        async def _(handle: Any) -> None:  # in the task of its connection
            await asyncio.to_thread(self._join, handle, connection_of_this_task())

        @self._server.on_client_disconnect
        def _(handle: Any) -> None:
            self._leave(handle.client_id)

    @property
    def num_clients(self) -> int:
        """How many browsers are connected."""
        return len(self._clients)

    def show(self, shown: Shown) -> None:
        """Show something else to all browsers, from where they stand; their controls begin anew."""
        scheduler = FrameScheduler(shown.painter, self._deliver, self._fail)
        with self._lock:
            before, self._shown = (self._shown, self._scheduler), shown
            self._scheduler = scheduler
            clients = self._server.get_clients()
            for name, client in list(self._clients.items()):
                client.leave()
                if name in clients:
                    clients[name].gui.reset()
                    clients[name].scene.reset()
                    self._clients[name] = Client(clients[name], shown, scheduler, client.connection)
        before[0].shapes.close()
        before[1].close()

    def close(self) -> None:
        """Stop drawing and serving."""
        for client in list(self._clients):
            self._leave(client)
        self._shown.shapes.close()
        self._scheduler.close()
        with _silent():
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _join(self, handle: Any, connection: Any) -> None:
        with self._lock:
            self._clients[handle.client_id] = Client(handle, self._shown, self._scheduler, connection)
        if handle.client_id not in self._server.get_clients():
            self._leave(handle.client_id)  # gone before it was here

    def _leave(self, name: int) -> None:
        with self._lock:
            client = self._clients.pop(name, None)
        if client is not None:
            client.leave()

    def _deliver(self, name: int, frame: Frame) -> None:
        client = self._clients.get(name)
        if client is not None:
            client.show(frame)

    def _fail(self, name: int, error: Exception) -> None:
        client = self._clients.get(name)
        if client is not None:
            client.fail(error)


def open_run(
    run: str | Path,
    *,
    cloud: str | Path | None = None,
    side: int = 512,
    device: torch.device | str = "cpu",
    say: Callable[[str], object] = print,
) -> Shown:
    """Load what is to be shown.

    Args:
        run: run directory or .safetensors file.
        cloud: what errors are measured from; by default what the field was fitted to.
        side: images have about ``side``² pixels.
        device: where to evaluate the field.
        say: called with a line where the cloud that the field was fitted to is not to be found.

    Raises:
        InputError: there is no such run, or no such cloud.
    """
    path = find_field(run)
    field, similarity, metadata = load_field(path, device=device)
    if cloud is not None:
        cloud = check_cloud_path(cloud)
    elif "cloud" in metadata.get("run", {}):
        try:
            cloud = fitted_cloud(path, metadata, remedy="without it no errors are shown; name it with --cloud FILE")
        except InputError as missing:
            say(str(missing))
    name = Path(run).resolve().stem if Path(run).is_dir() else path.stem
    texture, motion = start_texture(path, field), load_motion(path)
    if motion is not None:
        motion = motion.to(field.like)
    return show_field(field, name=name, similarity=similarity, cloud=cloud, texture=texture, motion=motion, side=side)


def show_field(
    field: FieldLike,
    *,
    name: str = "field",
    similarity: Similarity | None = None,
    cloud: Path | None = None,
    texture: TextureField | None = None,
    motion: VectorField | None = None,
    side: int = 512,
    picks: Picks | None = None,
) -> Shown:
    """What a `Viewer` needs to show any field in three dimensions, or in space and time, such as one in a script."""
    field, similarity = as_field(field), similarity or Similarity.identity()
    shapes = Shapes(field, similarity, cloud=cloud)
    return Shown(name, field, similarity, shapes, Painter(field, shapes.cloud, texture, motion), side, picks)


def import_viser() -> Any:
    """The package that serves the browser.

    Raises:
        InputError: it is not installed.
    """
    try:
        import viser
    except ModuleNotFoundError as error:
        raise InputError("the viewer needs viser; pip install mplicits[view]") from error
    return viser


def free_port(host: str, port: int | None) -> int:
    """A port that can be listened on; viser itself would silently take another one, or wait for ever."""
    for candidate in range(FIRST_PORT, FIRST_PORT + PORTS) if port is None else (port,):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, candidate, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            with socket.socket(family, kind, protocol) as attempt:
                attempt.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                attempt.bind(address)
        except OSError as error:
            if error.errno == errno.EADDRINUSE and port is None:
                continue
            if error.errno == errno.EADDRINUSE:
                raise InputError(f"--port {port}: is in use; leave out --port to take a free one") from error
            if error.errno == errno.EACCES:
                raise InputError(f"--port {port}: may not be used; take one above 1023") from error
            raise InputError(
                f"--host {host}: cannot listen there ({error.strerror or error}); try 127.0.0.1"
            ) from error
        return candidate
    raise InputError(f"no port from {FIRST_PORT} to {FIRST_PORT + PORTS - 1} is free; name one with --port")


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep viser's own banner off the terminal; ours names the address."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
