"""Dual estimation of a running twin: fit the parameters again at intervals to its last measurements.

A job watches the log's clock and starts the fits. A result that wins on the held-out blocks is a proposal, which a
user accepts or dismisses, or which is adopted at once with `adopt: if better`. Every fit adds a notice; an adopted one
becomes a tuning version with its evidence. A proposal is valid for the tuning that it was fitted from; a dismissed one
is proposed again only when the data differ.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from config.schema import RefitSection
from config.tunings import version_files
from estimators.errors import ConfigError, NisusError
from estimators.fold import Fold
from estimators.log import Log
from estimators.snapshots import Base
from estimators.tuning import Tuning

from ...format_time import format_time
from ...twin.defaults import bounds_of, natural_aim
from ..history_copy import END_OF_TIME, copy_log
from ..jobs import DONE, FAILED, Job, JobCancelled
from ..running_fold import Running
from ..tunings.versions import keep, load_into, settings_of, version_text

if TYPE_CHECKING:
    from estimators.fit.fit import Fitted

CLOCK_PERIOD_S = 0.5
"""Seconds between two looks at the log's clock."""

AT_BOUND = ", at the bound of its range"

MAX_FITS = 50
"""Fits that are kept with their result."""

FITTING, OFFERED, ADOPTED, DISMISSED, OUTDATED, NOTHING, BROKEN = (
    "fitting", "proposed", "adopted", "dismissed", "outdated", "nothing better", "failed",
)  # fmt: skip


@dataclass(frozen=True)
class LiveRefit:
    """One fit of a window, with its state and its result in a line (`text`).

    start and end are the window's first and last time, ns. `name` is the tuning version that was made of it.
    """

    number: int
    start: int
    end: int
    attempt: FitAttempt
    state: str = FITTING
    text: str = ""
    name: str = ""

    @property
    def fitted(self) -> Fitted | None:
        """The result; None while it is fitted, and if it failed."""
        return self.attempt.fitted


