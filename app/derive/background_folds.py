"""Folds of the running twin's log beside the engine's own, while a client shows them: of pinned runs, and smoothed.

A pinned run is folded on so that its charts do not end: a job folds the engine's log with the settings of the run, from
where the engine's own fold starts; its first rows are those that were kept.

For the smoothed estimate a job copies the last events, folds them and smooths backwards, then rests nine times as long
as that took. It does nothing without new events: a recording that has ended is smoothed once.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np

from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import Log
from estimators.pieces import SMOOTHER
from estimators.smoothing.smooth import check_smooth, smooth

from ..engine.compile_queue import CompileQueue
from ..engine.copies import MAX_PULL_ROWS, Cursor, Pull
from ..engine.jobs import Job
from ..engine.revisions import Revision
from ..engine.running_fold import Running

POLL_PERIOD_S = 0.1
"""Between two looks for new events."""

CHUNK_EVENTS = 64
"""Events folded at once while readers wait."""

MAX_SMOOTHED_EVENTS, MAX_PARTICLE_EVENTS = 65_536, 2_000
"""Last events that are smoothed; fewer for particle filters."""

PERIOD_S, REST_FACTOR = 0.5, 9.0
"""Least time between two looks, and the rest as a multiple of the work."""


class PinnedFold:
    """Fold of a run that is not the running one; see `RowSource`. Thread-safe."""

    def __init__(self, engine: Running, run: Revision) -> None:
        self._engine, self.run = engine, run
        self._lock = threading.Lock()
        self._cursor = engine.cursor(follows_log=True)
        self._readers: list[Cursor] = []
        self._fold: Fold | None = None
        self.caught_up = False
        """Whether it has reached the end of the kept rows."""
        self.job = engine.jobs.run(f"run {run.number}", self.follow, every=POLL_PERIOD_S, failed=self.fail)

    def stop(self) -> None:
        """End the fold; no client shows the run."""
        self.job.cancel()
        self._engine.release(self._cursor)

    def cursor(self) -> Cursor:
        """See `RowSource`."""
        with self._lock:
            self._readers.append(Cursor())
            return self._readers[-1]

    def release(self, cursor: Cursor) -> None:
        """See `RowSource`."""
        with self._lock:
            self._readers = [reader for reader in self._readers if reader is not cursor]

    def pull(self, cursor: Cursor, limit: int | None = None, *, align: int = 1) -> Pull:
        """See `RowSource`."""
        with self._lock:
            assert self._fold is not None
            first = self._fold.log.first
            start = max(cursor.next // align * align, first)
            pull = self._rows(start, start + limit if limit is not None else first + self._fold.n)
            pull = replace(pull, fresh=cursor.log < 0, changed=max(cursor.next, first))
            cursor.log, cursor.next = 0, pull.first + len(pull.events)
            return pull

    def rows(self, start: int, stop: int) -> Pull:
        """See `RowSource`."""
        with self._lock:
            return self._rows(start, stop)

    def index_at(self, t: int) -> int:
        """See `RowSource`."""
        with self._lock:
            assert self._fold is not None
            log = self._fold.log
            return log.first + int(np.searchsorted(log.t[: self._fold.n], t))

    def _rows(self, start: int, stop: int) -> Pull:
        assert self._fold is not None
        log, n = self._fold.log, self._fold.n
        start = min(max(start, log.first), log.first + n)
        rows = slice(start - log.first, max(start, min(stop, log.first + n)) - log.first)
        events = log.events.select(rows).copy()
        return Pull(self.run.number, False, start, events, self._fold.track.select(rows).copy(), oldest=log.first)

    def fail(self, reason: str) -> None:
        """Stop with a notice; charts show the kept rows again."""
        self.caught_up = False
        self.job.cancel()
        text = f"page error: run {self.run.number} is not continued: {reason}"
        self._engine.notices.report("page error", text, "error")

    def follow(self, job: Job) -> float:
        """Fold new events; return the seconds until the next look."""
        pull = self._engine.pull(self._cursor, MAX_PULL_ROWS)
        if pull.fresh and not self._begin(pull):
            return POLL_PERIOD_S
        assert self._fold is not None
        fold, log = self._fold, self._fold.log
        with self._lock:
            if len(pull.events):
                # A late measurement replaces rows, which the engine then sends again.
                at = pull.first - log.first
                if at > log.n:
                    # The engine has dropped events that were not taken yet: take all again from its start.
                    self._cursor.log = -1
                    return 0.0
                fold.rewind(at)
                log.n = at
                log.extend(pull.events)
                fold.advance(at - fold.n + CHUNK_EVENTS)
                for reader in self._readers:
                    reader.next = min(reader.next, pull.first)
        while job.wanted:
            with self._lock:
                if not fold.advance(CHUNK_EVENTS):
                    break
        with self._lock:
            if pull.oldest - log.first > log.n // 2:
                count, _ = fold.base_at(pull.oldest - log.first)
                fold.drop_front(count)
                log.drop_front(count)
        kept = self.run.track
        self.caught_up |= kept is None or log.first + fold.n >= kept.first + len(kept.events)
        return 0.0 if len(pull.events) == MAX_PULL_ROWS else POLL_PERIOD_S

    def _begin(self, pull: Pull) -> bool:
        """Start a fold where the engine's starts, also after the log has begun again; False if that has just moved."""
        engine, base = self._engine, self._engine.base()
        log = Log.resume(engine.model, base, capacity=1024)
        if pull.first != log.first or not len(pull.events):
            self._cursor.log = -1  # take all again
            return False
        fold = Fold(
            self.run.estimator, engine.model, self.run.tuning, log,
            policy=engine.policy, base=base, expected=engine.twin.expected,
        )  # fmt: skip
        with self._lock:
            self._fold, self.caught_up = fold, False
            for reader in self._readers:
                reader.log, reader.next = -1, 0
        return True


