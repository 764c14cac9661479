"""How wrong each state can be with nobody noticing, kept up to date beside the running twin and never in its way.

A thread of the lowest priority takes a copy of the last events now and then, folds it again for each nudge
(estimators/diagnostics/sensitivity), rests as long as it has worked, and leaves the bounds for whoever asks. Another
revision is looked at soon; the bounds of one that goes on change slowly, and are computed anew only now and then.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from estimators.diagnostics.sensitivity import Bound, Sensitivity, Smallest, bounds_of, sensitivity, smallest_of
from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.model.state_space import StateSpaceModel
from estimators.registry import find_entry
from estimators.snapshots import Base
from estimators.tuning import Tuning

EVERY = 15.0
"""Seconds between two looks."""

SHARE = 0.01
"""Part of a processor that the bounds of one revision may take: dearer ones are computed less often."""

MOST = 4000
"""Events that are folded again for every nudge, the last of the log."""

LOWEST = 19
"""The least urgent priority that a thread can have."""


@dataclass(frozen=True)
class Integrity:
    """Bounds by state, as of the log's time `t` (ns), for one revision; or the reason why there are none.

    `smallest` are the smallest faults that are seen.
    """

    revision: int
    t: int
    reason: str = ""
    bounds: dict[str, Bound] = field(default_factory=dict)
    smallest: tuple[Smallest, ...] = ()

    def age(self, now: int | None) -> float | None:
        """Seconds of the log since then; `now` is the time of its last event, ns."""
        return None if now is None else (now - self.t) * 1e-9


class Window(NamedTuple):
    """A copy of the last events, and what it takes to fold them."""

    estimator: str
    tuning: Tuning
    events: Events
    base: Base
    revision: int


def window(fold: Fold, revision: int, most: int = MOST) -> Window | None:
    """Copy the last events of a fold, from a snapshot on; None while there are none. Takes a millisecond at most."""
    if not fold.n:
        return None
    at, base = fold.base_at(max(0, fold.n - most))
    events = Events(*(column[at : fold.n].copy() for column in fold.log.events))
    return Window(fold.estimator.name, fold.tuning, events, base, revision)


class IntegrityWatch:
    """Computes the bounds again and again in a thread of its own."""

    def __init__(self, take: Callable[[], Window | None], false_alarm: float, *, every: float = EVERY) -> None:
        """Prepare.

        Args:
            take: Gives a copy of the last events, or None if now is not the time.
            false_alarm: Mean time between false alarms of the tests that watch the twin, s.
            every: Seconds between two looks.
        """
        self._take, self._false_alarm, self._every = take, false_alarm, every
        self._latest: Integrity | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="integrity", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the fold that is under way."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=1.0)

    @property
    def running(self) -> bool:
        """Whether the thread is alive."""
        return self._thread.is_alive()

    def of(self, revision: int) -> Integrity | None:
        """The latest bounds, if they are of this revision."""
        latest = self._latest
        return latest if latest is not None and latest.revision == revision else None

    def look(self) -> None:
        """Compute the bounds once, if events came since the last time."""
        taken = self._take()
        if taken is not None:
            self._look_at(taken)

    def _look_at(self, taken: Window) -> None:
        t, known = int(taken.events.t[-1]), self._latest
        if known is not None and (known.revision, known.t) == (taken.revision, t):
            return
        # That of the fold: a twin's files may have been saved anew.
        model = taken.tuning.model
        reason = reason_against(model, taken.estimator)
        if reason:
            self._latest = Integrity(taken.revision, t, reason)
            return
        try:
            found = self._compute(taken)
        except Stopped:
            return
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            self._latest = Integrity(taken.revision, t, f"{type(error).__name__}: {error}")
            return
        bounds = bounds_of(model, found)
        self._latest = Integrity(taken.revision, t, found.reason, bounds, smallest_of(found))

    def _compute(self, taken: Window) -> Sensitivity:
        model = taken.tuning.model
        log = Log.resume(model, taken.base, taken.events)
        return sensitivity(
            taken.estimator,
            model,
            taken.tuning,
            log,
            base=taken.base,
            false_alarm=self._false_alarm,
            executor=Unhurried(self._stopping),
        )

    def _run(self) -> None:
        if sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST)
        due = 0.0
        while not self._stopping.wait(self._every):
            taken = self._take()
            if taken is None or (time.monotonic() < due and self.of(taken.revision) is not None):
                continue
            begun = time.thread_time()
            self._look_at(taken)
            due = time.monotonic() + (time.thread_time() - begun) / SHARE


def reason_against(model: StateSpaceModel, estimator: str) -> str:
    """Why the bounds are not kept up to date, or nothing; what is too large `sensitivity` says itself."""
    if model.black_box:
        return f"{model.name} is a black box, which is too slow to be folded again all the time; see nisus check"
    if find_entry(estimator).family in ("particle", "ensemble"):
        return f"{estimator} draws at random, and its nudges would be noise; see nisus check"
    return ""


class Stopped(Exception):  # noqa: N818  no error: the twin ends
    """The twin has ended."""


class Unhurried(Executor):
    """Works on one item after another, and rests after each as long as it took."""

    def __init__(self, stopping: threading.Event) -> None:
        self._stopping = stopping

    def map(self, fn: Callable[..., Any], *iterables: Any, timeout: Any = None, chunksize: int = 1) -> Iterator[Any]:
        """As the built-in `map`.

        Raises:
            Stopped: If the twin has ended meanwhile.
        """
        took = 0.0
        for items in zip(*iterables, strict=False):
            if self._stopping.wait(took):
                raise Stopped
            begun = time.thread_time()
            yield fn(*items)
            took = time.thread_time() - begun
