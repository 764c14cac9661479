"""A twin's files, looked at while it runs: one that is saved is read again, and the history folded with what it says.

What the running fold can take over becomes a revision like any other; a model of another shape, or a source that is
another one, is started anew. What cannot be read is said with its line, and what runs goes on.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from pathlib import Path

from config.loader import shown_path
from config.tunings import OWN
from estimators.errors import NisusError

from ...live.changes import obstacle
from ...twin.twin import VERSION, Twin, with_version
from ..running import RunningTwin, Stamp, stamp_of
from .gallery import Gallery

EVERY = 0.4
"""Seconds between two looks at the files. An editor may write one in pieces: it is read once it stays as it is."""


class SavedFiles:
    """Looks at the files of what runs in a gallery's session, in a thread of its own."""

    def __init__(self, gallery: Gallery, *, every: float = EVERY) -> None:
        self._gallery, self._every = gallery, every
        # Not to be kept alive by being looked at.
        self._of: weakref.ref[RunningTwin] | None = None
        self._files: tuple[Path, ...] = ()
        self._known: Stamp = ()
        self._seen: Stamp = ()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="saved files", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)

    def look(self) -> None:
        """Look once; act when a file has changed since it was read, and not since the last look."""
        running = self._gallery.session.running
        if running is None or running.opening.again is None:
            self._of = None
            return
        if self._of is None or running is not self._of():
            self._of, self._files = weakref.ref(running), running.opening.files
            self._known = self._seen = running.opening.stamp
        stamp = stamp_of(self._files)
        settled, self._seen = stamp == self._seen, stamp
        if settled and stamp != self._known and self._gallery.starting is None:
            changed = [file for file, was, now in zip(self._files, self._known, stamp, strict=True) if was != now]
            self._known = stamp
            self._read(running, ", ".join(shown_path(file) for file in changed), running.opening.again)

    def _watch(self, files: tuple[Path, ...]) -> None:
        """The twin was read from these, some of which it may not have imported before."""
        known = dict(zip(self._files, self._known, strict=True))
        self._files = files
        self._known = self._seen = tuple(known.get(file, *stamp_of((file,))) for file in files)

    def _read(self, running: RunningTwin, what: str, again: Callable[[], Twin]) -> None:
        engine = running.engine
        try:
            twin = again()
            self._watch(twin.files)
            chosen = engine.twin.overrides.get(VERSION, OWN)
            if chosen != twin.overrides.get(VERSION, OWN):
                # Loaded on the page.
                twin = with_version(twin, chosen)
            reason = obstacle(engine.twin, twin)
            if reason is None:
                self._gallery.prepare(twin)
        except (NisusError, OSError) as error:
            self._refuse(running, str(error).splitlines()[0])
            return
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            self._refuse(running, f"{what}: {type(error).__name__}: {error}")
            return
        running.server.unread = None
        if twin.config == engine.twin.config and what == shown_path(twin.path):
            return  # a comment
        if reason is not None:
            self._gallery.again(f"{what} was saved and {reason}: the twin was started anew")
            return
        engine.notices.say(f"{what} was saved: the history is folded again with it")
        engine.reload(twin, f"{Path(what).name} saved")

    def _refuse(self, running: RunningTwin, text: str) -> None:
        running.server.unread = text
        running.engine.notices.say(f"not read again: {text}", level="error")

    def _run(self) -> None:
        while not self._stopping.wait(self._every):
            try:
                self.look()
            except NisusError as error:
                running = self._gallery.session.running
                if running is not None:
                    running.engine.notices.say(str(error), level="warn")
