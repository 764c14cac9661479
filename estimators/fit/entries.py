"""Entries of a tuning that can be fitted, as one vector: each on the scale on which a step means the same everywhere.

A variance or a positive parameter goes by its logarithm, what may change its sign by its own value. Each is held by
weakly believing what the twin says (`deviation`, on that scale) and by its range, so that nothing runs away where the
data say nothing.
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

OVER = "over"
"""How long the errors last that are given a time: the parameters that `coloured` appends."""

GROUPS = ("Q", "R", "p", "options", "prior", OVER)
"""What can be named as a whole."""

SCALE = "scale"
"""Q and R together by one factor. It moves no estimate of a linear filter that has settled, only its bands; where it is
the most likely, the mean NIS is what it should be."""

DECADE = float(np.log(10.0))

SPREAD = {
    SCALE: 2.0 * DECADE,
    "Q": 2.0 * DECADE,
    "R": 2.0 * DECADE,
    "p": 0.5 * DECADE,
    "options": DECADE,
    "prior": DECADE,
}
"""Deviation of the weak belief in what the twin says, in logarithms: two decades of a variance is one of a std."""

DIGITS = 4
"""Of a value that is proposed: finer than any interval."""

FURTHEST = 1e4
"""Factor by which a value may leave that of the twin where nothing else bounds it."""


@dataclass(frozen=True)
class Entry:
    """One entry: its key, its value in the twin, its range, and how weakly that value is believed.

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
        """A value on the scale of the fit."""
        return float(np.log(value)) if self.log else value

    def outward(self, x: float) -> float:
        """The value that a point of the scale stands for, never out of its range by rounding."""
        return float(np.clip(np.exp(x) if self.log else x, self.low, self.high))

    def written(self, x: float) -> float:
        """The value at a point, with as many digits as a file should have."""
        return float(np.clip(float(f"{self.outward(x):.{DIGITS}g}"), self.low, self.high))

    @property
    def group(self) -> str:
        """The first word of its key."""
        return self.key.partition(".")[0]


class Skipped(NamedTuple):
    """An entry that was asked for and cannot be fitted, and why."""

    key: str
    reason: str


class Setting(NamedTuple):
    """What a fold is given beside its log; `prior` is None for the model's own."""

    tuning: Tuning
    prior: tuple[np.ndarray, np.ndarray] | None


def entries_of(
    estimator: str,
    tuning: Tuning,
    logs: Sequence[Log],
    wanted: Sequence[str] = ("Q", "R"),
    bounds: Mapping[str, tuple[float, float]] | None = None,
    *,
    witnesses: bool = False,
) -> tuple[list[Entry], list[Skipped]]:
    """The entries that some keys and groups mean.

    Args:
        estimator: Whose options `options` means.
        tuning: Where they start.
        logs: What they are fitted to: a sensor that never speaks has no R to fit.
        wanted: Keys as `Tuning.set` has them, `options.NAME`, `prior.STATE.mean`, `prior.STATE.std`, `SCALE`, and
            `GROUPS`.
        bounds: Least and greatest value by key, in the entry's unit: a data sheet's.
        witnesses: Whether the fit aims at sensors held out too, so that it tells of their R.

    Raises:
        ConfigError: If there is no such entry, or it is no number.
    """
    entry = find_estimator(estimator, tuning.model)
    known = _all(entry, tuning)
    found: dict[str, Entry] = {}
    skipped: dict[str, Skipped] = {}
    for name in wanted:
        keys = _group(name, known, tuning) if name in GROUPS else [name]
        if not keys:
            skipped[name] = Skipped(name, "there is no such entry")
        for key in keys:
            item = known.get(key) or _sensor_of(key, tuning)
            if item is None:
                raise ConfigError(
                    f"{shown_name(key)} is no entry that can be fitted; {nearest(key, [*known, *GROUPS])}"
                )
            item = _bounded(item, (bounds or {}).get(key))
            reason = _against(item, tuning, logs, witnesses)
            if reason:
                skipped[key] = Skipped(key, reason)
            else:
                found[key] = item
    if not found:
        reasons = "; ".join(f"{item.key} {item.reason}" for item in skipped.values() if item.key not in GROUPS)
        raise ConfigError(f"nothing of {', '.join(wanted)} can be fitted: {reasons or 'there is no such entry'}")
    return list(found.values()), list(skipped.values())


def check_key(estimator: str, tuning: Tuning, key: str) -> None:
    """Refuse what no fit could turn, before there is anything to fit to.

    Raises:
        ConfigError: If it is no group, and there is no such entry.
    """
    known = _all(find_estimator(estimator, tuning.model), tuning)
    if key not in GROUPS and key not in known and _sensor_of(key, tuning) is None:
        raise ConfigError(f"{shown_name(key)} is no entry that can be fitted; {nearest(key, [*known, *GROUPS])}")


def _group(name: str, known: Mapping[str, Entry], tuning: Tuning) -> list[str]:
    if name != OVER:
        return [key for key in known if key.partition(".")[0] == name]
    model = tuning.model
    times = {disturbance_time(noise.name) for noise in model.noises} | {error_time(name) for name in model.sensor_names}
    return [key for key in known if key.partition(".")[2] in times and key.startswith("p.")]


