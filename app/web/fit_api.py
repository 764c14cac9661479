"""Fits over HTTP: begin, watch, cancel and keep one; fits of the last window (dual estimation); estimator advice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from starlette.routing import Route

from estimators.errors import ConfigError

from ..live.history_copy import END_OF_TIME
from ..live.jobs import DONE
from ..live.running_fold import Running
from ..live.runs.refits import FITTING, FitAttempt, Fitting, LiveRefit, Refits
from ..live.tunings.versions import keep, settings_of, version_text
from ..studies.advice.advising import Advising
from .http import get, one_line, post
from .runs_api import checked_note


class FitApi:
    """Routes for fits and advice, and the work behind them."""

    def __init__(self, engine: Running, refits: Refits) -> None:
        self._engine, self._refits = engine, refits
        self.fitting = Fitting(engine)
        self._advising = Advising(engine)

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/fit", get(self._fit)),
            Route("/api/fit", post(self._begin, status=202), methods=["POST"]),
            Route("/api/fit", get(self._cancel), methods=["DELETE"]),
            Route("/api/fit/keep", post(self._keep), methods=["POST"]),
            Route("/api/advice", get(self._advice)),
            Route("/api/advice", post(self._advise, status=202), methods=["POST"]),
            Route("/api/refit", get(self._refit)),
            Route("/api/refit", post(self._refit_now, status=202), methods=["POST"]),
            Route("/api/refit/accept", post(self._accept), methods=["POST"]),
            Route("/api/refit/dismiss", post(self._dismiss), methods=["POST"]),
        ]

    def _fit(self) -> Any:
        """Return the last fit; `available` events could be fitted, `current` says whether its tuning still runs."""
        engine, attempt = self._engine, self.fitting.latest
        available = {"available": engine.index_at(END_OF_TIME) - engine.rows(0, 0).first}
        if attempt is None:
            return {"state": "none"} | available
        return _attempt_json(attempt) | available | {"current": engine.folded_with()[0] is attempt.tuning}

    def _begin(self, wanted: list[str], events: int | None = None) -> Any:
        """Fit the entries `wanted`, such as Q or R.winding, to the last `events`; None is all."""
        if events is not None and events < 1:
            raise ConfigError(f"fit: events is {events}; it must be a positive whole number, or be left out for all")
        self.fitting.begin(list(dict.fromkeys(wanted)), events)
        return self._fit()

    def _cancel(self) -> Any:
        self.fitting.cancel()
        return self._fit()

    def _keep(self, name: str, note: str) -> Any:
        """Keep the fitted values as a tuning version, with their scores on the blocks held out."""
        twin, attempt = self._engine.twin, self.fitting.latest
        if attempt is None or attempt.fitted is None:
            raise ConfigError("fit: there is no result to keep; fit first")
        fitted_on = [f"{attempt.events} events over {attempt.seconds:.4g} s, from run {attempt.revision}"]
        settings = settings_of(attempt.fitted, fitted_on, checked_note(note))
        settings = replace(settings, model_version=self._engine.status().model_version)
        keep(twin, name, version_text(twin, settings))
        return {"name": name}

    def _advice(self) -> Any:
        found = self._advising
        current = found.revision == self._engine.revisions.runs[-1].number
        state = {"state": found.state, "revision": found.revision, "current": current, "reason": one_line(found.reason)}
        return state | ({"advice": found.advice} if found.state == DONE else {})

    def _advise(self) -> Any:
        """Begin to find the estimator that suits the log."""
        self._advising.begin()
        return self._advice()

    # Dual estimation

    def brief(self) -> dict[str, Any] | None:
        """Return for the status: the last fit of a window, its state, and the proposed one; None without `refit`."""
        if self._refits.section is None:
            return None
        known, offered = self._refits.known, self._refits.open
        last = known[-1] if known else None
        return {
            "last": None if last is None else last.number,
            "state": None if last is None else last.state,
            "proposed": None if offered is None else offered.number,
        }

    def _refit(self) -> Any:
        """Return the YAML's section, when the next fit is due, and every fit, newest first."""
        refits, section = self._refits, self._refits.section
        due = refits.due
        return {
            "section": None if section is None else section.model_dump(mode="json"),
            "due": None if due is None else str(due),
            "fits": [_refit_json(item) for item in reversed(refits.known)],
        }

    def _refit_now(self) -> Any:
        self._refits.now()
        return self._refit()

    def _accept(self, number: int) -> Any:
        """Keep a proposed fit as a tuning version, and go on with it."""
        return {"name": self._refits.accept(number)}

    def _dismiss(self, number: int) -> Any:
        self._refits.dismiss(number)
        return self._refit()


def _attempt_json(attempt: FitAttempt) -> dict[str, Any]:
    """Return a fit as JSON; `values` are the proposed values of its entries, by key."""
    found: dict[str, Any] = {
        "number": attempt.number,
        "state": attempt.job.state,
        "wanted": list(attempt.wanted),
        "estimator": attempt.estimator,
        "revision": attempt.revision,
        "events": attempt.events,
        "seconds": attempt.seconds,
        "folds": attempt.folds,
        "elapsed": attempt.job.elapsed,
        "reason": one_line(attempt.job.reason),
    }
    if attempt.fitted is None:
        return found
    from ..present.runs_json import fit_json

    values = {line.key: line.after for line in attempt.fitted.lines if not line.alone}
    return found | {"result": fit_json(attempt.fitted), "values": values}


def _refit_json(refit: LiveRefit) -> dict[str, Any]:
    """Return a fit of a window as JSON; times as text, since JavaScript's numbers cannot hold them."""
    attempt = refit.attempt
    found: dict[str, Any] = {
        "number": refit.number,
        "state": refit.state,
        "text": one_line(refit.text),
        "name": refit.name,
        "start": str(refit.start),
        "end": str(refit.end),
        "revision": attempt.revision,
        "events": attempt.events,
        "seconds": attempt.seconds,
        "folds": attempt.folds,
        "elapsed": attempt.job.elapsed,
    }
    if attempt.fitted is None or refit.state == FITTING:
        return found
    from ..present.runs_json import fit_json

    return found | {"result": fit_json(attempt.fitted)}
