"""Runs, sweeps, noise estimates and fits as JSON for the page."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from estimators.registry import ESTIMATORS

from ..columns import units_by_name
from ..derive.run_scores import RunScore, RunScores
from ..derive.sweep import NoiseEstimates, Swept
from ..engine.revisions import Revision
from ..engine.running_fold import Running
from ..result import plain
from ..twin.changes import SettingChange, in_words, units_of

if TYPE_CHECKING:
    from estimators.diagnostics.consistency import NisVerdict
    from estimators.fit.fit import Fitted
    from estimators.fit.judge import PartScore, PredictionScore


def runs_json(scores: RunScores, engine: Running) -> list[dict[str, Any]]:
    """Return every run, oldest first, with its changes and scores."""
    units, found = units_by_name(engine.model), scores.all()
    there = {run.number for run, _ in found}
    runs = []
    for run, known in found:
        running = run is found[-1][0]
        kept = running or run.track is not None
        names = ("number", "estimator", "began", "first", "loaded", "name", "note", "place")
        runs.append(
            {name: getattr(run, name) for name in names}
            | {
                "title": ESTIMATORS[run.estimator].title,
                "what": what_changed(run, there),
                "running": running,
                "kept": kept,
                "score": None if known is None else _score(known, units),
                "unscored": "" if known else "no measurements yet" if kept else "not scored: its track is gone",
            }
        )
    return runs


def _score(known: RunScore, units: dict[str, str]) -> dict[str, Any]:
    score = known.score
    fits = [(name, "truth", fit) for name, fit in score.states.items()]
    fits += [(name, "held out", fit) for name, fit in score.held_out.items()]
    if score.field is not None:
        fits.append(("all cells", "truth", score.field))
    found = {name: getattr(known, name) for name in ("rows", "seconds", "log_likelihood_reading", "step_us")}
    found |= {name: getattr(score, name) for name in ("log_likelihood", "readings", "refused")}
    found |= nis_json(score.nis_verdict)
    found["fits"] = [
        {"name": name, "against": against, "unit": units.get(name, "")} | fit._asdict() for name, against, fit in fits
    ]
    return dict(plain(found))


def nis_json(found: NisVerdict) -> dict[str, Any]:
    """Return a verdict on a mean NIS: numbers per measurement, position and words."""
    return {
        "nis": found.nis,
        "nis_low": found.low,
        "nis_high": found.high,
        "nis_dof": found.dof,
        "nis_judged": found.measure,
        "nis_place": found.place,
        "nis_words": found.words,
    }


def what_changed(run: Revision, there: Container[int]) -> str:
    """Describe the changes of a run in words; a run that was loaded is named if it is among those `there`."""
    changes = in_words(run.changes, units=units_of(run.estimator, run.tuning))
    said = ": ".join(part for part in (run.why, changes) if part)
    words = said or ("as it began" if run.first and run.loaded is None else "as before")
    if run.loaded is None:
        return words
    return f"back to {f'run {run.loaded}' if run.loaded in there else 'an earlier run'}: {words}"


def changes_json(changes: Sequence[SettingChange]) -> list[dict[str, Any]]:
    """Return changed entries with their values before and after."""
    return [{"key": key, "values": plain([before, after])} for key, before, after in changes]


def swept_json(swept: Swept) -> dict[str, Any]:
    """Return a sweep as far as it is done, its most likely value, and the value at which the NIS is consistent."""
    best = swept.best
    return plain(swept) | plain({"best": None if best is None else best.value, "level": swept.level})


def noise_json(noise: NoiseEstimates) -> dict[str, Any]:
    """Return the estimated R by key and the sweep of all of Q; `doubt` is the reason not to use an estimate."""
    estimates = {
        key: {"value": found.variance if found.variance > 0.0 else None, "std": found.std, "n": found.n}
        | {"doubt": noise.doubts.get(key, "")}
        for key, found in noise.sensors.items()
    }
    q = swept_json(noise.q) | {"doubt": noise.doubts.get("Q", "")}
    return {"revision": noise.revision, "R": plain(estimates), "reason": noise.reason, "Q": q}


HIGH_CORRELATION = 0.9
"""Correlation from which on two estimates are hardly identifiable separately."""


def fit_json(fitted: Fitted) -> dict[str, Any]:
    """Return a fit as JSON; null stands for a value that is not a number.

    `entries` have before and after, the 95 % interval, the change in deviations of the estimate (`sigma`), whether they
    are identifiable, whether they were left alone, and by how many deviations the weak prior has moved them (`pull`);
    `penalised` is whether there is one. `correlated` has pairs of entries that are hardly identifiable separately.
    `power` is the exponent of the tempered likelihood, `left_out` the measurements of stuck sensors. `before` and
    `after` have scores of the fitted and the held-out part: log-likelihood, mean per measurement (`log_density`), mean
    NIS per degree of freedom, coverage of the 95 % bands; `sensors` held out in turn, those `withheld`, which the twin
    never uses, and true `states`. `verdict` says whether the fit is proposed, its gain in nats on the held-out blocks,
    and the reasons against it. `widths` has the standard deviation of each parameter to consider after the fit and
    without data, the factor by which correlated errors discount the information, and the range of the fitted data.
    """
    # Half a second of imports, which a twin without a fit need not wait for.
    from estimators.fit.dual import shift

    names = ("estimator", "proposed", "penalised", "power", "skipped", "left_out", "folds", "stopped")
    verdict = fitted.verdict
    found = {name: getattr(fitted, name) for name in names} | {
        "verdict": {"gain": verdict.gain, "error": verdict.error, "reasons": verdict.reasons},
        "entries": [line._asdict() | {"sigma": shift(line)} for line in fitted.lines],
        "correlated": correlated(fitted),
    }
    if (widths := fitted.widths) is not None:
        stds = zip(widths.names, widths.std.tolist(), widths.prior.tolist(), strict=True)
        found["widths"] = {
            "parameters": {name: {"std": std, "prior": prior} for name, std, prior in stds},
            "inflation": widths.inflation,
            "envelope": {name: {"min": low, "max": high} for name, (low, high) in widths.envelope.items()},
        }
    for name, score in (("before", fitted.before), ("after", fitted.after)):
        found[name] = {"fitted": part_json(score.fitted), "held_out": part_json(score.held_out)}
    return dict(plain(found))


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
    names = ("log_density", "nis", "coverage", "log_likelihood")
    found = {name: getattr(part, name) for name in names} | {"readings": part.n}
    for group in ("sensors", "withheld", "states"):
        scores: Mapping[str, PredictionScore] = getattr(part, group)
        of = ("unit", "n", "rms", "coverage", "crps")
        found[group] = {key: {name: getattr(item, name) for name in of} for key, item in scores.items()}
    return dict(plain(found))