class Refits:
    """All fits of a running twin, the oldest first."""

    def __init__(self, engine: Running) -> None:
        """Nothing is fitted before `start`."""
        self._engine = engine
        self._fitting = Fitting(engine)
        self._lock = threading.RLock()
        self._passage = 0
        self._due: int | None = None
        self._dismissed: Fitted | None = None
        self.known: tuple[LiveRefit, ...] = ()

    # From any thread

    @property
    def section(self) -> RefitSection | None:
        """Section `refit` of the twin's YAML; None without it."""
        return self._engine.twin.config.refit

    @property
    def open(self) -> LiveRefit | None:
        """The present proposal."""
        return next((item for item in self.known if item.state == OFFERED), None)

    @property
    def due(self) -> int | None:
        """Time of the next fit, ns of the log; None before the first measurement, or without the section."""
        return self._due

    def start(self) -> None:
        """Begin to look at the log's clock."""
        self._engine.jobs.run("refit", lambda job: self.look(), every=CLOCK_PERIOD_S)

    def now(self) -> None:
        """Fit at once.

        Raises:
            ConfigError: If the YAML names nothing, a fit is under way, or nothing was read.
        """
        section = self.section
        if section is None:
            raise ConfigError("refit: the twin's YAML has no `refit` section; add one, or use Fit…")
        if not self._engine.span()[1]:
            raise ConfigError("refit: no reading has come yet; there is nothing to fit")
        with self._lock:
            self._begin(section)

    def accept(self, number: int, *, why: str = "by hand") -> str:
        """Keep a proposal as a tuning version with its evidence, and load it.

        Returns:
            The version's name.

        Raises:
            ConfigError: If it is not proposed any more, or cannot be kept or loaded.
        """
        with self._lock:
            self._outdate()
            refit = self._proposed(number)
            assert refit.fitted is not None
            engine, twin = self._engine, self._engine.twin
            taken = version_files(twin.path)
            name = next(name for k in range(1, len(taken) + 2) if (name := f"refit-{k}") not in taken)
            attempt = refit.attempt
            fitted_on = [f"{attempt.events} events over {attempt.seconds:.4g} s, to {format_time(refit.end)}"]
            given = settings_of(refit.fitted, fitted_on, f"dual estimation, fit {number}, adopted {why}: {refit.text}")
            given = replace(given, model_version=engine.status().model_version)
            keep(twin, name, version_text(twin, given))
            load_into(engine, name, f"refit {number}, version {name}")
            self._become(number, ADOPTED, refit.text, name)
            engine.notices.say(f"refit {number}: adopted {why} as tuning version {name}: {refit.text}")
        return name

    def dismiss(self, number: int) -> None:
        """Dismiss a proposal; it is not made again until the data differ.

        Raises:
            ConfigError: If it is not proposed any more.
        """
        with self._lock:
            refit = self._proposed(number)
            self._dismissed = refit.fitted
            self._become(number, DISMISSED, refit.text)
            self._engine.notices.say(f"refit {number}: dismissed: {refit.text}")

    # In its job

    def look(self) -> None:
        """Take the result of a finished fit, and begin one that is due."""
        with self._lock:
            last = self.known[-1] if self.known else None
            if last is not None and last.state == FITTING:
                if last.attempt.job.over:
                    self._take(last)
                return
            self._outdate()
            section = self.section
            if section is None:
                self._due = None
            elif self._is_due(section):
                self._begin(section)

    def _is_due(self, section: RefitSection) -> bool:
        begun, newest = self._engine.span()
        passage = self._engine.notices.passage
        if passage != self._passage:
            self._passage, self._due = passage, None
        if not newest:
            return False
        if self._due is None:
            self._due = begun + round(section.window * 1e9)
        # Not while a refold is under way: what it gives is what is to be fitted from.
        return newest >= self._due and not self._engine.status().refolding

    def _begin(self, section: RefitSection) -> None:
        engine = self._engine
        newest = engine.span()[1]
        first = newest - round(section.window * 1e9)
        self._due = newest + round(section.every * 1e9)
        attempt = self._fitting.begin(section.entries, since=first)
        number = self.known[-1].number + 1 if self.known else 1
        self.known = (*self.known, LiveRefit(number, first, newest, attempt))[-MAX_FITS:]

    def _take(self, refit: LiveRefit) -> None:
        """Report the result of a fit, and propose it if it won."""
        attempt, number = refit.attempt, refit.number
        fitted = attempt.fitted
        if attempt.state != DONE or fitted is None:
            reason = attempt.reason or "it was given up"
            self._tell(number, BROKEN, reason, "warn" if attempt.state == FAILED else "info")
        elif reasons := _against(fitted):
            self._tell(number, NOTHING, "; ".join(reasons))
        elif not self._current(attempt):
            self._tell(number, OUTDATED, f"{_moves(fitted)}; another tuning runs by now")
        elif self._dismissed is not None and _same(fitted, self._dismissed):
            self._tell(number, DISMISSED, f"{_moves(fitted)}; the same result was dismissed before")
        else:
            self._offer(refit, fitted)

    def _offer(self, refit: LiveRefit, fitted: Fitted) -> None:
        section, before = self.section, self.open
        if before is not None:
            self._become(before.number, OUTDATED, f"{before.text}; fit {refit.number} took its place")
        self._tell(refit.number, OFFERED, _moves(fitted))
        if section is not None and section.adopt == "if better":
            try:
                self.accept(refit.number, why="by rule")
            except NisusError as error:
                self._engine.notices.say(f"refit {refit.number}: not adopted: {error}", level="warn")

    def _tell(self, number: int, state: str, text: str, level: str = "info") -> None:
        self._become(number, state, text)
        self._engine.notices.say(f"refit {number}: {state}: {text}", level=level)

    def _outdate(self) -> None:
        """Mark the proposal as outdated once another tuning runs."""
        refit = self.open
        if refit is not None and not self._current(refit.attempt):
            self._tell(refit.number, OUTDATED, f"{refit.text}; another tuning runs by now")

    def _current(self, attempt: FitAttempt) -> bool:
        return self._engine.tuning is attempt.tuning and self._engine.estimator == attempt.estimator

    def _proposed(self, number: int) -> LiveRefit:
        refit = self.open
        if refit is None or refit.number != number:
            state = next((item.state for item in self.known if item.number == number), "not known")
            raise ConfigError(f"refit {number}: it is {state}; only a proposed fit can be adopted or dismissed")
        return refit

    def _become(self, number: int, state: str, text: str, name: str = "") -> None:
        # At once, so that a reader in another thread never sees half of it.
        self.known = tuple(
            replace(item, state=state, text=text, name=name) if item.number == number else item for item in self.known
        )


def _against(fitted: Fitted) -> tuple[str, ...]:
    from estimators.fit.dual import against

    return against(fitted)


def _same(fitted: Fitted, other: Fitted) -> bool:
    from estimators.fit.dual import agrees

    return agrees(fitted, other)


def _moves(fitted: Fitted) -> str:
    """Describe the changed entries and the gain in a line."""
    from estimators.fit.dual import shift

    moved = [
        f"{line.key} {line.before:.4g} → {line.after:.4g}{line.unit and ' ' + line.unit} "
        f"({shift(line):+.1f} σ{AT_BOUND if line.edge else ''})"
        for line in fitted.lines
        if not line.alone
    ]
    verdict = fitted.verdict
    gained = f"{verdict.gain:+.3g} ± {verdict.error:.2g} nats per measurement on held-out blocks"
    return f"{', '.join(moved)}; {gained}"


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