def setting(tuning: Tuning, entries: Sequence[Entry], x: np.ndarray) -> Setting:
    """The tuning, and the prior where that is fitted, at a point (k,) of the fit's scales."""
    return with_values(tuning, entries, [item.outward(float(value)) for item, value in zip(entries, x, strict=True)])


def with_values(tuning: Tuning, entries: Sequence[Entry], values: Sequence[float]) -> Setting:
    """The same with values of the entries, in their units."""
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
            tuning = _scaled(tuning, item, number)
        else:
            tuning = tuning.set(item.key, number)
    if factor != 1.0:
        tuning = replace(tuning, q=factor * tuning.q, r=factor * tuning.r)
    if options != dict(tuning.options):
        tuning = tuning.with_options(options)
    return Setting(tuning, None if mean is None else (mean, np.diag(std**2)))


def _all(entry: Estimator, tuning: Tuning) -> dict[str, Entry]:
    model = tuning.model
    found = []
    for item in tuning.items():
        group = item.key.partition(".")[0]
        found.append(_entry(item.key, item.unit, item.value, item.low, item.high, SPREAD[group]))
    chosen = entry.complete(tuning.options)
    for option in entry.options:
        # Of a choice or a count there is no nearby value.
        if not option.choices and not option.whole:
            key = f"options.{option.name}"
            found.append(_entry(key, option.unit, chosen[option.name], option.low, option.high, SPREAD["options"]))
    if not isinstance(model.states, Field) and model.nx <= LARGE:
        for state in model.states:
            value, deviation = float(state.mean), float(state.std)
            if deviation > 0.0:
                found.append(Entry(f"prior.{state.name}.mean", state.unit, value, -np.inf, np.inf, False, deviation))
                found.append(_entry(f"prior.{state.name}.std", state.unit, deviation, 0.0, np.inf, SPREAD["prior"]))
    found.append(_entry(SCALE, "", 1.0, 0.0, np.inf, SPREAD[SCALE]))
    return {item.key: item for item in found}


def _entry(key: str, unit: str, value: float, low: float, high: float, spread: float) -> Entry:
    if low >= 0.0 and value > 0.0:
        return Entry(key, unit, value, max(low, value / FURTHEST), min(high, value * FURTHEST), True, spread)
    width = abs(value) or (high - low if np.isfinite(high - low) else 1.0)
    return Entry(key, unit, value, low, high, False, width)


def _sensor_of(key: str, tuning: Tuning) -> Entry | None:
    """R of all rows of a sensor together: they keep their proportions."""
    group, _, name = key.partition(".")
    if group != "R" or name not in tuning.model.sensor_names:
        return None
    unit = tuning.model.sensors[tuning.model.sensor_names.index(name)].rows[0].unit
    return _entry(key, f"({unit})²" if unit else "", float(tuning.get(key) or 0.0), 0.0, np.inf, SPREAD["R"])


def _bounded(item: Entry, bounds: tuple[float, float] | None) -> Entry:
    if bounds is None:
        return item
    low, high = max(item.low, bounds[0]), min(item.high, bounds[1])
    if not low <= item.start <= high:
        raise ConfigError(
            f"{item.key} is {item.start:g} {item.unit}; it must lie between its bounds, {low:g} and {high:g}".replace(
                " ;", ";"
            )
        )
    return replace(item, low=low, high=high)


def _against(item: Entry, tuning: Tuning, logs: Sequence[Log], witnesses: bool) -> str:
    """Why an entry cannot be fitted; nothing if it can."""
    if item.low >= item.high:
        return "has no room in its range"
    if item.group in ("Q", "R") and item.start == 0.0:
        return "is 0, and stays so: there is nothing to scale"
    if item.group != "R":
        return ""
    model, name = tuning.model, item.key.partition(".")[2]
    if name in model.sensor_names:
        s = model.sensor_names.index(name)
    else:
        s = int(np.searchsorted(model.row_start, list(model.row_names).index(name), side="right")) - 1
    if not tuning.used[s] and not witnesses:
        return "is of a sensor that is held out"
    if not any(np.any((log.kind[: log.n] == READING) & (log.channel[: log.n] == s)) for log in logs):
        return "is of a sensor that says nothing here"
    if all(_constant(log, s) for log in logs):
        return "is of a sensor that says the same all the time here: one that is stuck tells no noise"
    return ""


def _scaled(tuning: Tuning, item: Entry, number: float) -> Tuning:
    model = tuning.model
    s = model.sensor_names.index(item.key.partition(".")[2])
    r = tuning.r.copy()
    r[model.row_start[s] : model.row_start[s] + len(model.sensors[s].rows)] *= number / item.start
    return replace(tuning, r=r)


def _constant(log: Log, sensor: int) -> bool:
    """Whether no row of a sensor ever changes."""
    said = log.value[: log.n][(log.kind[: log.n] == READING) & (log.channel[: log.n] == sensor)]
    return bool(np.all((said == said[:1]) | np.isnan(said)))
