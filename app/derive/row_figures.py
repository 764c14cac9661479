"""Figures of the innovations of each sensor row, with a verdict in one sentence."""

from __future__ import annotations

import math
from typing import SupportsFloat

import numpy as np

from estimators.diagnostics.calibration import (
    LIMITS,
    TIME,
    WHOLE,
    Calibration,
    CoverageBin,
    calibrations,
    coverage_bins,
    held_inputs,
    reading_words,
    standardised,
)
from estimators.diagnostics.innovations import (
    Autocorrelation,
    autocorrelation,
    histogram,
    memory,
    quantile_pairs,
    rank_histogram,
)
from estimators.diagnostics.intervals import Interval
from estimators.log import READING, Events
from estimators.model.state_space import StateSpaceModel
from estimators.numerics.quantiles import chi_square_quantile
from estimators.track import FAILED, GATED, HELD_OUT, SCREENED, USED, Track
from estimators.tuning import Tuning

from ..columns import rows_of
from ..result import JsonObject
from ..study.calibration_lines import worst_part

LAGS = 50

MIN_READINGS = 50  # measurements below which nothing is called consistent

SLOW, SLOW_SHARE = 25, 0.02
"""A slow error is the part of the innovations' variance that remains over so many lags, if it exceeds this share."""

MAX_ROWS = 24  # rows that are analysed, as many as have charts
COVERED = 4000  # measurements of a row whose coverage is divided: a question takes a tenth of a second


def rows_json(
    model: StateSpaceModel, events: Events, track: Track, tuning: Tuning, *, marginal: bool
) -> list[JsonObject]:
    """Return distribution, correlation and verdict of the whitened innovations of each row of the last events.

    For `autocorrelation` a rejected measurement is clipped to the gate, so that one spike does not hide the others.
    `marginal` tells whether `Track.whitened` holds each row by itself, as of particles and ensembles.
    """
    found = calibrations(model, events, track, gate=tuning.gate, marginal=marginal) if len(events) else []
    known = {item.subject: item for item in found}
    bins = coverage_bins(model, events, track, held_inputs(model, events), marginal=marginal, most=COVERED)
    units = model.units
    rows = dict(zip(model.row_names, () if tuning.baseline is None else tuning.baseline, strict=False))
    said = []
    for name, s, k in rows_of(model)[:MAX_ROWS]:
        own = (events.kind == READING) & (events.channel == s)
        judged = own & np.isin(track.verdict, (USED, GATED, HELD_OUT))
        e = standardised(track, k, marginal)[judged]
        edge = np.inf
        if tuning.gate is not None:
            edge = float(np.sqrt(chi_square_quantile(tuning.gate, len(model.sensors[s].rows))))
        clipped = np.clip(e, -edge, edge)
        correlated = autocorrelation(clipped, LAGS)
        shares, pairs, ranks = histogram(e), quantile_pairs(e), rank_histogram(e)
        n = int(np.isfinite(e).sum())
        times = events.t[judged]
        period = float(times[-1] - times[0]) * 1e-9 / (times.size - 1) if times.size > 1 else np.nan
        calibration = known.get(name)
        words, tone = verdict(name, calibration, correlated, n, period, rows.get(name))
        said.append(
            {
                "name": name,
                "sensor": model.sensor_names[s],
                "used": bool(tuning.used[s]),
                "n": n,
                "period": number(period),
                "mean": number(np.nanmean(e) if n else np.nan, 3),
                "std": number(np.nanstd(e) if n else np.nan, 3),
                "histogram": {"low": shares.low, "high": shares.high, "counts": shares.counts.tolist()},
                "autocorrelation": {"r": listed(correlated.r, 3), "bound": number(correlated.bound, 3)},
                "quantiles": listed(pairs, 4),
                "ranks": {"counts": ranks.counts.tolist(), "low": number(ranks.low), "high": number(ranks.high)},
                "refused": _share(track, own, (GATED, FAILED, SCREENED)),
                "coverage": _coverage([item for item in bins if item.subject == name and item.role != "truth"], units),
                **_figures(calibration),
                "verdict": words,
                "tone": tone,
            }
        )
    return said


