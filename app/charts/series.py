"""Series of a running twin: one set of levels of detail for all browsers, none without a browser."""

from __future__ import annotations

import threading
from collections.abc import Iterable

from sources.source import span_of

from ..columns import columns_of
from ..derive.background_folds import PinnedFold, Smoother
from ..engine.engine import Engine
from .chart_stream import ChartStream
from .charted_run import ChartedRun, KeptRows, RowSource

LIVE, PREVIOUS, SMOOTHED = "live", "previous", "smoothed"

DIFFERENCE = "difference:"
"""Before the number of a pinned run: its means less those of the running fold."""


class Series:
    """Frames for the chart streams of all browsers. Thread-safe."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.columns = columns_of(engine.model)
        self.streams: set[ChartStream] = set()
        """Open chart streams."""
        self.runs: dict[str, ChartedRun] = {}
        """Runs that they show, by name."""
        self._lock = threading.Lock()
        self._pinned: dict[str, PinnedFold] = {}
        self._smoother: Smoother | None = None
        self._origin: int | None = None

    def origin(self) -> int | None:
        """Return the time from which charts count, ns: the start of a recording, else the first event that was seen.

        None before the first event.
        """
        span = span_of(self._engine.source)
        first, newest = self._engine.span() if span is None else span
        if newest and (self._origin is None or span is not None or newest < self._origin):
            self._origin = first
        return self._origin

    def open(self, stream: ChartStream) -> None:
        """Open a chart stream."""
        with self._lock:
            self.streams.add(stream)

    def close(self, stream: ChartStream) -> None:
        """Close a chart stream."""
        with self._lock:
            self.streams.discard(stream)
            self._prune()

    def frames(self, streams: Iterable[ChartStream]) -> list[bytes]:
        """Return frames with the changes of these streams since the last call."""
        with self._lock:
            origin, newest = self.origin(), self._engine.span()[1]
            if origin is None or not newest:
                return []
            self._prune()
            asked = [stream for stream in streams if stream in self.streams]
            # Once for each name: its rows may be replaced meanwhile.
            runs = {name: self._find(name) for name in dict.fromkeys(stream.query.run for stream in asked)}
            shown = [(stream, run) for stream in asked if (run := runs[stream.query.run]) is not None]
            for stream, run in shown:
                stream.select(run, origin, newest)
            for name, run in runs.items():
                if run is not None:
                    viewers = [stream for stream in self.streams if stream.query.run == name]
                    run.sync({column for stream in viewers for column in stream.levelled})
                    for stream in viewers:
                        stream.mark_changed(run.changed)
            return [frame for stream, run in shown if (frame := stream.frame(run, origin)) is not None]

    def _find(self, name: str) -> ChartedRun | None:
        """Return a run by name: running, previous, smoothed, pinned, or a difference; None if there is none."""
        source, run = self._source(name.removeprefix(DIFFERENCE)), self.runs.get(name)
        if run is not None and run.source != source:
            self.runs.pop(name).close()
        if source is not None and name not in self.runs:
            self.runs[name] = ChartedRun(source, self.columns, self._engine if name.startswith(DIFFERENCE) else None)
        return self.runs.get(name)

    def _source(self, name: str) -> RowSource | None:
        engine = self._engine
        if name == LIVE:
            return engine
        if name == SMOOTHED:
            self._smoother = self._smoother or Smoother(engine)
            smoothed = self._smoother.latest
            return None if smoothed is None else KeptRows(smoothed)
        if name == PREVIOUS:
            previous = engine.revisions.previous()
            return None if previous is None else KeptRows(previous)
        run = next((run for run in engine.revisions.runs if run.pinned and str(run.number) == name), None)
        if run is None or run is engine.revisions.runs[-1]:
            return None
        kept, rows = run.track, engine.end()
        if name not in self._pinned and (kept is None or rows > kept.first + len(kept.events)):
            self._pinned[name] = PinnedFold(engine, run)
        fold = self._pinned.get(name)
        if fold is not None and fold.caught_up:
            return fold
        return None if kept is None else KeptRows(kept)

    def _prune(self) -> None:
        """Drop runs that no stream shows, and stop their folds."""
        shown = {stream.query.run for stream in self.streams}
        for name in self.runs.keys() - shown:
            self.runs.pop(name).close()
        sources = {name.removeprefix(DIFFERENCE) for name in shown}
        for name in self._pinned.keys() - sources:
            self._pinned.pop(name).stop()
        if self._smoother is not None and SMOOTHED not in sources:
            self._smoother.stop()
            self._smoother = None
