"""Scores of revisions, computed in jobs and on request, never on the engine's thread."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace

import numpy as np

from estimators.diagnostics.score import Score, score
from estimators.errors import NisusError
from estimators.fold import Fold

from ..engine.copies import Pull
from ..engine.history_copy import copy_rows
from ..engine.revisions import Revision
from ..engine.running_fold import Running

REST_FACTOR, MIN_AGE_S = 20.0, 1.0
"""The score of the running revision is reused for so many times its own duration, and for so many seconds at least."""

TIMED_EVENTS, WARM_UP_EVENTS = 2048, 64
"""Events that are folded again to time a step; those of them that are folded before the clock starts."""

MAX_TIMING_S = 0.1
"""Seconds that this takes at most."""


@dataclass(frozen=True)
class RunScore:
    """Score of one revision over its `rows` events, `seconds` of the log.

    `step_us` is the elapsed time of folding one event again, µs, on the loaded machine; NaN if it could not be timed.
    """

    score: Score
    rows: int
    seconds: float
    step_us: float = np.nan


class RunScores:
    """Scores of all revisions of a twin, each computed once; that of the running one again as it grows.

    A revision that ends is scored in a job, before its track is dropped, whether or not a client asks.
    """

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._lock = threading.Lock()
        self._known: dict[int, RunScore] = {}
        self._final: set[int] = set()
        self._fresh_until = (-1, 0.0)
        self._ended: dict[int, Revision] = {}
        engine.revisions.watchers.add(self._changed)
        self._changed()

    def _changed(self) -> None:
        """Queue the newest revision that has ended; in the engine's thread, which waits for no score."""
        runs = self._engine.revisions.runs
        run = runs[-2] if len(runs) > 1 else runs[-1]
        if run.track is not None and run.number not in self._final and run.number not in self._ended:
            self._ended[run.number] = run
            self._engine.jobs.run("scores", lambda job: self._score_ended())

    def _score_ended(self) -> None:
        with self._lock:
            while self._ended:
                _, run = self._ended.popitem()
                assert run.track is not None
                self._known[run.number] = self._scored(run, run.track)
                self._final.add(run.number)
            numbers = {run.number for run in self._engine.revisions.runs}
            self._known = {number: known for number, known in self._known.items() if number in numbers}
            self._final &= numbers

    def all(self) -> list[tuple[Revision, RunScore | None]]:
        """Return every revision with its score; None without rows."""
        self._score_ended()
        with self._lock:
            runs = self._engine.revisions.runs
            *_, running = runs
            self._look(running)
            return [(run, self._known.get(run.number)) for run in runs]

    def _look(self, running: Revision) -> None:
        """Score the running revision, unless that was done just now."""
        begun = time.monotonic()
        if self._fresh_until[0] == running.number and begun < self._fresh_until[1]:
            return
        pull = copy_rows(self._engine)
        if pull is None or pull.revision != running.number:
            return
        self._known[running.number] = self._scored(running, pull)
        took = time.monotonic() - begun
        self._fresh_until = (running.number, begun + took + max(MIN_AGE_S, REST_FACTOR * took))

    def _scored(self, run: Revision, pull: Pull) -> RunScore:
        gate, baseline, model = run.tuning.gate, run.tuning.baseline, self._engine.model
        found = score(pull.track, pull.events, model, pull.pictures, gate=gate, baseline=baseline)
        known = self._known.get(run.number)
        made = RunScore(found, len(pull.events), pull.events.seconds, np.nan if known is None else known.step_us)
        return made if np.isfinite(made.step_us) else replace(made, step_us=_step_us(self._engine, run))


def _step_us(engine: Running, run: Revision) -> float:
    """Return the elapsed time of an event under a revision's settings, µs, over the last events of the log."""
    part = engine.last_events(TIMED_EVENTS, rows=True)
    if part is None:
        return np.nan
    try:
        return 1e6 * seconds_per_event(
            part.fold(run.estimator, run.tuning, engine.policy), WARM_UP_EVENTS, MAX_TIMING_S
        )
    except NisusError:
        return np.nan


def seconds_per_event(fold: Fold, chunk: int, budget: float = 0.0) -> float:
    """Return the elapsed time of an event of a new fold, s; NaN without events.

    The first `chunk` events, half of all at most, are not timed; that many are folded at once. After `budget` seconds
    no other chunk begins.
    """
    fold.advance(min(chunk, fold.log.n // 2))
    events, begun, seconds = 0, time.perf_counter(), 0.0
    while (not events or seconds < budget) and (done := fold.advance(chunk)):
        events, seconds = events + done, time.perf_counter() - begun
    return seconds / events if events else np.nan
