"""Fits of the tuning beside a running twin: on request, and at intervals to its last measurements (dual estimation).

A fit is a job that folds a copy of the events again and again (estimators/fit); nothing is applied by itself. `Refits`
watches the log's clock and starts the fits of section `refit`. A result that wins on the held-out blocks is a proposal,
which a user accepts or dismisses, or which is adopted at once with `adopt: if better`. Every fit adds a notice; an
adopted one becomes a tuning version with its evidence. A proposal is valid for the tuning that it was fitted from; a
dismissed one is proposed again only when the data differ.
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
from estimators.fold import folded
from estimators.log import Log
from estimators.snapshots import Base
from estimators.tuning import Tuning

from ..engine.engine import Engine
from ..engine.history_copy import copy_log
from ..engine.jobs import DONE, FAILED, RUNNING, Job, JobCancelled
from ..engine.load_version import load_into
from ..format_time import format_time
from ..twin.defaults import bounds_of, natural_aim, width_priors
from ..twin.twin import with_held
from ..twin.versions import keep, settings_of, version_text

if TYPE_CHECKING:
    from estimators.fit.fit import Fitted
    from estimators.fit.objective import FitProgress

CLOCK_PERIOD_S = 0.5
"""Seconds between two looks at the log's clock."""

MAX_FITS = 50
"""Fits that are kept with their result."""

FITTING, OFFERED, ADOPTED, DISMISSED, OUTDATED, NOTHING, BROKEN = (
    "fitting", "proposed", "adopted", "dismissed", "outdated", "nothing better", "failed",
)  # fmt: skip


STOPPING = "stopping"
"""State of a fit whose search was ended, while its best values are judged."""


@dataclass
class FitAttempt:
    """One fit: its request, progress and job, whose result is the `Fitted`.

    `revision` is the run from which it starts, `events` how many are folded each time, over `seconds` of the log;
    `folds` are done by now; `progress` has the folds to come and the best values so far, once the search has begun.
    """

    number: int
    wanted: tuple[str, ...]
    estimator: str
    tuning: Tuning
    revision: int
    events: int = 0
    seconds: float = 0.0
    folds: int = 0
    progress: FitProgress | None = None
    job: Job = field(default_factory=lambda: Job("fit"))

    @property
    def stopping(self) -> bool:
        """Whether the search was ended, and its best point is being judged."""
        return self.progress is not None and self.progress.stop and self.job.state == RUNNING

    @property
    def fitted(self) -> Fitted | None:
        """The result, once there is one."""
        found: Fitted | None = self.job.result
        return found


