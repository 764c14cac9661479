"""Which signals of a recording become states, sensors and inputs of a draft, and how each state moves."""

from __future__ import annotations

import keyword
import re
from collections.abc import Sequence
from dataclasses import dataclass

from estimators.errors import ConfigError, nearest
from sources.inspect import RecordingContents

from .relations import Driven, Pair, driven, pairs, simulated
from .signals import MIN_VALUES, Signal, noise_of, signals, walk_of

MAX_SIGNALS = 6  # signals that are taken where none are named


@dataclass(frozen=True)
class Reads:
    """A sensor, `name` in the draft: offset + gain · state, or of its rate, with noise of variance `r`."""

    name: str
    signal: Signal
    r: float
    gain: float = 1.0
    offset: float = 0.0
    rate: bool = False


@dataclass(frozen=True)
class Moves:
    """One state, how it moves, and the sensors that read it, its own first.

    `smooth`: with a speed of its own, which is a second state. With `lag` it follows inputs, whose names are `inputs`,
    and the speed is what they leave unexplained.
    `q` is the variance that the noise adds in one second, to the speed if there is one.
    """

    name: str
    signal: Signal
    smooth: bool
    q: float
    sensors: tuple[Reads, ...]
    lag: Driven | None = None
    inputs: tuple[str, ...] = ()

    @property
    def second(self) -> str:
        """Name of its second state."""
        return f"{self.name}_{'rate' if self.lag is None else 'drift'}"


@dataclass(frozen=True)
class DraftPlan:
    """A draft: its states, the inputs by their names, the pairs that were found among the signals, and these."""

    states: tuple[Moves, ...]
    inputs: tuple[tuple[str, Signal], ...]
    signals: tuple[Signal, ...]
    pairs: tuple[Pair, ...]


def plan(found: RecordingContents, wanted: Sequence[str]) -> DraftPlan:
    """The signals that are named, or those that vary most finely, each in its role.

    Raises:
        ConfigError: If one is not there, is named by several messages, or has too few values.
    """
    every = signals(found)
    if not found.columns and not any(message.signals for message in found.messages):
        raise ConfigError(f"{found.files[0]}: no message of it is in a DBC; give one that describes it with --dbc")
    picked = [_named(name, found, every) for name in wanted] if wanted else _finest(found, every)
    for one in picked:
        count = one.series.values.size
        if count < MIN_VALUES:
            raise ConfigError(
                f"--signals {one.name}: has {count} values; its noise can be estimated from {MIN_VALUES} on"
            )
    told = pairs(picked)
    taken: set[str] = set()
    names = [_identifier(one.name, taken) for one in picked]
    # Of signals that say the same the first one is the state.
    leads = {k: k for k in range(len(picked))}
    for pair in (pair for pair in told if pair.one):
        if leads[pair.second] == pair.second and leads[pair.first] == pair.first:
            leads[pair.second] = pair.first
    lags = _lags(
        picked, [k for k in leads if leads[k] == k and not any(pair.first == k and pair.rate for pair in told)]
    )
    used = sorted({k for lag in lags.values() for k in lag.drivers})
    states = []
    for k in range(len(picked)):
        if leads[k] == k and k not in used:
            others = [pair for pair in told if pair.one and leads[pair.second] == k and pair.first == k]
            states.append(_moves(k, picked, names, others, lags.get(k)))
    return DraftPlan(tuple(states), tuple((names[k], picked[k]) for k in used), tuple(picked), tuple(told))


def _lags(picked: Sequence[Signal], leads: Sequence[int]) -> dict[int, Driven]:
    """Who follows whom, those best explained first; what follows drives nobody, and what drives does not follow."""
    found: dict[int, Driven] = {}
    while True:
        free = [k for k in leads if k not in found]
        busy = {k for lag in found.values() for k in lag.drivers}
        tried = [driven(picked, k, [other for other in free if other != k]) for k in free if k not in busy]
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
    more = tuple(_reads(names[pair.second], one, picked[pair.second], pair) for pair in others)
    inputs = tuple(names[j] for j in lag.drivers) if lag is not None else ()
    return Moves(names[k], one, smooth, q, (own, *more), lag, inputs)


def _reads(name: str, lead: Signal, one: Signal, pair: Pair) -> Reads:
    """Another sensor of the same state, or of its rate."""
    if pair.rate:
        r = max(noise_of(one.series)[2], one.resolution**2 / 12.0)
        return Reads(name, one, r, 1.0 / pair.gain, -pair.offset / pair.gain, True)
    # What is left is the noise of both.
    r = max(pair.left**2 - pair.gain**2 * lead.noise**2, 0.1 * pair.left**2, one.resolution**2 / 12.0)
    return Reads(name, one, r, pair.gain, pair.offset)


def _finest(found: RecordingContents, every: Sequence[Signal]) -> list[Signal]:
    """Those of the most levels, in the order of the recording."""
    fine = [one for one in every if one.kind == "signal"] or [
        one for one in every if one.kind == "switch" and one.levels > 2
    ]
    kept = sorted(range(len(fine)), key=lambda k: (-fine[k].levels, k))[:MAX_SIGNALS]
    if not kept:
        raise ConfigError(f"{found.files[0]}: no signal of it varies; name those to take with --signals")
    return [fine[k] for k in sorted(kept)]


def _named(name: str, found: RecordingContents, every: Sequence[Signal]) -> Signal:
    """SIGNAL or MESSAGE.SIGNAL, or a column."""
    fits = [one for one in every if name in (one.name, f"{one.message}.{one.name}")]
    silent = [s for m in found.messages for s in m.signals if name in (s.name, f"{m.name}.{s.name}")]
    silent += [s for s in found.columns if s.name == name]
    if not fits and silent:
        raise ConfigError(f"--signals {name}: has 0 values; its noise can be estimated from {MIN_VALUES} on")
    if not fits:
        raise ConfigError(f"--signals {name}: is not in the log; {nearest(name, [one.name for one in every])}")
    if len({one.message for one in fits}) > 1:
        several = " or ".join(f"{one.message}.{one.name}" for one in fits)
        raise ConfigError(f"--signals {name}: is in several messages; write {several}")
    return fits[0]


def _identifier(name: str, taken: set[str]) -> str:
    """A name for Python and YAML, of its own."""
    text = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower() or "value"
    if text[0].isdigit() or keyword.iskeyword(text) or text in ("on", "off", "yes", "no", "null", "true", "false"):
        text = f"s_{text}"
    base, k = text, 2
    while {text, f"{text}_rate", f"{text}_drift"} & taken:
        text, k = f"{base}_{k}", k + 1
    taken |= {text, f"{text}_rate", f"{text}_drift"}
    return text
