"""The running estimate, smoothed again and again while a client shows it.

A job copies the last events, folds them and smooths backwards, then rests nine times as long as that took. Without new
events it does nothing: a recording that has ended is smoothed once.
"""

from __future__ import annotations

import time

from estimators.errors import EstimatorError
from estimators.pieces import SMOOTHER
from estimators.smoothing.smooth import check_smooth, smooth

from ...live.jobs import Job
from ...live.outputs import EventWindow, Pull
from ...live.running_fold import Running
from ...live.workshop import Workshop

MAX_SMOOTHED_EVENTS, MAX_PARTICLE_EVENTS = 65_536, 2_000
"""Events that are smoothed, the last ones; fewer for particle filters."""

PERIOD_S, REST_FACTOR = 0.5, 9.0
"""Seconds between two looks at least, and the rest as a multiple of the work."""


class Smoother:
    """Smooths the last events of a twin. Any thread may read `latest`: the smoothed rows, None while there are none."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.latest: Pull | None = None
        self._seen: tuple[int, int, int] | None = None
        self._refused = ""
        self._compiled = False
        self._job = engine.jobs.run("smoother", self.look, every=PERIOD_S, failed=self._refuse)

    def stop(self) -> None:
        """End after the fold that is under way; no client shows the smoothed estimate."""
        self._job.cancel()

    def look(self, job: Job) -> float:
        """Smooth, if an event has come; return the seconds until the next look."""
        if not self._compiled:
            _compile(job)
            self._compiled = True
        begun = time.thread_time()
        taken = self._engine.last_events(MAX_PARTICLE_EVENTS if "pf" in self._engine.estimator else MAX_SMOOTHED_EVENTS)
        if taken is not None and (taken.revision, taken.first, taken.end) != self._seen:
            self._seen = taken.revision, taken.first, taken.end
            try:
                self.latest = smoothed(taken)
            except EstimatorError as error:
                self._refuse(str(error), "")
        return max(PERIOD_S, REST_FACTOR * (time.thread_time() - begun))

    def _refuse(self, reason: str, prefix: str = "not smoothed: ") -> None:
        """Show nothing, and say why, once."""
        self.latest = None
        if reason != self._refused:
            self._refused = reason
            self._engine.notices.say(f"{prefix}{reason}", "warn")


def _compile(job: Job) -> None:
    """Compile the smoother in another process if it is not in the cache: here it would slow the engine."""
    workshop = Workshop([SMOOTHER])
    workshop.start()
    try:
        while not workshop.ready(SMOOTHER):
            job.rest(PERIOD_S)
    finally:
        workshop.stop()


def smoothed(taken: EventWindow) -> Pull:
    """Return the rows of a window with smoothed moments."""
    fold = taken.fold()
    check_smooth(fold.estimator, fold.model, fold.options)
    fold.advance()
    track = smooth(fold).instead_of(fold.track)
    log = fold.log
    return Pull(taken.revision, False, log.first, log.events, track, oldest=log.first, version=log.version)
