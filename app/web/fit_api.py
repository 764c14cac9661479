"""Fits over HTTP: begin, watch, cancel and keep one; fits of the last window (dual estimation); estimator advice."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from starlette.routing import Route

from estimators.errors import ConfigError

from ..derive.refits import FITTING, STOPPING, FitAttempt, Fitting, LiveRefit, Refits
from ..engine.engine import Engine
from ..engine.history_copy import copy_log
from ..engine.jobs import Job
from ..result import JsonObject
from ..twin.versions import keep, settings_of, version_text
from .http import get, one_line, post
from .runs_api import checked_note

if TYPE_CHECKING:
    from estimators.fit.fit import Fitted

    from ..study.advice.measured import AdviceProgress


class FitApi:
    """Routes for fits and advice, and the work behind them."""

    def __init__(self, engine: Engine, refits: Refits) -> None:
        self._engine, self._refits = engine, refits
        self.fitting = Fitting(engine)
        self._advising = Advising(engine)

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            get("/api/fit", self._fit),
            post("/api/fit", self._begin, status=202),
            get("/api/fit", self._cancel, method="DELETE"),
            post("/api/fit/keep", self._keep),
            get("/api/advice", self._advice),
            post("/api/advice", self._advise, status=202),
            get("/api/advice", self._cancel_advice, method="DELETE"),
            get("/api/refit", self._refit),
            post("/api/refit", self._refit_now, status=202),
            post("/api/refit/accept", self._accept),
            post("/api/refit/dismiss", self._dismiss),
        ]

    def _fit(self) -> JsonObject:
        """Return the last fit; `available` events could be fitted, `current` says whether its tuning still runs."""
        engine, attempt = self._engine, self.fitting.latest
        available = {"available": engine.end() - engine.rows(0, 0).first}
        if attempt is None:
            return {"state": "none"} | available
        return _attempt_json(attempt) | available | {"current": engine.folded_with()[0] is attempt.tuning}

    def _begin(self, wanted: tuple[str, ...], events: int | None = None) -> JsonObject:
        """Fit the entries `wanted`, such as Q or R.winding, to the last `events`; None is all."""
        if events is not None and events < 1:
            raise ConfigError(f"fit: events is {events}; it must be a positive whole number, or be left out for all")
        self.fitting.begin(list(dict.fromkeys(wanted)), events)
        return self._fit()

    def _cancel(self) -> JsonObject:
        """End the search of the fit under way; its best values so far are the result."""
        self.fitting.cancel()
        return self._fit()

    def _keep(self, name: str, note: str) -> JsonObject:
        """Keep the fitted values as a tuning version, with their scores on the blocks held out."""
        twin, attempt = self._engine.twin, self.fitting.latest
        if attempt is None or attempt.fitted is None:
            raise ConfigError("fit: there is no result to keep; fit first")
        fitted_on = [f"{attempt.events} events over {attempt.seconds:.4g} s, from run {attempt.revision}"]
        settings = settings_of(twin, attempt.fitted, fitted_on, checked_note(note))
        settings = replace(settings, model_version=self._engine.status().model_version)
        keep(twin, name, version_text(twin, settings))
        return {"name": name}

    def _advice(self) -> JsonObject:
        """Return the advice, or the state of its search."""
        found, job = self._advising, self._advising.job
        current = found.revision == self._engine.revisions.runs[-1].number
        state, reason = ("none", "") if job is None else (job.state, one_line(job.reason))
        known = {"state": state, "revision": found.revision, "current": current, "reason": reason}
        return known | {"progress": found.progress()} | ({"advice": found.advice} if found.advice else {})

    def _advise(self) -> JsonObject:
        """Begin to search the estimator that suits the log."""
        self._advising.begin()
        return self._advice()

    def _cancel_advice(self) -> JsonObject:
        """Cancel the search; the advice before it stays."""
        if self._advising.job is not None:
            self._advising.job.cancel()
        return self._advice()

    # Dual estimation

    def brief(self) -> JsonObject | None:
        """Return for the status: the last fit of a window, its state, and the proposed one; None without `refit`."""
        if self._refits.section is None:
            return None
        last, proposed = next(reversed(self._refits.known), None), self._refits.open
        return {"last": last and last.number, "state": last and last.state, "proposed": proposed and proposed.number}

    def _refit(self) -> JsonObject:
        """Return the YAML's section, the time of the next fit, and every fit, newest first."""
        refits, section, due = self._refits, self._refits.section, self._refits.due
        return {
            "section": None if section is None else section.model_dump(mode="json"),
            "due": None if due is None else str(due),
            "fits": [_refit_json(item) for item in reversed(refits.known)],
        }

    def _refit_now(self) -> JsonObject:
        """Fit the last window at once."""
        self._refits.now()
        return self._refit()

    def _accept(self, number: int) -> JsonObject:
        """Keep a proposed fit as a tuning version, and load it."""
        return {"name": self._refits.accept(number)}

    def _dismiss(self, number: int) -> JsonObject:
        """Dismiss a proposed fit."""
        self._refits.dismiss(number)
        return self._refit()


