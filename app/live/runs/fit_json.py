"""A fit as JSON: what was found of each entry, what it is worth, and what was decided."""

from __future__ import annotations

from typing import Any

import numpy as np

from estimators.fit.dual import shift
from estimators.fit.fit import Fitted, Line
from estimators.fit.judge import Part, Prediction

TOGETHER = 0.9
"""Correlation of two estimates from which on one takes the blame for the other."""


def fit_json(fitted: Fitted) -> dict[str, Any]:
    """All there is to know of a fit; null stands for what is not a number.

    `entries` have before and after, the 95 % interval, by how many deviations of the estimate they moved (`sigma`),
    whether the data tell them, and whether they were left alone; `correlated` names pairs of entries that the data
    hardly tell apart. `power` is that of the likelihood that was believed, `left_out` the readings of sensors that
    were stuck. `before` and `after` have scores of the part that was fitted and of that which was held out: log
    density of a reading, mean NIS a degree of freedom, coverage of the 95 % bands; `sensors` held out in turn, those
    `withheld`, which the twin never uses, and true `states`. `verdict` says whether the fit is proposed, by which
    gain in nats on the blocks held out, and what speaks against it.
    """
    return {
        "estimator": fitted.estimator,
        "proposed": fitted.proposed,
        "verdict": {
            "gain": _number(fitted.verdict.gain),
            "error": _number(fitted.verdict.error),
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
    """Pairs of entries of which one takes the blame for the other, the closest first."""
    found = [
        {"entries": [one.key, other.key], "correlation": float(fitted.correlation[i, j])}
        for i, one in enumerate(fitted.lines)
        for j, other in enumerate(fitted.lines[:i])
        if abs(fitted.correlation[i, j]) >= TOGETHER
    ]
    return sorted(found, key=lambda pair: -abs(pair["correlation"]))


def _line(line: Line) -> dict[str, Any]:
    fields = {**line._asdict(), "sigma": shift(line)}
    return {name: _number(value) if isinstance(value, float) else value for name, value in fields.items()}


def part_json(part: Part) -> dict[str, Any]:
    """What the readings of one part of the recordings say."""
    return {
        "readings": part.n,
        "log_density": _number(part.log_density),
        "nis": _number(part.nis),
        "coverage": _number(part.coverage),
        "sensors": {name: _prediction(item) for name, item in part.sensors.items()},
        "withheld": {name: _prediction(item) for name, item in part.withheld.items()},
        "states": {name: _prediction(item) for name, item in part.states.items()},
    }


def _prediction(item: Prediction) -> dict[str, Any]:
    return {
        "unit": item.unit,
        "n": item.n,
        "rms": _number(item.rms),
        "coverage": _number(item.coverage),
        "crps": _number(item.crps),
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
