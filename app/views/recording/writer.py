"""Writes what a running twin concludes into a file, from a thread and with cursors of its own.

The log and the tunings are the truth, from which a review folds every track again. So an edit, after which the whole
history has another track, adds its tuning. The charts go on as they were seen, and when the file ends, those of the
last revision are drawn once over all of its time.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from estimators.diagnostics.health import MAX_ROWS_PER_READING
from estimators.errors import NisusError, SourceError

from ...live.notices import Notice
from ...live.outputs import Cursor, Pull
from ..rerun.rows import RerunRows
from ..rerun.sink import free_closed_streams
from .format import RecordingFile, summary, summary_of
from .rrd_file import NEVER, Disk, Split, part_path

if TYPE_CHECKING:
    from estimators.diagnostics.episodes import Episode
    from estimators.diagnostics.field_pictures import Picture
    from estimators.log import Log
    from estimators.smoothing.walk import Smoothed
    from estimators.track import Track

    from ...live.interface import Running
    from ...twin.twin import Twin

PERIOD = 0.4
"""Seconds between two writes; with what the operating system has after each, a killed process loses less than this."""

CHARTS = 5.0
"""Seconds between two writes of what the charts show, which follows from the rows. Each of its many entities costs the
same for a few rows as for thousands, and holds up the readings meanwhile."""

REST = 5.0
"""Seconds without an edit after which a knob has come to rest."""

ROWS = 20_000
"""Rows pulled at once, so that a long history does not hold the engine's lock for long."""

FINE = math.inf
"""Of `RerunRows`: charts as fine as the page draws them, however long the recording is."""


class Recorder:
    """Starts and stops recordings of one engine. `draw(stream)` gives what logs the charts' entities of a pull."""

    def __init__(self, engine: Running, draw: Any, split: Split = NEVER, folder: Path = Path()) -> None:
        self._engine = engine
        self.folder = folder
        self._draw = draw
        self._split = split
        self._wake = threading.Event()
        self._wanted: Path | None = None
        self._asked: deque[Path | None] = deque()
        self._taken: Path | None = None
        self._stopping = False
        self._open: _Part | None = None
        self._closed = False
        """Whether a stream was closed whose threads are still to be ended."""
        self.finished: list[Path] = []
        self.failure = ""
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def path(self) -> Path | None:
        """The recording that is being written; its first part, if it is split."""
        return self._wanted

    @property
    def writing(self) -> Path | None:
        """The file that is being written, or will be next: of a recording that is split, the part that began last."""
        part = self._open
        if part is not None:
            return part.file.path
        return next((path for path in (self._taken, *tuple(self._asked)) if path is not None), None)

    @property
    def written(self) -> list[Path]:
        """All files so far, that which is being written last."""
        writing = self.writing
        return [*self.finished, *([] if writing is None or writing in self.finished else [writing])]

    def start(self) -> None:
        """Wait for `record`."""
        self._thread.start()

    def record(self, path: Path | None) -> None:
        """Record into a new file from now on (the history included), or finish the one that is open."""
        self._wanted = path
        self._asked.append(path)
        self._wake.set()

    def stop(self) -> None:
        """Finish the file and end."""
        self._stopping = True
        self.record(None)
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)

    def _run(self) -> None:
        while True:
            # One after the other: a recording that is stopped at once is one too. In this order, as in `_finish`.
            if self._asked:
                self._taken = self._asked[0]
                self._asked.popleft()
            wanted = self._taken
            try:
                if self._open is not None and wanted != self._open.asked:
                    self._finish(self._open)
                if self._open is None and wanted is not None:
                    self._open = _Part(self._engine, wanted, self._draw)
                    self._engine.notices.say(f"recording into {wanted}")
                if self._open is not None:
                    self._go_on(self._open)
            except NisusError as error:
                self._taken = None
                self._fail(str(error))
            except Exception as error:  # noqa: BLE001  a full disk or a driver's fault must not stop the twin
                self._taken = None
                self._fail(self._reason(error))
            if self._closed:
                self._closed = False
                free_closed_streams()
            if self._asked:
                continue
            if self._stopping and self._open is None:
                return
            self._wake.wait(PERIOD if self._open is not None else None)
            self._wake.clear()

    def _go_on(self, part: _Part) -> None:
        part.write()
        warning = part.disk.warning(part.file.size)
        if warning is not None:
            self._engine.notices.say(f"recording {part.file.path}: {warning}", level="warn")
        if part.disk.free() < 0:
            self._finish(part, short=True)
            raise SourceError(f"{part.file.path}: the disk is nearly full; what was written until then can be reviewed")
        if part.due(self._split):
            self._finish(part, goes_on=True)
            self._open = _Part(self._engine, part.asked, self._draw, before=part)
            self._engine.notices.say(f"recording on into {self._open.file.path}")

    def _finish(self, part: _Part, *, short: bool = False, goes_on: bool = False) -> None:
        part.end(short=short)
        # In this order, so that whoever lists the files meanwhile never misses it.
        self.finished.append(part.file.path)
        self._open, self._closed = None, True
        if not goes_on:
            part.release()
        self._engine.notices.say(f"recorded {part.file.rows} rows into {part.file.path}")

    def _reason(self, error: Exception) -> str:
        if self._open is None:
            return f"{type(error).__name__}: {error}"
        said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        path = self._open.file.path
        return f"{path}: it can no longer be written ({said}); what was written until then can be reviewed"

    def _fail(self, text: str) -> None:
        self.failure = f"recording failed: {text}"
        self._engine.notices.report("recording failed", self.failure, level="error")
        if not self._asked:
            self._wanted = None
        if self._open is not None:
            self._open.abandon()
            self._open, self._closed = None, True


