"""What takes many folds: observability and the cost of a step, computed in the background while somebody looks.

A thread of the lowest priority folds a copy of the last events again, rests as long as it has worked, and ends. Nobody
waits for it: it leaves its result for the next look.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from dataclasses import dataclass

from estimators.diagnostics.sensitivity import View, gramian
from estimators.fold import Fold
from estimators.log import Log

from ...live.integrity import LOWEST, Unhurried, Window, reason_against
from ...live.interface import Running

EVERY = 20.0
"""Seconds between two computations."""

COST = 0.25
"""Seconds of work after which the cost of a step is known well enough."""

CHUNK = 64


@dataclass(frozen=True)
class Found:
    """Of one revision: microseconds of an event, by a fold of the last ones again; observability, or why there is none.

    `note` is what to know of it.
    """

    revision: int
    cost: float
    observability: View | None
    reason: str
    note: str = ""


class Slow:
    """Computes when asked, and never more often than every `EVERY` seconds."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._latest: Found | None = None
        self._begun = -EVERY
        self._wanted: int | None = None
        self._thread: threading.Thread | None = None

    def of(self, revision: int) -> Found | None:
        """The latest result, if it is of this revision; another computation is begun where it is time."""
        now = time.monotonic()
        busy = self._thread is not None and self._thread.is_alive()
        if not busy and (now - self._begun > EVERY or revision != self._wanted):
            self._begun, self._wanted = now, revision
            self._thread = threading.Thread(target=self._run, name="diagnosis", daemon=True)
            self._thread.start()
        latest = self._latest
        return latest if latest is not None and latest.revision == revision else None

    def _run(self) -> None:
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST)
        taken = self._engine.last_events()
        if taken is None:
            self._wanted = None
            return
        try:
            self._latest = self.compute(taken)
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            self._latest = Found(taken.revision, float("nan"), None, f"{type(error).__name__}: {error}")

    def compute(self, taken: Window) -> Found:
        """Fold the events again, for their cost and for every state nudged."""
        cost = self._cost(taken)
        reason = reason_against(self._engine.model, taken.estimator)
        if reason:
            return Found(taken.revision, cost, None, reason)
        found = gramian(
            taken.estimator,
            self._engine.model,
            taken.tuning,
            self._log(taken),
            base=taken.base,
            windows=0,
            executor=Unhurried(threading.Event()),
        )
        return Found(taken.revision, cost, found.whole, found.reason, found.note)

    def _log(self, taken: Window) -> Log:
        return Log.resume(self._engine.model, taken.base, taken.events)

    def _cost(self, taken: Window) -> float:
        """Microseconds of an event."""
        fold = Fold(taken.estimator, self._engine.model, taken.tuning, self._log(taken), base=taken.base)
        begun = time.thread_time()
        while fold.advance(CHUNK) and time.thread_time() - begun < COST:
            pass
        return 1e6 * (time.thread_time() - begun) / max(1, fold.n)