def verdict(
    name: str,
    calibration: Calibration | None,
    correlated: Autocorrelation,
    n: int,
    period: float,
    normal: np.ndarray | None = None,
) -> tuple[str, str]:
    """Return a sentence about a row, and whether it is good, bad or unknown.

    The findings are those of calibration.py, None without readings; a correlation is given with its duration, of `n`
    readings every `period` seconds. A row of a commissioned twin is compared with its baseline, as its NIS is: with
    `normal`, its bias, scale and correlation then, first; None if it was not.
    """
    if calibration is None or not n:
        return f"{name}: no reading among the last rows", "unknown"
    too_few = f"{name}: too few measurements to judge ({n} of {MIN_READINGS})"
    then = ""
    if normal is not None and calibration.role == "used":
        changed = _since(calibration, normal)
        if not changed:
            if n < MIN_READINGS:
                return too_few, "unknown"
            then = "; ".join(word.removeprefix(f"{name}: ") for word in calibration.words)
            return f"{name}: as commissioned ({n:,} measurements){then and f' ({then})'}", "good"
        then, calibration = "not as commissioned: ", calibration._replace(words=changed)
    if calibration.words:
        parts = [word.removeprefix(f"{name}: ") for word in calibration.words]
        lag = memory(correlated.r)
        if calibration.correlation.value > 0.0 and any("correlated" in part for part in parts) and lag > 1:
            longer = "over " if lag == correlated.r.size else ""
            parts.append(f"what is missing lasts {longer}{lag * period:.3g} s")
        return f"{name}: {then}{'; '.join(parts)}", "bad"
    r = correlated.r[:SLOW]
    mean = float(np.mean(r)) if np.isfinite(r).all() else 0.0
    # Of a white series the mean of K correlations has a variance of 1 / (n K), nearly.
    if n >= MIN_READINGS and mean - 2.0 / np.sqrt(n * SLOW) > SLOW_SHARE:
        return f"{name}: innovations stay on one side for long, a slow error of about {np.sqrt(mean):.2f} σ", "bad"
    if n < MIN_READINGS:
        return too_few, "unknown"
    if calibration.role == "held out":
        return f"{name}: held out; agrees with the prediction of the other sensors ({n:,} measurements)", "good"
    return f"{name}: consistent ({n:,} measurements)", "good"


def _since(calibration: Calibration, normal: np.ndarray) -> tuple[str, ...]:
    """Return findings on the changes of a row since it was commissioned."""
    bias, scale, correlation = normal[:3].tolist()
    return reading_words(
        calibration.subject,
        Interval(*(value / np.hypot(bias, scale) for value in calibration.scale)),  # root mean square
        Interval(*((value - bias) / scale for value in calibration.bias)),
        Interval(*(value - correlation for value in calibration.correlation)),
        calibration.refused,
        LIMITS,
    )


def _share(track: Track, own: np.ndarray, verdicts: tuple[int, ...]) -> float | None:
    """Return the share of a sensor's measurements with one of these verdicts."""
    return number(np.mean(np.isin(track.verdict[own], verdicts)), 3) if own.any() else None


def _figures(calibration: Calibration | None) -> JsonObject:
    """Return the sizes of effects with their intervals: value, low, high."""
    figures: dict[str, Interval] = {} if calibration is None else {
        "scale": calibration.scale, "bias": calibration.bias, "correlation": calibration.correlation,
    }  # fmt: skip
    return {name: [number(value, 3) for value in interval] for name, interval in figures.items()}


def _coverage(bins: list[CoverageBin], units: dict[str, str]) -> JsonObject:
    """Return coverage with its interval by time, the lowest by operating point in words, and the adaptive interval's.

    `t` has the ends of each part, s. `adaptive` has the coverage of the adaptive conformal interval and its width
    relative to the band.
    """
    parts = [item for item in bins if item.by == TIME]
    whole = next((item for item in bins if item.by == WHOLE), None)
    return {
        "t": [[item.low, item.high] for item in parts],
        "share": [[number(value, 3) for value in item.coverage] for item in parts],
        "operating": worst_part([item for item in bins if item.by not in (TIME, WHOLE)], units),
        "adaptive": None if whole is None else [number(whole.adaptive, 3), number(whole.factor, 3)],
    }


def number(value: SupportsFloat, digits: int = 6) -> float | None:
    """Round to so many significant digits; None if it is not finite."""
    value = float(value)
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def listed(values: np.ndarray, digits: int = 6) -> list[object]:
    """Return an array as nested lists of rounded numbers."""
    return [listed(row, digits) if np.ndim(row) else number(row, digits) for row in values]
