"""The engine: one thread that owns the log and the fold, and lets everybody else read copies.

Events, commands and finished refolds come through one inbox and are dealt with in order. Views pull; nothing they
do, or fail to do, reaches this thread.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from estimators.errors import NisusError
from estimators.late import inflated
from estimators.log import TICK, Events
from estimators.snapshots import SPARSE_EVERY, Base

from ..concurrency import run_all
from ..intake import Intake
from ..terminal import complain
from . import commands
from .changes import Reloaded, merged
from .counts import RowCounts
from .execute import Remembered, execute
from .feeder import Feeder, Finished, Restarted
from .interface import Records
from .jobs import Jobs
from .outputs import Status
from .refolder import Refolded, Refolder
from .running_fold import RunningFold
from .status import Asked, kept_status, status_of
from .watchdog import Watchdog
from .watchers import IdleTicks, Watchers
from .workshop import Workshop

if TYPE_CHECKING:
    from estimators.diagnostics.episodes import Episode
    from estimators.events.clocks import Passed
    from estimators.tuning import Tuning
    from sources.source import Source

    from ..twin.twin import Twin

STATUS_AGE = 0.1
"""Seconds for which a status is kept."""

STATUS_PATIENCE = 0.03
"""Seconds for which a status waits for the fold, longer than a piece of it usually takes."""


class Ready:
    """In the inbox: a filter that was waited for is compiled."""

    def __init__(self, name: str) -> None:
        self.name = name


class Engine(RunningFold):
    """A running twin: the thread that moves the fold, and what asks of it, tells of it and watches it."""

    def __init__(
        self,
        twin: Twin,
        open_source: Callable[[Callable[[str, str], None]], Source],
        *,
        base: Base | None = None,
        horizon: float | None = None,
        workshop: Workshop | None = None,
    ) -> None:
        """Open the source and prepare the fold.

        Args:
            twin: What to run.
            open_source: Called with a report function; must give the source, paced or live.
            base: Where the fold of the source's first event starts, if not at the prior (a recording's).
            horizon: Seconds of lateness allowed, in place of the twin's; infinity takes every reading (a recording's
                were judged when they came).
            workshop: Compiles filters, also the first, without which the log then begins. None: each is compiled where
                it is needed.

        Raises:
            NisusError: If the source cannot be opened or the model does not compile.
        """
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._workshop = workshop or Workshop()
        super().__init__(twin, Watchdog(self._say_stalled), base, self._workshop.ready)
        self._awaited = self.estimator if self._fold.idle else None
        section = twin.config.time
        allowed = section.horizon if horizon is None else horizon
        self._horizon = round(allowed * 1e9) if np.isfinite(allowed) else None
        self._first_base = base
        self._tick = section.tick
        self._options = Remembered(twin)
        self._workshop.report = lambda text: self.notices.say(text, level="warn")
        self._begin_intake()
        self._feeder = Feeder(lambda: open_source(self.notices.report), self._inbox, self.notices.report)
        self._refolder = Refolder(self._inbox.put)
        self.reloads = 0
        self._stopping = threading.Event()
        self._finished = False
        self._idle_ticks = IdleTicks(section.tick)
        self.jobs = Jobs(self.notices)
        self._watchers = Watchers(self)
        self.revisions.said = self._watchers.episodes_of
        self.recorder: Records | None = None
        self._status: tuple[float, Status] | None = (-np.inf, self._status_now())
        self._thread = threading.Thread(target=self._run, name="engine", daemon=True)

    def _begin_intake(self) -> None:
        """A log begins: nothing of it has been judged."""
        self._late = 0
        self._intake = Intake(self.model, self._horizon, self.notices.report, self.twin.maintenance)

    # For everybody, from any thread

    def start(self) -> None:
        """Begin to read and fold."""
        self._watchdog.start()
        self._refolder.start()
        self._thread.start()
        self._feeder.start()
        self._watchers.start()
        self.jobs.start()
        if self._awaited is not None:
            self._inbox.put(Ready(self._awaited))

    def stop(self) -> None:
        """Stop reading and folding."""
        self._stopping.set()
        run_all(self._fold_last, self._feeder.stop, self._workshop.stop, self._refolder.stop, self.jobs.stop)
        self._watchers.stop()
        self._watchdog.stop()

    def settle(self) -> None:
        """Carry out all that waits (events, commands, refolds, jobs) in this thread, for an engine without `start`."""
        while self._feeder.read(0.0) or not self._inbox.empty() or self._refolder.step() or self.jobs.step():
            if not self._inbox.empty():
                self._round(0.0)

    def _fold_last(self) -> None:
        """Wait for the piece that is being folded."""
        if self._thread.is_alive():
            self._thread.join(timeout=5.0 if self._watchdog.text is None else 0.1)

    def submit(self, command: commands.Command) -> None:
        """Queue a command."""
        self._inbox.put(command)

    def reload(self, twin: Twin, why: str, *, exact: bool = False) -> None:
        """Queue going on with the twin as it was saved anew, of the same shape (see reload.py)."""
        self._inbox.put(Reloaded(twin, why, exact))

    @property
    def source(self) -> Source:
        """Where the readings come from; it may be reopened."""
        return self._feeder.source

    def options_of(self, estimator: str) -> Mapping[str, float]:
        """The options with which an estimator starts: as it runs, as it was left, or as the YAML says."""
        return self.tuning.options if estimator == self.estimator else self._options.of(estimator)

    def episodes(self) -> list[Episode]:
        """What was and is wrong, in the order of its start; at most a second behind the rows."""
        return self._watchers.episodes()

    def status(self) -> Status:
        """What a panel shows; computed at most ten times a second. Of a fold that is at work it is the last one."""
        kept = self._status
        if kept is not None and time.monotonic() - kept[0] < STATUS_AGE:
            return kept[1]
        with self._reading(np.inf if kept is None else STATUS_PATIENCE) as still:
            status = self._status_now() if still or kept is None else self._status_kept(kept[1])
        self._status = (time.monotonic(), status)
        return status

    def _status_now(self) -> Status:
        """That of a fold that stands still."""
        return status_of(
            self._fold,
            self._row_counts,
            self._watchers,
            self.source,
            self._asked(self._requests.waiting),
            revision=self._revision,
            inflated=self._late,
            held=self._intake.held,
            notices=self.notices.counts(),
        )

    def _status_kept(self, kept: Status) -> Status:
        """That of a fold that is at work; a refold is waited for until the revision that came of it is shown."""
        asked = self._asked(self._requests.waiting or kept.revision != self._revision)
        return kept_status(kept, asked, self.model, self.source, self._watchdog.busy)

    def _asked(self, refolding: bool) -> Asked:
        return Asked(
            self.estimator,
            self.tuning,
            refolding,
            self._finished,
            self.recorder.path if self.recorder is not None else None,
            self._awaited,
            self._workshop.states(),
        )

    # The engine's own thread

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._round(min(0.05, self._tick))
            except NisusError as error:
                self.notices.report("engine error", str(error), level="error")
            except (Exception, SystemExit) as error:  # noqa: BLE001  nothing a user or a sensor does may stop the twin
                self.notices.report("engine error", f"{type(error).__name__}: {error}", level="error")

    def _round(self, timeout: float) -> None:
        """Wait for something, then deal with all that is there."""
        try:
            item = self._inbox.get(timeout=timeout)
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
        if self._feeder.live and not self._fold.idle:
            self._watchers.arrived(batch, passed.events)

    def _put(self, passed: Passed) -> None:
        with self._moving():
            events = passed.events
            if self._horizon is not None and self.twin.late.inflate:
                events, late = inflated(events, self._fold, self._log.newest, self._horizon)
                self._late += late
            stale = self._take(events, self._horizon, passed.settled)
            self._idle_ticks.broken(self._log.newest)
            if self._log.n:
                self._watchers.silence.broken()
        self._fold_on()
        with self._moving():
            self._forget()
        if stale:
            text = f"{stale} reading(s) later than the horizon, or older than the history, dropped"
            self.notices.report("stale", text, times=stale)

    def _take(self, batch: Events, horizon: int | None = None, settled: np.ndarray | None = None) -> int:
        """Put events where they belong, and begin to fold them; how many were stale."""
        before, stale = self._extend(batch, horizon, settled)
        self._watchers.alerts.look(self._fold, before)
        return stale

    def _fold_on(self) -> None:
        """Fold what is left in pieces, between which others may read; none once the twin is asked to stop."""
        while self._behind and not self._stopping.is_set():
            with self._moving():
                before = self._fold.n
                self._batches.advance(self._fold)
                self._watchers.alerts.look(self._fold, before)

    def _when_silent(self) -> None:
        if self._finished:
            return
        if not self._log.n:
            self._watchers.silence.look(live=self._feeder.live)
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
        elif isinstance(item, Ready):
            if item.name == self._awaited:
                self.retune(self.estimator, self.tuning)
        elif isinstance(item, Restarted):
            self._restart()
        elif isinstance(item, Reloaded):
            self._reload(item)
        elif isinstance(item, Finished):
            self._put(self._intake.finish())
            with self._moving():
                self._fold.finish()
            self._finished = True
            self.notices.say("the source has ended; the estimate stays")
        else:
            execute(item, self)

    def _restart(self) -> None:
        """The source began again: so does the log. The fold is a new revision of it; a refold is asked for again."""
        wanted = (self.estimator, self.tuning) if self._requests.waiting else None
        with self._moving():
            self._begin_again(self._first_base)
            self._begin_intake()
            self._finished = False
            self._requests.forget()
            self.notices.begin_again()
            self._watchers.alerts.again()
        if wanted:
            self.retune(*wanted)

    def _reload(self, item: Reloaded) -> None:
        """Fold the history again with the twin as it was saved."""
        estimator, tuning = item.twin.estimator, item.twin.tuning
        if not item.exact:
            estimator, tuning = merged(self.twin, item.twin, self.estimator, self.tuning)
        self._options.leave(self.estimator, self.tuning)
        self.twin, self.model, self._policy = item.twin, item.twin.model, item.twin.policy
        self._options.begin(item.twin)
        self.reloads += 1
        self.revisions.why = item.why
        self.retune(estimator, tuning)

    def insert(self, event: Events) -> None:
        """Put in an event of our own."""
        with self._moving():
            self._take(event)
        self._fold_on()

    def retune(self, estimator: str, tuning: Tuning) -> None:
        """Fold the history again, beside the running fold, over a copy of the log; when the filter is compiled."""
        self._options.leave(self.estimator, self.tuning)
        if tuning.model is not self.model:
            # Of a revision before the twin's files were saved.
            tuning = replace(tuning, model=self.model)
        # First, so that nobody sees the new tuning without a refold that is waited for.
        ticket = self._requests.ask()
        self.estimator, self.tuning = estimator, tuning
        self._awaited = None if self._workshop.ready(estimator) else estimator
        if (kept := self._status) is not None:
            self._status = (-np.inf, kept[1])
        if self._awaited is not None:
            self._workshop.ask(estimator, lambda name: self._inbox.put(Ready(name)))
            return
        log, base = self._log.copy(), self._base
        self._refolder.request(ticket, lambda: self._make_fold(estimator, tuning, log, base))

    def _adopt(self, done: Refolded) -> None:
        """Swap a finished refold in, after it has caught up with what came meanwhile."""
        wanted, changed_from = self._requests.look(done.ticket)
        fold, again = done.fold, False
        row_counts: RowCounts | None = None
        if wanted and fold is not None:
            try:
                # Nobody but this thread moves the log, and nobody sees this fold yet.
                row_counts = self._caught_up(fold, changed_from, self._stopping)
                again = row_counts is None
            except NisusError as error:
                done = replace(done, fold=None, error=str(error))
        # Answered under the lock, and last, so that nobody sees the old fold, and that none is waited for.
        with self._moving():
            if row_counts is not None and fold is not None:
                self._become(fold, row_counts)
                if self._finished:
                    fold.finish()
                self._watchers.alerts.again()
                self._watchers.alerts.look(fold, fold.n)
            elif wanted and not again:
                self._refuse(done.ticket, done.error)
            self._requests.answer(done.ticket)
        if again and not self._stopping.is_set():
            # The log was cut meanwhile: ask again.
            self.retune(self.estimator, self.tuning)

    def _refuse(self, ticket: int, reason: str) -> None:
        """A refold failed: what runs goes on, and is what the panel shows."""
        self.notices.say(f"not folded again: {reason}", level="error")
        if ticket == self._requests.newest:
            self.estimator, self.tuning = self._fold.estimator.name, self._fold.tuning