class _Part:
    """A file that is being written: how far its events and charts have come, and where a fold of them starts."""

    def __init__(self, engine: Running, asked: Path, draw: Any, *, before: _Part | None = None) -> None:
        """Begin a recording at the path that was asked for; or the part after another, from which it goes on."""
        twin = self._twin = engine.twin
        self._engine = engine
        self.asked = asked
        self.number: int
        path, self.number = part_path(asked, before.number + 1 if before else 1)
        if before is None:
            self._events, self._charts = engine.cursor(follows_log=True), engine.cursor(follows_log=True)
            self._start, self._base = -1, engine.base()
            self.disk = Disk(path.absolute().parent)
        else:
            # The same cursors, so that no late reading is missed in between.
            self._events, self._charts, self.disk = before._events, before._charts, before.disk
            # Health looks back at the rows before: they are there from where this part takes over.
            self._start, self._base = engine.origin(self._events.next - MAX_ROWS_PER_READING * engine.policy.window)
            self._events.next = self._start
        self._drawn_from = self._charts.next
        self._revision = -1
        self._before = before._revision if before else -1
        self._edited, self._undrawn = False, True
        self._turned: float | None = None
        try:
            self.file = RecordingFile(
                path,
                name=twin.name,
                text=twin.text,
                twin_path=twin.path,
                base=self._base,
                overrides=twin.overrides,
                version=twin.version,
            )
            self._drawing = draw(self.file.stream)
        except BaseException:
            self.release()
            raise
        self._begun = self._drawn = time.monotonic()
        self._opening = 0

    def write(self, *, last: bool = False) -> None:
        """Write everything that is there, in pieces; the charts too if their time has come or it is the last time."""
        self._write_events()
        if self._turned is not None and (last or time.monotonic() - self._turned >= REST):
            self._turned = None
            self._move(self._start)
            self._write_events()
        if last or time.monotonic() - self._drawn >= CHARTS:
            self._drawn = time.monotonic()
            for pull in self._pulls(self._charts):
                if pull.fresh:
                    self._drawn_from, self._edited = pull.first, False
                self._drawing(replace(pull, fresh=pull.fresh or self._undrawn))
                self._undrawn = False
        self.file.flush()
        self._opening = self._opening or self.file.size

    def due(self, split: Split) -> bool:
        """Whether the next part should begin; not while most of this one is what each part has to begin with."""
        grown = self.file.size - self._opening
        large = self.file.size >= split.size and grown >= split.size / 2
        return large or time.monotonic() - self._begun >= split.seconds

    def _write_events(self) -> None:
        for pull in self._pulls(self._events):
            begun = self._revision >= 0
            if pull.fresh:
                self._start, base = self._engine.origin(pull.first)
                if begun or base is not self._base:
                    # The source began again, and the log with it; or the log forgot its oldest events just now.
                    self.file.base(base, self._start, pull.revision)
                self._base = base
            elif pull.first < self._start:
                # A late reading belongs before the start.
                self._move(pull.first)
            if pull.revision != self._revision:
                tuning, estimator = self._engine.folded_with()
                if self._engine.twin is not self._twin:
                    self._twin = self._engine.twin
                    self.file.twin(self._twin.text, self._twin.overrides, self._twin.version)
                self.file.tuning(tuning, estimator, pull.first, pull.revision)
                # An edit while this part was begun, too: its base may be of the revision before.
                if (begun or self._before not in (-1, pull.revision)) and not pull.fresh:
                    self._edited, self._turned = True, time.monotonic()
                self._revision = pull.revision
            self.file.write(pull)

    def _move(self, index: int) -> None:
        """Write where a fold starts that gives the rows from `index` on; if that is earlier, the events from there."""
        start, base = self._engine.origin(index)
        if start == self._start and base is self._base:
            return
        self.file.base(base, start, self._revision)
        if start < self._start:
            self._events.next = start
        self._start, self._base = start, base

    def _pulls(self, cursor: Cursor) -> Iterator[Pull]:
        while True:
            pull = self._engine.pull(cursor, ROWS)
            yield pull
            if len(pull.events) < ROWS and cursor.next == pull.first + len(pull.events):
                return

    def end(self, *, short: bool = False) -> None:
        """Write what is left and close; after an edit with the charts of the last revision, unless room is `short`."""
        self.write(last=True)
        if self._edited and not short:
            again = replace(self._charts, next=self._drawn_from, picture=-1)
            fresh = True
            for pull in self._pulls(again):
                self._drawing(replace(pull, fresh=fresh, notices=[]))
                self.file.flush()
                fresh = False
        if not short:
            self.file.summary(summary_of(self._engine))
        self.file.close()

    def abandon(self) -> None:
        """Leave a file that takes no more as it is."""
        self.release()
        self.file.abandon()

    def release(self) -> None:
        """Give the cursors back."""
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
    """Write a finished fold as a recording, in the same form as a running twin's, with the pictures of a large field.

    Args:
        path: Where; what stands there is replaced, and a link is not followed.
        twin: What was folded.
        log: The events.
        track: Their rows.
        pictures: Of a large field.
        episodes: What was wrong; a line each among the recording's events.
        smoothed: What all readings say of the states, drawn beside the filter's; a review has the filter's alone.

    Raises:
        SourceError: If the file cannot be written.
    """
    lines = [
        Notice(k, round(episode.start * 1e9), "error" if episode.cause == "diverged" else "warn", episode.text)
        for k, episode in enumerate(episodes)
    ]
    try:
        path.unlink(missing_ok=True)
        file = RecordingFile(
            path, name=twin.name, text=twin.text, twin_path=twin.path, base=None, overrides=twin.overrides,
            version=twin.version,
        )  # fmt: skip
        drawing = RerunRows(file.stream, SimpleNamespace(model=twin.model, pairs=twin.pairs, twin=twin), series=None)
        file.tuning(twin.tuning, twin.estimator, 0, 0)
        for start in range(0, log.n, ROWS):
            rows = slice(start, min(log.n, start + ROWS))
            here = [picture for picture in pictures if start < picture.before <= rows.stop]
            said = lines if start == 0 else []
            pull = Pull(0, start == 0, start, log.events.select(rows), track.select(rows), said, here)
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
        raise SourceError(f"recording {path}: {error.strerror}; choose a place that can be written") from None
