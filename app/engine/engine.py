"""The engine: one thread owns the log and the fold; everybody else reads copies.

Events, commands and finished refolds arrive in one inbox and are handled in order. Views pull rows; nothing that they
do, or fail to do, reaches this thread.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.diagnostics.references import own_grades
from estimators.errors import NisusError, reason_of
from estimators.late import inflated
from estimators.log import INPUT, READING, TICK, Events
from estimators.registry import find_estimator
from estimators.snapshots import PERMANENT_SPACING, Base
from estimators.track import DEGRADED, DIVERGED, STALE, WAITING
from sources.messages import Messages
from sources.source import controls_of, is_utc, span_of

from ..terminal import complain
from ..twin.changes import merged
from ..twin.ingest import Ingest
from . import commands
from .batches import BatchSizer
from .compile_queue import CompileQueue
from .copies import LogTail, Status
from .execute import execute
from .feeder import Feeder, SourceBatch
from .jobs import Job, Jobs, LoopThread, run_all
from .outcomes import Outcomes
from .running_fold import Records, Running, StateWriter, StoredTwin
from .status import busy_status, past_status, status_of
from .watchdog import Watchdog
from .watchers import IdleTicks, Watchers

if TYPE_CHECKING:
    from estimators.diagnostics.episodes import Episode, TrackedEpisode
    from estimators.events.clocks import Passed
    from estimators.fold import Fold
    from estimators.tuning import Tuning
    from sources.source import Source

    from ..twin.twin import Twin
    from .counts import RowCounts

REFOLD_REMEDY = "the running estimate goes on. Correct the model, or choose another tuning"
"""End of the line about a refold that does not return."""

GESTURE_REFOLD_S = 1.0
"""Seconds after which a refold ends for a newer one of the same gesture, which else might never show anything."""

CATCH_UP_S = 0.1
"""Seconds for which a refold catches up in the engine's thread, which does nothing else meanwhile."""

WATCH_PERIOD_S = 0.5
"""Seconds between two looks for a fold that does not return."""

STATUS_PERIOD_S = 0.1
"""Seconds for which a status is reused."""

STATUS_TIMEOUT_S = 0.03
"""Seconds for which a status waits for the fold, longer than a batch usually takes."""


