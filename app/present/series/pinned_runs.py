"""Pinned runs continue beside the running fold while a client shows them, so that their charts do not end.

A job folds the log that the engine has folded, with the settings of the run: from where the engine's own fold starts,
so that its rows are those that were kept, and on from there.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from estimators.fold import Fold
from estimators.log import Events, Log

from ...live.jobs import Job
from ...live.outputs import Cursor, Pull
from ...live.revisions import Revision
from ...live.running_fold import Running
from .charted_run import ROWS, Levels, less
from .columns import Column
from .levels_of_detail import FIRST, Groups, grouped

POLL_PERIOD_S = 0.1
"""Seconds between two looks for new events."""

PULL_EVENTS = 4096
"""Events that are taken at once."""

CHUNK_EVENTS = 64
"""Events that are folded at once: a reader waits no longer."""


class PinnedFold:
    """The fold of one run that is not the running one. Any thread may read its rows."""

    def __init__(self, engine: Running, run: Revision) -> None:
        self._engine, self.run = engine, run
        self._lock = threading.Lock()
        self._cursor = engine.cursor(follows_log=True)
        self._marks: list[Cursor] = []
        self._fold: Fold | None = None
        self.caught_up = False
        """Whether it has reached the end of the kept rows."""
        self._job = engine.jobs.run(f"run {run.number}", self._follow, every=POLL_PERIOD_S, failed=self._fail)

    def stop(self) -> None:
        """End the fold; no client shows the run."""
        self._job.cancel()
        self._engine.release(self._cursor)

    def mark(self) -> Cursor:
        """A cursor for one consumer, for `pull`."""
        mark = Cursor()
        with self._lock:
            self._marks.append(mark)
        return mark

    def pull(self, mark: Cursor, limit: int) -> Pull:
        """Copies of the rows since the cursor, as the engine gives them; see `Pull`."""
        with self._lock:
            assert self._fold is not None
            log = self._fold.log
            start = max(mark.next // FIRST * FIRST, log.first)
            pull = replace(self._rows(start, start + limit), changed=max(mark.next, log.first))
            mark.next = pull.first + len(pull.events)
            return pull

    def rows(self, start: int, stop: int) -> Pull:
        """Copies of the rows with these absolute indices, as far as they are there."""
        with self._lock:
            return self._rows(start, stop)

    def index_at(self, t: int) -> int:
        """Absolute index of the first folded event at or after a time, ns."""
        with self._lock:
            assert self._fold is not None
            log = self._fold.log
            return log.first + int(np.searchsorted(log.t[: self._fold.n], t))

    def _rows(self, start: int, stop: int) -> Pull:
        assert self._fold is not None
        log, n = self._fold.log, self._fold.n
        start = min(max(start, log.first), log.first + n)
        rows = slice(start - log.first, max(start, min(stop, log.first + n)) - log.first)
        events = Events(*(column.copy() for column in log.events.select(rows)))
        return Pull(self.run.number, False, start, events, self._fold.track.select(rows).copy(), oldest=log.first)

    def _fail(self, reason: str) -> None:
        # The kept rows stay.
        self.caught_up = False
        self._job.cancel()
        text = f"page error: run {self.run.number} is not continued: {reason}"
        self._engine.notices.report("page error", text, "error")

    def _follow(self, job: Job) -> float:
        """Fold what came; return the seconds until the next look."""
        pull = self._engine.pull(self._cursor, PULL_EVENTS)
        if pull.fresh and not self._begin(pull):
            return POLL_PERIOD_S
        assert self._fold is not None
        fold, log = self._fold, self._fold.log
        with self._lock:
            if len(pull.events):
                # A late reading has its rows sent again: what stood there is others now.
                at = pull.first - log.first
                if at > log.n:
                    # The engine has forgotten events that were not taken yet: all of them again, from where it starts.
                    self._cursor.log = -1
                    return 0.0
                fold.rewind(at)
                log.n = at
                log.extend(pull.events)
                fold.advance(at - fold.n + CHUNK_EVENTS)
                for mark in self._marks:
                    mark.next = min(mark.next, pull.first)
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
        return 0.0 if len(pull.events) == PULL_EVENTS else POLL_PERIOD_S

    def _begin(self, pull: Pull) -> bool:
        """Begin where the engine's fold does, also when the log has begun again; False if that has just moved."""
        engine, base = self._engine, self._engine.base()
        log = Log.resume(engine.model, base, capacity=1024)
        if pull.first != log.first or not len(pull.events):
            self._cursor.log = -1  # to be given all again
            return False
        fold = Fold(
            self.run.estimator, engine.model, self.run.tuning, log,
            policy=engine.policy, base=base, expected=engine.twin.expected,
        )  # fmt: skip
        with self._lock:
            self._fold, self.caught_up = fold, False
            for mark in self._marks:
                mark.next = 0
        return True


class PinnedRun:
    """See `series.run.Run`: the rows of a pinned run, or, with `than`, its means less those of what runs there."""

    def __init__(self, fold: PinnedFold, columns: dict[str, Column], than: Running | None = None) -> None:
        self.fold, self._levels, self._than = fold, Levels(columns), than
        self._mark = fold.mark()
        self.revision = fold.run.number
        self.generation = self.changed = self.end = 0

    def sync(self, columns: Iterable[str]) -> None:
        """See `Run`."""
        running = self.revision if self._than is None else self._than.revisions.runs[-1].number
        if self._levels.ask(columns) or running != self.revision:
            self.revision = running
            self._mark.next = 0
            self._levels.clear()
            self.generation += 1
        self.changed = self.end
        while True:
            pull = self.fold.pull(self._mark, ROWS)
            if len(pull.events):
                self._levels.take(pull if self._than is None else less(pull, self._than))
                self.changed = min(self.changed, pull.changed)
            self.end = pull.first + len(pull.events)
            if len(pull.events) < ROWS:
                return

    def span(self, since: int, until: int) -> tuple[int, int]:
        """See `Run`."""
        return self.fold.index_at(since), self.fold.index_at(until)

    def groups(self, size: int, start: int, stop: int, columns: list[str]) -> Groups:
        """See `Run`."""
        if size >= FIRST:
            return self._levels.part(size, start, stop, columns)
        pull = self.fold.rows(start * size, min(stop * size, self.end))
        pull = pull if self._than is None else less(pull, self._than)
        return grouped(size, pull.first, pull.events.t, self._levels.values(pull, columns))
