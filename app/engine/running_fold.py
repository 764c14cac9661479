"""The running fold and its log: changed by the engine's thread alone, copied by all other readers."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from estimators.diagnostics.considered_shares import considered_pairs
from estimators.diagnostics.episodes import TrackedEpisode
from estimators.diagnostics.references import withheld
from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.numerics.peaks import peaks_of
from estimators.snapshots import PERMANENT_SPACING, Base
from estimators.tuning import Tuning
from sources.source import Source

from ..result import JsonObject
from .batches import BatchSizer, FairLock, Requests
from .copies import AlertMute, Belief, Cursor, EventWindow, Here, LogTail, Pull, Status, event_window
from .counts import RowCounts
from .feeder import Feeder
from .jobs import Jobs
from .notices import Annotation, Annotations, Audit, AuditEntry, Notices
from .revisions import Revision, Revisions
from .watchdog import Watchdog

if TYPE_CHECKING:
    from estimators.diagnostics.field_pictures import Picture

    from ..twin.twin import Twin

WINDOW_EVENTS = 4000
"""Events of a window that is folded many times over."""

RATE_EVENTS = 1024
"""Last events from which the sample rate is found."""


class Records(Protocol):
    """Recorder of a running twin."""

    finished: list[Path]
    folder: Path
    """Folder of recordings that are given by name."""

    @property
    def path(self) -> Path | None:
        """The file that is being written."""

    def record(self, path: Path | None) -> None:
        """Record into a new file from now on, or finish the open one."""


class Published(Protocol):
    """Outputs of a running twin."""

    def json(self) -> JsonObject:
        """Return the state of outputs, receivers and alerts."""


class StateWriter(Protocol):
    """Writer of the store of a running twin."""

    def request_write(self) -> None:
        """Write soon."""

    def has(self, mark: int) -> bool | None:
        """Return whether the store has the events of the source up to a mark; None while it cannot be written."""


@dataclass(frozen=True)
class StoredTwin:
    """State of a twin whose process ended, for an engine that continues it.

    `twin` is under the tuning version that was loaded last, `tail` has the whole log. `runs` and `annotations` are
    those of the session. The state was `written` at that time, s since 1970, and `closed` is whether it was the last.
    `numbers` are the sequence numbers of messages that the log has, by sender, `commands` the last ones of
    users.
    """

    twin: Twin
    tail: LogTail
    runs: tuple[Revision, ...]
    annotations: tuple[Annotation, ...]
    written: float
    closed: bool
    numbers: JsonObject
    episodes: tuple[TrackedEpisode, ...]
    commands: tuple[AuditEntry, ...]


class Running(ABC):
    """A running twin: its log, the fold that follows it, and earlier revisions. The engine adds source and commands.

    The public methods may be called from any thread and never wait for a viewer: they hold the lock only to copy. The
    private ones below change the fold on the engine's thread and hold the lock for one batch at most. In between, the
    log may have events that are not folded yet; readers never see them.
    """

    jobs: Jobs
    monitors: Jobs
    recorder: Records | None
    published: Published | None = None
    """Outputs of the twin, None if it has none."""
    mute: AlertMute | None = None
    """Time in which no alerts are sent, None if it was never asked for."""
    grown: frozenset[Callable[[], object]] = frozenset()
    """Called on the engine's thread after each batch; they must return at once."""
    _feeder: Feeder

    def __init__(
        self,
        twin: Twin,
        watchdog: Watchdog,
        base: Base | None,
        ready: Callable[[str], bool],
        stored: StoredTwin | None = None,
    ) -> None:
        """Prepare the fold from a base, where None is the prior, or from the stored state of the twin.

        The watchdog watches the thread that folds. While the first filter is not compiled (`ready`), an idle fold takes
        its place.
        """
        self.twin = twin
        self.model = twin.model
        self.pairs = twin.pairs
        self.policy = twin.policy
        self.history = max(2 * PERMANENT_SPACING, twin.config.history)
        """Events that the log keeps at least."""
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
        self._taken = self._mark = 0
        """Events that the source gave since it began, and its mark after them; see `SourceBatch`."""
        self._intake_state: JsonObject = {}
        if stored is not None:
            self.estimator, self.tuning = stored.tail.estimator, stored.tail.tuning
            self.revisions.restore(stored.runs)
            self._revision = self.revisions.runs[-1].number
            base = stored.tail.base
        self._clear(base)
        self.notices = Notices(lambda: self._log.newest if self._log.n else 0)
        self.annotations = Annotations()
        self.audit = Audit(lambda: self.notices.revision)
        if stored is not None:
            self.annotations.restore(stored.annotations)
            self._log.extend(stored.tail.events)
            self._log.floor = max(self._log.floor, stored.tail.floor)
            self._note_span()
            self.audit.restore(stored.commands)

    @contextmanager
    def _reading(self, timeout: float = np.inf) -> Iterator[bool]:
        """Keep everything as it is meanwhile; yield False if the fold was at work for `timeout` seconds.

        Beneath a fold that never returns, which keeps the lock for ever, nothing changes either.
        """
        end = time.monotonic() + timeout
        while not (held := self._lock.acquire(timeout=min(0.05, timeout))):
            if self._watchdog.text is not None or time.monotonic() >= end:
                break
        try:
            yield held or self._watchdog.text is not None
        finally:
            if held:
                self._lock.release()

    # From any thread

    @property
    def source(self) -> Source:
        """The source of the measurements; it may be reopened."""
        return self._feeder.source

    @property
    def innermost(self) -> Source:
        """The source itself, also if faults are injected into it."""
        return self._feeder.innermost

    def cursor(self, *, follows_log: bool = False, span: int | None = None) -> Cursor:
        """Return a cursor of one consumer for `pull`, to be given back with `release`; for the options see `Cursor`."""
        cursor = Cursor(follows_log=follows_log, span=span)
        with self._changing_cursors:
            self._cursors = (*self._cursors, cursor)
        return cursor

    def release(self, cursor: Cursor) -> None:
        """Forget a cursor."""
        with self._changing_cursors:
            self._cursors = tuple(item for item in self._cursors if item is not cursor)

    def pull(self, cursor: Cursor, limit: int | None = None, *, align: int = 1) -> Pull:
        """Copy the rows since the cursor, from a multiple of `align` on and at most `limit`, and the notices since."""
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
            end = max(start, end)
            pictures = _since(fold, cursor.picture, end)
            pull = self._copy(start, end, fresh=fresh, pictures=pictures, changed=max(cursor.next, log.first))
            cursor.next = end
            if pull.pictures:
                cursor.picture = pull.pictures[-1].before
        lines = self.notices.since(cursor.notice)
        if lines:
            cursor.notice = lines[-1].number + 1
        return replace(pull, notices=lines)

    def tail(self, cursor: Cursor) -> LogTail:
        """Copy the events since the cursor, also those that are not folded yet, with what continues them."""
        with self._reading():
            log = self._log
            fresh, cursor.log = cursor.log != self._logs, self._logs
            start = log.first if fresh else max(cursor.next, log.first)
            cursor.next = log.first + log.n
            events = log.events.select(slice(start - log.first, None)).copy()
            settings, taken = (self._base, self.estimator, self.tuning), (self._taken, self._intake_state, self._mark)
            return LogTail(fresh, start, events, log.first, log.floor, *settings, *taken)

    def _from(self, span: int | None) -> int:
        """Return the absolute index of the first folded event in the last `span` ns; 0 for all."""
        n = self._fold.n
        if span is None or not n:
            return 0
        return self._log.first + int(np.searchsorted(self._log.t[:n], self._log.t[n - 1] - span))

    def rows(self, start: int, stop: int) -> Pull:
        """Copy the rows with these absolute indices, as far as they exist, and the pictures until then.

        No cursor moves.
        """
        with self._reading():
            end = self._log.first + self._fold.n
            start = min(max(start, self._log.first), end)
            stop = max(start, min(stop, end))
            return self._copy(start, stop, pictures=_since(self._fold, -1, stop))

    def _copy(self, start: int, stop: int, *, fresh: bool = False, **fields: Any) -> Pull:
        log, fold, rows = self._log, self._fold, slice(start - self._log.first, stop - self._log.first)
        events, track = log.events.select(rows).copy(), fold.track.select(rows).copy()
        fields |= {"oldest": log.first, "version": log.version, "settings": (fold.tuning, fold.estimator.name)}
        return Pull(self._revision, fresh, start, events, track, **fields)

    def index_at(self, t: int) -> int:
        """Return the absolute index of the first folded event at or after a time, ns; else that after the last."""
        with self._reading():
            return self._log.first + int(np.searchsorted(self._log.t[: self._fold.n], t))

    def end(self) -> int:
        """Return the absolute index after the last folded event."""
        with self._reading():
            return self._log.first + self._fold.n

    def settled(self) -> int:
        """Return the absolute index after the last folded event that no late measurement can change any more.

        If the horizon has many events, it is at least the middle of the history, which drops its oldest events.
        """
        with self._reading():
            log, n = self._log, self._fold.n
            oldest = log.newest - round(self.twin.config.time.max_delay * 1e9)
            return log.first + max(int(np.searchsorted(log.t[:n], oldest)), n - self.history // 2)

    def span(self) -> tuple[int, int]:
        """Return the times of the first and the last event, ns; zeros while there is none. Never waits."""
        return self._span

    def base(self) -> Base | None:
        """Return the start of a fold of the present log if its oldest events were dropped; None for the prior."""
        return self._base

    def origin(self, index: int) -> tuple[int, Base | None]:
        """Return an event at or before `index` at which a fold can start, and its base; None for the prior.

        Later revisions have a snapshot there too, unless their state is so large that theirs are wider apart.
        """
        with self._reading():
            first = self._log.first
            at, base = self._fold.base_at(max(0, index // PERMANENT_SPACING * PERMANENT_SPACING - first))
            return first + at, base if at else self._base

    def folded_with(self) -> tuple[Tuning, str]:
        """Return tuning and estimator of the fold that `pull` shows."""
        with self._reading():
            return self._fold.tuning, self._fold.estimator.name

    def belief(self, t: int | None = None) -> Belief:
        """Return the estimate after the last event at or before a time, ns; None is the present one.

        An earlier one is folded again from the snapshot before it, beside the running fold. Withheld states are NaN.
        """
        past = None if t is None else self.fold_until(t)
        with self._reading() if past is None else nullcontext():
            fold = self._fold if past is None else past
            mean, cov = fold.moments()
            points, clock, row = fold.points(), fold.clock, fold.track.select(slice(-1, None)).copy()
        # Clustering takes milliseconds, which the engine's thread must not wait for.
        peaks = peaks_of(points, fold.model.circular) if fold.estimator.peaks is not None else []
        hidden = np.asarray(fold.model.shown)[withheld(fold.model, row).any(axis=0)]
        if hidden.size:
            mean, points, peaks = mean.copy(), points.copy(), []
            mean[hidden], points[:, hidden] = np.nan, np.nan
        return Belief(clock, mean, cov, points, tuple(peaks) if len(peaks) > 1 else ())

    def fold_until(self, t: int) -> Fold | None:
        """Return a fold of its own, from the snapshot before the last event at or before a time, ns, up to that event.

        None while there are none, or none are folded.
        """
        with self._reading():
            if self._fold.idle:
                return None
            stop = max(1, int(np.searchsorted(self._log.t[: self._fold.n], t, side="right")))
            window = event_window(self._fold, self._revision, 1, origin=self._base, stop=stop)
        if window is None:
            return None
        fold = window.fold(policy=self.policy, expected=self.twin.expected)
        fold.advance()
        return fold

    def here(self) -> Here | None:
        """Return the state of the filter, to fold on from; None before the first event. Copies nothing else."""
        with self._reading():
            fold, log = self._fold, self._log
            if not fold.n:
                return None
            lately = slice(max(0, fold.n - RATE_EVENTS), fold.n)
            read = log.t[lately][log.kind[lately] == READING]
            step = (
                float(read[-1] - read[0]) * 1e-9 / (np.unique(read).size - 1)
                if read.size and read[-1] > read[0]
                else np.nan
            )
            t = int(log.t[fold.n - 1])
            return Here(self._revision, fold.estimator.name, fold.tuning, fold.base_here(), t, step)

    def last_events(self, limit: int = WINDOW_EVENTS, *, rows: bool = False) -> EventWindow | None:
        """Copy the last events, to fold them again; None while there are none.

        With `rows` the window has its track and begins where all revisions have a snapshot; without, it is None while
        a refold is under way.
        """
        with self._reading():
            if self._requests.waiting and not rows:
                return None
            return event_window(self._fold, self._revision, limit, origin=self._base, rows=rows)

    def window(self, since: int, until: int) -> EventWindow | None:
        """Copy the events between two times, ns, and those from the snapshot before on; None while there are none."""
        with self._reading():
            t = self._log.t[: self._fold.n]
            start, stop = (int(np.searchsorted(t, time, side="right")) for time in (since, until))
            if self._fold.idle or not stop:
                return None
            # The snapshot is that before the row whose estimate the change begins with.
            return event_window(self._fold, self._revision, stop - max(0, start - 1), origin=self._base, stop=stop)

    # Added by the engine

    @abstractmethod
    def status(self) -> Status:
        """Return the status, computed at most ten times per second; during a refold usually the previous one."""

    @abstractmethod
    def options_of(self, estimator: str) -> Mapping[str, float]:
        """Return the options with which an estimator starts: its running ones, its last ones, or those of the YAML."""

    @abstractmethod
    def edit(self, estimator: str, tuning: Tuning, gesture: str = "") -> None:
        """Fold the history again with an edit, which `Undo` takes back; on the engine's thread.

        Edits of one `gesture` are one revision.
        """

    @abstractmethod
    def retune(self, estimator: str, tuning: Tuning, gesture: str = "") -> None:
        """Fold the history again beside the running fold, over a copy of the log; on the engine's thread."""

    @abstractmethod
    def insert(self, event: Events) -> None:
        """Put an event of the engine's own into the log; on the engine's thread."""

    # On the engine's thread

    @contextmanager
    def _moving(self) -> Iterator[None]:
        """Exclude readers meanwhile, under the watchdog."""
        with self._lock, self._watchdog.watched(self._fold):
            try:
                yield
            finally:
                self._note_span()

    def _note_span(self) -> None:
        log = self._log
        self._span = (int(log.t[0]), int(log.t[log.n - 1])) if log.n else (0, 0)

    def _clear(self, base: Base | None) -> None:
        """Begin an empty log and the fold that follows it."""
        self._log = Log.resume(self.model, base, capacity=self.history + 4 * PERMANENT_SPACING)
        self._logs += 1
        self._base = base
        idle = not self._ready(self.estimator)
        self._fold = self._make_fold(self.estimator, self.tuning, self._log, base, idle=idle)
        self._row_counts = RowCounts(self.model)
        self._span = (0, 0)
        self._batches.begin()

    def _make_fold(self, estimator: str, tuning: Tuning, log: Log, base: Base | None, *, idle: bool = False) -> Fold:
        period = self.twin.picture if self.model.grid is not None else None
        # The last pairs tell how much of a band is noise; only charts read them.
        pairs = np.concatenate((self.pairs, considered_pairs(self.model)))
        return Fold(
            estimator,
            self.model,
            tuning,
            log,
            pairs=pairs,
            policy=self.policy,
            base=base,
            picture=period,
            expected=self.twin.expected,
            idle=idle,
            room=self._log.capacity,
        )

    def _extend(self, batch: Events, horizon: int | None, settled: np.ndarray | None) -> tuple[int, int]:
        """Put events into the log and fold the first of them; return the first new row and how many were stale.

        Rows that were shown before are folded again at once, so that no reader sees the twin go back in time.
        """
        shown = self._fold.n
        newest = int(self._log.t[shown - 1]) if shown else 0
        end = self._log.n
        first, stale = self._log.extend(batch, horizon, settled)
        if first < end:
            self._inserted(first)
        if first < shown:
            self._fold.rewind(first)
            self._row_counts.changed(first)
            again = int(np.searchsorted(self._log.events.t, newest, side="right"))
            self._fold.advance(again - self._fold.n)
        self._batches.advance(self._fold)
        return min(first, shown), stale

    @property
    def _behind(self) -> bool:
        """Whether events wait to be folded."""
        return not self._fold.idle and self._fold.n < self._log.n

    def _inserted(self, index: int) -> None:
        """Let every cursor fetch the events from `index` on again, and refolds fold them again."""
        absolute = self._log.first + index
        self._requests.changed(absolute)
        for cursor in self._cursors:
            cursor.next = min(cursor.next, absolute)
            cursor.picture = min(cursor.picture, absolute)

    def _forget(self) -> None:
        """Once there are many events, drop the oldest up to a snapshot, from which later refolds start."""
        if self._fold.idle or self._log.n <= self.history + 3 * PERMANENT_SPACING:
            return
        count = (self._log.n - self.history) // PERMANENT_SPACING * PERMANENT_SPACING
        count, self._base = self._fold.base_at(count)
        if count:
            self._row_counts.forget(self._fold.track.select(slice(0, count)), self._log.channel[:count])
            self._fold.drop_front(count)
            self._log.drop_front(count)

    def _begin_again(self, base: Base | None) -> None:
        """Begin another log and its fold, a new revision."""
        self.estimator, self.tuning = self._fold.estimator.name, self._fold.tuning
        self._clear(base)
        self._count_up()
        self.revisions.restarted(self._revision)

    def _become(self, fold: Fold, row_counts: RowCounts, gesture: str) -> None:
        """Go on with another fold of the same log, a new revision, or the same one while a gesture lasts."""
        old, log = self._fold, self._log
        self._batches.begin()
        if old.idle:  # the first
            self._fold, self._row_counts = fold, row_counts
            self.revisions.began_with(fold.estimator.name, fold.tuning)
            return
        # The old track is not copied: nobody changes it any more.
        events = Events(*(column[: old.n].copy() for column in log.events))
        pictures = _since(old, -1, log.first + old.n)
        left = replace(self._copy(log.first, log.first), events=events, track=old.track, pictures=pictures)
        self.revisions.left(left, fold.estimator.name, fold.tuning, gesture)
        self._fold, self._row_counts = fold, row_counts
        self._count_up()

    def _followed(self, fold: Fold, changed_from: int | None, row_counts: RowCounts | None) -> RowCounts | None:
        """Let a refold follow the log; return counts of the rows that it lost before and here, None if it does not fit.

        Raises:
            NisusError: If an event does not fit the model.
        """
        log = self._log
        lost = max(0, log.first - fold.log.first)
        row_counts = row_counts or RowCounts(self.model)
        row_counts.forget(fold.track.select(slice(0, lost)), fold.log.channel[:lost])
        try:
            fold.follow(log, changed_from)
        except EstimatorError:
            return None
        return row_counts

    def _count_up(self) -> None:
        self._revision += 1
        self.notices.revision = self._revision


def _since(fold: Fold, index: int, end: int) -> list[Picture]:
    """Return the pictures of a fold after event `index`, up to event `end`."""
    if fold.pictures is None:
        return []
    return [picture for picture in fold.pictures.taken if index < picture.before <= end]
