"""The running fold and the log that it follows: moved by the engine's thread alone, read by all others as copies."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.diagnostics.health import HealthPolicy
from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.numerics.peaks import peaks_of
from estimators.snapshots import SPARSE_EVERY, Base

from .counts import RowCounts
from .interface import WINDOW_EVENTS
from .notices import Notices
from .outputs import Belief, Cursor, EventWindow, Here, Pull, event_window
from .refolder import BatchSizer, Requests
from .revisions import Revisions
from .watchdog import Watchdog

if TYPE_CHECKING:
    from estimators.diagnostics.field_pictures import Picture
    from estimators.tuning import Tuning

    from ..twin.twin import Twin

LATELY = 1024
"""Events of which it is told how far readings are apart."""


class RunningFold:
    """The log, the fold that follows it, and the revisions before.

    Whoever moves it (the methods at the end) holds the lock, for a piece of the fold at most; whoever reads holds it
    for no longer than copying takes. In between the log may have events that are not folded yet: nobody is shown them.
    """

    def __init__(self, twin: Twin, watchdog: Watchdog, base: Base | None, ready: Callable[[str], bool]) -> None:
        """Prepare the fold.

        Args:
            twin: What to fold.
            watchdog: Watches the thread that folds.
            base: Where the fold starts; None: the prior.
            ready: Whether a filter is compiled; while the first is not, an idle fold stands in its place.
        """
        self.twin = twin
        self.model = twin.model
        self.pairs = twin.pairs
        self._policy = twin.policy
        self._history = max(2 * SPARSE_EVERY, twin.config.history)
        self.estimator, self.tuning = twin.estimator, twin.tuning
        self._lock = FairLock()
        self._watchdog, self._ready = watchdog, ready
        self._batches = BatchSizer()
        self._cursors: tuple[Cursor, ...] = ()
        self._changing_cursors = threading.Lock()
        self._requests = Requests()
        self.revisions = Revisions(self.estimator, self.tuning)
        self._revision = 0
        self._logs = 0
        self._clear(base)
        self.notices = Notices(lambda: self._log.newest if self._log.n else 0)

    @contextmanager
    def _reading(self, patience: float = np.inf) -> Iterator[bool]:
        """Nothing changes meanwhile; also not beneath a fold that never returns, which keeps the lock for ever.

        It says whether that is so: not if the fold was at work for `patience` seconds.
        """
        end = time.monotonic() + patience
        while not (held := self._lock.acquire(timeout=min(0.05, patience))):
            if self._watchdog.text is not None or time.monotonic() >= end:
                break
        try:
            yield held or self._watchdog.text is not None
        finally:
            if held:
                self._lock.release()

    # For everybody, from any thread

    @property
    def policy(self) -> HealthPolicy:
        """When the estimate may be trusted."""
        return self._policy

    def cursor(self, *, follows_log: bool = False, span: int | None = None) -> Cursor:
        """A cursor for one consumer, for `pull`; give it back with `release`. See `Cursor` for the rest."""
        cursor = Cursor(follows_log=follows_log, span=span)
        with self._changing_cursors:
            self._cursors = (*self._cursors, cursor)
        return cursor

    def release(self, cursor: Cursor) -> None:
        """Forget a cursor."""
        with self._changing_cursors:
            self._cursors = tuple(item for item in self._cursors if item is not cursor)

    def pull(self, cursor: Cursor, limit: int | None = None, *, align: int = 1) -> Pull:
        """Copies of the rows since the cursor, from a multiple of `align` on, at most `limit`; the notices since."""
        with self._reading():
            log, fold = self._log, self._fold
            fresh = cursor.log != self._logs or (cursor.revision != self._revision and not cursor.follows_log)
            cursor.log, cursor.revision = self._logs, self._revision
            if fresh:
                cursor.next, cursor.picture = self._from(cursor.span), -1
            start = max(cursor.next // align * align, log.first)
            end = log.first + fold.n
            if limit is not None:
                end = min(end, start + limit)
            rows = slice(start - log.first, max(start, end) - log.first)
            readings = log.events.select(rows)
            pull = Pull(
                self._revision,
                fresh,
                start,
                Events(*(column.copy() for column in readings)),
                fold.track.select(rows).copy(),
                pictures=_since(fold, cursor.picture, max(start, end)),
                oldest=log.first,
                changed=max(cursor.next, log.first),
                version=log.version,
            )
            cursor.next = max(start, end)
            if pull.pictures:
                cursor.picture = pull.pictures[-1].before
        lines = self.notices.since(cursor.notice)
        if lines:
            cursor.notice = lines[-1].number + 1
        return replace(pull, notices=lines)

    def _from(self, span: int | None) -> int:
        """Absolute index of the first folded event in the last `span` ns; 0 of all."""
        n = self._fold.n
        if span is None or not n:
            return 0
        return self._log.first + int(np.searchsorted(self._log.t[:n], self._log.t[n - 1] - span))

    def rows(self, start: int, stop: int) -> Pull:
        """Copies of the rows with these absolute indices, as far as they are there; no cursor moves."""
        with self._reading():
            log, fold = self._log, self._fold
            start = min(max(start, log.first), log.first + fold.n)
            rows = slice(start - log.first, max(start, min(stop, log.first + fold.n)) - log.first)
            readings = log.events.select(rows)
            events = Events(*(column.copy() for column in readings))
            track = fold.track.select(rows).copy()
            return Pull(self._revision, False, start, events, track, oldest=log.first, version=log.version)

    def index_at(self, t: int) -> int:
        """Absolute index of the first folded event at or after a time, ns; the number of events if there is none."""
        with self._reading():
            return self._log.first + int(np.searchsorted(self._log.t[: self._fold.n], t))

    def span(self) -> tuple[int, int]:
        """Times of the first and the last event, ns; zeros while there is none. Waits for nobody."""
        return self._span

    def base(self) -> Base | None:
        """Where a fold of the present log starts, if its oldest events were dropped; else None, for the prior."""
        return self._base

    def origin(self, index: int) -> tuple[int, Base | None]:
        """Where a fold that gives the rows from `index` on can start: at an event at or before it, from a base.

        That is None for the prior. Revisions that follow have a snapshot there too, unless their state is so large
        that theirs are wider apart.
        """
        with self._reading():
            first = self._log.first
            at, base = self._fold.base_at(max(0, index // SPARSE_EVERY * SPARSE_EVERY - first))
            return first + at, base if at else self._base

    def folded_with(self) -> tuple[Tuning, str]:
        """Tuning and estimator of the fold that `pull` shows."""
        with self._reading():
            return self._fold.tuning, self._fold.estimator.name

    def previous(self) -> Pull | None:
        """The whole previous revision, for comparison, before a drag if one goes on; its arrays never change."""
        return self.revisions.previous()

    def belief(self) -> Belief:
        """The estimate now."""
        with self._reading():
            mean, cov = self._fold.moments()
            points, clock = self._fold.points(), self._fold.clock
            model, several = self._fold.model, self._fold.estimator.peaks is not None
        # Clustering takes milliseconds, which the engine's thread must not wait for.
        peaks = peaks_of(points, model.circular) if several else []
        return Belief(clock, mean, cov, points, tuple(peaks) if len(peaks) > 1 else ())

    def here(self) -> Here | None:
        """The filter as it stands, to fold on from; None while nothing has come. Copies its state, and no more."""
        with self._reading():
            fold, log = self._fold, self._log
            if not fold.n:
                return None
            lately = slice(max(0, fold.n - LATELY), fold.n)
            read = log.t[lately][log.kind[lately] == READING]
            step = (
                float(read[-1] - read[0]) * 1e-9 / (np.unique(read).size - 1)
                if read.size and read[-1] > read[0]
                else np.nan
            )
            t = int(log.t[fold.n - 1])
            return Here(self._revision, fold.estimator.name, fold.tuning, fold.base_here(), t, step)

    def last_events(self, limit: int = WINDOW_EVENTS, *, rows: bool = False) -> EventWindow | None:
        """Copy the last events, to fold them again; see `Running`."""
        with self._reading():
            if self._requests.waiting and not rows:
                return None
            return event_window(self._fold, self._revision, limit, origin=self._base, rows=rows)

    # For the thread that moves it

    @contextmanager
    def _moving(self) -> Iterator[None]:
        """Nobody reads meanwhile; a fold that does not return is noticed."""
        with self._lock, self._watchdog.watched(self._fold):
            try:
                yield
            finally:
                log = self._log
                self._span = (int(log.t[0]), int(log.t[log.n - 1])) if log.n else (0, 0)

    def _clear(self, base: Base | None) -> None:
        """An empty log and the fold that follows it."""
        self._log = Log.resume(self.model, base, capacity=self._history + 4 * SPARSE_EVERY)
        self._logs += 1
        self._base = base
        idle = not self._ready(self.estimator)
        self._fold = self._make_fold(self.estimator, self.tuning, self._log, base, idle=idle)
        self._row_counts = RowCounts(self.model)
        self._span = (0, 0)
        self._batches.begin()

    def _make_fold(self, estimator: str, tuning: Tuning, log: Log, base: Base | None, *, idle: bool = False) -> Fold:
        period = self.twin.picture if self.model.grid is not None else None
        return Fold(
            estimator,
            self.model,
            tuning,
            log,
            pairs=self.pairs,
            policy=self._policy,
            base=base,
            picture=period,
            expected=self.twin.expected,
            idle=idle,
            room=self._log.capacity,
        )

    def _extend(self, batch: Events, horizon: int | None, settled: np.ndarray | None) -> tuple[int, int]:
        """Put events where they belong, and fold the first of them; the first row that is new, and how many were stale.

        What was shown already is folded again at once, so that nobody sees the twin go back in time.
        """
        shown = self._fold.n
        newest = int(self._log.t[shown - 1]) if shown else 0
        first, stale = self._log.extend(batch, horizon, settled)
        if first < shown:
            self._go_back(first)
            again = int(np.searchsorted(self._log.t[: self._log.n], newest, side="right"))
            self._fold.advance(again - self._fold.n)
        self._batches.advance(self._fold)
        return min(first, shown), stale

    @property
    def _behind(self) -> bool:
        """Whether there are events that are to be folded."""
        return not self._fold.idle and self._fold.n < self._log.n

    def _go_back(self, index: int) -> None:
        """Events at and after `index` changed: fold them again, and let every cursor fetch them again."""
        self._fold.rewind(index)
        self._row_counts.changed(index)
        absolute = self._log.first + index
        self._requests.changed(absolute)
        for cursor in self._cursors:
            cursor.next = min(cursor.next, absolute)
            cursor.picture = min(cursor.picture, absolute)

    def _forget(self) -> None:
        """Once there are many, drop the oldest events, up to a snapshot, from which later refolds start."""
        if self._fold.idle or self._log.n <= self._history + 3 * SPARSE_EVERY:
            return
        count = (self._log.n - self._history) // SPARSE_EVERY * SPARSE_EVERY
        count, self._base = self._fold.base_at(count)
        if count:
            self._row_counts.forget(self._fold.track.select(slice(0, count)), self._log.channel[:count])
            self._fold.drop_front(count)
            self._log.drop_front(count)

    def _begin_again(self, base: Base | None) -> None:
        """Another log, and the fold of it that follows: a new revision."""
        self.estimator, self.tuning = self._fold.estimator.name, self._fold.tuning
        self._clear(base)
        self._count_up()
        self.revisions.restarted(self._revision)

    def _become(self, fold: Fold, row_counts: RowCounts) -> None:
        """Go on with another fold of the same log, which has caught up with it: a new revision."""
        old, log = self._fold, self._log
        self._batches.begin()
        if old.idle:  # the first
            self._fold, self._row_counts = fold, row_counts
            self.revisions.began_with(fold.estimator.name, fold.tuning)
            return
        events = Events(*(column[: old.n].copy() for column in log.events))
        pictures = _since(old, -1, log.first + old.n)
        left = Pull(
            self._revision,
            False,
            log.first,
            events,
            old.track,
            pictures=pictures,
            oldest=log.first,
            version=log.version,
        )
        self.revisions.left(left, fold.estimator.name, fold.tuning)
        self._fold, self._row_counts = fold, row_counts
        self._count_up()

    def _caught_up(self, fold: Fold, changed_from: int | None, stopping: threading.Event) -> RowCounts | None:
        """Let a refold follow the log, and fold what came meanwhile; None if it no longer fits the log.

        What the new revision says of the readings counts, also of those that it loses here; not what others said.

        Raises:
            NisusError: If an event does not fit the model.
        """
        log = self._log
        lost = max(0, log.first - fold.log.first)
        row_counts = RowCounts(self.model)
        row_counts.forget(fold.track.select(slice(0, lost)), fold.log.channel[:lost])
        try:
            fold.follow(log, changed_from)
        except EstimatorError:
            return None
        batches = BatchSizer()
        with self._watchdog.watched(fold):
            while batches.advance(fold):
                if stopping.is_set():
                    return None
        return row_counts

    def _count_up(self) -> None:
        self._revision += 1
        self.notices.revision = self._revision


def _since(fold: Fold, index: int, end: int) -> list[Picture]:
    """The pictures of a fold after event `index`, up to event `end`."""
    if fold.pictures is None:
        return []
    return [picture for picture in fold.pictures.taken if index < picture.before <= end]


class FairLock:
    """Held by one thread at a time. Whoever is next stands at the door, and all others behind."""

    def __init__(self) -> None:
        self._door, self._lock = threading.Lock(), threading.Lock()

    def acquire(self, timeout: float = -1) -> bool:
        """Take it, within so many seconds at the door and as many before it; whether that was possible."""
        if not self._door.acquire(timeout=timeout):
            return False
        try:
            return self._lock.acquire(timeout=timeout)
        finally:
            self._door.release()

    def release(self) -> None:
        """Let it go."""
        self._lock.release()

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *_: Any) -> None:
        self.release()
