"""``mplicits fit --watch``: a run in the browser while it grows, checkpoint by checkpoint."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from ...neural_fields import InputError
from ..run.folder import FIELD_FILE
from .server import Viewer, import_viser, open_run

__all__ = ["Watcher"]

LOOK_EVERY = 1.0  # seconds


class Watcher:
    """Shows what a training writes into its run directory; use it as a context manager around the training.

    A thread of its own looks for a new checkpoint once a second, and loads it if a browser is connected: nothing is
    evaluated while nobody looks. The viewer begins with the first checkpoint. Whatever goes wrong in it is said once,
    and leaves the training alone.

    Args:
        run: directory of the run.
        resume: whether a field that is there already is of this run, and to be shown.
        port: the viewer's, or None for the first free one.
        up: the axis that points up, "y" or "z".
        say: told where to look, and what went wrong.
        look_every: seconds between two looks.

    Raises:
        InputError: viser is not installed.
    """

    def __init__(
        self,
        run: Path,
        *,
        resume: bool = False,
        port: int | None = None,
        up: str = "y",
        say: Callable[[str], object] = print,
        look_every: float = LOOK_EVERY,
    ) -> None:
        import_viser()
        self.run, self.port, self.up, self.say = run, port, up, say
        self.viewer: Viewer | None = None
        self.shown = 0  # how many checkpoints were shown
        self._every, self._seen = look_every, None if resume else self._state()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look_on, daemon=True)

    def __enter__(self) -> Watcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        if self.viewer is not None:
            self.viewer.close()

    def _state(self) -> tuple[int, int] | None:
        """What tells one checkpoint from the next: the time of its file, and which file that is; None without one."""
        try:
            facts = (self.run / FIELD_FILE).stat()
        except OSError:
            return None
        return facts.st_mtime_ns, facts.st_ino

    def _look_on(self) -> None:
        try:
            while not self._over.wait(self._every):
                self._look()
        except Exception as error:  # the training goes on, whatever it was
            self.say(f"--watch: ended ({' '.join(str(error).split())})")

    def _look(self) -> None:
        state = self._state()
        if state is None or state == self._seen or (self.viewer is not None and not self.viewer.num_clients):
            return
        try:
            shown = open_run(self.run, say=lambda _: None)
        except InputError:  # replaced or removed just now: there will be another
            return
        self._seen = state
        if self.viewer is None:
            self.viewer = Viewer(shown, port=self.port, up=self.up)
            self.say(f"--watch: open {self.viewer.url} in a browser")
        else:
            self.viewer.show(shown)
        self.shown += 1
