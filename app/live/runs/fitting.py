"""A fit of the tuning to what the running twin has folded, beside it: one at a time, told while it goes on.

A thread of the lowest priority takes a copy of the events and folds that again and again (estimators/fit). The engine
does not know of it; what was found is put in like any other edit, by whoever looks at it.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimators.errors import ConfigError, NisusError
from estimators.fold import Fold
from estimators.log import Log
from estimators.snapshots import Base
from estimators.tuning import Tuning

from ...twin.bounds import bounds_of, natural_aim
from ..history_copy import END_OF_TIME, copy_log
from ..integrity import LOWEST
from ..interface import Running

if TYPE_CHECKING:
    from estimators.fit.fit import Fitted

RUNNING, CANCELLING, CANCELLED, FAILED, DONE = "running", "cancelling", "cancelled", "failed", "done"


@dataclass
class Attempt:
    """One fit: what was asked for, how far it is, and what came of it.

    `revision` is the run from which it starts, `events` how many are folded each time, over `seconds` of the log;
    `folds` are done by now, `elapsed` is in seconds. `reason` says why it failed.
    """

    number: int
    wanted: tuple[str, ...]
    estimator: str
    tuning: Tuning
    revision: int
    events: int = 0
    seconds: float = 0.0
    folds: int = 0
    state: str = RUNNING
    reason: str = ""
    fitted: Fitted | None = None
    begun: float = 0.0
    ended: float | None = None

    @property
    def elapsed(self) -> float:
        """Seconds that it has taken."""
        return (time.monotonic() if self.ended is None else self.ended) - self.begun


class Fitting:
    """Fits when asked, in a thread of its own that ends with the fit."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self.latest: Attempt | None = None
        """The last that was begun."""

    def begin(self, wanted: Sequence[str], most: int | None = None, *, since: int | None = None) -> Attempt:
        """Fit entries of the tuning that runs.

        Args:
            wanted: Keys and groups, as `estimators.fit` takes them.
            most: Events, the last of the log; None for all that the engine holds.
            since: In place of that, the time (ns) from which on they are fitted, to the event.

        Raises:
            ConfigError: If another fit is under way, nothing is asked for, or it would be too slow.
        """
        model = self._engine.model
        if model.black_box:
            raise ConfigError(
                f"fit: {model.name} is a black box, too slow to be fitted beside what runs; use nisus tune"
            )
        if not wanted:
            raise ConfigError("fit: wanted is empty; name what is fitted, for example Q and R")
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise ConfigError("fit: another one is under way; wait for it, or cancel it")
            tuning, estimator = self._engine.folded_with()
            attempt = Attempt(
                number=1 if self.latest is None else self.latest.number + 1,
                wanted=tuple(wanted),
                estimator=estimator,
                tuning=tuning,
                revision=self._engine.revisions.runs[-1].number,
                begun=time.monotonic(),
            )
            self.latest = attempt
            self._thread = threading.Thread(target=self._run, args=(attempt, most, since), name="fit", daemon=True)
            self._thread.start()
        return attempt

    def cancel(self) -> None:
        """Give up the fit that is under way; it ends with the folds that it is at."""
        with self._lock:
            if self.latest is not None and self.latest.state == RUNNING:
                self.latest.state = CANCELLING

    def stop(self) -> None:
        """The twin ends."""
        self.cancel()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def _run(self, attempt: Attempt, most: int | None, since: int | None) -> None:
        if sys.platform == "linux":
            # What this thread starts to fold side by side takes after it.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOWEST)
        # Half a second of imports, which a twin that nobody fits need not wait for.
        from estimators.fit.fit import fit
        from estimators.fit.objective import Cancelled
        from estimators.fit.recording import Recording

        state, reason, fitted = DONE, "", None
        try:
            log, base = self._log(attempt, most, since)
            attempt.events = log.n
            attempt.seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9
            fitted = fit(
                attempt.estimator,
                attempt.tuning,
                [Recording(log, base=base)],
                wanted=attempt.wanted,
                bounds=bounds_of(self._engine.twin.config, self._engine.model),
                aim=natural_aim(self._engine.twin.config),
                go=lambda folds: self._count(attempt, folds),
            )
        except Cancelled:
            state = CANCELLED
        except NisusError as error:
            state, reason = FAILED, str(error)
        except Exception as error:  # noqa: BLE001  a user's model may raise anything; the twin goes on
            state, reason = FAILED, f"{type(error).__name__}: {error}"
        with self._lock:
            attempt.fitted, attempt.reason, attempt.ended = fitted, reason, time.monotonic()
            attempt.state = state

    def _log(self, attempt: Attempt, most: int | None, since: int | None) -> tuple[Log, Base | None]:
        """What is fitted to, and where a fold of it starts."""
        from estimators.fit.dual import tail

        engine = self._engine
        if since is not None:
            most = engine.index_at(END_OF_TIME) - engine.index_at(since)
        log, base = copy_log(engine, attempt.tuning, most, lambda: self._count(attempt, 0))
        if since is None:
            return log, base
        # A copy starts at a snapshot, which may be long before.
        fold = Fold(attempt.estimator, attempt.tuning.model, attempt.tuning, log, base=base)
        fold.advance()
        return tail(fold, int(np.searchsorted(log.t[: log.n], since)), base)

    def _count(self, attempt: Attempt, folds: int) -> bool:
        with self._lock:
            attempt.folds += folds
            return attempt.state == RUNNING
