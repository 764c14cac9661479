"""Responses of innovations and states to small changes of sensors, inputs and parameters, by refolding a log."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np

from ...errors import digits as digits
from ...fold import folded
from ...log import INPUT, READING, Log
from ...model.state_space import StateSpaceModel
from ...numerics.linalg import wrapped
from ...registry import find_entry, find_estimator, unfit
from ...snapshots import Base
from ...track import DIVERGED, MISSING, NONE, USED, Track
from ...tuning import Tuning

DETERMINISTIC_FILTERS = ("ekf", "ukf", "kf")
"""Deterministic filters that replace a Monte Carlo one, the first that applies."""

MAX_DIVERGED_SHARE = 0.1  # Share of diverged rows up to which a filter can replace another

SMOOTHED = 20  # Earlier measurements over which the corrections of predictions are averaged

THREADS = int(numba.config.NUMBA_NUM_THREADS)

T = TypeVar("T")
R = TypeVar("R")


class Response(NamedTuple):
    """Difference of two tracks of N events, or its derivative by a nudge; NaN where there is none.

    innovation (N, ny) is dν, whitened (N, ny) S^-1/2 dν, states (N, shown) dx, of the states that a track keeps.
    """

    innovation: np.ndarray
    whitened: np.ndarray
    states: np.ndarray


class Start(NamedTuple):
    """A fold to be perturbed: its inputs, its track, the index of its first event in the log, and a note."""

    estimator: str
    tuning: Tuning
    log: Log
    base: Base
    first: int
    note: str
    track: Track

    @classmethod
    def of(cls, estimator: str, tuning: Tuning, log: Log, base: Base, first: int = 0, note: str = "") -> Start:
        """Fold these inputs once."""
        return cls(estimator, tuning, log, base, first, note, _track(estimator, tuning, log, base))

    def refold(self, *, tuning: Tuning | None = None, log: Log | None = None, base: Base | None = None) -> Track:
        """Return the track of a fold with some inputs replaced."""
        return _track(self.estimator, tuning or self.tuning, log or self.log, base or self.base)

    def with_fault(self, nudge: Nudge, size: float) -> Track:
        """Return the track of a fold with a fault of this size."""
        model, tuning = self.tuning.model, self.tuning
        if nudge.kind in NOISES:
            key = f"{nudge.kind}.{nudge.name}"
            return self.refold(tuning=tuning.set(key, float(tuning.get(key) or 0.0) * (1.0 + size)))
        if nudge.kind == PARAMETER:
            p = tuning.p.copy()
            p[[item.name for item in model.parameters].index(nudge.name)] += size
            return self.refold(tuning=replace(tuning, p=p))
        if nudge.kind == PRIOR:
            mean = self.base.mean.copy()
            mean[model.state_names.index(nudge.name)] += size
            return self.refold(base=self.base._replace(mean=mean, state=None))
        other = self.log.copy()
        kind, value = other.events.kind, other.events.value
        if nudge.kind in (INPUT_, INPUT_SCALE):
            k = model.input_names.index(nudge.name)
            factor, offset = (1.0 + size, 0.0) if nudge.kind == INPUT_SCALE else (1.0, size)
            value[kind == INPUT, k] = factor * value[kind == INPUT, k] + offset
            u = self.base.u.copy()
            u[k] = factor * u[k] + offset
            return self.refold(log=other, base=self.base._replace(u=u))
        if nudge.kind in (STUCK, INPUT_STUCK):
            of_input = nudge.kind == INPUT_STUCK
            k = (model.input_names if of_input else model.sensor_names).index(nudge.name)
            own = np.flatnonzero(kind == INPUT) if of_input else other.events.of_sensor(k)
            columns = [k] if of_input else range(len(model.sensors[k].rows))
            for column in columns:
                there = own[np.isfinite(value[own, column])]
                value[there, column] = self.base.u[column] if of_input else value[there[:1], column]
            return self.refold(log=other)
        if nudge.kind == SWAP:
            names = nudge.name.split(SWAPPED)
            (own, at, was), (others, then, theirs) = map(self._predicted, names)
            value[own, : was.shape[1]] += size * (_at(at, then, theirs) - was)
            value[others, : was.shape[1]] += size * (_at(then, at, was) - theirs)
            return self.refold(log=other)
        if nudge.kind == DELAY:
            own, at, predicted = self._predicted(nudge.name)
            count = predicted.shape[1]
            if abs(size) < nudge.scale:
                value[own, :count] += _at(at - size, at, predicted) - predicted
            else:
                # Whole measurements with their noise, those nearest in time; at the ends there are none.
                there = (at - size >= at[0]) & (at - size <= at[-1]) if at.size else np.zeros(0, bool)
                nearest = np.searchsorted(0.5 * (at[1:] + at[:-1]), at[there] - size)
                value[own[there], :count] = value[own[nearest], :count]
            return self.refold(log=other)
        row = model.row_names.index(nudge.name)
        sensor = int(np.searchsorted(model.row_start, row, side="right")) - 1
        own = other.events.of_sensor(sensor)
        column = row - model.row_start[sensor]
        if nudge.kind == SCALE:
            own, _, predicted = self._predicted(model.sensor_names[sensor])
            value[own, column] += size * predicted[:, column]
        elif nudge.kind == SPIKES:
            spikes = own[min(SPIKE_PERIOD, own.size) // 2 :: SPIKE_PERIOD]
            value[spikes, column] += size * (-1.0) ** np.arange(spikes.size)
        else:
            value[own, column] += size if nudge.kind == SENSOR else size * 1e-9 * (other.t[own] - other.t[0])
        return self.refold(log=other)

    def _predicted(self, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows (n,), times (n,) in s and predictions (n, ny) of the measurements of a sensor.

        Scaled, exchanged or delayed predictions move the mean of a measurement as the fault does, without its noise. A
        prediction follows noise by its corrections, H K ν = ν (S - R) / S, so that these are smoothed; the steps of the
        model between them are kept.
        """
        model, log = self.tuning.model, self.log
        s = model.sensor_names.index(name)
        own = log.events.of_sensor(s)
        count = len(model.sensors[s].rows)
        own = own[np.isfinite(log.value[own, :count] - self.track.innovation[own, :count]).all(axis=1)]
        predicted = np.zeros((own.size, count))
        for k, row in enumerate(model.sensors[s].rows):
            nu, variance = self.track.innovation[own, k], self.track.innovation_std[own, k] ** 2
            mean = log.value[own, k] - nu
            mean = np.unwrap(mean) if row.circular else mean
            follows = np.where(self.track.verdict[own] == USED, variance - self.tuning.r[model.row_start[s] + k], 0.0)
            corrections = np.cumsum(np.concatenate([np.zeros(min(1, own.size)), (nu * follows / variance)[:-1]]))
            predicted[:, k] = mean - corrections + _smoothed(corrections)
        return own, 1e-9 * (log.t[own] - log.t[0]), predicted

    def moved(self, new: Track, old: Track | None = None) -> Response:
        """Subtract a track from another, by default that of the fold without nudge; angles by the shorter way."""
        model, log, old = self.tuning.model, self.log, old or self.track
        innovation, states = new.innovation - old.innovation, new.mean - old.mean
        whitened = new.whitened - old.whitened
        for s, sensor in enumerate(model.sensors):
            own = log.events.of_sensor(s)
            for k, row in enumerate(sensor.rows):
                innovation[own, k] = wrapped(innovation[own, k], row.circular)
            # By the S of the fold without nudge, where its square root is known. A change of S also changes the
            # whitened innovations, by less than its effect on their distribution.
            if len(sensor.rows) == 1 or not np.isfinite(whitened[own]).any():
                whitened[own] = innovation[own] / self.track.innovation_std[own]
        for j, state in enumerate(model.shown_states):
            states[:, j] = wrapped(states[:, j], state.circular)
        return Response(innovation, whitened, states)

    def respond(self, nudge: Nudge) -> Response:
        """Return the derivative by a nudge, as a difference over a step; central where the range allows."""
        low, high = max(-nudge.step, nudge.low), min(nudge.step, nudge.high)
        below, above = (self.track if size == 0.0 else self.with_fault(nudge, size) for size in (low, high))
        return Response(*(change / (high - low) for change in self.moved(above, below)))