class Smoother:
    """Smooths the last events of a twin. `latest` has the smoothed rows, None while there are none; thread-safe."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.latest: Pull | None = None
        self._smoothed: tuple[int, int, int] | None = None
        self._refused = ""
        self._compiled = False
        self.job = engine.jobs.run("smoother", self.update, every=PERIOD_S, failed=self._refuse)

    def stop(self) -> None:
        """End after the fold that is under way; no client shows the smoothed estimate."""
        self.job.cancel()

    def update(self, job: Job) -> float:
        """Smooth, if there are new events; return the seconds until the next look."""
        if not self._compiled:
            _compile(job)
            self._compiled = True
        begun = time.thread_time()
        window = self._engine.last_events(
            MAX_PARTICLE_EVENTS if "pf" in self._engine.estimator else MAX_SMOOTHED_EVENTS
        )
        if window is not None and (window.revision, window.first, window.end) != self._smoothed:
            self._smoothed = window.revision, window.first, window.end
            try:
                fold = window.fold()
                check_smooth(fold.estimator, fold.model, fold.options)
                fold.advance()
                log, track = fold.log, smooth(fold).instead_of(fold.track)
                self.latest = Pull(
                    window.revision, False, log.first, log.events, track, oldest=log.first, version=log.version
                )
            except EstimatorError as error:
                self._refuse(str(error), "")
        return max(PERIOD_S, REST_FACTOR * (time.thread_time() - begun))

    def _refuse(self, reason: str, prefix: str = "not smoothed: ") -> None:
        """Drop the smoothed rows, and report each reason once."""
        self.latest = None
        if reason != self._refused:
            self._refused = reason
            self._engine.notices.say(f"{prefix}{reason}", "warn")


def _compile(job: Job) -> None:
    """Compile the smoother in another process if it is not in the cache: here it would slow the engine."""
    compile_queue = CompileQueue([SMOOTHER])
    compile_queue.start()
    try:
        while not compile_queue.ready(SMOOTHER):
            job.rest(PERIOD_S)
    finally:
        compile_queue.stop()
