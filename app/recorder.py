"""Writes what a running twin concludes into a file, from a thread and a cursor of its own."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from estimators.errors import NisusError

from .pull import Pull
from .recording import RecordingFile
from .rerun_rows import RerunRows

if TYPE_CHECKING:
    from estimators.log import Log
    from estimators.track import Track

    from .engine import Engine
    from .twin import Twin

PERIOD = 0.4
"""Seconds between two writes; with what the operating system has after each, a killed process loses less than this."""

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
        self._file: RecordingFile | None = None
        self.finished: list[Path] = []
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
        cursor: Any = None
        drawing: Any = None
        while True:
            wanted = self._wanted
            try:
                if self._file is not None and wanted != self._file.path:
                    self._pass_on(cursor, drawing)
                    self._finish(cursor)
                if self._file is None and wanted is not None:
                    cursor, drawing = self._begin(wanted)
                if self._file is not None:
                    self._pass_on(cursor, drawing)
            except NisusError as error:
                self._fail(str(error), cursor)
            except Exception as error:  # noqa: BLE001  a full disk or a driver's fault must not stop the twin
                self._fail(f"{type(error).__name__}: {error}", cursor)
            if self._stopping and self._file is None:
                return
            self._wake.wait(PERIOD if self._file is not None else None)
            self._wake.clear()

    def _begin(self, path: Path) -> tuple[Any, Any]:
        twin = self._engine.twin
        base = self._engine.base()
        self._file = RecordingFile(path, name=twin.name, text=twin.text, twin_path=twin.path, base=base)
        self._engine.notices.say(f"recording into {path}")
        return self._engine.cursor(), self._draw(self._file.stream)

    def _pass_on(self, cursor: Any, drawing: Any) -> None:
        """Write everything that is there, in pieces."""
        assert self._file is not None
        while True:
            pull: Pull = self._engine.pull(cursor, ROWS)
            if pull.fresh:
                tuning, estimator = self._engine.folded_with()
                self._file.tuning(tuning, estimator, pull.first, pull.revision)
            self._file.write(pull)
            drawing(pull)
            if len(pull.readings) < ROWS:
                break
        self._file.flush()

    def _finish(self, cursor: Any) -> None:
        file, self._file = self._file, None
        self._engine.release(cursor)
        if file is not None:
            file.close()
            self.finished.append(file.path)
            self._engine.notices.say(f"recorded {file.rows} rows into {file.path}")

    def _fail(self, text: str, cursor: Any) -> None:
        self._engine.notices.report("recording failed", f"recording failed: {text}", level="error")
        self._wanted = None
        self._file = None
        if cursor is not None:
            self._engine.release(cursor)


def write_recording(path: Path, twin: Twin, log: Log, track: Track) -> None:
    """Write a finished fold as a recording, in the same form as a running twin's.

    Raises:
        SourceError: If the file cannot be written.
    """
    file = RecordingFile(path, name=twin.name, text=twin.text, twin_path=twin.path, base=None)
    drawing = RerunRows(file.stream, SimpleNamespace(model=twin.model, pairs=twin.pairs, twin=twin), series=None)
    file.tuning(twin.tuning, twin.estimator, 0, 0)
    for start in range(0, log.n, ROWS):
        rows = slice(start, min(log.n, start + ROWS))
        pull = Pull(0, start == 0, start, log.readings.select(rows), track.select(rows))
        file.write(pull)
        drawing(pull)
    file.close()
