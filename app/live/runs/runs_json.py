"""Runs, sweeps, noise estimates and fits as JSON for the page."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from estimators.diagnostics.score import Fit
from estimators.fit.dual import shift
from estimators.fit.fit import Fitted, Line
from estimators.fit.judge import Part, Prediction
from estimators.registry import ESTIMATORS

from ..changes import difference, in_words
from ..interface import Running
from ..revisions import Revision
from .noise import NoiseEstimates
from .scores import RunScore, RunScores
from .sweep import Swept


def runs_json(scores: RunScores, engine: Running) -> list[dict[str, Any]]:
    """Return every run, oldest first, with its changes and scores."""
    units = {state.name: state.unit for state in engine.model.shown_states}
    rows = [row.unit for sensor in engine.model.sensors for row in sensor.rows]
    units |= dict(zip(engine.model.row_names, rows, strict=True))
    found = scores.all()
    running = found[-1][0]
    return [_run(run, known, run is running, units) for run, known in found]


def _run(run: Revision, known: RunScore | None, running: bool, units: dict[str, str]) -> dict[str, Any]:
    kept = running or run.track is not None
    return {
        "number": run.number,
        "estimator": run.estimator,
        "title": ESTIMATORS[run.estimator].title,
        "began": run.began,
        "what": what_changed(run),
        "running": running,
        "loaded": run.loaded,
        "name": run.name,
        "note": run.note,
        "place": run.place,
        "kept": kept,
        "score": None if known is None else _score(known, units),
        "unscored": "" if known is not None else "no readings yet" if kept else "not scored: its track is gone",
    }


def what_changed(run: Revision) -> str:
    """Describe the changes of a run in words."""
    said = ": ".join(part for part in (run.why, in_words(run.changes)) if part)
    words = said or ("as it began" if run.loaded is None and not run.number else "as before")
    return words if run.loaded is None else f"back to run {run.loaded}: {words}"


def difference_json(run: Revision, other: Revision) -> list[dict[str, Any]]:
    """Return the entries in which two runs differ, with both values."""
    changes = difference(run.estimator, run.tuning, other.estimator, other.tuning)
    return [{"key": key, "values": [_plain(before), _plain(after)]} for key, before, after in changes]


def swept_json(swept: Swept) -> dict[str, Any]:
    """Return a sweep as far as it is done, its most likely value, and the value at which the NIS is consistent."""
    best = swept.best
    return {
        **{key: _plain(value) for key, value in dataclasses.asdict(swept).items() if key != "points"},
        "points": [dataclasses.asdict(point) for point in swept.points],
        "best": None if best is None else best.value,
        "level": _plain(swept.level),
    }


def noise_json(noise: NoiseEstimates) -> dict[str, Any]:
    """Return the estimated R by key and the sweep of all of Q; `doubt` is the reason not to use an estimate."""
    estimates = {
        key: {
            "value": _plain(found.variance) if found.variance > 0.0 else None,
            "std": _plain(found.std),
            "n": found.n,
            "doubt": noise.doubts.get(key, ""),
        }
        for key, found in noise.sensors.items()
    }
    q = swept_json(noise.q) | {"doubt": noise.doubts.get("Q", "")}
    return {"revision": noise.revision, "R": estimates, "reason": noise.reason, "Q": q}


def _score(known: RunScore, units: dict[str, str]) -> dict[str, Any]:
    found = known.score
    fits = [_fit(name, "truth", fit, units.get(name, "")) for name, fit in found.states.items()]
    fits += [_fit(name, "held out", fit, units.get(name, "")) for name, fit in found.held_out.items()]
    if found.field is not None:
        fits.append(_fit("all cells", "truth", found.field, ""))
    return {
        "rows": known.rows,
        "seconds": known.seconds,
        "nis": _plain(found.nis),
        "nis_low": _plain(found.nis_low),
        "nis_high": _plain(found.nis_high),
        "nis_judged": _plain(found.nis_verdict.measure),
        "nis_place": found.nis_verdict.place,
        "nis_words": found.nis_verdict.words,
        "log_likelihood": _plain(found.log_likelihood),
        "log_likelihood_reading": _plain(known.log_likelihood_reading),
        "readings": found.readings,
        "refused": _plain(found.refused),
        "step_us": _plain(known.step_us),
        "fits": fits,
    }


def _fit(name: str, against: str, fit: Fit, unit: str) -> dict[str, Any]:
    return {
        "name": name,
        "against": against,
        "unit": unit,
        "rmse": _plain(fit.rmse),
        "coverage": _plain(fit.coverage),
        "bias": _plain(fit.bias),
    }


def _plain(value: Any) -> Any:
    """Replace infinity and NaN, which JSON does not have, by None."""
    if isinstance(value, (str, bool, int)) or value is None:
        return value
    return float(value) if math.isfinite(value) else None


HIGH_CORRELATION = 0.9
"""Correlation from which on two estimates are hardly identifiable separately."""


def fit_json(fitted: Fitted) -> dict[str, Any]:
    """Return a fit as JSON; null stands for a value that is not a number.

    `entries` have before and after, the 95 % interval, the change in deviations of the estimate (`sigma`), whether
    they are identifiable, and whether they were left alone; `correlated` has pairs of entries that are hardly
    identifiable separately. `power` is the exponent of the tempered likelihood, `left_out` the measurements of stuck
    sensors. `before` and `after` have scores of the fitted and the held-out part: log density per measurement, mean
    NIS per degree of freedom, coverage of the 95 % bands; `sensors` held out in turn, those `withheld`, which the twin
    never uses, and true `states`. `verdict` says whether the fit is proposed, its gain in nats on the held-out blocks,
    and the reasons against it.
    """
    return {
        "estimator": fitted.estimator,
        "proposed": fitted.proposed,
        "verdict": {
            "gain": _plain(fitted.verdict.gain),
            "error": _plain(fitted.verdict.error),
            "reasons": list(fitted.verdict.reasons),
        },
        "entries": [_line(line) for line in fitted.lines],
        "power": fitted.power,
        "skipped": [item._asdict() for item in fitted.skipped],
        "left_out": dict(fitted.left_out),
        "correlated": correlated(fitted),
        "before": {"fitted": part_json(fitted.before.fitted), "held_out": part_json(fitted.before.held_out)},
        "after": {"fitted": part_json(fitted.after.fitted), "held_out": part_json(fitted.after.held_out)},
        "folds": fitted.folds,
    }


def correlated(fitted: Fitted) -> list[dict[str, Any]]:
    """Return pairs of entries that are hardly identifiable separately, the most correlated first."""
    found = [
        {"entries": [one.key, other.key], "correlation": float(fitted.correlation[i, j])}
        for i, one in enumerate(fitted.lines)
        for j, other in enumerate(fitted.lines[:i])
        if abs(fitted.correlation[i, j]) >= HIGH_CORRELATION
    ]
    return sorted(found, key=lambda pair: -abs(pair["correlation"]))


def _line(line: Line) -> dict[str, Any]:
    return {name: _plain(value) for name, value in {**line._asdict(), "sigma": shift(line)}.items()}


def part_json(part: Part) -> dict[str, Any]:
    """Return the scores of one part of the recordings."""
    return {
        "readings": part.n,
        "log_density": _plain(part.log_density),
        "nis": _plain(part.nis),
        "coverage": _plain(part.coverage),
        "sensors": {name: _prediction(item) for name, item in part.sensors.items()},
        "withheld": {name: _prediction(item) for name, item in part.withheld.items()},
        "states": {name: _prediction(item) for name, item in part.states.items()},
    }


def _prediction(item: Prediction) -> dict[str, Any]:
    return {
        "unit": item.unit,
        "n": item.n,
        "rms": _plain(item.rms),
        "coverage": _plain(item.coverage),
        "crps": _plain(item.crps),
    }
