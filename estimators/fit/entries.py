"""Entries of a tuning that can be fitted, as one vector on scales where a step means the same everywhere.

Variances and positive parameters are fitted by their logarithm, entries that may change their sign by their value. Each
has a weak prior about the twin's value (`deviation`, on that scale) and a range, so that no entry runs away without
information in the data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..errors import ConfigError, nearest, shown_name
from ..estimator import Estimator
from ..log import READING, Log
from ..model.coloured import disturbance_time, error_time
from ..model.state_space import LARGE, Field
from ..registry import find_estimator
from ..tuning import Tuning

OVER = "over"  # Group of the correlation times of coloured noise: the parameters that `coloured` appends
GROUPS = ("Q", "R", "p", "options", "prior", OVER)  # Groups of entries


SCALE = "scale"
"""Q and R together by one factor. It does not change the estimates of a linear filter in steady state, only its bands;
at its maximum likelihood the mean NIS is as expected."""

DECADE = float(np.log(10.0))


SPREAD = {
    SCALE: 2.0 * DECADE,
    "Q": 2.0 * DECADE,
    "R": 2.0 * DECADE,
    "p": 0.5 * DECADE,
    "options": DECADE,
    "prior": DECADE,
}
"""Deviation of the weak prior, in logarithms: two decades of a variance is one of a standard deviation."""


DIGITS, PLAIN_DIGITS = 4, 6
"""Significant digits of a value: finer than any interval, and to compare a plain maximum with that of others."""

MAX_FACTOR = 1e4  # Largest factor between a value and that of the twin where nothing else bounds it


@dataclass(frozen=True)
class TuningEntry:
    """One entry: its key, its value in the twin, its range, and the deviation of its weak prior.

    `start`, `low` and `high` are in `unit`; `deviation` is on the scale of the fit, the logarithm where `log` is true.
    """

    key: str
    unit: str
    start: float
    low: float
    high: float
    log: bool
    deviation: float

    def inward(self, value: float) -> float:
        """Return a value on the scale of the fit."""
        if self.log:
            return float(np.log(value)) if value > 0.0 else -np.inf
        return value

    def outward(self, x: float) -> float:
        """Return the value at a point of the scale, within its range."""
        return float(np.clip(np.exp(x) if self.log else x, self.low, self.high))

    def written(self, x: float, digits: int = DIGITS) -> float:
        """Return the value at a point, rounded to so many significant digits."""
        return float(np.clip(float(f"{self.outward(x):.{digits}g}"), self.low, self.high))

    @property
    def group(self) -> str:
        """First word of its key."""
        return self.key.partition(".")[0]


class Skipped(NamedTuple):
    """An entry that was requested and cannot be fitted, and the reason."""

    key: str
    reason: str


class Setting(NamedTuple):
    """A tuning, and a prior (mean, covariance); None for the model's own."""

    tuning: Tuning
    prior: tuple[np.ndarray, np.ndarray] | None


def entries_of(
    estimator: str,
    tuning: Tuning,
    logs: Sequence[Log],
    wanted: Sequence[str] = ("Q", "R"),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    *,
    references: bool = False,
) -> tuple[list[TuningEntry], list[Skipped]]:
    """Return the entries for some keys and groups, and those that cannot be fitted.

    Args:
        estimator: The filter that `options` belongs to.
        tuning: Their start.
        logs: Logs to fit to: a sensor without measurements has no R to fit.
        wanted: Keys of `Tuning.set`, `options.NAME`, `prior.STATE.mean`, `prior.STATE.std`, `SCALE`, and `GROUPS`.
        bounds: Range by key, in the entry's unit, for example of a data sheet.
        references: Whether the aim uses held-out sensors, so that their R can be fitted too.

    Raises:
        ConfigError: If there is no such entry, or it is no number.
    """
    entry = find_estimator(estimator, tuning.model)
    known = _all(entry, tuning)
    found: dict[str, TuningEntry] = {}
    skipped: dict[str, Skipped] = {}
    for name in wanted:
        keys = [name]
        if name == OVER:
            model = tuning.model
            times = {disturbance_time(noise.name) for noise in model.noises} | set(map(error_time, model.sensor_names))
            keys = [key for key in known if key.startswith("p.") and key.partition(".")[2] in times]
        elif name in GROUPS:
            keys = [key for key, item in known.items() if item.group == name]
        if not keys:
            skipped[name] = Skipped(name, "there is no such entry")
        for key in keys:
            item = _find(key, known, tuning)
            if bounds and key in bounds:
                low, high = max(item.low, bounds[key][0]), min(item.high, bounds[key][1])
                if not low <= item.start <= high:
                    value = f"{item.start:g} {item.unit}".strip()
                    raise ConfigError(f"{key} is {value}; it must lie between its bounds, {low:g} and {high:g}")
                item = replace(item, low=low, high=high)
            reason = _against(item, tuning, logs, references)
            if reason:
                skipped[key] = Skipped(key, reason)
            else:
                found[key] = item
    if not found:
        reasons = "; ".join(f"{item.key} {item.reason}" for item in skipped.values() if item.key not in GROUPS)
        raise ConfigError(f"nothing of {', '.join(wanted)} can be fitted: {reasons or 'there is no such entry'}")
    return list(found.values()), list(skipped.values())


