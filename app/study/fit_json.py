"""Fits and verdicts on a NIS as JSON, for commands and the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from ..result import JsonObject, plain

if TYPE_CHECKING:
    from estimators.diagnostics.consistency import NisVerdict
    from estimators.fit.fit import Fitted
    from estimators.fit.judge import PartScore, PredictionScore

HIGH_CORRELATION = 0.9
"""Correlation from which on two estimates are hardly identifiable separately."""


def fit_json(fitted: Fitted) -> JsonObject:
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


def correlated(fitted: Fitted) -> list[JsonObject]:
    """Return pairs of entries that are hardly identifiable separately, the most correlated first."""
    found = [
        {"entries": [one.key, other.key], "correlation": float(fitted.correlation[i, j])}
        for i, one in enumerate(fitted.lines)
        for j, other in enumerate(fitted.lines[:i])
        if abs(fitted.correlation[i, j]) >= HIGH_CORRELATION
    ]
    return sorted(found, key=lambda pair: -abs(pair["correlation"]))


def part_json(part: PartScore) -> JsonObject:
    """Return the scores of one part of the recordings."""
    names = ("log_density", "nis", "coverage", "log_likelihood")
    found = {name: getattr(part, name) for name in names} | {"readings": part.n}
    for group in ("sensors", "withheld", "states"):
        scores: Mapping[str, PredictionScore] = getattr(part, group)
        of = ("unit", "n", "rms", "coverage", "crps")
        found[group] = {key: {name: getattr(item, name) for name in of} for key, item in scores.items()}
    return dict(plain(found))


def nis_json(found: NisVerdict) -> JsonObject:
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
