"""Which image the viewer draws next: one thread for all clients, coarse images first, finer when a camera rests."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...datasets.cameras import Camera

__all__ = ["Frame", "FrameScheduler", "Look", "Superseded", "View", "halvings_in_time"]

# Seconds that the first image after a movement may take to draw; sending and showing it takes about as long again.
FIRST_IMAGE = 0.2
# The coarsest image has 1/8 of the width; the first one ever, when nothing has been measured yet, 1/4.
MOST_HALVINGS = 3
UNKNOWN_HALVINGS = 2
# Seconds of drawing that a client may have had more than another that waits, before it comes after it.
AHEAD = 1.0
MOST_MEASURED = 256  # looks and sizes of which times are kept


class Superseded(Exception):  # noqa: N818  not an error
    """Nobody waits for the image any more."""


@dataclass(frozen=True)
class Look:
    """How a field is drawn; what a drawing costs depends on it.

    Attributes:
        level: the level that is traced.
        normal_level: the level whose gradient gives the normals, at least ``level``.
        shading: one of ``SHADINGS``.
        shadows: whether lambert's lamp throws shadows.
        occlusion: whether lambert darkens hollows.
        time: when, for a field that moves; it costs the same at all times.
    """

    level: int
    normal_level: int
    shading: str
    shadows: bool = False
    occlusion: bool = False
    time: float = 0.0


@dataclass(frozen=True)
class View:
    """What a client wants to see: the image at full size, and how it is drawn."""

    camera: Camera
    look: Look


@dataclass(frozen=True)
class Frame:
    """A drawn image.

    Attributes:
        camera: the camera at the size of this image.
        rgb: ``(H, W, 3)`` uint8.
        z: ``(H, W)`` float32 distance from the plane of the eye, ∞ where nothing is seen.
        seconds: how long it took to draw.
        final: whether no finer one follows.
    """

    camera: Camera
    rgb: NDArray[np.uint8]
    z: NDArray[np.float32]
    seconds: float = 0.0
    final: bool = False


class Draw(Protocol):
    """Draws a camera's image; calls ``check`` now and then, which raises `Superseded` to stop it."""

    def __call__(
        self, camera: Camera, look: Look, check: Callable[[], None], /
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]: ...


def halvings_in_time(measured: dict[int, float], budget: float = FIRST_IMAGE) -> int:
    """How often to halve the image so that drawing it takes at most ``budget``.

    An image halved once less has four times the pixels, and takes at most four times as long (there is a fixed part).

    Args:
        measured: seconds that images took, by how often they were halved.
        budget: seconds.
    """
    if not measured:
        return UNKNOWN_HALVINGS
    for halvings in range(MOST_HALVINGS):
        if halvings in measured:
            seconds = measured[halvings]
        else:
            nearest = min(measured, key=lambda other: (abs(other - halvings), -other))
            seconds = measured[nearest] * 4.0 ** (nearest - halvings)
        if seconds <= budget:
            return halvings
    return MOST_HALVINGS


@dataclass
class _Job:
    """A view that is being drawn for a client."""

    view: View
    halvings: int
    order: int
    first: bool = True  # whether no image of it has been shown
    key: tuple[Look, int, int] = field(init=False)

    @property
    def urgency(self) -> tuple[bool, int, int]:
        """The least comes first."""
        return not self.first, -self.halvings, self.order

    def __post_init__(self) -> None:
        self.key = (replace(self.view.look, time=0.0), self.view.camera.width, self.view.camera.height)


