"""One browser: what it has been shown, and what follows when something in it is changed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...neural_fields import Field, InputError, Similarity
from ..training.settings import SHADINGS
from .camera import describe_reading, image_size, probe, viser_camera
from .controls import LARGEST_PICTURE_SIDE, Controls
from .frames import Frame, FrameScheduler, Superseded, View
from .paint import Painter
from .picks import Picks
from .scene import SceneNodes, Shapes

__all__ = ["Client", "Shown"]

SCREENSHOT_SECONDS = 20.0
JPEG_QUALITY = 92
# Pixels of an image that is quickly sent as PNG; the blocks of JPEG show when it is enlarged.
SMALL_IMAGE = 1 << 15


# Pictures that are drawn at a time, of all browsers: each may be 200 MB large.
_PICTURES = threading.Semaphore(2)


class OneAtATime:
    """Work that is asked for more often than it can be done: once now, and once more if it was asked for meanwhile."""

    def __init__(self) -> None:
        self._lock, self._asked, self._runs = threading.Lock(), False, False

    def run(self, work: Callable[[], None]) -> None:
        """Do the work, or let the thread that does it already do it once more."""
        with self._lock:
            self._asked = True
            if self._runs:
                return
            self._runs = True
        try:
            while self._wanted():
                work()
        except BaseException:
            with self._lock:
                self._runs = False
            raise

    def _wanted(self) -> bool:
        with self._lock:
            self._runs, self._asked = self._asked, False
            return self._runs


@contextmanager
def _one_picture(mine: threading.Lock, controls: Controls) -> Iterator[bool]:
    """Whether a browser may have a picture made: one at a time for each, and few for all together."""
    if not mine.acquire(blocking=False):
        yield False
        return
    try:
        if not _PICTURES.acquire(blocking=False):
            controls.say("Others are having pictures drawn; try again.")
            yield False
            return
        try:
            yield True
        finally:
            _PICTURES.release()
    finally:
        mine.release()


@dataclass(frozen=True)
class Shown:
    """What the viewer shows, to all browsers alike.

    Attributes:
        name: of the run, for the names of saved pictures.
        field: in unit-sphere coordinates, three- or four-dimensional.
        similarity: from input to unit-sphere coordinates.
        shapes: meshes and points beside the traced image.
        painter: draws the traced image.
        side: images have about ``side``² pixels.
        picks: the landmarks that are picked, where two shapes are shown for that.
    """

    name: str
    field: Field
    similarity: Similarity
    shapes: Shapes
    painter: Painter
    side: int
    picks: Picks | None = None

    @property
    def shadings(self) -> list[str]:
        """The shadings that the field can be given: errors need a cloud, and colours a texture."""
        there = {"color": self.painter.colored, "error": self.shapes.cloud_file is not None}
        return [name for name in SHADINGS if there.get(name, True)]


class Client:
    """A connected browser.

    Args:
        handle: viser's handle of it.
        shown: what it is shown.
        scheduler: who draws the images.
        connection: the guarded connection that it came by.
    """

    def __init__(self, handle: Any, shown: Shown, scheduler: FrameScheduler, connection: Any = None) -> None:
        self._handle, self._shown, self._scheduler = handle, shown, scheduler
        self.connection = connection
        self._arranging, self._picturing = OneAtATime(), threading.Lock()
        self._gone = threading.Event()
        self._last: Frame | None = None
        self._pictures = 0
        self._controls = Controls(
            handle.gui,
            levels=shown.field.num_levels,
            shadings=shown.shadings,
            has_cloud=shown.shapes.cloud_file is not None,
            moves=shown.field.in_dim == 4,
            similarity=shown.similarity,
            deltas=shown.field.deltas.tolist(),
            picks=shown.picks is not None,
        )
        scale = shown.similarity.scale
        self._scene = SceneNodes(handle.scene, shown.shapes, self._controls, scale=scale, check=self._check)
        self._controls.on_change(self._redraw, self._rearrange)
        self._controls.on_save(self._save_picture, self._save_screenshot)

        @handle.camera.on_update
        async def _(_camera: Any) -> None:  # in the event loop, so that the order of movements is kept
            self._redraw()

        handle.scene.on_click()(self._read)
        self._controls.on_undo(self._undo)
        self._show_picks()
        self._redraw()

    def leave(self) -> None:
        """Stop all work for this browser."""
        self._gone.set()
        self._scheduler.leave(self._handle.client_id)

    def show(self, frame: Frame) -> None:
        """Show an image; called by the scheduler."""
        if self._gone.is_set() or not self._controls.is_traced:
            return
        self._last = frame
        try:
            self._send(frame)
            self._say_size()
            self._controls.play_on()
        except Exception:  # what is on its way to a browser that has just left cannot be sent, and is no failure
            if self.connection is None or not self.connection.has_left:
                raise

    def fail(self, error: Exception) -> None:
        """Say that an image could not be drawn; called by the scheduler."""
        self._controls.say(f"**Cannot be drawn:** {' '.join(str(error).split())}")

    def _say_size(self) -> None:
        """Say how large the image on the screen is, and whether a finer one follows."""
        frame = self._last
        if frame is None:
            self._controls.say("")
            return
        size = f"{frame.camera.width} × {frame.camera.height}"
        self._controls.say(f"{size} in {frame.seconds:.2f} s" if frame.final else f"{size} …")

    def _send(self, frame: Frame) -> None:
        # Depths are a third as much work again, and only needed where something else may be in front or behind.
        depth = frame.z if self._scene.is_filled else None
        kind = "png" if frame.z.size <= SMALL_IMAGE else "jpeg"
        self._handle.scene.set_background_image(frame.rgb, format=kind, jpeg_quality=JPEG_QUALITY, depth=depth)

    def _view(self, size: tuple[int, int]) -> View:
        camera = self._handle.camera
        return View(viser_camera(camera.wxyz, camera.position, camera.fov, size), self._controls.look)

    def _redraw(self) -> None:
        """The camera or the look has changed."""
        if self._gone.is_set():
            return
        if self._controls.is_traced:
            canvas = (self._handle.camera.image_width, self._handle.camera.image_height)
            self._scheduler.request(self._handle.client_id, self._view(image_size(self._shown.side, canvas)))
        elif self._last is not None:
            self._scheduler.forget(self._handle.client_id)
            self._last = None
            self._handle.scene.set_background_image(None)
            self._say_size()

    def _rearrange(self) -> None:
        """What stands beside the traced image has changed."""
        self._arranging.run(self._arrange)

    def _arrange(self) -> None:
        had_depth = self._scene.is_filled
        try:
            self._scene.arrange(busy=lambda: self._controls.say("Extracting a mesh …"))
            self._say_size()
        except InputError as error:
            self._controls.say(f"**{error}**")
        except Superseded:
            return
        self._update_depth(had_depth)

    def _update_depth(self, had_depth: bool) -> None:
        """Send the image again if it now needs a depth that it had not."""
        last = self._last
        if last is not None and self._scene.is_filled and not had_depth and not self._gone.is_set():
            self._send(last)

    def _read(self, event: Any) -> None:
        if self._gone.is_set():
            return
        reading = probe(
            self._shown.shapes.moments.at(self._controls.time),
            self._shown.similarity,
            event.ray_origin,
            event.ray_direction,
            level=self._controls.level,
            surface=self._controls.is_traced or self._controls.mesh is not None,
            plane=self._controls.slice,
        )
        self._controls.read(describe_reading(reading, self._shown.similarity.scale))
        had_depth, picks = self._scene.is_filled, self._shown.picks
        if picks is None:
            self._scene.mark(reading)
            self._update_depth(had_depth)
        elif reading is not None and not reading.on_plane:
            self._change_picks(lambda: picks.pick(reading.point))

    def _undo(self) -> None:
        if self._shown.picks is not None:
            self._change_picks(self._shown.picks.undo)

    def _change_picks(self, change: Callable[[], None]) -> None:
        try:
            change()
        except InputError as error:
            self._controls.say(f"**{error}**")
        self._show_picks()

    def _show_picks(self) -> None:
        if self._shown.picks is None:
            return
        had_depth = self._scene.is_filled
        self._controls.tell_picks(self._shown.picks.text())
        self._scene.pin(self._shown.picks.places())
        self._update_depth(had_depth)

    def _save_picture(self) -> None:
        with _one_picture(self._picturing, self._controls) as free:
            if free:
                self._draw_picture()

    def _draw_picture(self) -> None:
        width, transparent = self._controls.picture
        canvas = (self._handle.camera.image_width, self._handle.camera.image_height)
        height = min(max(1, round(width * canvas[1] / max(canvas[0], 1))), LARGEST_PICTURE_SIDE)
        view = self._view((width, height))
        self._controls.say(f"Drawing {width} × {height} …")
        try:
            image = self._shown.painter.picture(view.camera, view.look, self._check, transparent=transparent)
        except Superseded:
            return
        self._download(image)
        self._controls.say(f"Saved {width} × {height}.")

    def _save_screenshot(self) -> None:
        with _one_picture(self._picturing, self._controls) as free:
            if free:
                self._take_screenshot()

    def _take_screenshot(self) -> None:
        camera, larger = self._handle.camera, nullcontext()
        if self.connection is not None:
            larger = self.connection.awaiting_picture()
        try:
            with larger:
                image = self._handle.get_render(
                    camera.image_height, camera.image_width, transport_format="png", timeout=SCREENSHOT_SECONDS
                )
        except (RuntimeError, TimeoutError) as error:
            self._controls.say(f"**The browser sent no picture:** {error}")
            return
        self._download(image)

    def _check(self) -> None:
        if self._gone.is_set():
            raise Superseded

    def _download(self, image: NDArray[np.uint8]) -> None:
        """Send a PNG as a download, under a name of its own: browsers keep older files of the same name."""
        self._pictures += 1
        swapped = cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR)
        content = cv2.imencode(".png", swapped)[1].tobytes()
        name = f"{self._shown.name}-{self._pictures:03d}.png"
        self._handle.send_file_download(name, content, save_immediately=True)