def check_key(estimator: str, tuning: Tuning, key: str) -> None:
    """Refuse a key that no fit could change, before there is anything to fit to.

    Raises:
        ConfigError: If it is no group, and there is no such entry.
    """
    if key not in GROUPS:
        _find(key, _all(find_estimator(estimator, tuning.model), tuning), tuning)


def with_values(tuning: Tuning, entries: Sequence[TuningEntry], values: Sequence[float]) -> Setting:
    """Return the tuning, and the prior where it is fitted, with values of the entries in their units."""
    mean: np.ndarray | None = None
    options, factor = dict(tuning.options), 1.0
    for item, number in zip(entries, values, strict=True):
        if item.group == "options":
            options[item.key.partition(".")[2]] = number
        elif item.key == SCALE:
            factor = number
        elif item.group == "prior":
            if mean is None:
                mean, std = tuning.model.prior_mean.copy(), tuning.model.prior_std.copy()
            _, state, what = item.key.split(".")
            (mean if what == "mean" else std)[tuning.model.state_names.index(state)] = number
        elif item.group == "R" and item.key.partition(".")[2] not in tuning.model.row_names:
            r = tuning.r.copy()
            r[tuning.rows_of(item.key)] *= number / item.start
            tuning = replace(tuning, r=r)
        else:
            tuning = tuning.set(item.key, number)
    if factor != 1.0:
        tuning = replace(tuning, q=factor * tuning.q, r=factor * tuning.r)
    if options != dict(tuning.options):
        tuning = tuning.with_options(options)
    if mean is None:
        return Setting(tuning, None)
    own = tuning.model.prior_std
    scale = np.divide(std, own, out=np.ones_like(std), where=own > 0.0)
    return Setting(tuning, (mean, tuning.model.prior_cov * np.outer(scale, scale)))


def _all(entry: Estimator, tuning: Tuning) -> dict[str, TuningEntry]:
    model = tuning.model
    found = [_entry(item.key, item.unit, item.value, item.low, item.high) for item in tuning.items()]
    chosen = entry.complete(tuning.options)
    for option in entry.options:
        # A choice or a count has no nearby value.
        if not option.choices and not option.whole:
            found.append(_entry(f"options.{option.name}", option.unit, chosen[option.name], option.low, option.high))
    if not isinstance(model.states, Field) and model.nx <= LARGE:
        for state in model.states:
            value, deviation = float(state.mean), float(state.std)
            if deviation > 0.0:
                found.append(
                    TuningEntry(f"prior.{state.name}.mean", state.unit, value, -np.inf, np.inf, False, deviation)
                )
                found.append(_entry(f"prior.{state.name}.std", state.unit, deviation, 0.0, np.inf))
    found.append(_entry(SCALE, "", 1.0, 0.0, np.inf))
    return {item.key: item for item in found}


def _entry(key: str, unit: str, value: float, low: float, high: float) -> TuningEntry:
    if low >= 0.0 and value > 0.0:
        spread = SPREAD[key.partition(".")[0]]
        return TuningEntry(key, unit, value, max(low, value / MAX_FACTOR), min(high, value * MAX_FACTOR), True, spread)
    width = abs(value) or (high - low if np.isfinite(high - low) else 1.0)
    return TuningEntry(key, unit, value, low, high, False, width)


def _find(key: str, known: Mapping[str, TuningEntry], tuning: Tuning) -> TuningEntry:
    """Return an entry by its key; R of a sensor scales all its rows and keeps their proportions."""
    if key in known:
        return known[key]
    model = tuning.model
    group, _, name = key.partition(".")
    if group != "R" or name not in model.sensor_names:
        own = [item for item in known if item.startswith(f"{group}.")] if name else []
        none = f"{model.name} has none of {group}; " if name and group in GROUPS and not own else ""
        remedy = none + nearest(key, own or [*known, *GROUPS])
        raise ConfigError(f"{shown_name(key)} is no entry that can be fitted; {remedy}")
    unit = model.sensors[model.sensor_names.index(name)].rows[0].unit
    return _entry(key, f"({unit})²" if unit else "", float(tuning.get(key) or 0.0), 0.0, np.inf)


def _against(item: TuningEntry, tuning: Tuning, logs: Sequence[Log], references: bool) -> str:
    """Return why an entry cannot be fitted; empty if it can."""
    if item.low >= item.high:
        return "has no room in its range"
    if item.group in ("Q", "R") and item.start == 0.0:
        return "is 0, and stays so: there is nothing to scale"
    if item.group != "R":
        return ""
    own = np.unique(np.searchsorted(tuning.model.row_start, tuning.rows_of(item.key), side="right") - 1)
    if not tuning.used[own].any() and not references:
        return "belongs to a held-out sensor"
    values = [log.events.value[(log.events.kind == READING) & np.isin(log.events.channel, own)] for log in logs]
    if not any(len(item) for item in values):
        return "belongs to a sensor without readings here"
    if all(np.all((item == item[:1]) | np.isnan(item)) for item in values):
        return "belongs to a sensor whose readings never change here: a stuck sensor shows no noise"
    return ""
