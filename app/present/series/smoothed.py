"""Smoothed estimate of the running twin, updated while a client shows it.

A job copies the last events, folds them and smooths backwards, then rests nine times as long as that took. It does
nothing without new events: a recording that has ended is smoothed once.
"""

from __future__ import annotations

import time

from estimators.errors import EstimatorError
from estimators.pieces import SMOOTHER
from estimators.smoothing.smooth import check_smooth, smooth

from ...live.jobs import Job
from ...live.outputs import Pull
from ...live.running_fold import Running
from ...live.workshop import Workshop

MAX_SMOOTHED_EVENTS, MAX_PARTICLE_EVENTS = 65_536, 2_000
"""Last events that are smoothed; fewer for particle filters."""

PERIOD_S, REST_FACTOR = 0.5, 9.0
"""Least time between two looks, and the rest as a multiple of the work."""


class Smoother:
    """Smooths the last events of a twin. `latest` has the smoothed rows, None while there are none; thread-safe."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.latest: Pull | None = None
        self._smoothed: tuple[int, int, int] | None = None
        self._refused = ""
        self._compiled = False
        self.job = engine.jobs.run("smoother", self.look, every=PERIOD_S, failed=self._refuse)

    def stop(self) -> None:
        """End after the fold that is under way; no client shows the smoothed estimate."""
        self.job.cancel()

    def look(self, job: Job) -> float:
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
    workshop = Workshop([SMOOTHER])
    workshop.start()
    try:
        while not workshop.ready(SMOOTHER):
            job.rest(PERIOD_S)
    finally:
        workshop.stop()