class Engine(Running):
    """A running twin: the thread that advances the fold, its source, commands, watchers and background jobs."""

    def __init__(
        self,
        twin: Twin,
        open_source: Callable[[Callable[[str, str], None]], Source],
        *,
        base: Base | None = None,
        horizon: float | None = None,
        compile_queue: CompileQueue | None = None,
        stored: StoredTwin | None = None,
    ) -> None:
        """Open the source and prepare the fold.

        Args:
            twin: The twin to run.
            open_source: Called with a report function; must return the source, paced or live.
            base: Start of the fold, if not the prior (that of a recording).
            horizon: Seconds of lateness allowed, in place of the twin's; infinity takes every reading (those of a
                recording were judged when it was made).
            compile_queue: Compiles filters, also the first, without which the log then begins. None: each is compiled
                where it is needed.
            stored: State of the twin to continue, in place of `base`.

        Raises:
            NisusError: If the source cannot be opened or the model does not compile.
        """
        self._inbox: queue.SimpleQueue[SourceBatch | Callable[[], object]] = queue.SimpleQueue()
        self._submitted: deque[Callable[[], object]] = deque()
        """Commands and reloads that wait in the inbox; a fold is left unfinished for them."""
        self._compile_queue = compile_queue or CompileQueue()
        super().__init__(twin, Watchdog(self._report_stalled), base, self._compile_queue.ready, stored)
        self._awaited = self.estimator if self._fold.idle else None
        self._gesture = ""
        """Gesture of the edit that asked for the present settings."""
        section = twin.config.time
        allowed = section.max_delay if horizon is None else horizon
        self._horizon = round(allowed * 1e9) if np.isfinite(allowed) else None
        self._first_base = base
        self._tick = section.predict_every
        self._last_options: dict[str, Mapping[str, float]] = {}
        self._compile_queue.report = lambda text: self.notices.say(text, level="warn")
        if self.twin.forced_baseline:
            self.notices.say(f"the baseline was accepted with --force: {self.twin.forced_baseline}", level="warn")
        self.outcomes = Outcomes()
        """What became of messages that were sent to it."""
        self._feeder = Feeder(
            lambda: open_source(self.notices.report),
            self._inbox,
            self.notices.report,
            restarted=self._restart,
            finished=self._finish,
        )
        self._begin_intake()
        # One at a time, at the priority of the engine; of the requests that arrive meanwhile only the latest counts.
        self._refolds = Jobs(self.notices, "refold", threads=1, niceness=0)
        # A long history may take minutes: only a function that does not return ends a refold.
        self._refold_watchdog = Watchdog(self._give_up, then=REFOLD_REMEDY, long=math.inf)
        self._watching = LoopThread(self._watch, "watchdog")
        self.reloads = 0
        self._thread = LoopThread(self._run, "engine")
        self._finished = False
        self._idle_ticks = IdleTicks(section.predict_every)
        self._prompt: int | None = None
        """Time of the newest event when measurements were last used in time, ns."""
        self.jobs = Jobs(self.notices)
        # Short ones, which must not wait for fits of minutes.
        self.monitors = Jobs(self.notices, "monitor", threads=1)
        self._pools = self._refolds, self.jobs, self.monitors
        self._watchers = Watchers(self)
        self.revisions.said = self._watchers.episodes_of
        self.recorder: Records | None = None
        self.store: StateWriter | None = None
        self._telling = threading.Lock()
        self._status = (-np.inf, self._status_now())
        if stored is not None:
            self._go_on_from(stored.tail)
            self._watchers.episode_log.restore(stored.episodes)

    def _begin_intake(self) -> None:
        """Begin a log, of which no event has been judged."""
        self._late = self._taken = self._skipped = 0
        self._intake_state = {}
        twin = self.twin
        self._intake = Ingest(
            self.model,
            self._horizon,
            self.notices.report,
            twin.maintenance,
            twin.unknown_inputs,
            is_utc(self._feeder.source),
            None if self._feeder.live else round(twin.degraded.seconds * 1e9),
        )

    def _go_on_from(self, tail: LogTail) -> None:
        """Continue with a stored log, whose events have been judged and reported."""
        if tail.intake:
            self._intake.restore(tail.intake, self._log.newest)
        paced = controls_of(self.source)
        if paced is not None and self._log.n:
            # It is read from its start again.
            self._skipped = tail.taken
            paced.seek(self._log.newest)
        self._taken, self._intake_state = tail.taken, tail.intake
        if self._log.n:
            # The age of the estimate includes the time for which the twin was stopped.
            stopped = max(0.0, (time.time_ns() - int(tail.events.arrival.max())) * 1e-9) if self._feeder.live else 0.0
            self._idle_ticks.broken(self._log.newest, stopped)
        self._inbox.put(self._fold_stored)

    # From any thread

    def start(self) -> None:
        """Begin to read and fold."""
        for part in (self._watching, self._thread, self._feeder, self._watchers, *self._pools):
            part.start()
        if self._awaited is not None:
            self._inbox.put(partial(self._compiled, self._awaited))

    def stop(self) -> None:
        """Stop reading and folding."""
        self._thread.stopping.set()
        # It may be in a function that does not return.
        end = partial(self._thread.stop, 5.0 if self._watchdog.text is None else 0.1)
        run_all(end, self._feeder.stop, self._compile_queue.stop, *(pool.stop for pool in self._pools))
        self._watchers.episode_log.stop()
        self._watching.stopping.set()

    def settle(self) -> None:
        """Carry out all that waits (events, commands, refolds, jobs) in this thread, for an engine without `start`."""
        while self._feeder.read(0.0) or not self._inbox.empty() or any(pool.step() for pool in self._pools):
            if not self._inbox.empty():
                self._round(0.0)

    def submit(self, command: commands.Command) -> None:
        """Queue a command."""
        self._submit(partial(execute, command, self))

    def reload(self, twin: Twin, why: str, *, exact: bool = False) -> None:
        """Queue a change to another twin of the same shape, or to the same one as it was saved anew.

        Args:
            twin: The new twin; `changes.obstacle` must have found no obstacle.
            why: Reason of the new revision.
            exact: Whether all its settings are taken; if not, settings changed on the page stay, unless the twin's
                files changed them too.
        """
        self._submit(partial(self._reload, twin, why, exact))

    def _submit(self, work: Callable[[], object]) -> None:
        self._submitted.append(work)
        self._inbox.put(lambda: self._submitted.popleft()())

    def options_of(self, estimator: str) -> Mapping[str, float]:
        """See `Running`."""
        if estimator == self.estimator:
            return self.tuning.options
        return self._last_options.get(estimator, self.twin.options_of(estimator))

    def episodes(self) -> list[Episode]:
        """Return all episodes in the order of their start; at most a second behind the rows."""
        return self._watchers.episodes()

    def tracked_episodes(self) -> tuple[TrackedEpisode, ...]:
        """Return the same with their keys, for the store."""
        return self._watchers.episode_log.summary.entries

    def status_at(self, t: int) -> Status:
        """Return the status with health, sensors, episodes and NIS as they were at a time, ns."""
        return past_status(self, self._watchers, t)

    def status(self) -> Status:
        """See `Running`."""
        with self._telling:  # one after the other, so that none replaces a newer one
            last, now = self._status, time.monotonic()
            if now - last[0] < STATUS_PERIOD_S:
                return self._with_lag(last[1])
            with self._reading(STATUS_TIMEOUT_S) as still:
                if still:
                    status = self._status_now()
                else:
                    # A refold counts as waiting until the revision that came of it is shown.
                    fields = self._known_fields(self._requests.waiting or last[1].revision != self._revision)
                    status = busy_status(last[1], fields, self._watchdog.busy)
            if self._status is last:  # what was asked for meanwhile is not in this one
                self._status = (now, status)
        return self._with_lag(status)

    def _with_lag(self, status: Status) -> Status:
        """Return a status, of a health that shows measurements which wait for longer than one may be missing."""
        age, late, since, sensors = time.monotonic() - status.heard, self._idle_ticks.late, status.t, status.sensors
        if not self._feeder.live or age <= self.policy.degraded_after or status.health in (WAITING, DIVERGED, STALE):
            return status
        if self._behind or not self._inbox.empty():
            cause = f"the filter is behind: measurements of the last {age:.3g} s are not folded yet"
        elif late > self.policy.degraded_after:
            cause = f"measurements are {late:.3g} s old when they arrive"
            since = self._span[0] if self._prompt is None else self._prompt
            old = dict.fromkeys(("tracking", "advisory"), ("degraded", cause))
            sensors = {name: old.get(known[0], known) for name, known in sensors.items()}
        else:
            return status
        health = STALE if age - late > self.policy.stale_after else DEGRADED
        return replace(status, health=health, since=since, cause=cause, sensors=sensors)

    def latest(self) -> Status:
        """Return the status with time, estimate, inputs and health of the newest row; the rest may be 0.1 s old."""
        status = self.status()
        with self._reading(STATUS_TIMEOUT_S) as still:
            fold, last = self._fold, self._fold.n - 1
            if not still or last < 0:
                return status
            row, u = fold.track.select(slice(last, last + 1)).copy(), fold.u.copy()
            t, revision, heard = int(self._log.t[last]), self._revision, self._idle_ticks.heard
        latest = replace(
            status,
            t=t,
            revision=revision,
            heard=heard,
            health=int(row.health[0]),
            cause=status.cause if int(row.health[0]) == status.health else "",
            mean=row.mean[0],
            std=row.std[0],
            inputs=u,
            grades=own_grades(self.model, row, u),
        )
        return self._with_lag(latest)

    def _status_now(self) -> Status:
        """Return the status of a fold that does not change meanwhile."""
        fields = self._known_fields(self._requests.waiting) | {"revision": self._revision}
        counts = self.notices.counts(), {"inflated": self._late, "held": self._intake.held}
        return status_of(self._fold, self._row_counts, self._watchers, self.source, fields, *counts)

    def _known_fields(self, refolding: bool) -> dict[str, object]:
        """Return the fields of a status that are known without the fold.

        Estimator and tuning are the requested ones, which differ from the fold's while a refold is waited for.
        """
        paced = controls_of(self.source)
        return {
            "estimator": self.estimator,
            "tuning": self.tuning,
            "options": find_estimator(self.estimator, self.model).complete(dict(self.tuning.options)),
            "refolding": refolding,
            "finished": self._finished,
            "recording": self.recorder.path if self.recorder is not None else None,
            "awaited": self._awaited,
            "compiling": self._compile_queue.states(),
            "paused": paced is not None and paced.paused,
            "speed": paced.speed if paced is not None else None,
            "seekable": paced is not None,
            "span": span_of(self.source),
            "heard": self._idle_ticks.heard,
        }

    # On the engine's own thread

    def _run(self) -> None:
        while not self._thread.stopping.is_set():
            try:
                self._round(min(0.05, self._tick))
                for tell in self.grown:
                    tell()
            except (Exception, SystemExit) as error:  # noqa: BLE001  no input of a user or sensor may stop the twin
                self.notices.report("engine error", reason_of(error), level="error")

    def _round(self, timeout: float) -> None:
        """Wait for an item, then handle all that are in the inbox."""
        try:
            item: SourceBatch | Callable[[], object] | None = self._inbox.get(timeout=timeout)
        except queue.Empty:
            self._when_idle()
            return
        batches: list[Events] = []
        mark = self._mark
        while item is not None:
            if isinstance(item, SourceBatch):
                batches.append(item.events)
                mark = item.mark
                if self._feeder.waits:
                    self._feeder.taken()
            else:
                self._accept(batches, mark)
                batches = []
                item()
            try:
                item = self._inbox.get_nowait() if sum(map(len, batches)) < PERMANENT_SPACING else None
            except queue.Empty:
                item = None
        self._accept(batches, mark)
        self._fold_on()

    def _accept(self, batches: list[Events], mark: int | None = None) -> None:
        if not batches:
            return
        batch = batches[0] if len(batches) == 1 else Events.concat(batches, self.model.width)
        if self._skipped:
            batch, self._skipped = batch.select(slice(self._skipped, None)), max(0, self._skipped - len(batch))
        passed = self._intake.take(batch)
        self._put(passed, len(batch), mark)
        if self._feeder.live and not self._fold.idle:
            self._watchers.arrived(batch, passed.events)

    def _put(self, passed: Passed, taken: int = 0, mark: int | None = None) -> None:
        with self._moving():
            self._taken += taken
            self._mark = self._mark if mark is None else mark
            self._intake_state = {} if self.store is None else self._intake.state()
            events = passed.events
            if self._horizon is not None and self.twin.late.inflate:
                events, late = inflated(events, self._fold, self._log.newest, self._horizon)
                self._late += late
            answers = isinstance(self.innermost, Messages)
            newest, old = self._log.lateness(events, self._horizon, passed.settled) if answers else (events.t, events.t)
            stale = self._take(events, self._horizon, passed.settled)
            if answers:
                self.outcomes.note(self._mark, events, *self._intake.came(events), events.t < newest, old)
            dropped = stale + len(passed.refused)
            self._watchers.dropped.note(self._log.newest, len(events) + len(passed.refused), dropped)
            if np.count_nonzero((events.kind == READING) | (events.kind == INPUT)) > stale:
                self._idle_ticks.arrived(self._feeder.source, events, self._log.newest)
                if self._idle_ticks.late <= self.policy.degraded_after:
                    self._prompt = self._log.newest
            if self._log.n:
                self._watchers.silence.broken()
        self._fold_on()
        with self._moving():
            self._forget()
        if stale:
            text = f"{stale} measurement(s) older than the time horizon or the history, dropped"
            self.notices.report("stale", text, times=stale)

    def _take(self, batch: Events, horizon: int | None = None, settled: np.ndarray | None = None) -> int:
        """Put events into the log and fold the first of them; return how many were stale."""
        before, stale = self._extend(batch, horizon, settled)
        self._watchers.alerts.report(self._fold, before)
        return stale

    def _fold_on(self) -> None:
        """Fold the rest in batches, between which others may read, until the twin is asked for something else."""
        while self._behind and not self._thread.stopping.is_set():
            with self._moving():
                before = self._fold.n
                self._batches.advance(self._fold)
                self._watchers.alerts.report(self._fold, before)
            if self._submitted:
                return
        self._idle_ticks.folded()

    def _fold_stored(self) -> None:
        """Fold the stored events, in batches as `_fold_on`; nothing about them is reported again."""
        while True:
            with self._moving():
                self._batches.advance(self._fold)
                self._watchers.alerts.examined(self._fold)
            if not self._behind or self._thread.stopping.is_set():
                return

    def _when_idle(self) -> None:
        if self._finished:
            return
        if not self._log.n:
            self._watchers.silence.check(live=self._feeder.live)
            return
        now = self._idle_ticks.asks(self._feeder.source, int(self._log.t[self._log.n - 1]))
        if now is not None:
            self.insert(Events.one(now, time.time_ns(), TICK, 0, [], self.model.width))

    def _watch(self) -> None:
        while not self._watching.stopping.wait(WATCH_PERIOD_S):
            self._watchdog.check()
            self._refold_watchdog.check()

    def _report_stalled(self, text: str, level: str) -> None:
        self.notices.say(text, level=level)
        if level != "error":  # which is printed as a notice
            complain(text)

    def _compiled(self, estimator: str) -> None:
        """The filter that was waited for can be had."""
        if estimator == self._awaited:
            self.retune(self.estimator, self.tuning, self._gesture)

    def _finish(self) -> None:
        """The source has ended."""
        self._put(self._intake.finish())
        while self._behind and not self._thread.stopping.is_set():
            self._fold_on()
        with self._moving():
            self._fold.finish()
        self._finished = True
        self.notices.say("the source has ended; the estimate stays")

    def _restart(self) -> None:
        """The source began again, and so does the log. The fold is a new revision; a refold is requested again."""
        wanted = (self.estimator, self.tuning, self._gesture) if self._requests.waiting else None
        with self._moving():
            self._begin_again(self._first_base)
            self._begin_intake()
            self._finished = False
            self._requests.forget()
            self.notices.begin_again()
            self._watchers.alerts.again()
        if wanted:
            self.retune(*wanted)

    def _reload(self, twin: Twin, why: str, exact: bool) -> None:
        """Fold the history again with another twin."""
        estimator, tuning = twin.estimator, twin.tuning
        if not exact:
            estimator, tuning = merged(self.twin, twin, self.estimator, self.tuning)
        self.twin, self.model, self.policy = twin, twin.model, twin.policy
        self.reloads += 1
        self.revisions.why = why
        # The options of the YAML count again.
        self._last_options = {}
        if exact:
            self.edit(estimator, tuning)
        else:
            # Undo would take back what the files changed too.
            self.revisions.edits.forget()
            self.retune(estimator, tuning)

    def insert(self, event: Events) -> None:
        """Put an event of the engine's own into the log."""
        with self._moving():
            self._take(event)
        self._fold_on()

    def edit(self, estimator: str, tuning: Tuning, gesture: str = "") -> None:
        """Fold the history again with an edit, which `Undo` takes back."""
        self.revisions.edits.add((self.estimator, self.tuning), (estimator, tuning), gesture)
        self.retune(estimator, tuning, gesture)

    def retune(self, estimator: str, tuning: Tuning, gesture: str = "") -> None:
        """Fold the history again beside the running fold, once the filter is compiled."""
        self._last_options[self.estimator] = self.tuning.options
        if tuning.model is not self.model:
            # Of a revision before the twin's files were saved.
            tuning = replace(tuning, model=self.model)
        # First, so that nobody sees the new tuning without a refold that is waited for.
        ticket = self._requests.add()
        with self._lock:
            self.estimator, self.tuning, self._gesture = estimator, tuning, gesture
        self._awaited = None if self._compile_queue.ready(estimator) else estimator
        self._status = (-np.inf, self._status[1])
        if self._awaited is not None:
            self._compile_queue.request(estimator, lambda name: self._inbox.put(partial(self._compiled, name)))
            return
        log, base = self._log.copy(), self._base
        self._ask_refold(ticket, lambda: self._make_fold(estimator, tuning, log, base), gesture)

    def _ask_refold(self, ticket: int, made: Callable[[], Fold], gesture: str, *progress: Any) -> None:
        self._refolds.run(
            "refold",
            lambda job: self._refold(ticket, made(), gesture, job, *progress),
            stale=lambda: ticket != self._requests.newest,
            failed=lambda reason: self._inbox.put(partial(self._adopt, ticket, None, reason)),
        )

    def _caught_up(self, fold: Fold, *, hurried: bool) -> bool:
        """Fold the events of meanwhile; return whether all are: not if a command waits, or if `hurried` for long."""
        batches, end = BatchSizer(), time.monotonic() + (CATCH_UP_S if hurried else math.inf)
        with self._watchdog.watched(fold):
            while batches.advance(fold):
                if self._thread.stopping.is_set() or self._submitted or time.monotonic() > end:
                    break
        return fold.n == self._log.n

    def _refold(self, ticket: int, fold: Fold, gesture: str, job: Job, *progress: Any) -> None:
        """Advance a new fold to its end, in a job; a newer request ends it, one of the same gesture after a while."""
        batches, self._refolding, begun = BatchSizer(), ticket, time.monotonic()
        with self._refold_watchdog.watched(fold):
            while batches.advance(fold):
                shown = gesture and gesture == self._gesture and time.monotonic() - begun < GESTURE_REFOLD_S
                if job.cancelled or not (job.wanted or shown):
                    return
        self._inbox.put(partial(self._adopt, ticket, fold, "", gesture, *progress))

    def _give_up(self, text: str, level: str) -> None:
        """Leave a refold in a function that does not return; its answer, should it come, is no longer waited for."""
        if level == "error":
            self._refolds.abandon()
            self._inbox.put(partial(self._adopt, self._refolding, None, text))

    def _adopt(
        self,
        ticket: int,
        fold: Fold | None,
        error: str = "",
        gesture: str = "",
        row_counts: RowCounts | None = None,
        left: float = math.inf,
    ) -> None:
        """Replace the running fold by a finished refold, after that has caught up with the log.

        If that takes long or a command waits, the refold continues as a job; `row_counts` are of the rows that it has
        lost, and `left` is the number of events that it was behind then. One that falls behind even so ends here.
        """
        wanted, changed_from = self._requests.state(ticket)
        again = False
        if wanted and fold is not None:
            try:
                # Nobody but this thread moves the log, and nobody sees this fold yet.
                row_counts = self._followed(fold, changed_from, row_counts)
                again = row_counts is None
                if not again and not self._caught_up(fold, hurried=self._log.n - fold.n <= left / 2):
                    behind, left = fold, self._log.n - fold.n
                    behind.follow(self._log.copy(), None)
                    self._requests.again(ticket)
                    self._ask_refold(ticket, lambda: behind, gesture, row_counts, left)
                    return
            except NisusError as failure:
                fold, error = None, str(failure)
        # Answered under the lock, and last, so that nobody sees the old fold without a refold that is waited for.
        with self._moving():
            if row_counts is not None and fold is not None:
                self._become(fold, row_counts, gesture)
                if self._finished:
                    fold.finish()
                self._watchers.alerts.again()
                self._watchers.alerts.report(fold, fold.n)
            elif wanted and not again:
                self.notices.say(f"not folded again: {error}", level="error")
                if ticket == self._requests.newest:
                    # The running fold goes on, and the page shows its settings.
                    self.estimator, self.tuning = self._fold.estimator.name, self._fold.tuning
            self._requests.answer(ticket)
        if again and not self._thread.stopping.is_set():
            # The log was cut meanwhile.
            self.retune(self.estimator, self.tuning, self._gesture)
