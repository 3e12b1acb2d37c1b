"""A run in the browser while it grows, checkpoint by checkpoint: ``mplicits view``, and ``fit --watch``."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from ...neural_fields import InputError
from ..training.folder import FIELD_FILE
from .export import pack
from .serve import PageServer


class Watcher:
    """Shows the checkpoints of a training at ``run``, as a context manager around it.

    A thread looks for a new checkpoint every ``look_every`` seconds, and packs it if a browser is connected. The page
    begins with the first one, or with a field that is there already if ``resume``; a ``server`` shows the run already,
    and is closed at the end. ``say`` is called with the address, and once with an error, which leaves the training
    alone.
    """

    def __init__(
        self,
        run: Path,
        *,
        server: PageServer | None = None,
        resume: bool = False,
        say: Callable[[str], object] = print,
        look_every: float = 1.0,
    ) -> None:
        self.run, self.say = run, say
        self.server = server
        self.shown = 0  # how many checkpoints were shown
        self._every, self._seen = look_every, None if resume and server is None else self._state()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look_on, daemon=True)

    def __enter__(self) -> Watcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        if self.server is not None:
            self.server.close()

    def _state(self) -> tuple[int, int] | None:
        """What tells one checkpoint from the next: the time of its file, and which file that is; None without one."""
        file = self.run / FIELD_FILE if self.run.is_dir() else self.run
        try:
            facts = file.stat()
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
        if state is None or state == self._seen or (self.server is not None and not self.server.num_clients):
            return
        try:
            if self.server is None:
                self.server = PageServer(lambda: pack(self.run))
                self.say(f"--watch: open {self.server.url} in a browser")
            else:
                self.server.update()
        except InputError:
            return  # replaced or removed just now, or without a surface yet: there will be another
        self._seen = state
        self.shown += 1
