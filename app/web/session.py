"""Process that runs twins: one port, one twin at a time, until Ctrl-C."""

from __future__ import annotations

import ctypes
import gc
import html
import os
import sys
import tempfile
import threading
import time
import weakref
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from estimators.errors import SourceError

from ..engine.commands import Record
from ..engine.engine import Engine
from ..engine.jobs import run_all
from ..engine.notices import Annotation
from ..record.rrd_file import NEVER, Split
from ..record.writer import Recorder
from ..terminal import complain, until_asked_to_end
from .access import Grant
from .http_server import HttpServer
from .running import OpenedTwin, RunningTwin

DISCONNECT_TIMEOUT_S = 3.0
"""Longest wait for browsers that keep connections to a stopped twin."""

MALLOC_OPTIONS = ((-8, 2), (-3, 1 << 17), (-1, 1 << 17))
"""Of glibc: M_ARENA_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD.

By default each thread has a heap, and large arrays go there once one was freed, so edits scatter free memory: after 60
edits motor_can held 608 MB, with few heaps 479. Columns of a pull have 128 KiB or more; with a threshold of 1 MiB the
gaps that they left in the heaps grew by 60 MB in ten minutes of edits.
"""

RUST_PURGE = ("MIMALLOC_PURGE_DELAY", "0")
"""Rerun and Arrow bring an allocator of their own, mimalloc, which keeps the pages that ended threads have freed: with
Explore and recordings opened and closed it grew by 20 MB in an hour. So free pages are returned at once."""

TRIM_PERIOD_S = 5.0
"""Seconds between two returns of free memory to the system, each of 2 ms at most. glibc returns only the free end of a
heap by itself: the first 250 edits of motor_can left 20 MB of free pages between used ones."""

SWITCH_INTERVAL_S = 0.0005
"""Time after which Python lets another thread run; the default of 5 ms is the time budget of a measurement."""


@dataclass(frozen=True)
class Page:
    """Port of the page, whether to open it in a browser, and tokens of other programs.

    `public` is the address at which a reverse proxy offers it. `overview` is the address of the overview of a service,
    of which this twin is one; it then has no gallery, and `site` is its own address there.
    """

    port: int
    open_browser: bool
    grants: tuple[Grant, ...] = ()
    overview: str | None = None
    public: str | None = None
    site: str | None = None


def _settle(gone: threading.Event | None = None, before: Callable[[], Engine | None] | None = None) -> None:
    """Keep the objects of a start out of garbage collections, which would delay measurements by milliseconds.

    The previous twin is garbage once it has no connection left (`gone`) and its last request is answered; `before`
    returns its engine until then.
    """
    end = time.monotonic() + DISCONNECT_TIMEOUT_S
    if gone is not None:
        gone.wait(DISCONNECT_TIMEOUT_S)
        gc.unfreeze()  # not at the first start, as a collection writes to the pages that processes of a service share
    gc.collect()
    while before is not None and before() is not None and time.monotonic() < end:
        time.sleep(0.05)
        gc.collect()
    gc.freeze()
    _trim()


