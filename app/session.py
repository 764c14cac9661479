"""A running twin with all around it: engine, recorder, views, page. `run` and `review` differ in the source."""

from __future__ import annotations

import gc
import secrets
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimators.errors import SourceError

from .engine.commands import Record
from .engine.engine import Engine
from .engine.workshop import Workshop
from .recording.split import NEVER, Split
from .recording.writer import FINE, Recorder
from .rerun.rows import RerunRows
from .server.open_browser import Opening
from .signals import restore, when_asked_to_end
from .stderr import complain

if TYPE_CHECKING:
    from estimators.snapshots import Base
    from sources.source import Source

    from .twin.twin import Twin

SWITCH = 0.0005
"""Seconds after which Python lets another thread run; its default of 5 ms is as long as a reading may take in all."""


@dataclass(frozen=True)
class Page:
    """Where the page is served, and whether to open it."""

    port: int
    open_browser: bool


class Session:
    """Starts what a twin needs, in order, and stops it in reverse."""

    def __init__(
        self,
        twin: Twin,
        open_source: Callable[[Callable[[str, str], None]], Source],
        *,
        page: Page | None,
        base: Base | None = None,
        horizon: float | None = None,
        review: Path | None = None,
        split: Split = NEVER,
        workshop: Workshop | None = None,
    ) -> None:
        """Put it together; nothing runs yet.

        Args:
            twin: What to run.
            open_source: See `Engine`.
            page: Where to serve the page; None for no page.
            base: See `Engine`.
            horizon: See `Engine`.
            review: The recording that is reviewed, for the page to offer.
            split: Into what parts to split a recording.
            workshop: See `Engine`.

        Raises:
            NisusError: If the source cannot be opened, or the port is in use.
        """
        sys.setswitchinterval(SWITCH)
        self.engine = Engine(twin, open_source, base=base, horizon=horizon, workshop=workshop)
        self.recorder = Recorder(self.engine, lambda stream: RerunRows(stream, self.engine, series=FINE), split)
        self.engine.recorder = self.recorder
        self._page = page
        self.view: Any = None
        self.server: Any = None
        if page is not None:
            from .server.server import PageServer
            from .viser.view import ViserView

            secret = secrets.token_urlsafe(24)
            try:
                self.view = ViserView(self.engine, secret=secret)
                self.server = PageServer(
                    self.engine,
                    port=page.port,
                    viser_port=self.view.port,
                    secret=secret,
                    review=review,
                    choices=self.view.stage.choices,
                )
            except BaseException:
                self.engine.stop()
                if self.view is not None:
                    self.view.stop()
                raise

    @property
    def url(self) -> str | None:
        """Address of the page, with its token."""
        return self.server.url if self.server is not None else None

    def start(self) -> None:
        """Start everything."""
        # What the start has built stays; looking through it again and again would hold readings up for milliseconds.
        gc.collect()
        gc.freeze()
        self.recorder.start()
        if self.server is not None:
            self.view.start()
            self.server.start()
        self.engine.start()

    def stop(self) -> None:
        """Stop everything; a recording is finished."""
        self.engine.stop()
        self.recorder.stop()
        if self.server is not None:
            self.server.stop()
            self.view.stop()

    def _open(self, url: str) -> Opening | None:
        """Open the page in a browser; where that cannot be, the printed address is there."""
        try:
            opening = Opening(url)
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
        done = threading.Event()
        opening: Opening | None = None
        previous = when_asked_to_end(done.set)
        try:
            self.start()
            if record is not None:
                self.engine.submit(Record(record))
            if self.url is not None:
                print(f"Nisus shows {self.engine.twin.name} at\n\n    {self.url}\n\nCtrl-C ends it.", flush=True)
                assert self._page is not None
                if self._page.open_browser:
                    opening = self._open(self.url)
            end = time.monotonic() + duration if duration is not None else float("inf")
            while not done.is_set() and time.monotonic() < end:
                if until_finished and self.engine.status().finished:
                    break
                if opening is not None and self.server.entered.is_set():
                    opening.close()
                    opening = None
                done.wait(min(0.2, max(0.0, end - time.monotonic())))
        except KeyboardInterrupt:
            pass
        finally:
            if opening is not None:
                opening.close()
            self.stop()
            restore(previous)
        if record is not None and self.recorder.failure:
            raise SourceError(self.recorder.failure)
