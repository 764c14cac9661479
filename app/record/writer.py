"""The recorder: writes a running twin into a file, from a thread and with cursors of its own.

A review folds the log with the tunings again, so an edit, which changes the whole track, only adds its tuning. The
charts continue as they were seen; when the file ends, those of the last revision are drawn over all of its time.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

from estimators.diagnostics.health import MAX_ROWS_PER_READING
from estimators.errors import NisusError, SourceError
from sources.worker_process import gist

from ..engine.copies import MAX_PULL_ROWS, Pull
from ..engine.history_copy import follow
from ..engine.jobs import LoopThread
from ..engine.notices import Notice
from ..format_time import counted
from .rrd_file import DATE, NEVER, Disk, Split, part_path, surplus_parts

if TYPE_CHECKING:
    from rerun import RecordingStream

    from estimators.diagnostics.episodes import Episode
    from estimators.diagnostics.field_pictures import Picture
    from estimators.log import Log
    from estimators.smoothing.walk import Smoothed
    from estimators.track import Track

    from ..engine.running_fold import Running
    from ..twin.twin import Twin

LOG_PERIOD_S = 0.4  # Seconds between two writes of the log: a killed process loses less

CHARTS_PERIOD_S = 5.0
"""Seconds between two writes of the charts. Each of their many entities costs the same for one row as for thousands."""

EDIT_REST_S = 5.0  # Seconds without an edit after which the file gets a new base

ALL_STRETCHES = math.inf
"""`series` of `RerunRows`: charts as fine as on the page, however long the recording is."""


Draw = Callable[["RecordingStream"], Callable[[Pull], None]]


class Recorder:
    """Starts and stops recordings of one engine. `draw(stream)` returns a function that logs the charts of a pull."""

    def __init__(self, engine: Running, draw: Draw, split: Split = NEVER, folder: Path = Path()) -> None:
        self._engine = engine
        self.folder = folder
        self._draw = draw
        self._split = split
        self._wake = threading.Event()
        self._wanted: Path | None = None
        self._asked: deque[Path | None] = deque()
        self._taken: Path | None = None
        self._open: RecordingPart | None = None
        self._closed = False
        """Whether a closed stream still has threads."""
        self.finished: list[Path] = []
        self.failure = ""
        self._thread = LoopThread(self._run, "recorder")

    @property
    def path(self) -> Path | None:
        """Path of the current recording; of its first part if it is split."""
        return self._wanted

    @property
    def writing(self) -> Path | None:
        """Path of the file that is being written, or is next; of a split recording its last part.

        A dated one is known once it is open.
        """
        part = self._open
        if part is not None:
            return part.file.path
        known = (path for path in (self._taken, *tuple(self._asked)) if path is not None)
        return next((path for path in known if not DATE.search(str(path))), None)

    @property
    def written(self) -> list[Path]:
        """Paths of all files so far, the current one last."""
        writing = self.writing
        return [*self.finished, *([] if writing is None or writing in self.finished else [writing])]

    def record(self, path: Path | None) -> None:
        """Record into a new file, history included; None finishes the current one."""
        self._wanted = path
        self._asked.append(path)
        self._wake.set()
        if path is not None and not self._thread.is_alive():
            self._thread.start()

    def stop(self) -> None:
        """Finish the file and end the thread."""
        self._thread.stop(10.0, lambda: self.record(None))

    def _run(self) -> None:
        while True:
            # In order: a recording that is stopped at once must still be written.
            if self._asked:
                self._taken = self._asked[0]
                self._asked.popleft()
            wanted = self._taken
            try:
                if self._open is not None and wanted != self._open.asked:
                    self._finish(self._open)
                if self._open is None and wanted is not None:
                    self._begin(wanted, "recording into")
                if self._open is not None:
                    self._go_on(self._open)
            except NisusError as error:
                self._taken = None
                self._fail(str(error))
            except Exception as error:  # noqa: BLE001  a full disk or a driver's fault must not stop the twin
                self._taken = None
                self._fail(self._reason(error))
            if self._closed:
                from ..explore.sink import free_closed_streams

                self._closed = False
                free_closed_streams()
            if self._asked:
                continue
            if self._thread.stopping.is_set() and self._open is None:
                return
            self._wake.wait(LOG_PERIOD_S if self._open is not None else None)
            self._wake.clear()

    def _go_on(self, part: RecordingPart) -> None:
        part.write()
        warning = part.disk.warning(part.file.size)
        if warning is not None:
            self._engine.notices.say(f"recording {part.file.path}: {warning}", level="warn")
        if part.disk.free() < 0:
            self._finish(part, short=True)
            raise SourceError(f"{part.file.path}: the disk is nearly full; the recording up to here can be reviewed")
        if part.due(self._split):
            self._finish(part, goes_on=True)
            self._begin(part.asked, "recording on into", part)

    def _begin(self, asked: Path, what: str, before: RecordingPart | None = None) -> None:
        """Begin a part, and remove those that are too many or too old by then."""
        self._open = part = RecordingPart(self._engine, asked, self._draw, before=before)
        self._engine.notices.say(f"{what} {part.file.path}")
        for path in surplus_parts(asked, self._split, part.file.path):
            try:
                path.unlink()
            except OSError as error:
                self._engine.notices.report("kept recording", f"{path}: it cannot be removed ({error.strerror})")
                continue
            self._engine.notices.say(f"removed {path}, beyond --record-keep")

    def _finish(self, part: RecordingPart, *, short: bool = False, goes_on: bool = False) -> None:
        part.end(short=short)
        # In this order, so that `written` always lists it.
        self.finished.append(part.file.path)
        self._open, self._closed = None, True
        if not goes_on:
            part.release()
        self._engine.notices.say(f"recorded {counted(part.file.rows, 'row')} into {part.file.path}")

    def _reason(self, error: Exception) -> str:
        if self._open is None:
            return f"{type(error).__name__}: {error}"
        path = self._open.file.path
        return f"{path}: it can no longer be written ({gist(error)}); the recording up to here can be reviewed"

    def _fail(self, text: str) -> None:
        if not self._asked:
            self._wanted = None
        if self._open is not None:
            self._open.abandon()
            self._open, self._closed = None, True
        self.failure = f"recording failed: {text}"
        self._engine.notices.report("recording failed", self.failure, level="error")


class RecordingPart:
    """File of a recording: cursors of its events and charts, and the base of its fold.

    Rerun takes 50 MB, so it is imported with the first file.
    """

    def __init__(self, engine: Running, asked: Path, draw: Draw, *, before: RecordingPart | None = None) -> None:
        """Start a recording at a path, or the part that continues another."""
        from .format import RecordingFile

        twin = self._twin = engine.twin
        self._engine = engine
        self.asked = asked
        self.number: int
        path, self.number = part_path(asked, before.number + 1 if before else 1)
        if before is None:
            self._events, self._charts = engine.cursor(follows_log=True), engine.cursor(follows_log=True)
            self._start, self._base = -1, engine.base()
            # To open the first file of a process takes a second, in which the twin may be edited.
            self._asked_of = engine.here()
            self.disk = Disk(path.absolute().parent)
        else:
            # The same cursors, so that no late measurement is missed in between.
            self._events, self._charts, self.disk = before._events, before._charts, before.disk
            # Health uses earlier rows, so they are repeated.
            self._start, self._base = engine.origin(self._events.next - MAX_ROWS_PER_READING * engine.policy.window)
            self._events.next = self._start
            self._asked_of = None
        self._drawn_from = self._charts.next
        self._revision = -1
        self._before = before._revision if before else -1
        self._edited, self._undrawn = False, True
        self._turned: float | None = None
        try:
            self.file = RecordingFile(path, twin, self._base)
            # A process that is killed keeps these; the first charts of a process take seconds.
            self._write_events()
            self.file.flush()
            self._drawing = draw(self.file.stream)
        except BaseException:
            self.release()
            raise
        self._begun = self._drawn = time.monotonic()
        self._day = time.localtime()[:3]
        self._opening = 0

    def write(self, *, last: bool = False) -> None:
        """Write all new events; the charts too if they are due or this is the last time."""
        self._write_events()
        self.file.annotations(self._engine.annotations.notes)
        if self._turned is not None and (last or time.monotonic() - self._turned >= EDIT_REST_S):
            self._turned = None
            self._move(self._start)
            self._write_events()
        if last or time.monotonic() - self._drawn >= CHARTS_PERIOD_S:
            self._drawn = time.monotonic()
            for pull in follow(self._engine, self._charts):
                if pull.fresh:
                    self._drawn_from, self._edited = pull.first, False
                self._drawing(replace(pull, fresh=pull.fresh or self._undrawn))
                self._undrawn = False
        self.file.flush()
        self._opening = self._opening or self.file.size

    def due(self, split: Split) -> bool:
        """Return whether the next part should begin; not while this one holds little but its header."""
        grown = self.file.size - self._opening
        large = self.file.size >= split.size and grown >= split.size / 2
        over = split.daily and time.localtime()[:3] != self._day
        return large or over or time.monotonic() - self._begun >= split.seconds

    def _write_events(self) -> None:
        for pull in follow(self._engine, self._events):
            begun = self._revision >= 0
            if pull.fresh:
                self._start, base = self._engine.origin(pull.first)
                if begun or base is not self._base:
                    # The source restarted, and the log with it, or the log dropped its oldest events.
                    self.file.base(base, self._start, pull.revision)
                self._base = base
            elif pull.first < self._start:
                # A late measurement belongs before the start.
                self._move(pull.first)
            if pull.revision != self._revision:
                assert pull.settings is not None
                tuning, estimator = pull.settings
                if self._engine.twin is not self._twin:
                    self._twin = self._engine.twin
                    self.file.twin(self._twin)
                if (here := self._asked_of) is not None and here.revision != pull.revision:
                    self.file.tuning(here.tuning, here.estimator, pull.first, here.revision)
                self._asked_of = None
                self.file.tuning(tuning, estimator, pull.first, pull.revision)
                # Also after an edit while this part was created: its base may be of the revision before.
                if (begun or self._before not in (-1, pull.revision)) and not pull.fresh:
                    self._edited, self._turned = True, time.monotonic()
                self._revision = pull.revision
            self.file.write(pull)

    def _move(self, index: int) -> None:
        """Write the base of a fold that gives the rows from `index` on, and the events from there if it is earlier."""
        start, base = self._engine.origin(index)
        if start == self._start and base is self._base:
            return
        self.file.base(base, start, self._revision)
        if start < self._start:
            self._events.next = start
        self._start, self._base = start, base

    def end(self, *, short: bool = False) -> None:
        """Write the rest and close; after an edit with the charts of the last revision, if the disk has room."""
        self.write(last=True)
        if self._edited and not short:
            again = replace(self._charts, next=self._drawn_from, picture=-1)
            fresh = True
            for pull in follow(self._engine, again):
                self._drawing(replace(pull, fresh=fresh, notices=[]))
                self.file.flush()
                fresh = False
        if not short:
            from .format import summary_of

            # Among the events of the charts as they are now: what is drawn cannot be changed.
            notes = self._engine.annotations.notes
            lines = [Notice(note.number, note.t, "info", f"note: {note.text}") for note in notes]
            self._drawing(replace(self._engine.rows(0, 0), notices=lines))
            self.file.summary(summary_of(self._engine))
        self.file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self.release()
        self.file.abandon()

    def release(self) -> None:
        """Release the cursors."""
        self._engine.release(self._events)
        self._engine.release(self._charts)


def write_recording(
    path: Path,
    twin: Twin,
    log: Log,
    track: Track,
    pictures: Sequence[Picture] = (),
    episodes: Sequence[Episode] = (),
    smoothed: Smoothed | None = None,
) -> None:
    """Write a finished fold as a recording, in place of an existing file; a link is not followed.

    `pictures` are those of a large field. Each of `episodes` is a notice. The smoothed states are drawn beside the
    filter's; a review shows the filter's only.

    Raises:
        SourceError: If the file cannot be written.
    """
    from ..explore.rows import RerunRows
    from ..explore.sink import free_closed_streams
    from .format import RecordingFile, summary

    lines = [
        Notice(k, round(episode.start * 1e9), "error" if episode.cause == "diverged" else "warn", episode.text)
        for k, episode in enumerate(episodes)
    ]
    try:
        path.unlink(missing_ok=True)
        file = RecordingFile(path, twin, None)
        drawing = RerunRows(file.stream, SimpleNamespace(model=twin.model, pairs=twin.pairs, twin=twin), series=None)
        file.tuning(twin.tuning, twin.estimator, 0, 0)
        for start in range(0, log.n, MAX_PULL_ROWS):
            rows = slice(start, min(log.n, start + MAX_PULL_ROWS))
            here = [picture for picture in pictures if start < picture.before <= rows.stop]
            pull = Pull(
                0, start == 0, start, log.events.select(rows), track.select(rows), lines if start == 0 else [], here
            )
            file.write(pull)
            drawing(pull)
            if smoothed is not None:
                drawing.smoothed(log.events.t[rows], smoothed.instead_of(track).select(rows))
            file.flush()
        file.summary(summary(twin.estimator, twin.tuning, log.events, track, pictures))
        file.close()
        del file, drawing
        free_closed_streams()
    except OSError as error:
        raise SourceError(f"recording {path}: {error.strerror}; choose another folder") from None
