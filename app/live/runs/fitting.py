"""A fit of the tuning to the events of the running twin: one at a time, with its progress.

A job folds a copy of the events again and again (estimators/fit). Its result is applied like any other edit.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from estimators.errors import ConfigError
from estimators.fold import Fold
from estimators.log import Log
from estimators.snapshots import Base
from estimators.tuning import Tuning

from ...twin.defaults import bounds_of, natural_aim
from ..history_copy import END_OF_TIME, copy_log
from ..interface import Running
from ..jobs import Job, JobCancelled

if TYPE_CHECKING:
    from estimators.fit.fit import Fitted


@dataclass
class FitAttempt:
    """One fit: its request, progress and result.

    `revision` is the run from which it starts, `events` how many are folded each time, over `seconds` of the log;
    `folds` are done by now, `elapsed` is in seconds. `state` is that of the job, `reason` says why it failed.
    """

    number: int
    wanted: tuple[str, ...]
    estimator: str
    tuning: Tuning
    revision: int
    events: int = 0
    seconds: float = 0.0
    folds: int = 0
    job: Job = field(default_factory=lambda: Job("fit"))

    @property
    def state(self) -> str:
        """As `Job.state`."""
        return self.job.state

    @property
    def reason(self) -> str:
        """Why it failed."""
        return self.job.reason

    @property
    def elapsed(self) -> float:
        """Seconds that it has taken."""
        return self.job.elapsed

    @property
    def fitted(self) -> Fitted | None:
        """The result, once there is one."""
        found: Fitted | None = self.job.result
        return found


class Fitting:
    """Fits when asked, one at a time."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self._lock = threading.Lock()
        self.latest: FitAttempt | None = None
        """The last one."""

    def begin(self, wanted: Sequence[str], most: int | None = None, *, since: int | None = None) -> FitAttempt:
        """Fit entries of the tuning that runs.

        Args:
            wanted: Keys and groups, as `estimators.fit` takes them.
            most: Events, the last of the log; None for all that the engine holds.
            since: In place of that, the time (ns) of the first event, exactly.

        Raises:
            ConfigError: If another fit is under way, `wanted` is empty, or the model is too slow.
        """
        model = self._engine.model
        if model.black_box:
            raise ConfigError(
                f"fit: {model.name} is a black box, too slow to fit beside the running twin; use nisus tune"
            )
        if not wanted:
            raise ConfigError("fit: wanted is empty; name what is fitted, for example Q and R")
        with self._lock:
            if self.latest is not None and not self.latest.job.over:
                raise ConfigError("fit: another one is under way; wait for it, or cancel it")
            tuning, estimator = self._engine.folded_with()
            number = 1 if self.latest is None else self.latest.number + 1
            revision = self._engine.revisions.runs[-1].number
            attempt = FitAttempt(number, tuple(wanted), estimator, tuning, revision)
            work = partial(self._fit, attempt, most, since)
            # The answer shows why it failed.
            attempt.job = self._engine.jobs.run("fit", work, failed=lambda reason: None)
            self.latest = attempt
        return attempt

    def cancel(self) -> None:
        """Cancel the fit that is under way; it ends after its current folds."""
        if self.latest is not None:
            self.latest.job.cancel()

    def _fit(self, attempt: FitAttempt, most: int | None, since: int | None, job: Job) -> Fitted:
        # Half a second of imports, which a twin that nobody fits need not wait for.
        from estimators.fit import objective
        from estimators.fit.fit import fit
        from estimators.fit.recording import Recording

        def go(folds: int) -> bool:
            attempt.folds += folds
            return job.wanted

        log, base = self._log(attempt, most, since, job)
        attempt.events = log.n
        attempt.seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9
        try:
            return fit(
                attempt.estimator,
                attempt.tuning,
                [Recording(log, base=base)],
                wanted=attempt.wanted,
                bounds=bounds_of(self._engine.twin.config, self._engine.model),
                aim=natural_aim(self._engine.twin.config),
                go=go,
            )
        except objective.Cancelled:
            raise JobCancelled from None

    def _log(self, attempt: FitAttempt, most: int | None, since: int | None, job: Job) -> tuple[Log, Base | None]:
        """The events to fit to, and where a fold of them starts."""
        from estimators.fit.dual import tail

        engine = self._engine
        if since is not None:
            most = engine.index_at(END_OF_TIME) - engine.index_at(since)
        log, base = copy_log(engine, attempt.tuning, most, job.check)
        if since is None:
            return log, base
        # A copy starts at a snapshot, which may be long before.
        fold = Fold(attempt.estimator, attempt.tuning.model, attempt.tuning, log, base=base)
        fold.advance()
        return tail(fold, int(np.searchsorted(log.t[: log.n], since)), base)