class Fitting:
    """Fits on request, one at a time."""

    def __init__(self, engine: Engine) -> None:
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
        engine = self._engine
        if engine.model.black_box:
            name = engine.model.name
            raise ConfigError(f"fit: {name} is a black box, too slow to fit beside the running twin; use nisus tune")
        if not wanted:
            raise ConfigError("fit: wanted is empty; name what is fitted, for example Q and R")
        with self._lock:
            if self.latest is not None and not self.latest.job.over:
                raise ConfigError("fit: another one is under way; wait for it, or cancel it")
            tuning, estimator = engine.folded_with()
            number = 1 if self.latest is None else self.latest.number + 1
            attempt = FitAttempt(number, tuple(wanted), estimator, tuning, engine.revisions.runs[-1].number)
            # The answer shows why it failed.
            attempt.job = engine.jobs.run("fit", partial(self._fit, attempt, most, since), failed=lambda reason: None)
            self.latest = attempt
        return attempt

    def cancel(self) -> None:
        """End the search of the fit that is under way: its best values so far are judged and become the result.

        Without a better point than the start, or if the search was ended before, the fit ends without a result.
        """
        attempt = self.latest
        if attempt is None:
            return
        progress = attempt.progress
        if progress is not None and progress.gain > 0.0 and not progress.stop:
            progress.stop = True
        else:
            attempt.job.cancel()

    def _fit(self, attempt: FitAttempt, most: int | None, since: int | None, job: Job) -> Fitted:
        # Half a second of imports, which a twin that nobody fits need not wait for.
        from estimators.fit import objective
        from estimators.fit.fit import fit
        from estimators.fit.recording import Recording

        def go(folds: int) -> bool:
            attempt.folds += folds
            return job.wanted

        log, base = self._log(attempt, most, since, job)
        attempt.progress = objective.FitProgress()
        attempt.events, attempt.seconds = log.n, log.events.seconds
        config = self._engine.twin.config
        try:
            # Data say the widths of parameters that the filter considers, so the fit holds them.
            model = with_held(self._engine.twin).model
            if base is not None:
                base = base._replace(mean=base.mean[: model.nx], cov=base.cov[: model.nx, : model.nx])
            return fit(
                attempt.estimator,
                replace(attempt.tuning, model=model),
                [Recording(log, base=base)],
                wanted=attempt.wanted,
                bounds=bounds_of(config, model),
                aim=natural_aim(config),
                # A fit of a window is loaded while the twin runs, which can add no states.
                considered=width_priors(config, model, attempt.wanted if since is None else ()),
                go=go,
                progress=attempt.progress,
            )
        except objective.Cancelled:
            raise JobCancelled from None

    def _log(self, attempt: FitAttempt, most: int | None, since: int | None, job: Job) -> tuple[Log, Base | None]:
        """Return the events to fit to, and where a fold of them starts."""
        from estimators.fit.dual import tail

        engine = self._engine
        if since is not None:
            most = engine.end() - engine.index_at(since)
        log, base = copy_log(engine, attempt.tuning, most, job.check)
        if since is None:
            return log, base
        # A copy starts at a snapshot, which may be long before.
        fold = folded(attempt.estimator, attempt.tuning.model, attempt.tuning, log, base=base)
        return tail(fold, int(np.searchsorted(log.events.t, since)), base)


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


