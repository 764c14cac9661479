"""A running twin with its engine and recorder, and with a page also its scene and page server."""

from __future__ import annotations

import os
import secrets
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..derive.refits import Refits
from ..engine.engine import Engine
from ..engine.jobs import run_all
from ..engine.outputs.publisher import Publisher
from ..engine.store import StoreWriter, open_store
from ..record.rrd_file import NEVER, Split
from ..record.writer import ALL_STRETCHES, Recorder
from ..terminal import complain, print_line

if TYPE_CHECKING:
    from rerun import RecordingStream

    from estimators.snapshots import Base
    from sources.source import Source

    from ..engine.compile_queue import CompileQueue
    from ..engine.notices import Annotation
    from ..explore.rows import RerunRows
    from ..twin.twin import Twin
    from .http_server import HttpServer

PRINT_PERIOD_S = 0.5
"""Seconds between two looks for notices to print."""

Stamp = tuple[tuple[int, int] | None, ...]
"""Time of writing, ns, and size of each of some files; None where one is missing."""


def stamp_of(files: tuple[Path, ...]) -> Stamp:
    """Return time of writing and size of each file; None while an editor has removed it."""
    found: list[tuple[int, int] | None] = []
    for file in files:
        try:
            stat = os.stat(file)
            found.append((stat.st_mtime_ns, stat.st_size))
        except OSError:
            found.append(None)
    return tuple(found)


@dataclass(frozen=True)
class OpenedTwin:
    """A twin and its source, ready to run, or a recording of one.

    `open_source`, `base` and `horizon` are those of `Engine`; `review` is the reviewed recording, `said` the notices of
    its session, `annotations` its notes of users, `remarks` new notices, (level, text). `files` are the twin's files,
    `stamp` their state when read, and `again` reads them once more; a recording has none. `compile_queue` compiles its
    filters, and stops with the engine. `store` is the file from which it continues after a restart,
    `archive` makes the archive of its rows.
    """

    twin: Twin
    open_source: Callable[[Callable[[str, str], None]], Source]
    base: Base | None = None
    horizon: float | None = None
    review: Path | None = None
    said: Sequence[tuple[int, str, str]] = ()
    annotations: Sequence[Annotation] = ()
    remarks: Sequence[tuple[str, str]] = ()
    files: tuple[Path, ...] = ()
    stamp: Stamp = ()
    again: Callable[[], Twin] | None = None
    compile_queue: CompileQueue | None = None
    store: Path | None = None
    archive: Callable | None = None


class RunningTwin:
    """Starts the parts of a running twin in order, and stops them in reverse."""

    def __init__(
        self,
        opening: OpenedTwin,
        *,
        http_server: HttpServer | None,
        split: Split = NEVER,
        recordings: Path | None = None,
        printed: bool = False,
    ) -> None:
        """Put it together; nothing runs yet.

        Args:
            opening: What to run.
            http_server: Shows its page, once it is started; None for no page.
            split: Into what parts to split a recording.
            recordings: Folder of recordings made on the page; None is the working directory.
            printed: Whether all notices are printed on standard error, not errors alone.

        Raises:
            NisusError: If the source cannot be opened.
        """
        self.opening = opening
        store, stored, remarks = None, None, list(opening.remarks)
        if opening.store is not None:
            store, stored, remark = open_store(opening.store, opening.twin)
            remarks.append(remark)
            if remark[0] != "info" and not printed:
                complain(remark[1])
        try:
            self.engine = Engine(
                opening.twin if stored is None else stored.twin,
                opening.open_source,
                base=opening.base,
                horizon=opening.horizon,
                compile_queue=opening.compile_queue,
                stored=stored,
            )
        except BaseException:
            if store is not None:
                store.close()
            raise
        self.store = None if store is None else StoreWriter(self.engine, store, stored)
        self.engine.store = self.store
        self.archive = None if opening.archive is None else opening.archive(self.engine, stored)
        if opening.said:
            self.engine.notices.restore(list(opening.said))
        if stored is None:
            self.engine.annotations.restore(opening.annotations)
        for level, text in remarks:
            self.engine.notices.say(text, level=level)
        self._next_line, self._printed = 0, printed
        self.engine.monitors.run("lines", lambda job: self._print_notices(), every=PRINT_PERIOD_S)
        self.recorder = Recorder(self.engine, self._draw_into, split, recordings or Path())
        self.engine.recorder = self.recorder
        self.refits = Refits(self.engine)
        self.publisher: Publisher | None = None
        config = opening.twin.config
        if opening.review is not None or opening.twin.plan.recorded:
            if config.outputs.receivers:
                self.engine.notices.say("a recording is replayed: no alerts are sent")
        else:
            page = None if http_server is None else http_server.site
            self.publisher = self.engine.published = Publisher(self.engine, page=page, store=store)
        self.view: Any = None
        self.server: Any = None
        self.gone: threading.Event | None = None
        """After the start: set once the application shown before has no connection left."""
        if http_server is not None:
            from ..scene.view import ViserView
            from .server import PageServer

            secret = secrets.token_urlsafe(24)
            try:
                self.view = ViserView(self.engine, secret=secret)
                self.server = PageServer(
                    self.engine,
                    port=http_server,
                    viser_port=self.view.port,
                    secret=secret,
                    review=opening.review,
                    choices=self.view.renderer.choices,
                    refits=self.refits,
                )
            except BaseException:
                self.discard()
                raise

    def _draw_into(self, stream: RecordingStream) -> RerunRows:
        """Return a function that logs the charts of a pull into a Rerun stream."""
        from ..explore.rows import RerunRows

        return RerunRows(stream, self.engine, series=ALL_STRETCHES)

    def discard(self) -> None:
        """Discard a twin that was never started."""
        _stop(self.engine, self.store, self.view)

    def start(self) -> None:
        """Start everything."""
        if self.server is not None:
            self.view.start()
            self.gone = self.server.start()
        self.engine.start()
        if self.publisher is not None:
            self.publisher.start()
            if self.publisher.problem and not self._printed:
                complain(self.publisher.problem)
        if self.store is not None:
            self.store.start()
        if self.archive is not None:
            self.archive.start()
        if self.opening.review is None:
            # A recording is over; what it had adopted is in it.
            self.refits.start()

    def stop(self) -> None:
        """Stop everything; a recording is finished, with the last row that there will be."""
        shown = () if self.server is None else (self.server.stop, self.view.stop)
        run_all(self._close_log, *shown)

    def _print_notices(self) -> None:
        for line in self.engine.notices.since(self._next_line):
            self._next_line = line.number + 1
            if self._printed:
                fields = {"twin": self.engine.twin.name, "t": line.t, "revision": line.revision}
                print_line(line.level, line.text, **fields)
            elif line.level == "error" and self.opening.review is None:
                complain(line.text)

    def _close_log(self) -> None:
        _stop(self.publisher, self.engine, self.store, self.archive, self.recorder)
        self._print_notices()


def _stop(*parts: Any) -> None:
    """Stop the parts of a twin that there are, in this order."""
    for part in parts:
        if part is not None:
            part.stop()