def _attempt_json(attempt: FitAttempt) -> JsonObject:
    """Return a fit as JSON; `values` are the proposed values of its entries, by key."""
    found = _progress_json(attempt) | {"reason": one_line(attempt.job.reason)}
    state = STOPPING if attempt.stopping else attempt.job.state
    found |= {name: getattr(attempt, name) for name in ("number", "wanted", "estimator")} | {"state": state}
    if attempt.fitted is not None:
        found |= _result_json(attempt.fitted)
        found["values"] = {line.key: line.after for line in attempt.fitted.lines if not line.alone}
    return found


def _refit_json(refit: LiveRefit) -> JsonObject:
    """Return a fit of a window as JSON; times as text, since JavaScript's numbers cannot hold them."""
    found = _progress_json(refit.attempt) | {name: getattr(refit, name) for name in ("number", "state", "name")}
    found |= {"text": one_line(refit.text), "start": str(refit.start), "end": str(refit.end)}
    fitted = refit.attempt.fitted
    return found if fitted is None or refit.state == FITTING else found | _result_json(fitted)


def _progress_json(attempt: FitAttempt) -> JsonObject:
    found = {name: getattr(attempt, name) for name in ("revision", "events", "seconds", "folds")}
    progress, elapsed = attempt.progress, attempt.job.elapsed
    found |= {"elapsed": elapsed, "expected": None, "left": None, "gain": 0.0, "best": ""}
    if progress is not None and progress.folds:
        from ..study.tune import moves_text  # which imports SciPy's optimisers too

        expected = max(progress.expected, progress.folds)
        left = elapsed / progress.folds * (expected - progress.folds)
        found |= {"expected": expected, "left": left, "gain": progress.gain, "best": moves_text(progress)}
    return found


def _result_json(fitted: Fitted) -> JsonObject:
    from ..study.fit_json import fit_json  # which imports SciPy's optimisers, 0.5 s

    return {"result": fit_json(fitted)}


class Advising:
    """Measures one log at a time and keeps the last result with its `revision`."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.job: Job | None = None
        """The last measurement."""
        self._progress: AdviceProgress | None = None
        self.advice: JsonObject = {}
        """The last advice as JSON; a cancelled one leaves the one before."""
        self.revision: int | None = None

    def progress(self) -> JsonObject:
        """Return the question that is being answered, the share done, and the seconds spent and left, about."""
        job, progress = self.job, self._progress
        if job is None or progress is None:
            return {"question": "", "share": None, "elapsed": 0.0, "left": None}
        share = progress.done / progress.expected if progress.expected else None
        return {
            "question": progress.question,
            "share": share,
            "elapsed": job.elapsed,
            "left": progress.left(job.elapsed),
        }

    def begin(self) -> None:
        """Measure the log.

        Raises:
            ConfigError: If it is being measured, or measuring would hold up the running twin.
        """
        engine = self._engine
        if self.job is not None and not self.job.over:
            raise ConfigError("advice: the log is being measured; wait for it")
        if engine.model.black_box:
            raise ConfigError(f"advice: {engine.model.name} is a black box, too slow to be measured; use nisus advise")
        if engine.status().compiling:
            # Compiling holds the interpreter.
            raise ConfigError("advice: the filters that it compares are still being compiled; ask again then")
        self._progress = None
        self.job = engine.jobs.run("advice", self.measure, failed=lambda reason: None)

    def measure(self, job: Job) -> JsonObject:
        """Return the advice on a copy of the log, as JSON."""
        from ..study.advice.measured import AdviceProgress, Measured, without_faults
        from ..study.advice.verdict import advice_json, advise

        engine = self._engine
        self._progress = AdviceProgress(check=job.check)
        revision = engine.revisions.runs[-1].number
        tuning, estimator = engine.folded_with()
        log, _ = copy_log(engine, tuning, check=job.check)
        twin = replace(engine.twin, tuning=tuning, estimator=estimator)
        clean, excluded = without_faults(twin, log, engine.episodes())
        found = advice_json(twin, log, advise(Measured(twin, clean, excluded, self._progress)))
        self.advice, self.revision = found, revision
        return found