class FrameScheduler:
    """Draws the newest view of every client, coarse images before fine ones, in one thread of its own.

    The first image of a view is drawn to its end even when the camera has moved on, since otherwise nothing would be
    shown while it moves; it is chosen small enough to be quick. Finer images are given up as soon as their client
    asks for another view, leaves, or another client waits for its first image. But whoever has had `AHEAD` seconds
    more than the one that waits and has had least comes after all others, and nothing is given up for it: a client that
    never stops asking gets its share, and no more.

    Args:
        draw: makes an image.
        deliver: called in the drawing thread with the client and a finished frame.
        failed: called in the drawing thread when drawing for a client failed; the view is dropped.
    """

    def __init__(
        self,
        draw: Draw,
        deliver: Callable[[int, Frame], None],
        failed: Callable[[int, Exception], None] | None = None,
    ) -> None:
        self._draw, self._deliver, self._failed = draw, deliver, failed
        self._jobs: dict[int, _Job] = {}
        self._measured: dict[tuple[Look, int, int], dict[int, float]] = {}
        self._had: dict[int, float] = {}  # seconds of drawing, by client
        self._least = 0.0  # of those that wait; it only grows
        self._order = 0
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="mplicits-view", daemon=True)
        self._thread.start()

    def request(self, client: int, view: View) -> None:
        """Draw this view for the client, instead of what was requested before."""
        with self._changed:
            self._order += 1
            job = _Job(view, 0, self._order)
            job.halvings = halvings_in_time(self._measured.get(job.key, {}))
            if client not in self._jobs:  # who has not waited has no claim to time that went by
                self._had[client] = max(self._had.get(client, 0.0), self._least)
            self._jobs[client] = job
            self._changed.notify()

    def forget(self, client: int) -> None:
        """Draw nothing more for the client."""
        with self._changed:
            self._jobs.pop(client, None)

    def leave(self, client: int) -> None:
        """Draw nothing more for the client, which will not come back."""
        with self._changed:
            self._jobs.pop(client, None)
            self._had.pop(client, None)

    def close(self, timeout: float = 5.0) -> None:
        """Stop drawing, and wait until the thread has ended."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._changed.notify()
        self._thread.join(timeout)

    def _next(self) -> tuple[int, _Job] | None:
        """The job to do now: first images, then coarse ones, then whoever has waited longest; None after the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._closed)
            if self._closed:
                return None
            self._least = max(self._least, min(self._had[client] for client in self._jobs))
            return min(self._jobs.items(), key=lambda item: (self._is_ahead(item[0]), *item[1].urgency))

    def _is_ahead(self, client: int) -> bool:
        """Whether a client has had much more than another that waits."""
        return self._had[client] > min(self._had[other] for other in self._jobs) + AHEAD

    def _is_wanted(self, client: int, job: _Job) -> bool:
        if self._closed or client not in self._jobs:
            return False
        if job.first:
            return True
        with self._changed:
            waiting = (name for name, other in self._jobs.items() if other.first)
            return self._jobs.get(client) is job and all(map(self._is_ahead, waiting))

    def _work(self) -> None:
        while (chosen := self._next()) is not None:
            client, job = chosen
            try:
                frame = self._drawn(client, job)
                if client in self._jobs:
                    self._deliver(client, frame)
            except Superseded:
                continue
            except Exception as error:
                if client in self._jobs:  # sending to a client that has just left may fail, and is no failure
                    self._report(client, error)
                self._drop(client, job)
                continue
            with self._changed:
                self._measured.setdefault(job.key, {})[job.halvings] = frame.seconds
                while len(self._measured) > MOST_MEASURED:
                    del self._measured[next(iter(self._measured))]  # the oldest
                if frame.final and self._jobs.get(client) is job:
                    del self._jobs[client]
                self._order += 1
                job.first, job.halvings, job.order = False, job.halvings - 1, self._order

    def _drawn(self, client: int, job: _Job) -> Frame:
        def check() -> None:
            if not self._is_wanted(client, job):
                raise Superseded

        full = job.view.camera
        camera = full
        if job.halvings:
            factor = 2**job.halvings
            camera = full.resized(max(1, full.width // factor), max(1, full.height // factor))
        started = time.perf_counter()
        try:
            rgb, z = self._draw(camera, job.view.look, check)
        finally:
            seconds = time.perf_counter() - started
            with self._changed:
                if client in self._had:
                    self._had[client] += seconds
        return Frame(camera, rgb, z, seconds, job.halvings == 0)

    def _drop(self, client: int, job: _Job) -> None:
        with self._changed:
            if self._jobs.get(client) is job:
                del self._jobs[client]

    def _report(self, client: int, error: Exception) -> None:
        traceback.print_exception(error)
        if self._failed is not None:
            self._failed(client, error)
