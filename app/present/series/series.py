"""Series of a running twin: one set of levels of detail for all browsers, none without a browser."""

from __future__ import annotations

import threading
from collections.abc import Iterable

from ...live.outputs import Pull
from ...live.running_fold import Running
from .chart_stream import ChartStream
from .charted_run import DifferenceRun, KeptRun, LiveRun, Run
from .columns import columns_of
from .pinned_runs import PinnedFold, PinnedRun
from .smoothed import Smoother

LIVE, PREVIOUS, SMOOTHED = "live", "previous", "smoothed"

ALL = 2**62
"""Later than every event."""

LESS = "difference:"
"""Before the name of a revision: its means less those of what runs."""


class Series:
    """Frames for the chart streams of all browsers. Thread-safe."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.columns = columns_of(engine.model)
        self._lock = threading.Lock()
        self._live: LiveRun | None = None
        self._kept: dict[str, KeptRun | DifferenceRun | PinnedRun] = {}
        self._besides: dict[str, PinnedFold] = {}
        self._smoothing: Smoother | None = None
        self._lanes: set[ChartStream] = set()
        self._origin: int | None = None

    def origin(self) -> int | None:
        """The time from which charts count seconds, ns: the start of a recording, else the first event that was seen.

        None while nothing has come.
        """
        span = self._engine.status().span
        first, newest = self._engine.span() if span is None else span
        if newest and (self._origin is None or span is not None or newest < self._origin):
            self._origin = first
        return self._origin

    def open(self, lane: ChartStream) -> None:
        """Open a chart stream."""
        with self._lock:
            self._lanes.add(lane)

    def close(self, lane: ChartStream) -> None:
        """Close a chart stream."""
        with self._lock:
            self._lanes.discard(lane)
            if not self._lanes:
                self._kept.clear()
                self._leave(set())
                if self._live is not None:
                    self._live.close()
                    self._live = None

    def frames(self, lanes: Iterable[ChartStream]) -> list[bytes]:
        """Return frames with the changes of these streams since the last call."""
        with self._lock:
            origin, newest = self.origin(), self._engine.span()[1]
            if origin is None or not newest:
                return []
            looked_at = {lane.wanted.run for lane in self._lanes}
            self._kept = {name: run for name, run in self._kept.items() if name in looked_at}
            self._leave({name.removeprefix(LESS) for name in looked_at})
            asked = [lane for lane in lanes if lane in self._lanes]
            # Once for each name: what it stands for may change meanwhile.
            runs = {name: self._find(name) for name in dict.fromkeys(lane.wanted.run for lane in asked)}
            shown = [(lane, run) for lane in asked if (run := runs[lane.wanted.run]) is not None]
            for lane, run in shown:
                lane.look(run, origin, newest)
            for name, run in runs.items():
                if run is not None:
                    self._sync(run, [lane for lane in self._lanes if lane.wanted.run == name])
            return [frame for lane, run in shown if (frame := lane.frame(run, origin)) is not None]

    def _sync(self, run: Run, lanes: list[ChartStream]) -> None:
        """Bring a run up to date for the streams that show it."""
        run.sync({column for lane in lanes for column in lane.levelled})
        for lane in lanes:
            lane.changed(run.changed)

    def _find(self, name: str) -> Run | None:
        """Return a run by name: running, previous, smoothed, pinned, or a difference; None if there is none."""
        if name == LIVE:
            if self._live is None:
                self._live = LiveRun(self._engine, self.columns)
            return self._live
        pull = self._pulled(name.removeprefix(LESS))
        kept = self._kept.get(name)
        if pull is None:
            self._kept.pop(name, None)
            return None
        beside = self._beside(name.removeprefix(LESS), pull)
        if beside is not None and beside.caught_up:
            if not isinstance(kept, PinnedRun) or kept.fold is not beside:
                kept = PinnedRun(beside, self.columns, self._engine if name.startswith(LESS) else None)
                self._kept[name] = kept
            return kept
        if isinstance(kept, PinnedRun):
            kept = None
        if kept is None or kept.of is not pull:
            if name.startswith(LESS):
                kept = DifferenceRun(pull, self.columns, self._engine)
            else:
                kept = KeptRun(pull, self.columns)
            self._kept[name] = kept
        return kept

    def _beside(self, name: str, pull: Pull) -> PinnedFold | None:
        """The fold of a pinned run that goes on; None while there is nothing that its kept rows lack."""
        found = self._besides.get(name)
        if (
            found is None
            and name not in (PREVIOUS, SMOOTHED)
            and self._engine.index_at(ALL) > pull.first + len(pull.events)
        ):
            found = self._besides[name] = PinnedFold(self._engine, self._engine.revisions.find(int(name)))
        return found

    def _leave(self, looked_at: set[str]) -> None:
        """End the folds of pinned runs that no client shows, and the smoother."""
        if self._smoothing is not None and SMOOTHED not in looked_at:
            self._smoothing.stop()
            self._smoothing = None
        for name in self._besides.keys() - looked_at:
            self._besides.pop(name).stop()

    def _pulled(self, name: str) -> Pull | None:
        if name == SMOOTHED:
            if self._smoothing is None:
                self._smoothing = Smoother(self._engine)
            return self._smoothing.latest
        if name == PREVIOUS:
            return self._engine.previous()
        pinned = {str(run.number): run.track for run in self._engine.revisions.runs if run.pinned}
        return pinned.get(name)