class Refits:
    """All fits of the windows of a running twin, the oldest first."""

    def __init__(self, engine: Engine) -> None:
        """Nothing is fitted before `start`."""
        self._engine = engine
        self._fitting = Fitting(engine)
        self._lock = threading.RLock()
        self._passage = 0
        self._dismissed: Fitted | None = None
        self.due: int | None = None
        """Time of the next fit, ns of the log; None before the first measurement, or without the section."""
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

    def start(self) -> None:
        """Begin to look at the log's clock."""
        self._engine.jobs.run("refit", lambda job: self.update(), every=CLOCK_PERIOD_S)

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
        """Keep a proposal as a tuning version with its evidence, and load it; return the version's name.

        Raises:
            ConfigError: If it is not proposed any more, or cannot be kept or loaded.
        """
        with self._lock:
            self._outdate()
            refit = self._proposed(number)
            attempt, engine, twin = refit.attempt, self._engine, self._engine.twin
            assert attempt.fitted is not None
            taken = version_files(twin.path)
            name = next(name for k in range(1, len(taken) + 2) if (name := f"refit-{k}") not in taken)
            fitted_on = [f"{attempt.events} events over {attempt.seconds:.4g} s, to {format_time(refit.end)}"]
            given = settings_of(
                twin, attempt.fitted, fitted_on, f"dual estimation, fit {number}, adopted {why}: {refit.text}"
            )
            given = replace(given, model_version=engine.status().model_version)
            keep(twin, name, version_text(twin, given))
            load_into(engine, name, f"refit {number}, version {name}")
            words = f"adopted {why} as tuning version {name}: {refit.text}"
            self._become(number, ADOPTED, refit.text, name=name, words=words)
        return name

    def dismiss(self, number: int) -> None:
        """Dismiss a proposal; it is not made again until the data differ.

        Raises:
            ConfigError: If it is not proposed any more.
        """
        with self._lock:
            refit = self._proposed(number)
            self._dismissed = refit.attempt.fitted
            self._become(number, DISMISSED, refit.text)

    # In its job

    def update(self) -> None:
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
                self.due = None
            elif self._is_due(section):
                self._begin(section)

    def _is_due(self, section: RefitSection) -> bool:
        begun, newest = self._engine.span()
        passage = self._engine.notices.passage
        if passage != self._passage:
            self._passage, self.due = passage, None
        if not newest:
            return False
        if self.due is None:
            self.due = begun + round(section.window * 1e9)
        # Not while a refold is under way: what it gives is what is to be fitted from.
        return newest >= self.due and not self._engine.status().refolding

    def _begin(self, section: RefitSection) -> None:
        newest = self._engine.span()[1]
        first = newest - round(section.window * 1e9)
        self.due = newest + round(section.every * 1e9)
        attempt = self._fitting.begin(section.entries, since=first)
        number = self.known[-1].number + 1 if self.known else 1
        self.known = (*self.known, LiveRefit(number, first, newest, attempt))[-MAX_FITS:]

    def _take(self, refit: LiveRefit) -> None:
        """Report the result of a fit, and propose it if it won."""
        from estimators.fit.dual import against, agrees

        attempt, number, job, fitted = refit.attempt, refit.number, refit.attempt.job, refit.attempt.fitted
        if job.state != DONE or fitted is None:
            level = "warn" if job.state == FAILED else "info"
            self._become(number, BROKEN, job.reason or "it was given up", level=level)
        elif reasons := against(fitted):
            self._become(number, NOTHING, "; ".join(reasons))
        elif not self._current(attempt):
            self._become(number, OUTDATED, f"{_moves(fitted)}; another tuning runs by now")
        elif self._dismissed is not None and agrees(fitted, self._dismissed):
            self._become(number, DISMISSED, f"{_moves(fitted)}; the same result was dismissed before")
        else:
            if before := self.open:
                text = f"{before.text}; fit {number} took its place"
                self._become(before.number, OUTDATED, text, words="")
            self._become(number, OFFERED, _moves(fitted))
            if self.section is not None and self.section.adopt == "if better":
                try:
                    self.accept(number, why="by rule")
                except NisusError as error:
                    self._engine.notices.say(f"refit {number}: not adopted: {error}", level="warn")

    def _outdate(self) -> None:
        """Mark the proposal as outdated once another tuning runs."""
        refit = self.open
        if refit is not None and not self._current(refit.attempt):
            self._become(refit.number, OUTDATED, f"{refit.text}; another tuning runs by now")

    def _current(self, attempt: FitAttempt) -> bool:
        return self._engine.tuning is attempt.tuning and self._engine.estimator == attempt.estimator

    def _proposed(self, number: int) -> LiveRefit:
        refit = self.open
        if refit is None or refit.number != number:
            state = next((item.state for item in self.known if item.number == number), "not known")
            raise ConfigError(f"refit {number}: it is {state}; only a proposed fit can be adopted or dismissed")
        return refit

    def _become(
        self, number: int, state: str, text: str, level: str = "info", *, name: str = "", words: str | None = None
    ) -> None:
        """Change the state of a fit, and report it in `words`; by default state and text, "" for no notice."""
        # At once, so that a reader in another thread never sees half of it.
        self.known = tuple(
            replace(item, state=state, text=text, name=name) if item.number == number else item for item in self.known
        )
        if words != "":
            self._engine.notices.say(f"refit {number}: {words or f'{state}: {text}'}", level=level)


def _moves(fitted: Fitted) -> str:
    """Describe the changed entries and the gain in a line."""
    from estimators.fit.dual import shift

    moved = [
        f"{line.key} {line.before:.4g} → {line.after:.4g}{line.unit and ' ' + line.unit} "
        f"({shift(line):+.1f} σ{', at the bound of its range' if line.edge else ''})"
        for line in fitted.lines
        if not line.alone
    ]
    gained = f"{fitted.verdict.gain:+.3g} ± {fitted.verdict.error:.2g} nats per measurement on held-out blocks"
    return f"{', '.join(moved)}; {gained}"
