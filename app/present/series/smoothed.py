"""What runs, smoothed again and again while somebody looks: what the readings after each moment add to the estimate.

A thread of the lowest priority copies the last events, folds them and goes back over them, and rests nine times as long
as that took. With nothing new it does nothing: a recording that has ended is smoothed once.
"""

from __future__ import annotations

import os
import sys
import threading
import time

from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import Log
from estimators.pieces import SMOOTHER
from estimators.smoothing.smooth import check_smooth, smooth

from ...live.integrity import LOWEST, Window
from ...live.interface import Running
from ...live.outputs import Pull
from ...live.workshop import Workshop

MOST, MOST_PARTICLES = 65_536, 2_000
"""Events, the last ones, that are smoothed: the work for a picture is bounded."""

PERIOD, REST = 0.5, 9.0
"""Seconds between two looks at least, and how many times as long as it worked the thread rests."""


class Smoothing:
    """Any thread may read `latest`: the smoothed rows, None while there are none."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.latest: Pull | None = None
        self._seen: tuple[int, int, int] | None = None
        self._refused = ""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="smoother", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Nobody looks any more; it ends after the fold that is under way."""
        self._stopping.set()

    def _run(self) -> None:
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST)
        self._compile()
        rest = 0.0
        while not self._stopping.wait(rest):
            begun = time.thread_time()
            self._look()
            rest = max(PERIOD, REST * (time.thread_time() - begun))

    def _compile(self) -> None:
        """In another process, if it is not in the cache: here it would slow the engine."""
        workshop = Workshop([SMOOTHER])
        workshop.start()
        while not workshop.ready(SMOOTHER) and not self._stopping.wait(PERIOD):
            pass
        workshop.stop()

    def _look(self) -> None:
        """Smooth, if something came."""
        taken = self._engine.last_events(MOST_PARTICLES if "pf" in self._engine.estimator else MOST)
        if taken is None:
            return
        seen = taken.revision, taken.base.first, int(taken.events.t[-1])
        if seen == self._seen:
            return
        self._seen = seen
        try:
            self.latest = _smoothed(taken)
        except EstimatorError as error:
            self.latest = None
            self._refuse(str(error))
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            self.latest = None
            self._refuse(f"not smoothed: {type(error).__name__}: {error}")

    def _refuse(self, text: str) -> None:
        """Say why there is nothing, once."""
        if text != self._refused:
            self._refused = text
            self._engine.notices.say(text, "warn")


def _smoothed(taken: Window) -> Pull:
    """The rows of a window, with smoothed moments."""
    model, base = taken.tuning.model, taken.base
    log = Log.resume(model, base, taken.events)
    fold = Fold(taken.estimator, model, taken.tuning, log, base=base)
    check_smooth(fold.estimator, model, fold.options)
    fold.advance()
    track = smooth(fold).instead_of(fold.track)
    return Pull(taken.revision, False, base.first, log.events, track, oldest=base.first, version=log.version)
