"""The engine: one thread that owns the log and the fold, and lets everybody else read copies.

Events, commands and finished refolds come through one inbox and are dealt with in order. Views pull; nothing they
do, or fail to do, reaches this thread.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.diagnostics.health import HealthPolicy
from estimators.diagnostics.sensor_states import sensor_states
from estimators.errors import EstimatorError, NisusError
from estimators.fold import Fold
from estimators.late import inflated
from estimators.log import READING, TICK, Events, Log
from estimators.numerics.peaks import peaks_of
from estimators.registry import find_estimator
from estimators.snapshots import SPARSE_EVERY, Base
from estimators.track import TRACKING, WAITING
from estimators.versions import model_version_at

from ..intake import Intake
from ..stderr import complain
from . import commands
from .alerts import Alerts
from .blame import Blame
from .chronicle import Chronicle
from .counts import Latency, RowCounts, last_run
from .execute import Remembered, execute
from .faults import Faulty
from .feeder import Feeder, Finished, Restarted
from .host_clock import HostClock
from .idle_ticks import IdleTicks
from .integrity import MOST, IntegrityWatch, Window, window
from .interface import Records
from .notices import Notices
from .outputs import Belief, Cursor, Here, Pull, Status
from .playback import playback_status
from .refolder import Refolded, Refolder, Requests
from .revisions import Revisions
from .silence import Silence
from .stall import Stall

if TYPE_CHECKING:
    from estimators.diagnostics.episodes import Episode
    from estimators.diagnostics.field_pictures import Picture
    from estimators.events.clocks import Passed
    from estimators.tuning import Tuning
    from sources.source import Source

    from ..twin.twin import Twin

STATUS_AGE = 0.1

LATELY = 1024
"""Events of which it is told how far readings are apart."""


class Engine:
    """A running twin."""

    def __init__(
        self,
        twin: Twin,
        open_source: Callable[[Callable[[str, str], None]], Source],
        *,
        base: Base | None = None,
        horizon: float | None = None,
    ) -> None:
        """Open the source and prepare the fold.

        Args:
            twin: What to run.
            open_source: Called with a report function; must give the source, paced or live.
            base: Where the fold of the source's first event starts, if not at the prior (a recording's).
            horizon: Seconds of lateness allowed, in place of the twin's; infinity takes every reading (a recording's
                were judged when they came).

        Raises:
            NisusError: If the source cannot be opened or the model does not compile.
        """
        self.twin = twin
        self.model = twin.model
        self.pairs = twin.pairs
        section = twin.config.time
        self._policy = twin.policy
        allowed = section.horizon if horizon is None else horizon
        self._horizon = round(allowed * 1e9) if np.isfinite(allowed) else None
        self._first_base = base
        self._tick = section.tick
        self._history = max(2 * SPARSE_EVERY, twin.config.history)
        self.estimator, self.tuning = twin.estimator, twin.tuning
        self._options = Remembered(twin)
        self._lock = threading.Lock()
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._cursors: list[Cursor] = []
        self.notices = Notices(lambda: self._log.newest if self._log.n else 0)
        self._base: Base | None = base
        self._logs = 0
        self._clear(base)
        self._feeder = Feeder(lambda: open_source(self.notices.report), self._inbox, self.notices.report)
        self._refolder = Refolder(self._inbox.put)
        self._requests = Requests()
        self.revisions = Revisions(self.estimator, self.tuning)
        self._revision = 0
        self._stopping = threading.Event()
        self._finished = False
        self._idle_ticks = IdleTicks(section.tick)
        self._latency = Latency()
        self._clock = HostClock(self.notices, section.horizon)
        self._chronicle = Chronicle(self)
        self._alerts = Alerts(self.notices, lambda: self._chronicle.account.in_alarm)
        self._silence = Silence(self.notices, section.stale_after)
        self._stall = Stall(self._say_stalled)
        self._integrity = IntegrityWatch(self.model, self.last_events, self._policy.false_alarm_every)
        self._blame = Blame(self.model, lambda: self._chronicle.account.episodes, self.last_events, self.notices)
        self._status: tuple[float, Status] | None = None
        self.recorder: Records | None = None
        self._thread = threading.Thread(target=self._run, name="engine", daemon=True)

    def _clear(self, base: Base | None) -> None:
        """An empty log and the fold that follows it."""
        self._log = Log.of(self.model, capacity=self._history + 4 * SPARSE_EVERY)
        if base is not None:
            self._log.first, self._log.floor, self._log.version = base.first, base.clock, base.version
        self._logs += 1
        self._base = base
        self._fold = self._make_fold(self.estimator, self.tuning, self._log, base)
        self._row_counts = RowCounts(self.model)
        self._late = 0
        self._intake = Intake(self.model, self._horizon, self.notices.report, self.twin.maintenance)

    def _make_fold(self, estimator: str, tuning: Tuning, log: Log, base: Base | None) -> Fold:
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
        )

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Nothing changes meanwhile; also not beneath a fold that never returns, which keeps the lock for ever."""
        while not (held := self._lock.acquire(timeout=0.05)) and self._stall.text is None:
            pass
        try:
            yield
        finally:
            if held:
                self._lock.release()

    # For everybody, from any thread

    def start(self) -> None:
        """Begin to read and fold."""
        self._stall.start()
        self._refolder.start()
        self._thread.start()
        self._chronicle.start()
        self._feeder.start()
        self._integrity.start()
        self._blame.start()

    def stop(self) -> None:
        """Stop reading and folding."""
        self._stopping.set()
        self._integrity.stop()
        self._blame.stop()
        self._feeder.stop()
        self._refolder.stop()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0 if self._stall.text is None else 0.1)
        self._chronicle.stop()
        self._stall.stop()

    def submit(self, command: commands.Command) -> None:
        """Queue a command."""
        self._inbox.put(command)

    def cursor(self, *, follows_log: bool = False, span: int | None = None) -> Cursor:
        """A cursor for one consumer, for `pull`; give it back with `release`. See `Cursor` for the rest."""
        cursor = Cursor(follows_log=follows_log, span=span)
        with self._reading():
            self._cursors.append(cursor)
        return cursor

    def release(self, cursor: Cursor) -> None:
        """Forget a cursor."""
        with self._reading():
            self._cursors = [item for item in self._cursors if item is not cursor]

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

    @property
    def source(self) -> Source:
        """Where the readings come from; it may be reopened."""
        return self._feeder.source

    @property
    def policy(self) -> HealthPolicy:
        """When the estimate may be trusted."""
        return self._policy

    def options_of(self, estimator: str) -> Mapping[str, float]:
        """The options with which an estimator starts: as it runs, as it was left, or as the YAML says."""
        return self.tuning.options if estimator == self.estimator else self._options.of(estimator)

    def span(self) -> tuple[int, int]:
        """Times of the first and the last event, ns; zeros while there is none."""
        with self._reading():
            return (int(self._log.t[0]), int(self._log.t[self._log.n - 1])) if self._log.n else (0, 0)

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

    def episodes(self) -> list[Episode]:
        """What was and is wrong, in the order of its start; at most a second behind the rows."""
        return [self._blame.told(episode) for episode in self._chronicle.account.episodes]

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

    def last_events(self, most: int = MOST) -> Window | None:
        """The last events, to fold them again; None while there are none, or a refold is waited for."""
        with self._reading():
            return None if self._requests.waiting else window(self._fold, self._revision, most)

    def status(self) -> Status:
        """What a panel shows; computed at most ten times a second."""
        kept = self._status
        if kept is not None and time.monotonic() - kept[0] < STATUS_AGE:
            return kept[1]
        source = self._feeder.source
        layer = source.faults if isinstance(source, Faulty) else None
        lost = layer.lost if layer is not None else 0
        with self._reading():
            log, fold = self._log, self._fold
            track = fold.track
            last = fold.n - 1
            now = log.t[last] * 1e-9 if last >= 0 else 0.0
            states = sensor_states(self.model, fold.tuning.used, fold.evidence, now, self._policy)
            health = int(track.health[last]) if last >= 0 else self._silence.health
            account = self._chronicle.account
            leading = account.leading(dict(zip(self.model.sensor_names, states, strict=True)))
            status = Status(
                estimator=self.estimator,
                tuning=self.tuning,
                options=find_estimator(self.estimator, self.model).complete(dict(self.tuning.options)),
                revision=self._revision,
                refolding=self._requests.waiting,
                t=int(log.t[last]) if last >= 0 else None,
                health=health,
                since=int(log.t[last_run(track.health)]) if last >= 0 else None,
                cause=self._cause(leading, health) if last >= 0 else self._silence.cause,
                sensors=account.of_sensors(self.model.sensor_names, states),
                episodes_open=len(account.lasting),
                lost=self._alerts.lost,
                model_version=model_version_at(log, int(log.t[last])) if last >= 0 else log.version,
                clock=self._clock.estimate,
                counts={
                    **self.notices.counts(),
                    **({"inflated": self._late} if self._late else {}),
                    **({"held": self._intake.held} if self._intake.held else {}),
                    **self._row_counts.count(track, log.channel),
                    **({"recovered": fold.recoveries()} if fold.recoveries() else {}),
                    **({"silenced": lost} if lost else {}),
                },
                account=fold.account(),
                nis=float(track.nis_mean[last]) if last >= 0 else np.nan,
                nis_low=float(track.nis_low[last]) if last >= 0 else np.nan,
                nis_high=float(track.nis_high[last]) if last >= 0 else np.nan,
                **playback_status(self._feeder.source),
                finished=self._finished,
                recording=self.recorder.path if self.recorder is not None else None,
                latency_ms=self._latency.percentile(99.0),
                latency_p50_ms=self._latency.percentile(50.0),
                integrity=self._integrity.of(self._revision),
                faults=layer.status() if layer is not None else (),
            )
        self._status = (time.monotonic(), status)
        return status

    def _cause(self, leading: Episode | None, health: int) -> str:
        """Why the twin is not to be trusted now."""
        return self._blame.told(leading).text if leading is not None and health not in (WAITING, TRACKING) else ""

    # The engine's own thread

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._round()
            except NisusError as error:
                self.notices.report("engine error", str(error), level="error")
            except Exception as error:  # noqa: BLE001  nothing a user or a sensor does may stop the twin
                self.notices.report("engine error", f"{type(error).__name__}: {error}", level="error")

    def _round(self) -> None:
        """Wait for something, then deal with all that is there."""
        try:
            item = self._inbox.get(timeout=min(0.05, self._tick))
        except queue.Empty:
            self._when_silent()
            return
        batches: list[Events] = []
        while item is not None:
            if isinstance(item, Events):
                batches.append(item)
                if not self._feeder.live:
                    self._feeder.taken()
            else:
                self._accept(batches)
                batches = []
                self._execute(item)
            try:
                item = self._inbox.get_nowait() if sum(map(len, batches)) < SPARSE_EVERY else None
            except queue.Empty:
                item = None
        self._accept(batches)

    def _accept(self, batches: list[Events]) -> None:
        if not batches:
            return
        batch = batches[0] if len(batches) == 1 else Events.concat(batches, self.model.width)
        passed = self._intake.take(batch)
        self._put(passed)
        if self._feeder.live:
            self._latency.note(batch)
            self._clock.note(passed.events)

    def _put(self, passed: Passed) -> None:
        with self._lock, self._stall.watched(self._fold):
            events = passed.events
            if self._horizon is not None and self.twin.late.inflate:
                events, late = inflated(events, self._fold, self._log.newest, self._horizon)
                self._late += late
            stale = self._take(events, self._horizon, passed.settled)
            self._idle_ticks.broken(self._log.newest)
            if self._log.n:
                self._silence.broken()
            if self._log.n > self._history + 3 * SPARSE_EVERY:
                self._forget()
        if stale:
            text = f"{stale} reading(s) later than the horizon, or older than the history, dropped"
            self.notices.report("stale", text, times=stale)

    def _take(self, batch: Events, horizon: int | None = None, settled: np.ndarray | None = None) -> int:
        """Put events where they belong, and fold from there on; how many were stale."""
        first, stale = self._log.extend(batch, horizon, settled)
        before = min(first, self._fold.n)
        if first < self._fold.n:
            self._go_back(first)
        self._fold.advance()
        self._alerts.look(self._fold, before)
        return stale

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
        """Drop the oldest events, up to a snapshot, from which later refolds start."""
        count = (self._log.n - self._history) // SPARSE_EVERY * SPARSE_EVERY
        count, self._base = self._fold.base_at(count)
        if count:
            self._row_counts.forget(self._fold.track.select(slice(0, count)), self._log.channel[:count])
            self._fold.drop_front(count)
            self._log.drop_front(count)

    def _when_silent(self) -> None:
        if self._finished:
            return
        if not self._log.n:
            self._silence.look(live=self._feeder.live)
            return
        now = self._idle_ticks.asks(self._feeder.source, int(self._log.t[self._log.n - 1]))
        if now is not None:
            self.insert(Events.one(now, time.time_ns(), TICK, 0, [], self.model.width))

    def _say_stalled(self, text: str, level: str) -> None:
        self.notices.say(text, level=level)
        complain(text)

    def _execute(self, item: Any) -> None:
        """Carry one command out, or take a refold or a word from the feeder."""
        if isinstance(item, Refolded):
            self._adopt(item)
        elif isinstance(item, Restarted):
            self._restart()
        elif isinstance(item, Finished):
            self._put(self._intake.finish())
            with self._lock, self._stall.watched(self._fold):
                self._fold.finish()
            self._finished = True
            self.notices.say("the source has ended; the estimate stays")
        else:
            execute(item, self)

    def _restart(self) -> None:
        """The source began again: so does the log. The fold is a new revision of it; a refold is asked for again."""
        wanted = (self.estimator, self.tuning) if self._requests.waiting else None
        with self._lock, self._stall.watched(self._fold):
            self.estimator, self.tuning = self._fold.estimator.name, self._fold.tuning
            self._clear(self._first_base)
            self._revision += 1
            self.revisions.restarted(self._revision)
            self.notices.revision = self._revision
            self._finished = False
            self._requests.forget()
            self.notices.begin_again()
            self._alerts.again()
        if wanted:
            self.retune(*wanted)

    def insert(self, event: Events) -> None:
        """Put in an event of our own."""
        with self._lock, self._stall.watched(self._fold):
            self._take(event)

    def retune(self, estimator: str, tuning: Tuning) -> None:
        """Fold the history again, beside the running fold, over a copy of the log."""
        self._options.leave(self.estimator, self.tuning)
        # First, so that nobody sees the new tuning without a refold that is waited for.
        ticket = self._requests.ask()
        self.estimator, self.tuning = estimator, tuning
        log, base = self._log.copy(), self._base
        self._refolder.request(ticket, lambda: self._make_fold(estimator, tuning, log, base))
        self._status = None

    def _adopt(self, done: Refolded) -> None:
        """Swap a finished refold in, after it has caught up with what came meanwhile."""
        # Answered under the lock, so that nobody sees the old fold, and that none is waited for.
        with self._lock:
            wanted, changed_from = self._requests.answer(done.ticket)
            if wanted and not self._swap(done, changed_from):
                # The log was cut meanwhile: ask again.
                self.retune(self.estimator, self.tuning)

    def _swap(self, done: Refolded, changed_from: int | None) -> bool:
        """Go on with a refold, or say why not; False if it no longer fits the log."""
        if done.fold is None:
            self._refuse(done.ticket, done.error)
            return True
        fold = done.fold
        with self._stall.watched(fold):
            old, log = self._fold, self._log
            # What the new revision says of the readings counts, also of those that it loses here; not what others said.
            lost = max(0, log.first - fold.log.first)
            row_counts = RowCounts(self.model)
            row_counts.forget(fold.track.select(slice(0, lost)), fold.log.channel[:lost])
            try:
                fold.follow(log, changed_from)
            except EstimatorError:
                return False
            try:
                fold.advance()
            except NisusError as error:
                self._refuse(done.ticket, str(error))
                return True
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
            self._revision += 1
            self.notices.revision = self._revision
            self._alerts.again()
            self._alerts.look(fold, fold.n)
        return True

    def _refuse(self, ticket: int, reason: str) -> None:
        """A refold failed: what runs goes on, and is what the panel shows."""
        self.notices.say(f"not folded again: {reason}", level="error")
        if ticket == self._requests.newest:
            self.estimator, self.tuning = self._fold.estimator.name, self._fold.tuning


def _since(fold: Fold, index: int, end: int) -> list[Picture]:
    """The pictures of a fold after event `index`, up to event `end`."""
    if fold.pictures is None:
        return []
    return [picture for picture in fold.pictures.taken if index < picture.before <= end]