def _smoothed(series: np.ndarray) -> np.ndarray:
    """Return the mean of each value of a series (n,) and the `SMOOTHED` before it: later ones contain its noise."""
    total = np.concatenate([np.zeros(1), np.cumsum(series)])
    last = np.arange(1, series.size + 1)
    first = np.maximum(last - SMOOTHED - 1, 0)
    return (total[last] - total[first]) / (last - first)


def _at(t: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate series of values (n, rows) at times t; without any value nothing is moved."""
    if not times.size:
        return np.zeros((t.size, values.shape[1]))
    return np.stack([np.interp(t, times, column) for column in values.T], axis=1)


def _track(estimator: str, tuning: Tuning, log: Log, base: Base) -> Track:
    return folded(estimator, tuning.model, tuning, log, base=base).track


def stand_in(estimator: str, model: StateSpaceModel) -> tuple[str, str]:
    """Return the filter to nudge in place of a Monte Carlo one, and a note about it, or "".

    A nudge changes which particles survive, even with the same seed, so differences would be noise.

    Raises:
        EstimatorError: If the estimator does not exist or does not apply to the model.
    """
    if not find_estimator(estimator, model).samples:
        return estimator, ""
    for name in DETERMINISTIC_FILTERS:
        if unfit(find_entry(name), model) is None:
            return name, f"{estimator} is a Monte Carlo filter; nudged in its place: {name}"
    return (
        estimator,
        f"{estimator} is a Monte Carlo filter without a deterministic substitute: differences contain its noise",
    )


def nonlinear_note(estimator: str, tuning: Tuning, effect: str) -> str:
    """Return the note on a filter that responds nonlinearly to nudges, with the options that make it so."""
    options = [name for name in ("adapt", "robust") if tuning.options.get(name)]
    if not options:
        return f"{estimator} responds nonlinearly to nudges: {effect}"
    off = " ".join(f"--set estimator.options.{name}=off" for name in options)
    which = f"the option {' and '.join(options)} makes {estimator} respond nonlinearly to nudges"
    return f"{which}: {effect}; repeat with {off}"


def astray(estimator: str, instead: str, track: Track) -> str:
    """Return why the filter `instead` cannot replace an estimator on this track, or "".

    A diverged filter, with one peak in place of two or an invalid linearisation, responds differently.
    """
    if instead == estimator or np.mean(track.health == DIVERGED) <= MAX_DIVERGED_SHARE:
        return ""
    return f"{estimator} is a Monte Carlo filter, and {instead}, which would be nudged in its place, diverges"


NOW, PRIOR = "now", "prior"
"""Beginnings of a fault: after the log has shown the state, or at the prior. Of a nudge: offset of a prior mean."""


def start(
    estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, base: Base | None, most: int, begin: str = NOW
) -> Start:
    """Fold once, and prepare to refold the last `most` events from the state before them, or the first from the prior.

    Rejected measurements stay rejected under every nudge: they are removed from the log, and the gate is opened.
    """
    name, note = stand_in(estimator, model)
    if begin == PRIOR:
        log = log.copy()
        log.n = min(log.n, most)
    if name != estimator:
        tuning = tuning.with_options({})
    fold = folded(name, model, tuning, log, base=base)
    at, base = fold.base_at(max(0, log.n - most))
    still = log.copy()
    refused = (still.kind == READING) & ~np.isin(fold.track.verdict, (USED, NONE, MISSING))
    # Measurements of a held-out sensor are not used, but their predictions are needed.
    refused &= tuning.used[np.where(still.kind == READING, still.channel, 0)]
    still.value[refused, : still.width] = np.nan
    if at:
        still.drop_front(at)
    return Start.of(name, replace(tuning, gate=None), still, base, at, note)


def each(
    work: Callable[[T], R],
    items: Iterable[T],
    executor: Executor | str | None,
    done: Callable[[], None] = lambda: None,
) -> list[R]:
    """Map a function over items: in threads (a fold releases the interpreter), in an Executor, or one by one with None.

    Args:
        work: The function; an Executor of processes needs one of a module, or a partial of one.
        items: Its arguments.
        executor: "threads", an Executor, or None.
        done: Called after each result, in their order; calls that have not begun are cancelled if it raises.
    """
    own: Any = ThreadPoolExecutor(THREADS) if executor == "threads" else nullcontext(executor)
    found = []
    with own as pool:
        for result in map(work, items) if pool is None else pool.map(work, items):
            found.append(result)
            done()
    return found


SENSOR, INPUT_, PARAMETER = KINDS = ("sensor", "input", "parameter")

MAX_RELATIVE_SIZE = 10.0  # of a parameter's value, up to which a size is given in percent of it

DRIFT = "drift"  # Kind of a nudge that grows in proportion to the time since the first event, of a sensor row
SCALE, INPUT_SCALE = "scale", "input scale"  # Of a sensor row and of an input: factor, less 1
DELAY = "delay"  # Of a sensor, s
SPIKES = "spikes"  # Size of spikes in every `SPIKE_PERIOD`-th measurement of a sensor row, of alternating sign
SWAP = "swap"  # Of the names of two sensors with the same units, 0 or 1
STUCK, INPUT_STUCK = "stuck", "input stuck"  # Of a sensor and of an input: the first value is repeated, 0 or 1
SWITCHED = (SWAP, STUCK, INPUT_STUCK)  # Kinds that are there or not
R_, Q_ = NOISES = ("R", "Q")  # Factor on a variance, less 1
FROM_PRIOR = (PRIOR, *NOISES)  # Kinds that are there from the prior on
CATALOGUE = (*KINDS, DRIFT, SCALE, INPUT_SCALE, DELAY, SPIKES, *SWITCHED, *FROM_PRIOR)
BY_ALARMS = (*NOISES, DELAY, SPIKES)  # Kinds that change the noise of innovations, so that alarms judge them

SPIKE_PERIOD = 100  # Measurements from one spike to the next

SWAPPED = " and "  # Between the names of two sensors

MAX_DELAY_S, MAX_DELAY_PERIODS, MAX_DELAY_SHARE = 10.0, 10.0, 0.2
"""Delay of a sensor at most: seconds or periods, whichever is longer, and share of the log."""

MAX_SCALE = 0.5  # Largest relative error of a scale
MAX_OFFSET_SIGMAS = 50.0  # Largest offset of a sensor, in standard deviations, unless its values extend further
MAX_NOISE_FACTOR = 100.0  # Largest factor on a variance, and its reciprocal the smallest
MAX_PRIOR_SIGMAS = 5.0  # Range of a prior mean, in its standard deviations, where the state moves less

STEP = 1e-3
"""Step of a difference, as a share of the nudge's scale: the error of a central difference is of the order of its
square, that of rounding 1e-16 over it."""


WORDS = {
    DRIFT: "drift of",
    SPIKES: "spikes of",
    SCALE: "scale of",
    INPUT_SCALE: "scale of input",
    DELAY: "delay of",
    SWAP: "swap of",
    STUCK: "stuck",
    INPUT_STUCK: "stuck input",
    PRIOR: "prior of",
}


class Nudge(NamedTuple):
    """A fault of one of the kinds of `CATALOGUE`: for the first, a constant added to a sensor row, input or parameter.

    `step` is added and subtracted for the differences, `low` and `high` the range in which a fault of this kind
    (a change from the present value) makes sense, `scale` the size by which nudges are compared: the deviation of the
    sensor's noise, the spread of the input in the log, the parameter's value, or its range where that is 0. `value` is
    a parameter's own. All in `unit`.
    """

    kind: str
    name: str
    unit: str
    step: float
    low: float
    high: float
    scale: float
    value: float = np.nan

    def in_words(self, size: float) -> str:
        """Describe a fault of a size: of a parameter in percent of its value, if that is not near zero."""
        if self.kind in SWITCHED:
            return self.subject
        if self.kind in NOISES:
            return f"{self.subject} × {digits(1.0 + size)}"
        if self._in_percent(size):
            name = self.name if self.kind == PARAMETER else self.subject
            return f"{name} {100.0 * size / abs(self.value):+.3g} %"
        if self.kind == DRIFT:
            return f"{SENSOR} {self.name} drifting by {size:+.3g} {self.unit}"
        if self.kind == DELAY:
            return f"{SENSOR} {self.name} {'delayed' if size > 0.0 else 'early'} by about {abs(size):.2g} s"
        if self.kind in WORDS:
            return f"{self.subject} {size:+.3g} {self.unit}".rstrip()
        kind = "" if self.kind == PARAMETER else f"{self.kind} "
        return f"{kind}{self.name} {size:+.3g} {self.unit}".rstrip()

    def _in_percent(self, size: float) -> bool:
        """Return whether a size is given in percent of a parameter's value."""
        return self.kind in (PARAMETER, SCALE, INPUT_SCALE) and abs(size) <= MAX_RELATIVE_SIZE * abs(self.value) > 0.0

    @property
    def subject(self) -> str:
        """Kind and name."""
        return f"{self.kind}.{self.name}" if self.kind in NOISES else f"{WORDS.get(self.kind, self.kind)} {self.name}"

    @property
    def target(self) -> tuple[str, str]:
        """Kind of the faulty part (sensor, input, parameter, prior, swap or noise) and its name."""
        if self.kind in (DRIFT, SCALE, DELAY, SPIKES, STUCK, R_):
            return SENSOR, self.name
        return (INPUT_ if self.kind in (INPUT_SCALE, INPUT_STUCK) else self.kind), self.name

    def size_text(self, size: float) -> str:
        """Return the size of a fault without its sign: in percent as `in_words`, else in its unit."""
        if self.kind in SWITCHED:
            return "always"
        if self.kind in NOISES:
            return f"× {digits(1.0 + size)}"
        if self._in_percent(size):
            return f"{digits(100.0 * size / abs(self.value))} %"
        return f"{digits(size)} {self.unit}".rstrip()

    def range_text(self, low: float, high: float) -> str:
        """Return the range of undetectable sizes: `-31 to +92 %`, or `± 2.51 °C`."""
        if self.kind in SWITCHED:
            return "always" if high > 0.0 else "none"
        if self.kind in NOISES:
            return f"× {digits(1.0 + low)} to × {digits(1.0 + high)}"
        if not (np.isfinite(low) and np.isfinite(high)):
            return "any size"
        percent = self._in_percent(max(abs(low), abs(high)))
        scale, unit = (100.0 / abs(self.value), "%") if percent else (1.0, self.unit)
        first, last = digits(scale * low, "+"), digits(scale * high, "+")
        both = f"± {last[1:]}" if first[1:] == last[1:] and first != last else f"{first} to {last}"
        return f"{both} {unit}".rstrip()


def nudges_of(
    model: StateSpaceModel, tuning: Tuning, log: Log, kinds: Sequence[str], track: Track | None = None
) -> list[Nudge]:
    """Return all nudges of a model, those of `KINDS` first: rows of used sensors with measurements, inputs, parameters.

    `track`: of the log, by which the priors of states have a range.
    """
    found, others = [], []
    seconds = log.events.seconds
    units = [row.unit for sensor in model.sensors for row in sensor.rows]
    kind = log.events.kind
    reporting = tuning.used & np.isin(np.arange(len(model.sensors)), log.events.channel[kind == READING])
    in_use = np.repeat(reporting, [len(sensor.rows) for sensor in model.sensors])
    for row, (name, unit, variance, used) in enumerate(zip(model.row_names, units, tuning.r, in_use, strict=True)):
        if used:
            scale = float(np.sqrt(variance)) or 1.0
            s = int(np.searchsorted(model.row_start, row, side="right")) - 1
            values = log.value[log.events.of_sensor(s), row - model.row_start[s]]
            values = values[np.isfinite(values)]
            extent = float(max(MAX_SCALE * np.abs(values).max(), np.ptp(values))) if values.size else 0.0
            most = max(MAX_OFFSET_SIGMAS * scale, extent)
            found.append(Nudge(SENSOR, name, unit, STEP * scale, -most, most, scale))
            others.append(Nudge(SCALE, name, "", STEP, -MAX_SCALE, MAX_SCALE, 1.0, 1.0))
            others.append(Nudge(SPIKES, name, unit, STEP * scale, 0.0, MAX_OFFSET_SIGMAS * scale, scale))
            if variance > 0.0:
                others.append(_noise(R_, name))
            if seconds > 0.0:
                rate = scale / seconds
                others.append(Nudge(DRIFT, name, f"{unit}/s", STEP * rate, -np.inf, np.inf, rate))
    given = log.events.value[kind == INPUT]
    for k, item in enumerate(model.inputs):
        values = given[np.isfinite(given[:, k]), k]
        values = values if values.size else np.array([item.default])
        scale = float(np.std(values)) or float(np.abs(values[0])) or 1.0
        found.append(Nudge(INPUT_, item.name, item.unit, STEP * scale, -np.inf, np.inf, scale))
        if np.ptp(values) > 0.0:
            others.append(Nudge(INPUT_STUCK, item.name, "", STEP, 0.0, 1.0, 1.0))
        if np.any(values != 0.0):
            others.append(Nudge(INPUT_SCALE, item.name, "", STEP, -MAX_SCALE, MAX_SCALE, 1.0, 1.0))
    for parameter, value in zip(model.parameters, tuning.p.tolist(), strict=True):
        low, high = parameter.low - value, parameter.high - value
        scale = abs(value) or (high - low if np.isfinite(high - low) else 1.0)
        if low < high:
            found.append(Nudge(PARAMETER, parameter.name, parameter.unit, STEP * scale, low, high, scale, value))
    sensors = [sensor for sensor, used in zip(model.sensors, reporting, strict=True) if used]
    for k, sensor in enumerate(sensors):
        times = log.t[log.events.of_sensor(model.sensor_names.index(sensor.name))]
        others.append(Nudge(STUCK, sensor.name, "", STEP, 0.0, 1.0, 1.0))
        period = float(np.median(np.diff(times))) * 1e-9 if times.size > 1 else 0.0
        most = min(max(MAX_DELAY_S, MAX_DELAY_PERIODS * period), MAX_DELAY_SHARE * seconds)
        if period > 0.0 and most > 0.0:
            others.append(Nudge(DELAY, sensor.name, "s", STEP * period, -most, most, period))
        for other in sensors[k + 1 :]:
            if [row.unit for row in other.rows] == [row.unit for row in sensor.rows]:
                others.append(Nudge(SWAP, f"{sensor.name}{SWAPPED}{other.name}", "", STEP, 0.0, 1.0, 1.0))
    for j, state in enumerate(model.states):
        std = float(model.prior_std[j])
        if std > 0.0:
            shown = np.flatnonzero(model.shown == j)
            moved = np.ptp(track.mean[:, shown[0]]) if track is not None and shown.size and len(track) else 0.0
            most = MAX_PRIOR_SIGMAS * std + (float(moved) if np.isfinite(moved) else 0.0)
            others.append(Nudge(PRIOR, state.name, state.unit, STEP * std, -most, most, std))
    for noise in model.noises:
        if float(tuning.get(f"Q.{noise.name}") or 0.0) > 0.0:
            others.append(_noise(Q_, noise.name))
    return [nudge for nudge in found + others if nudge.kind in kinds]


def _noise(kind: str, name: str) -> Nudge:
    return Nudge(kind, name, "", STEP, 1.0 / MAX_NOISE_FACTOR - 1.0, MAX_NOISE_FACTOR - 1.0, 1.0, 1.0)


MAX_STATES = 64  # States up to which a model is refolded for each of its nudges
MAX_REFOLD_EVENTS = 20_000  # Events that are refolded at most beside a running twin
MAX_CHECKED_EVENTS = 60_000  # Events that are refolded at most to check a log
MAX_RESPONSE_NUMBERS = 32_000_000  # Numbers in all responses at most
MAX_REFOLD_OPERATIONS = 2_000_000_000  # Events times nudges times nx³, as a covariance costs: some ten seconds


def reason_against(model: StateSpaceModel, log: Log) -> str:
    """Return why sensitivities are not computed, or ""."""
    if model.grid is not None or model.nx > MAX_STATES:
        return f"{model.name} has {model.nx:,} states; sensitivities are computed up to {MAX_STATES}"
    if not (log.events.kind == READING).any():
        return "the log has no measurement"
    return ""


def max_events(model: StateSpaceModel, nudges: int, most: int = MAX_REFOLD_EVENTS) -> int:
    """Return the number of events to refold for this number of nudges, by their cost."""
    numbers = nudges * (2 * model.ny + 2 * len(model.shown))
    return max(1, min(most, MAX_RESPONSE_NUMBERS // numbers, MAX_REFOLD_OPERATIONS // (nudges * model.nx**3)))
