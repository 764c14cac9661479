"""The series of a running twin, for every browser that looks: one set of levels for all, and none while nobody does."""

from __future__ import annotations

import threading
from collections.abc import Iterable

from ..engine.interface import Running
from ..engine.outputs import Pull
from .beside import Beside, BesideRun
from .columns import columns_of
from .difference import DifferenceRun
from .lane import Lane
from .run import KeptRun, LiveRun, Run
from .smoothed import Smoothing

PREVIOUS, SMOOTHED = "previous", "smoothed"

ALL = 2**62
"""Later than every event."""

LESS = "difference:"
"""Before the name of a revision: its means less those of what runs."""


class Series:
    """Frames for the lanes of all browsers. Any thread may ask."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.columns = columns_of(engine.model)
        self._lock = threading.Lock()
        self._live: LiveRun | None = None
        self._kept: dict[str, KeptRun | DifferenceRun | BesideRun] = {}
        self._besides: dict[str, Beside] = {}
        self._smoothing: Smoothing | None = None
        self._lanes: set[Lane] = set()
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

    def open(self, lane: Lane) -> None:
        """A browser looks at this lane from now on."""
        with self._lock:
            self._lanes.add(lane)

    def close(self, lane: Lane) -> None:
        """Nobody looks at it any more."""
        with self._lock:
            self._lanes.discard(lane)
            if not self._lanes:
                self._kept.clear()
                self._leave(set())
                if self._live is not None:
                    self._live.close()
                    self._live = None

    def frames(self, lanes: Iterable[Lane]) -> list[bytes]:
        """What has changed in these lanes since they were asked last."""
        with self._lock:
            origin, newest = self.origin(), self._engine.span()[1]
            if origin is None or not newest:
                return []
            asked = [lane for lane in lanes if lane in self._lanes]
            looked_at = {lane.wanted.run for lane in self._lanes}
            self._kept = {name: run for name, run in self._kept.items() if name in looked_at}
            self._leave({name.removeprefix(LESS) for name in looked_at})
            self._sync({column for lane in asked if lane.wanted.run == "live" for column in lane.wanted.columns})
            frames = [frame for lane in asked if (frame := self._frame(lane, origin, newest)) is not None]
            return frames

    def _sync(self, columns: set[str]) -> None:
        if self._live is None:
            self._live = LiveRun(self._engine, self.columns)
        self._live.sync(columns)
        for lane in self._lanes:
            if lane.wanted.run == "live":
                lane.changed(self._live.changed)

    def _frame(self, lane: Lane, origin: int, newest: int) -> bytes | None:
        name = lane.wanted.run
        if name == "live":
            assert self._live is not None
            return lane.frame(self._live, origin, newest)
        run = self._find(name)
        if run is None:
            return None
        run.sync(lane.wanted.columns)
        if isinstance(run, BesideRun):
            for other in self._lanes:
                if other.wanted.run == name:
                    other.changed(run.changed)
        return lane.frame(run, origin, newest)

    def _find(self, name: str) -> Run | None:
        """The previous revision, what is smoothed, a pinned one, or one less what runs; None if there is none."""
        pull = self._pulled(name.removeprefix(LESS))
        kept = self._kept.get(name)
        if pull is None:
            self._kept.pop(name, None)
            return None
        beside = self._beside(name.removeprefix(LESS), pull)
        if beside is not None and beside.caught_up:
            if not isinstance(kept, BesideRun) or kept.beside is not beside:
                kept = BesideRun(beside, self.columns, self._engine if name.startswith(LESS) else None)
                self._kept[name] = kept
            return kept
        if isinstance(kept, BesideRun):
            kept = None
        if kept is None or kept.of is not pull:
            if name.startswith(LESS):
                kept = DifferenceRun(pull, self.columns, self._engine)
            else:
                kept = KeptRun(pull, self.columns)
            self._kept[name] = kept
        return kept

    def _beside(self, name: str, pull: Pull) -> Beside | None:
        """The fold of a pinned run that goes on; None while there is nothing that its kept rows lack."""
        found = self._besides.get(name)
        if (
            found is None
            and name not in (PREVIOUS, SMOOTHED)
            and self._engine.index_at(ALL) > pull.first + len(pull.events)
        ):
            found = self._besides[name] = Beside(self._engine, self._engine.revisions.find(int(name)))
        return found

    def _leave(self, looked_at: set[str]) -> None:
        """End the folds of pinned runs at which nobody looks, and the smoother."""
        if self._smoothing is not None and SMOOTHED not in looked_at:
            self._smoothing.stop()
            self._smoothing = None
        for name in self._besides.keys() - looked_at:
            self._besides.pop(name).stop()

    def _pulled(self, name: str) -> Pull | None:
        if name == SMOOTHED:
            if self._smoothing is None:
                self._smoothing = Smoothing(self._engine)
            return self._smoothing.latest
        if name == PREVIOUS:
            return self._engine.previous()
        pinned = {str(run.number): run.track for run in self._engine.revisions.runs if run.pinned}
        return pinned.get(name)