def _trim() -> None:
    """Return the free pages of all heaps to the system, which takes milliseconds; nothing without glibc."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _log_of(opening: OpenedTwin) -> object:
    """Return what identifies a twin and its log: notes at moments of one log mean nothing in another."""
    return opening.twin.path, opening.review, opening.files, repr(opening.twin.config.source)


class Session:
    """A process: one page, and behind it one twin at a time, or none; `app/web/gallery` changes it.

    `run` and `review` differ in what runs first.
    """

    def __init__(
        self,
        opening: OpenedTwin | None,
        *,
        page: Page | None,
        split: Split = NEVER,
        recordings: Path | None = None,
        printed: bool = False,
    ) -> None:
        """Put it together; nothing runs yet.

        Args:
            opening: First twin; None for the gallery alone.
            page: Port of the page; None for no page.
            split: Parts into which a recording is split.
            recordings: Folder of recordings made on the page; None is the working directory.
            printed: Whether the notices of twins are printed on standard error.

        Raises:
            NisusError: If the source cannot be opened, or the port is in use.
        """
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        os.environ.setdefault(*RUST_PURGE)  # read when Rerun is imported
        with suppress(OSError, AttributeError):  # not glibc
            for option, value in MALLOC_OPTIONS:
                ctypes.CDLL(None).mallopt(option, value)
        self._page, self._split, self._recordings, self._printed = page, split, recordings, printed
        self.http_server: HttpServer | None = None
        self.running: RunningTwin | None = None
        self._changing = threading.RLock()
        self._recorded: list[Path] = []
        self._notes: dict[object, tuple[Annotation, ...]] = {}
        """Notes of users on the twins that ran before, by twin and log."""
        self.starts: Callable[[RunningTwin], object] = lambda running: None
        """Called with each twin that is about to start."""
        if page is not None:
            public, overview, site = page.public, page.overview, page.site
            self.http_server = HttpServer(page.port, page.grants, public=public, overview=overview, site=site)
        try:
            if opening is not None:
                self.running = self.prepared(opening)
        except BaseException:
            if self.http_server is not None:
                self.http_server.stop()
            raise

    @property
    def engine(self) -> Engine:
        """Engine of the running twin."""
        return self._ran.engine

    @property
    def recorder(self) -> Recorder:
        """Recorder of the running twin."""
        return self._ran.recorder

    @property
    def _ran(self) -> RunningTwin:
        assert self.running is not None, "no twin runs"
        return self.running

    @property
    def url(self) -> str | None:
        """Address of the page, with its token."""
        return self.http_server.url if self.http_server is not None else None

    @property
    def recorded(self) -> list[Path]:
        """Files recorded by this session, in any folder."""
        running = self.running
        return [*self._recorded, *([] if running is None else running.recorder.written)]

    def prepared(self, opening: OpenedTwin) -> RunningTwin:
        """Return a twin for `change`, put together but not started.

        Raises:
            NisusError: If its source cannot be opened.
        """
        self._keep_notes()
        if not opening.annotations:
            opening = replace(opening, annotations=self._notes.get(_log_of(opening), ()))
        split, folder, printed = self._split, self._recordings, self._printed
        return RunningTwin(opening, http_server=self.http_server, split=split, recordings=folder, printed=printed)

    def _keep_notes(self) -> None:
        """Keep the notes of the running twin for its next start in this session."""
        if self.running is not None:
            self._notes[_log_of(self.running.opening)] = self.running.engine.annotations.notes

    def change(self, make: Callable[[], RunningTwin] | None, *, stop_first: bool = False) -> None:
        """Replace the running twin by another, or by none; from any thread.

        `make` assembles the next twin; if it fails, the running one goes on. With `stop_first` that is stopped before,
        since both would read one bus.

        Raises:
            NisusError: As `make` does.
        """
        with self._changing:
            before, after, stopped = self.running, None, False
            left: Callable[[], Engine | None] | None = None
            try:
                if make is not None and not stop_first:
                    after = make()
                if before is not None:
                    left = weakref.ref(before.engine)
                    before.stop()
                    self._keep_notes()
                    self._recorded += before.recorder.written
                stopped = True
                if make is not None and stop_first:
                    after = make()
            finally:
                # Until here browsers see the stopped twin.
                if stopped:
                    self.running = after
                    del before
                if after is not None:
                    self.starts(after)
                    after.start()
                    _settle(after.gone, left)
                elif stopped and self.http_server is not None:
                    self.http_server.show(None)

    def start(self) -> None:
        """Start everything."""
        if self.http_server is not None:
            self.http_server.start()
        if self.running is not None:
            self.starts(self.running)
            self.running.start()
        _settle()

    def stop(self) -> None:
        """Stop everything; a recording is finished."""
        with self._changing:
            ends = [item.stop for item in (self.running, self.http_server) if item is not None]
            run_all(*ends)

    def _open(self, url: str) -> BrowserPage | None:
        """Open the page in a browser; None if that fails, as the address is printed too."""
        try:
            opening = BrowserPage(url)
        except OSError as error:
            complain(f"the browser is not opened ({error.strerror}: {error.filename}); open the address above")
            return None
        opening.show()
        return opening

    def run(self, *, record: Path | None, duration: float | None, until_finished: bool) -> None:
        """Run until interrupted, for `duration` seconds, or (`until_finished`) until the source has ended.

        Raises:
            NisusError: If the page cannot be served, or, in the end, that `record` could not be written.
        """
        opening: BrowserPage | None = None

        def stop() -> None:
            if opening is not None:
                opening.close()
            self.stop()

        with until_asked_to_end(stop) as done:
            if record is not None:
                # Before the first event: commands wait for the fold, and a fold may never return.
                self.engine.submit(Record(record))
            self.start()
            if self.url is not None:
                shown = "the gallery" if self.running is None else self.engine.twin.name
                print(f"Nisus shows {shown} at\n\n    {self.url}\n\nCtrl-C ends it.", flush=True)
                assert self._page is not None
                if self._page.open_browser:
                    opening = self._open(self.url)
            end = time.monotonic() + duration if duration is not None else float("inf")
            trim_at = time.monotonic() + TRIM_PERIOD_S
            while not done.wait(min(0.2, max(0.0, end - time.monotonic()))) and time.monotonic() < end:
                if until_finished and self.engine.status().finished:
                    break
                if time.monotonic() >= trim_at:
                    _trim()
                    trim_at = time.monotonic() + TRIM_PERIOD_S
                if opening is not None and self.http_server is not None and self.http_server.entered.is_set():
                    opening.close()
                    opening = None
        if record is not None and self.recorder.failure:
            raise SourceError(self.recorder.failure)


REDIRECT = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0;url={url}">
<title>Nisus</title>
<a href="{url}">Open Nisus</a>
</html>
"""


class BrowserPage:
    """A file of this user that leads to the page, until it has been used: no command line shows the token."""

    def __init__(self, url: str) -> None:
        """Write the file.

        Raises:
            OSError: If it cannot be written.
        """
        # The runtime folder is the user's own, and is emptied when they log out, should this process be killed.
        root = os.environ.get("XDG_RUNTIME_DIR")
        usable = root is not None and os.access(root, os.W_OK | os.X_OK)
        # mkstemp makes a file for this user only, whatever the umask.
        handle, name = tempfile.mkstemp(".html", "nisus-", root if usable else None)
        self.path = Path(name)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(REDIRECT.format(url=html.escape(url)))

    def show(self) -> None:
        """Start the browser, in a thread: one in the terminal does not return before the user leaves it."""
        threading.Thread(target=webbrowser.open, args=(self.path.as_uri(),), daemon=True).start()

    def close(self) -> None:
        """Remove the file."""
        with suppress(OSError):
            self.path.unlink()
