"""Runs, sweeps, noise estimates and fits as JSON for the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from estimators.registry import ESTIMATORS

from ..live.changes import difference, in_words
from ..live.revisions import Revision
from ..live.running_fold import Running
from ..live.runs.scores import RunScore, RunScores
from ..live.runs.sweep import NoiseEstimates, Swept
from .result import plain

if TYPE_CHECKING:
    from estimators.fit.fit import Fitted
    from estimators.fit.judge import PartScore, PredictionScore


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
    return [{"key": key, "values": plain([before, after])} for key, before, after in changes]


def swept_json(swept: Swept) -> dict[str, Any]:
    """Return a sweep as far as it is done, its most likely value, and the value at which the NIS is consistent."""
    best = swept.best
    return plain(swept) | plain({"best": None if best is None else best.value, "level": swept.level})


def noise_json(noise: NoiseEstimates) -> dict[str, Any]:
    """Return the estimated R by key and the sweep of all of Q; `doubt` is the reason not to use an estimate."""
    estimates = {
        key: {
            "value": found.variance if found.variance > 0.0 else None,
            "std": found.std,
            "n": found.n,
            "doubt": noise.doubts.get(key, ""),
        }
        for key, found in noise.sensors.items()
    }
    q = swept_json(noise.q) | {"doubt": noise.doubts.get("Q", "")}
    return {"revision": noise.revision, "R": plain(estimates), "reason": noise.reason, "Q": q}


def _score(known: RunScore, units: dict[str, str]) -> dict[str, Any]:
    found = known.score
    fits = [(name, "truth", fit) for name, fit in found.states.items()]
    fits += [(name, "held out", fit) for name, fit in found.held_out.items()]
    if found.field is not None:
        fits.append(("all cells", "truth", found.field))
    return plain(
        {
            "rows": known.rows,
            "seconds": known.seconds,
            "nis": found.nis,
            "nis_low": found.nis_low,
            "nis_high": found.nis_high,
            "nis_judged": found.nis_verdict.measure,
            "nis_place": found.nis_verdict.place,
            "nis_words": found.nis_verdict.words,
            "log_likelihood": found.log_likelihood,
            "log_likelihood_reading": known.log_likelihood_reading,
            "readings": found.readings,
            "refused": found.refused,
            "step_us": known.step_us,
            "fits": [
                {"name": name, "against": against, "unit": units.get(name, ""), **fit._asdict()}
                for name, against, fit in fits
            ],
        }
    )


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
    # Half a second of imports, which a twin without a fit need not wait for.
    from estimators.fit.dual import shift

    return plain(
        {
            "estimator": fitted.estimator,
            "proposed": fitted.proposed,
            "verdict": {
                "gain": fitted.verdict.gain,
                "error": fitted.verdict.error,
                "reasons": fitted.verdict.reasons,
            },
            "entries": [{**line._asdict(), "sigma": shift(line)} for line in fitted.lines],
            "power": fitted.power,
            "skipped": fitted.skipped,
            "left_out": fitted.left_out,
            "correlated": correlated(fitted),
            "before": {"fitted": part_json(fitted.before.fitted), "held_out": part_json(fitted.before.held_out)},
            "after": {"fitted": part_json(fitted.after.fitted), "held_out": part_json(fitted.after.held_out)},
            "folds": fitted.folds,
        }
    )


def correlated(fitted: Fitted) -> list[dict[str, Any]]:
    """Return pairs of entries that are hardly identifiable separately, the most correlated first."""
    found = [
        {"entries": [one.key, other.key], "correlation": float(fitted.correlation[i, j])}
        for i, one in enumerate(fitted.lines)
        for j, other in enumerate(fitted.lines[:i])
        if abs(fitted.correlation[i, j]) >= HIGH_CORRELATION
    ]
    return sorted(found, key=lambda pair: -abs(pair["correlation"]))


def part_json(part: PartScore) -> dict[str, Any]:
    """Return the scores of one part of the recordings."""

    def predictions(items: Mapping[str, PredictionScore]) -> dict[str, Any]:
        names = ("unit", "n", "rms", "coverage", "crps")
        return {key: {name: getattr(item, name) for name in names} for key, item in items.items()}

    return plain(
        {
            "readings": part.n,
            "log_density": part.log_density,
            "nis": part.nis,
            "coverage": part.coverage,
            "sensors": predictions(part.sensors),
            "withheld": predictions(part.withheld),
            "states": predictions(part.states),
        }
    )
