"""Which signals of a recording become states, sensors and inputs of a draft, and how each state moves."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.intervals import Interval
from estimators.diagnostics.repeats import LINEAR
from estimators.errors import LARGEST, ConfigError, nearest
from sources.inspect import RecordingContents
from sources.units import unit_scale

from ...format_time import duration_text
from .relations import Driven, Pair, driven, pairs, simulated
from .signals import MIN_VALUES, Signal, cycle_of, noise_of, signals, thinned, walk_of

MAX_SIGNALS = 6  # signals that are taken where none are named


@dataclass(frozen=True)
class Roles:
    """Roles that a user gives to signals, each a name or glob: SIGNAL, MESSAGE.SIGNAL or a column.

    `sensors` measure states; `inputs` drive them and have none; `held_out` are sensors that are predicted and scored,
    never used. `signals` may become sensors or inputs, as the draft finds. Without sensors and signals the draft takes
    those that vary most finely. `states` are sensors with a state of their own, also where another measures the same.
    """

    sensors: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    signals: tuple[str, ...] = ()
    states: tuple[str, ...] = ()


OMISSIONS = {
    "switch": "a switch: few different values",
    "counter": "time, counter or status",
    "constant": "constant",
    "huge": f"values beyond {LARGEST:g}",
    "short": f"fewer than {MIN_VALUES} values",
}
"""Reasons by kind of signal for which it is omitted."""

STATE, SENSOR, INPUT, HELD_OUT, OMITTED = "state", "sensor", "input", "held out", "omitted"


class SignalRole(NamedTuple):
    """Role of a signal in a draft, its name there (empty if omitted), and the reason in words."""

    signal: Signal
    role: str
    name: str
    reason: str


@dataclass(frozen=True)
class Reads:
    """A sensor, `name` in the draft: offset + gain · state, or of its rate, with noise of variance `r`.

    `error` is the variance and the correlation time, s, of a coloured error beside the white noise.
    """

    name: str
    signal: Signal
    r: float
    gain: float = 1.0
    offset: float = 0.0
    rate: bool = False
    error: tuple[float, float] | None = None


@dataclass(frozen=True)
class Moves:
    """One state, how it moves, and the sensors that read it, its own first.

    `smooth`: with a speed of its own, which is a second state. With `lag` it follows inputs, whose names are `inputs`,
    and the speed is the part that they do not explain.
    `q` is the variance that the noise adds in one second, to the speed if there is one; `over` is its correlation time,
    s, None for white noise. `cycle` is the period, s, and the amplitude of a cycle that the draft does not have.
    """

    name: str
    signal: Signal
    smooth: bool
    q: float
    sensors: tuple[Reads, ...]
    lag: Driven | None = None
    inputs: tuple[str, ...] = ()
    over: float | None = None
    cycle: tuple[float, float] | None = None

    @property
    def second(self) -> str:
        """Name of its second state."""
        return f"{self.name}_{'rate' if self.lag is None else 'drift'}"


MIN_COVERAGE, MAX_COVERAGE = 0.90, 0.98  # of the 95 % band of a consistent draft
YAML_NAME = "NAME.yaml"  # stands for the file of the draft in the reason of a check


class SensorCheck(NamedTuple):
    """Predictions of one sensor on the second half of the recording.

    `coverage` is the share of the n measurements in the 95 % band of their prediction, `correlation` that of successive
    innovations. `held_out` is the coverage of its predictions from all other sensors alone, NaN if none measures the
    same state.
    """

    name: str
    n: int
    coverage: Interval
    correlation: Interval
    held_out: Interval


class DraftCheck(NamedTuple):
    """Check of a draft on data that took no part in the fit: from `start` to `end`, s after the first measurement.

    Of more than two `parts` every other one was fitted and the others checked; `start` is where the first one ends.
    `nis` is the mean NIS per degree of freedom, with the bounds `low` and `high` of `nisus fold`. `reason` says why it
    is not consistent; empty if it is. `said` is the NIS and its position in words. `wide`: the only reason is that
    bands are wider than needed. `refitted`: a short recording is then fitted as a whole. Of a long one some `windows`
    are checked.
    """

    start: float
    end: float
    nis: float
    low: float
    high: float
    sensors: tuple[SensorCheck, ...]
    reason: str
    said: str
    parts: int = 2
    wide: bool = False
    refitted: bool = False
    windows: int = 1

    @property
    def fitted_to(self) -> str:
        """The fitted and the checked parts in words."""
        thinned = f" (in {self.windows} windows over the recording)" if self.windows > 1 else ""
        return f"{self._fitted_to}{thinned}{', and fitted again to all of it' if self.refitted else ''}"

    @property
    def _fitted_to(self) -> str:
        if self.parts > 2:
            length = duration_text(self.end / self.parts)
            parts = f"every other of {self.parts} parts (about {length} each)"
            return f"The halves of the recording differ. Fitted to {parts}, checked on the others"
        first, other = duration_text(self.start), duration_text(self.end - self.start)
        return f"Fitted to the first {first}, checked on the other {other}"

    @property
    def words(self) -> str:
        """The verdict in one line."""
        if not self.reason:
            fit = "" if self.low <= self.nis <= self.high else " within the error of a fit to one half"
            return f"consistent{fit}: {self.said}"
        return f"{'conservative' if self.wide else 'not consistent'}: {self.said}; {self.reason}"


@dataclass(frozen=True)
class DraftPlan:
    """A draft: its states, the inputs by their names, the pairs that were found among the signals, and these.

    `roles` has every signal of the recording, omitted ones too. `options` are those of the filter, and `check` is how
    well it predicts the second half of the recording, once its noises were fitted to the first (draft_fit.py).
    """

    states: tuple[Moves, ...]
    inputs: tuple[tuple[str, Signal], ...]
    signals: tuple[Signal, ...]
    pairs: tuple[Pair, ...]
    roles: tuple[SignalRole, ...] = ()
    held_out: frozenset[str] = frozenset()
    options: Mapping[str, str | float] = field(default_factory=dict)
    check: DraftCheck | None = None

    @property
    def sensors(self) -> list[Reads]:
        """Sensors of all states."""
        return [reads for item in self.states for reads in item.sensors]


def plan(found: RecordingContents, roles: Roles) -> DraftPlan:
    """Return a draft in which every signal has the role that it was given, or one that the data suggest.

    Raises:
        ConfigError: If a signal is not there, is named by several messages, has two roles, or has too few values.
    """
    every = signals(found)
    for part in found.parts or (found,):
        if part.kind == "can_log" and not any(message.signals for message in part.messages):
            remedy = "give one that describes it with --dbc" + (", or leave the log out" if found.parts else "")
            raise ConfigError(f"{part.files[0]}: no message of it is in a DBC; {remedy}")
        if part.kind == "table" and not any(one.values.size for one in part.columns):
            texts = f" (text in {', '.join(part.texts)})" if part.texts else ""
            texts += "".join(f"; {fault}" for fault in part.faults)
            raise ConfigError(f"{part.files[0]}: no column beside {part.time.name} has numbers{texts}")
        if part.t.size > 1 and part.t[0] == part.t[-1]:
            column = f"if {part.time.name} is not the time, name it with --time; otherwise " * (part.kind == "table")
            raise ConfigError(f"{part.files[0]}: its {part.t.size:,} times are all the same; {column}record it again")
    given = _given(roles, found, every)
    named = {id(one) for one, _ in given}
    thin: dict[int, Signal] = {}
    free = (
        []
        if roles.sensors or roles.signals or roles.states
        else _finest(found, [one for one in every if id(one) not in named], thin)
    )
    # Of several sensors of one quantity the first is the state, so held-out signals come last.
    order = {STATE: 0, HELD_OUT: 2}
    places = sorted([*given, *((one, "") for one in free)], key=lambda entry: order.get(entry[1], 1))
    picked = [one for one, _ in places]
    inputs = {k for k, (_, role) in enumerate(places) if role == INPUT}
    own = {k for k, (_, role) in enumerate(places) if role == STATE}
    sensors = {k for k, (_, role) in enumerate(places) if role in (STATE, SENSOR, HELD_OUT)}
    if free:
        more = [one for one in every if id(one) not in named and not any(one is other for other in picked)]
        picked += _same_quantity(more, [one for k, one in enumerate(picked) if k not in inputs])
    raw, few = picked, [one if k in inputs else thin.get(id(one)) or thinned(one) for k, one in enumerate(picked)]
    for one, (_, role) in zip(few, places, strict=False):
        if interpolated(one) and role != INPUT:
            raise ConfigError(
                f"{one.name}: {one.repeats.reason}; a sensor needs the values themselves: record them without "
                "interpolation, or give the signal as an input with --inputs"
            )
    told = pairs(picked)
    told += _chained(told, picked)
    taken: set[str] = set()
    names = [_identifier(one, taken) for one in picked]
    # Of sensors of one quantity the first one is the state.
    leads = {k: k for k in range(len(picked)) if k not in inputs}
    one_state = [pair for pair in told if (pair.one and _comparable(pair, picked)) or redundant(pair, picked)]
    for pair in one_state:
        first, second = pair.first, pair.second
        alone = second not in own and list(leads.values()).count(second) == 1
        if alone and leads.get(first) == first and leads.get(second) == second:
            leads[second] = first
    groups = {k: [other for other in leads if leads[other] == k and other != k] for k in leads if leads[k] == k}
    heads = [k for k in groups if not any(pair.first == k and pair.rate for pair in told)]
    # What one source of a table measures does not drive what another one does.
    free_heads = [k for k in heads if k not in sensors and not groups[k] and picked[k].series.only is None]
    lags = _lags(picked, heads, sorted(inputs) or free_heads)
    used = sorted({k for lag in lags.values() for k in lag.drivers} | inputs)
    # A driver holds between its rows, and what follows it is seen best in all of them.
    picked = [one if k in used else few[k] for k, one in enumerate(picked)]
    states = []
    for k in groups:
        if k not in used:
            others = [pair for pair in one_state if pair.first == k and pair.second in groups[k]]
            states.append(_moves(k, picked, names, others, lags.get(k)))
    held_out = frozenset(names[k] for k, (_, role) in enumerate(places) if role == HELD_OUT)
    for item in states:
        if item.lag is None and all(reads.name in held_out for reads in item.sensors):
            raise ConfigError(
                f"--hold-out {item.signal.name}: nothing predicts it, as no sensor in use measures the same "
                f"quantity and no input drives it; hold out a redundant sensor, or give its inputs with --inputs"
            )
    rest = "has no role" if not free else f"not among the {MAX_SIGNALS} signals with most different values"
    known = {id(one): found for one, found in zip(raw, picked, strict=True)}
    computed = {key: one.repeats.reason for key, one in thin.items() if interpolated(one)}
    found_roles = [
        _role(one, known.get(id(one)), picked, names, states, used, held_out, computed.get(id(one), rest))
        for one in every
    ]
    driving = tuple((names[k], picked[k]) for k in used)
    return DraftPlan(tuple(states), driving, tuple(picked), tuple(told), tuple(found_roles), held_out)


REDUNDANT_GAIN = 0.05  # by how much the scales of two sensors of one quantity may differ
REDUNDANT_EXPLAINED = 0.995  # share of the variance that the one explains of the other
CONVERTED_EXPLAINED = 0.98  # the same where their known units differ, and the scale is that of the units

SCALES = tuple(
    factor**sign for factor in (1.0, 3.6, 2.236936, 9.549297, 57.29578, 60.0, 100.0, 1000.0) for sign in (1.0, -1.0)
)
"""Usual ratios of two units of one quantity: km/h and mph in m/s, rpm in rad/s, degrees, minutes, per cent, kilo."""


def unit_ratio(one: Signal, other: Signal, gain: float) -> float | None:
    """Return the factor from the unit of one signal to that of another; None if they measure different things.

    Of signals without known units it is the usual ratio of units next to the gain, if their names share a word.
    """
    if one.series.unit and other.series.unit:
        same = one.series.unit == other.series.unit
        return 1.0 if same else unit_scale(one.series.unit, other.series.unit)
    if not one.series.unit and not other.series.unit and abs(gain - 1.0) <= REDUNDANT_GAIN:
        return 1.0
    spaced = [re.sub(r"([a-z])([A-Z])", r"\1 \2", signal.name).lower() for signal in (one, other)]
    words = [set(re.findall(r"[a-z]{4,}", text)) for text in spaced]
    near = min(SCALES, key=lambda scale: abs(np.log(max(abs(gain), 1e-300) / scale)))
    return near if words[0] & words[1] else None


def redundant(pair: Pair, picked: Sequence[Signal]) -> bool:
    """Return whether two signals are the same quantity up to its unit and a small bias, scale and noise.

    The noise may be coloured. The speeds of two wheels are such: in a curve they differ for seconds.
    """
    ratio = unit_ratio(picked[pair.first], picked[pair.second], pair.gain)
    alike = ratio is not None and abs(pair.gain / ratio - 1.0) <= REDUNDANT_GAIN
    interval = max(1.0 / picked[k].rate for k in (pair.first, pair.second))
    units = {picked[k].series.unit for k in (pair.first, pair.second)}
    least = CONVERTED_EXPLAINED if len(units) > 1 and "" not in units else REDUNDANT_EXPLAINED
    return alike and pair.explained >= least and not pair.rate and abs(pair.lag) <= 1.5 * interval


def _comparable(pair: Pair, picked: Sequence[Signal]) -> bool:
    """Return whether two signals may be one quantity by their units, where both are known."""
    units = [picked[k].series.unit for k in (pair.first, pair.second)]
    return pair.rate or not all(units) or units[0] == units[1] or unit_scale(*units) is not None


def _same_quantity(others: Sequence[Signal], picked: Sequence[Signal]) -> list[Signal]:
    """Return the signals that measure the quantity of a picked one in another unit."""
    found = []
    for one in others:
        for lead in picked if one.kind == "signal" else ():
            if one.series.unit != lead.series.unit and unit_scale(lead.series.unit, one.series.unit) is not None:
                if any(redundant(pair, (lead, one)) for pair in pairs((lead, one))):
                    found.append(one)
                    break
    return found


def _chained(told: Sequence[Pair], picked: Sequence[Signal]) -> list[Pair]:
    """Return that a signal measures the rate of a state, of those that measure the same as one that does."""
    found = []
    for rate in (pair for pair in told if pair.rate):
        for pair in told:
            known = any({one.first, one.second} == {rate.first, pair.second} for one in told)
            if pair.first == rate.second and not pair.rate and not known and redundant(pair, picked):
                gain = rate.gain / pair.gain
                offset = rate.offset - gain * pair.offset
                found.append(rate._replace(second=pair.second, gain=gain, offset=offset))
    return found


def interpolated(one: Signal) -> bool:
    """Return whether most rows of a signal lie on lines between values that come at a known period."""
    return one.repeats.kind == LINEAR and bool(np.isfinite(one.repeats.period))


def _role(
    one: Signal,
    used_as: Signal | None,
    picked: Sequence[Signal],
    names: Sequence[str],
    states: Sequence[Moves],
    used: Sequence[int],
    held_out: frozenset[str],
    rest: str,
) -> SignalRole:
    """Return the role of a signal, and why it has it; `rest` is why signals that vary were not picked.

    `used_as` is the signal among `picked` that the plan uses for it; None without one.
    """
    k = next((k for k, other in enumerate(picked) if other is used_as), None)
    if k is None:
        return SignalRole(one, OMITTED, "", OMISSIONS.get(one.kind, rest))
    name = names[k]
    if k in used:
        driven_by = [item.name for item in states if name in item.inputs]
        reason = f"drives {', '.join(driven_by)}" if driven_by else "given as an input; no state was found to follow it"
        return SignalRole(one, INPUT, name, reason)
    state = next((item for item in states if name in [reads.name for reads in item.sensors]), None)
    if state is None:
        return SignalRole(one, OMITTED, "", "measures the same quantity as an input")
    rate = next(reads.rate for reads in state.sensors if reads.name == name)
    repeats = f"; {picked[k].repeats.reason}" if picked[k].repeats.found else ""
    reason = f"measures {'the rate of ' if rate else ''}{state.name}{repeats}"
    return SignalRole(one, HELD_OUT if name in held_out else SENSOR, name, reason)


def _given(roles: Roles, found: RecordingContents, every: Sequence[Signal]) -> list[tuple[Signal, str]]:
    """Return the signals that are named, each once with its role, in the order of their names."""
    given: dict[int, tuple[Signal, str]] = {}
    groups = (
        ("--hold-out", HELD_OUT, roles.held_out),
        ("--inputs", INPUT, roles.inputs),
        ("--states", STATE, roles.states),
        ("--sensors", SENSOR, roles.sensors),
        ("--signals", "", roles.signals),
    )
    for option, role, names in groups:
        for name in names:
            for one in _named(option, name, found, every):
                before = given.get(id(one))
                if before is not None and {before[1], role} in ({HELD_OUT, INPUT}, {INPUT, SENSOR}):
                    raise ConfigError(f"{option} {name}: {one.name} is {before[1]} as well; give each signal one role")
                if before is None:
                    given[id(one)] = one, role
    order = {id(one): k for k, one in enumerate(every)}
    return [given[key] for key in sorted(given, key=order.__getitem__)] if len(given) > 1 else list(given.values())


def _lags(picked: Sequence[Signal], leads: Sequence[int], drivers: Sequence[int]) -> dict[int, Driven]:
    """Return lags of signals behind drivers, best explained first; a follower drives none, a driver follows none."""
    found: dict[int, Driven] = {}
    while True:
        free = [k for k in leads if k not in found]
        busy = {k for lag in found.values() for k in lag.drivers}
        able = [k for k in drivers if k not in found]
        tried = [driven(picked, k, [other for other in able if other != k]) for k in free if k not in busy]
        best = max((one for one in tried if one is not None), key=lambda one: one.explained, default=None)
        if best is None:
            return found
        found[best.signal] = best


def _moves(k: int, picked: Sequence[Signal], names: Sequence[str], others: Sequence[Pair], lag: Driven | None) -> Moves:
    """The state of signal k."""
    one = picked[k]
    series = one.series if lag is None else simulated(picked, lag)
    smooth, q, r = noise_of(series)
    r = max(r, one.resolution**2 / 12.0)
    rated = [pair for pair in others if pair.rate]
    if rated:
        # Its speed is measured, so it has one, and that tells what it changes by in a second.
        smooth, q = True, walk_of(picked[rated[0].second].series) * rated[0].gain ** 2
        r = max(one.noise, one.resolution / 12.0**0.5) ** 2
    own = Reads(names[k], one, r)
    more = tuple(reads_of(names[pair.second], one, picked[pair.second], pair) for pair in others)
    inputs = tuple(names[j] for j in lag.drivers) if lag is not None else ()
    return Moves(names[k], one, smooth, q, (own, *more), lag, inputs, cycle=cycle_of(series))


def reads_of(name: str, lead: Signal, one: Signal, pair: Pair) -> Reads:
    """Another sensor of the same state, or of its rate."""
    if pair.rate:
        r = max(noise_of(one.series)[2], one.resolution**2 / 12.0)
        return Reads(name, one, r, 1.0 / pair.gain, -pair.offset / pair.gain, True)
    # What is left is the noise of both.
    r = max(pair.left**2 - pair.gain**2 * lead.noise**2, 0.1 * pair.left**2, one.resolution**2 / 12.0)
    return Reads(name, one, r, pair.gain, pair.offset)


def _finest(found: RecordingContents, every: Sequence[Signal], thin: dict[int, Signal]) -> list[Signal]:
    """Those of the most levels, in the order of the recording, without interpolated ones; `thin` are those thinned."""
    fine = [one for one in every if one.kind == "signal"] or [
        one for one in every if one.kind == "switch" and one.levels > 2
    ]
    kept: list[int] = []
    for k in sorted(range(len(fine)), key=lambda k: (-fine[k].levels, k)):
        if len(kept) < MAX_SIGNALS:
            one = thin[id(fine[k])] = thinned(fine[k])
            if not interpolated(one):
                kept.append(k)
    if not kept and thin:
        reasons = ", ".join(f"{one.name}: {thin[id(one)].repeats.reason}" for one in fine)
        raise ConfigError(f"{found.files[0]}: no signal has measurements; {reasons}")
    if not kept:
        longest = max((one.series.values.size for one in every), default=0)
        if longest < MIN_VALUES:
            text = f"no signal has more than {longest} values, of which a draft needs {MIN_VALUES}; record a longer log"
        else:
            text = "no signal varies; name those to take with --signals"
        raise ConfigError(f"{found.files[0]}: {text}")
    return [fine[k] for k in sorted(kept)]


def _named(option: str, name: str, found: RecordingContents, every: Sequence[Signal]) -> list[Signal]:
    """Return SIGNAL, MESSAGE.SIGNAL or a column, or all that match a glob and vary."""
    stem = {k: part.files[0].stem for k, part in enumerate(found.parts)}
    spelt = {id(one): (one.name, f"{one.message or stem.get(one.part)}.{one.name}") for one in every}
    fits = [one for one in every if name in spelt[id(one)]]
    if not fits and (of_sources := [one for one in every if one.series.column == name]):
        return of_sources
    if not fits and any(mark in name for mark in "*?["):
        fits = [one for one in every if any(fnmatchcase(text.lower(), name.lower()) for text in spelt[id(one)])]
        fits = [one for one in fits if one.kind not in ("constant", "short")]
        if fits:
            return fits
    silent = [s for m in found.messages for s in m.signals if name in (s.name, f"{m.name}.{s.name}")]
    silent += [s for s in found.columns if s.name == name]
    if not fits and silent:
        raise ConfigError(f"{option} {name}: has 0 values; its noise can be estimated from {MIN_VALUES} on")
    if not fits:
        raise ConfigError(f"{option} {name}: is not in the log; {nearest(name, [one.name for one in every])}")
    if len({(one.part, one.message) for one in fits}) > 1:
        several = " or ".join(spelt[id(one)][1] for one in fits)
        raise ConfigError(f"{option} {name}: is in several {'files' if found.parts else 'messages'}; write {several}")
    count = fits[0].series.values.size
    if count < MIN_VALUES:
        raise ConfigError(f"{option} {name}: has {count} values; its noise can be estimated from {MIN_VALUES} on")
    return fits[:1]


def _identifier(one: Signal, taken: set[str]) -> str:
    """A name for Python and YAML, of its own; of a source of rows COLUMN_ID, as `landmark_column` names it."""
    text = re.sub(r"\W+", "_", one.series.column or one.name, flags=re.ASCII).strip("_").lower() or "value"
    if text[0].isdigit() or keyword.iskeyword(text) or text in ("on", "off", "yes", "no", "null", "true", "false"):
        text = f"s_{text}"
    if one.series.only is not None:
        text += "_" + (re.sub(r"\W+", "_", one.series.only[1], flags=re.ASCII).strip("_") or "source")
    base, k = text, 2
    while {text, f"{text}_rate", f"{text}_drift"} & taken:
        text, k = f"{base}_{k}", k + 1
    taken |= {text, f"{text}_rate", f"{text}_drift"}
    return text
