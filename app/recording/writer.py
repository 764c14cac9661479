"""Writes what a running twin concludes into a file, from a thread and with cursors of its own."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from estimators.errors import NisusError

from ..engine.outputs import Cursor, Pull
from ..rerun.rows import RerunRows
from .format import RecordingFile

if TYPE_CHECKING:
    from estimators.diagnostics.field_pictures import Picture
    from estimators.log import Log
    from estimators.track import Track

    from ..engine.engine import Engine
    from ..twin.twin import Twin

PERIOD = 0.4
"""Seconds between two writes; with what the operating system has after each, a killed process loses less than this."""

CHARTS = 5.0
"""Seconds between two writes of what the charts show, which follows from the rows. Each of its many entities costs the
same for a few rows as for thousands, and holds up the readings meanwhile."""

NEARLY_FULL = 2**20
"""Free bytes under which a disk that takes no more is said to be full."""

ROWS = 20_000
"""Rows pulled at once, so that a long history does not hold the engine's lock for long."""


class Recorder:
    """Starts and stops recordings of one engine. `draw(stream)` gives what logs the charts' entities of a pull."""

    def __init__(self, engine: Engine, draw: Any) -> None:
        self._engine = engine
        self._draw = draw
        self._wake = threading.Event()
        self._wanted: Path | None = None
        self._stopping = False
        self._open: _Open | None = None
        self.finished: list[Path] = []
        self.failure = ""
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def path(self) -> Path | None:
        """The file that is being written."""
        return self._wanted

    def start(self) -> None:
        """Wait for `record`."""
        self._thread.start()

    def record(self, path: Path | None) -> None:
        """Record into a new file from now on (the history included), or finish the one that is open."""
        self._wanted = path
        self._wake.set()

    def stop(self) -> None:
        """Finish the file and end."""
        self._wanted = None
        self._stopping = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)

    def _run(self) -> None:
        while True:
            wanted = self._wanted
            try:
                if self._open is not None and wanted != self._open.file.path:
                    self._finish(self._open)
                if self._open is None and wanted is not None:
                    self._open = _Open(self._engine, wanted, self._draw)
                    self._engine.notices.say(f"recording into {wanted}")
                if self._open is not None:
                    self._open.write()
            except NisusError as error:
                self._fail(str(error))
            except Exception as error:  # noqa: BLE001  a full disk or a driver's fault must not stop the twin
                self._fail(self._reason(error))
            if self._stopping and self._open is None:
                return
            self._wake.wait(PERIOD if self._open is not None else None)
            self._wake.clear()

    def _finish(self, open_file: _Open) -> None:
        open_file.write(last=True)
        self._open = None
        open_file.release()
        open_file.file.close()
        self.finished.append(open_file.file.path)
        self._engine.notices.say(f"recorded {open_file.file.rows} rows into {open_file.file.path}")

    def _reason(self, error: Exception) -> str:
        # Rerun says only that its writer is gone.
        if self._open is None:
            return f"{type(error).__name__}: {error}"
        path, reason = self._open.file.path, f"it can no longer be written ({error})"
        with suppress(OSError):
            if shutil.disk_usage(path.parent).free < NEARLY_FULL:
                reason = "the disk is full"
        return f"{path}: {reason}; what was written until then can be reviewed"

    def _fail(self, text: str) -> None:
        self.failure = f"recording failed: {text}"
        self._engine.notices.report("recording failed", self.failure, level="error")
        self._wanted = None
        if self._open is not None:
            self._open.release()
            self._open.file.abandon()
            self._open = None


class _Open:
    """A file that is being written, and how far its rows and its charts have come."""

    def __init__(self, engine: Engine, path: Path, draw: Any) -> None:
        twin = engine.twin
        self._engine = engine
        self.file = RecordingFile(path, name=twin.name, text=twin.text, twin_path=twin.path, base=engine.base())
        self._drawing = draw(self.file.stream)
        self._rows, self._charts = engine.cursor(), engine.cursor()
        self._drawn = time.monotonic()

    def write(self, *, last: bool = False) -> None:
        """Write everything that is there, in pieces; the charts too if their time has come or it is the last time."""
        for pull in self._pulls(self._rows):
            if pull.fresh:
                tuning, estimator = self._engine.folded_with()
                self.file.tuning(tuning, estimator, pull.first, pull.revision)
            self.file.write(pull)
        if last or time.monotonic() - self._drawn >= CHARTS:
            self._drawn = time.monotonic()
            for pull in self._pulls(self._charts):
                self._drawing(pull)
        self.file.flush()

    def _pulls(self, cursor: Cursor) -> Iterator[Pull]:
        while True:
            pull = self._engine.pull(cursor, ROWS)
            yield pull
            if len(pull.readings) < ROWS:
                return

    def release(self) -> None:
        """Give the cursors back."""
        self._engine.release(self._rows)
        self._engine.release(self._charts)


def write_recording(path: Path, twin: Twin, log: Log, track: Track, pictures: Sequence[Picture] = ()) -> None:
    """Write a finished fold as a recording, in the same form as a running twin's, with the pictures of a large field.

    Raises:
        SourceError: If the file cannot be written.
    """
    file = RecordingFile(path, name=twin.name, text=twin.text, twin_path=twin.path, base=None)
    drawing = RerunRows(file.stream, SimpleNamespace(model=twin.model, pairs=twin.pairs, twin=twin), series=None)
    file.tuning(twin.tuning, twin.estimator, 0, 0)
    for start in range(0, log.n, ROWS):
        rows = slice(start, min(log.n, start + ROWS))
        here = [picture for picture in pictures if start < picture.before <= rows.stop]
        pull = Pull(0, start == 0, start, log.readings.select(rows), track.select(rows), pictures=here)
        file.write(pull)
        drawing(pull)
    file.close()
