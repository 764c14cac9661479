"""Responses: how innovations and states move with each nudge, by folding the same log again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np

from ...fold import Fold
from ...log import INPUT, READING, Log
from ...model.state_space import StateSpaceModel
from ...registry import find_entry, find_estimator, unfit
from ...snapshots import Base
from ...track import DIVERGED, MISSING, NONE, USED, Track
from ...tuning import Tuning

SMOOTH = ("ekf", "ukf", "kf")
"""Filters that stand in for one that draws at random, the first that applies."""

ASTRAY = 0.1
"""Share of the rows in which a filter has diverged, from which on it cannot stand in for another."""

THREADS = int(numba.config.NUMBA_NUM_THREADS)

T = TypeVar("T")
R = TypeVar("R")


class Response(NamedTuple):
    """What one unit of a nudge does: N events, `innovation` and `whitened` NaN where there is none.

    innovation (N, ny) is dν, whitened (N, ny) S^-1/2 dν, states (N, shown) dx, of the states that a track keeps.
    """

    nudge: Nudge
    innovation: np.ndarray
    whitened: np.ndarray
    states: np.ndarray


class Start(NamedTuple):
    """The fold that is nudged: its estimator, what it is given, its track, and the log's index of its first event."""

    estimator: str
    given: Given
    track: Track
    first: int
    note: str


def stand_in(estimator: str, model: StateSpaceModel) -> tuple[str, str]:
    """The filter to nudge in place of one that draws at random, and a note that says so, or nothing.

    With one seed the draws are the same, but a nudge changes which particles survive, so that differences are noise.

    Raises:
        EstimatorError: If the estimator does not exist or does not apply to the model.
    """
    if find_estimator(estimator, model).family not in ("particle", "ensemble"):
        return estimator, ""
    for name in SMOOTH:
        if unfit(find_entry(name), model) is None:
            return name, f"{estimator} draws at random; nudged in its place: {name}"
    return estimator, f"{estimator} draws at random, and no filter without chance applies: differences hold its noise"


def astray(estimator: str, instead: str, track: Track) -> str:
    """Why the fold of the filter `instead` tells nothing of what an estimator sees; nothing if it does.

    One peak in place of two, or a linearisation where there is none: what moves a filter that is lost moves no other.
    """
    if instead == estimator or np.mean(track.health == DIVERGED) <= ASTRAY:
        return ""
    return f"{estimator} draws at random, and {instead}, which would be nudged in its place, loses this track"


def start(estimator: str, model: StateSpaceModel, tuning: Tuning, log: Log, base: Base | None, most: int) -> Start:
    """Fold once, and prepare to fold the last `most` events again and again from what stood before them.

    What was refused stays refused under every nudge, however near to the gate it was: it is taken out of the log, and
    the gate is opened.
    """
    name, note = stand_in(estimator, model)
    if name != estimator:
        tuning = tuning.with_options({})
    fold = Fold(name, model, tuning, log, base=base)
    fold.advance()
    at, base = fold.base_at(max(0, log.n - most))
    still = log.copy()
    refused = (still.kind == READING) & ~np.isin(fold.track.verdict, (USED, NONE, MISSING))
    # Of a sensor that is held out nothing is used anyhow, and its prediction is of interest.
    refused &= tuning.used[np.where(still.kind == READING, still.channel, 0)]
    still.value[refused, : still.width] = np.nan
    if at:
        still.drop_front(at)
    given = Given(replace(tuning, gate=None), still, base)
    return Start(name, given, refold(name, given), at, note)


def refold(estimator: str, given: Given) -> Track:
    """The track of what is given."""
    fold = Fold(estimator, given.tuning.model, given.tuning, given.log, base=given.base)
    fold.advance()
    return fold.track


def respond(begun: Start, nudge: Nudge) -> Response:
    """The derivative, as a difference over a step; central where the range allows."""
    low, high = max(-nudge.step, nudge.low), min(nudge.step, nudge.high)
    below, above = (
        begun.track if size == 0.0 else refold(begun.estimator, nudged(begun.given, nudge, size))
        for size in (low, high)
    )
    return Response(nudge, *(change / (high - low) for change in moved(begun, above, below)))


class Moved(NamedTuple):
    """What is other in one track than in another; see `Response`."""

    innovation: np.ndarray
    whitened: np.ndarray
    states: np.ndarray


def moved(begun: Start, new: Track, old: Track | None = None) -> Moved:
    """A track less another, or less that of the fold without nudge; angles go by the shorter way."""
    model = begun.given.tuning.model
    log = begun.given.log
    old = old or begun.track
    innovation, states = new.innovation - old.innovation, new.mean - old.mean
    reading, channel = log.kind[: log.n] == READING, log.channel[: log.n]
    whitened = new.whitened - old.whitened
    for s, sensor in enumerate(model.sensors):
        own = reading & (channel == s)
        for k, row in enumerate(sensor.rows):
            if row.circular:
                innovation[own, k] = _shorter(innovation[own, k])
        # By the S of the fold without nudge, where its square root is known: where S moves, too, the whitened rows hold
        # what that does to the innovations there are. It is less than what a change of S tells in truth.
        if len(sensor.rows) == 1 or not np.isfinite(whitened[own]).any():
            whitened[own] = innovation[own] / begun.track.innovation_std[own]
    for j, state in enumerate(model.shown_states):
        if state.circular:
            states[:, j] = _shorter(states[:, j])
    return Moved(innovation, whitened, states)


def _shorter(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def each(work: Callable[[T], R], items: Iterable[T], executor: Executor | str | None) -> list[R]:
    """Do the same with each item: "threads" side by side (a fold gives up the interpreter), None one by one."""
    own: Any = ThreadPoolExecutor(THREADS) if executor == "threads" else nullcontext(executor)
    with own as pool:
        return list(map(work, items) if pool is None else pool.map(work, items))


SENSOR, INPUT_, PARAMETER = KINDS = ("sensor", "input", "parameter")

DRIFT = "drift"
"""Of a sensor row, too: its readings move away from the log's first event on, by so much a second."""

STEP = 1e-3
"""Of the scale of what is nudged: the error of a central difference is of the order of its square, and rounding of the
order of 1e-16 over it."""


class Nudge(NamedTuple):
    """A constant, or a drift, added to the readings of a sensor row; a constant added to an input or a parameter.

    `step` is what is added and taken off for the differences, `low` and `high` the range in which a fault of this kind
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
        """A fault of a size: of a parameter in percent of its value, if it has one; else in units."""
        if self.kind == PARAMETER and self.value:
            return f"{self.name} {100.0 * size / abs(self.value):+.3g} %"
        if self.kind == DRIFT:
            return f"{SENSOR} {self.name} drifting by {size:+.3g} {self.unit}"
        kind = "" if self.kind == PARAMETER else f"{self.kind} "
        return f"{kind}{self.name} {size:+.3g} {self.unit}"

    @property
    def largest(self) -> float:
        """Size of the largest fault within the range."""
        return max(abs(self.low), abs(self.high))


class Given(NamedTuple):
    """What a fold is given: any of it may be nudged."""

    tuning: Tuning
    log: Log
    base: Base


def nudges_of(model: StateSpaceModel, tuning: Tuning, log: Log, kinds: Sequence[str] = KINDS) -> list[Nudge]:
    """Every nudge of a model: rows of sensors that speak and are used, inputs, parameters with room in their range."""
    found = []
    seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9 if log.n else 0.0
    units = [row.unit for sensor in model.sensors for row in sensor.rows]
    kind, channel = log.kind[: log.n], log.channel[: log.n]
    speak = tuning.used & np.isin(np.arange(len(model.sensors)), channel[kind == READING])
    in_use = np.repeat(speak, [len(sensor.rows) for sensor in model.sensors])
    for name, unit, variance, used in zip(model.row_names, units, tuning.r, in_use, strict=True):
        if used:
            scale = float(np.sqrt(variance)) or 1.0
            found.append(Nudge(SENSOR, name, unit, STEP * scale, -np.inf, np.inf, scale))
            if seconds > 0.0:
                rate = scale / seconds
                found.append(Nudge(DRIFT, name, f"{unit}/s", STEP * rate, -np.inf, np.inf, rate))
    given = log.value[: log.n][kind == INPUT]
    for k, item in enumerate(model.inputs):
        values = given[np.isfinite(given[:, k]), k]
        values = values if values.size else np.array([item.default])
        scale = float(np.std(values)) or float(np.abs(values[0])) or 1.0
        found.append(Nudge(INPUT_, item.name, item.unit, STEP * scale, -np.inf, np.inf, scale))
    for parameter, value in zip(model.parameters, tuning.p.tolist(), strict=True):
        low, high = parameter.low - value, parameter.high - value
        scale = abs(value) or (high - low if np.isfinite(high - low) else 1.0)
        if low < high:
            found.append(Nudge(PARAMETER, parameter.name, parameter.unit, STEP * scale, low, high, scale, value))
    return [nudge for nudge in found if nudge.kind in kinds]


def nudged(given: Given, nudge: Nudge, size: float) -> Given:
    """What a fold is given, with `size` added to what the nudge names; nothing that was given changes."""
    tuning, log, base = given
    model = tuning.model
    if nudge.kind == PARAMETER:
        p = tuning.p.copy()
        p[[item.name for item in model.parameters].index(nudge.name)] += size
        return Given(replace(tuning, p=p), log, base)
    other = log.copy()
    kind, value = other.kind[: other.n], other.value[: other.n]
    if nudge.kind in (SENSOR, DRIFT):
        row = model.row_names.index(nudge.name)
        sensor = int(np.searchsorted(model.row_start, row, side="right")) - 1
        own = np.flatnonzero((kind == READING) & (other.channel[: other.n] == sensor))
        off = size if nudge.kind == SENSOR else size * 1e-9 * (other.t[own] - other.t[0])
        value[own, row - model.row_start[sensor]] += off
        return Given(tuning, other, base)
    k = model.input_names.index(nudge.name)
    value[kind == INPUT, k] += size
    u = base.u.copy()
    u[k] += size
    return Given(tuning, other, base._replace(u=u))


def digits(value: float, sign: str = "") -> str:
    """A number to three digits, with an exponent only where it would be longer without: `2,280`, `0.0375`, `1.8e+10`.

    `sign`: "+" shows that of a positive number too. Zero has none.
    """
    value = value or 0.0
    if 1e3 <= abs(value) < 1e6:
        return f"{float(f'{value:.3g}'):{sign},.0f}"
    return f"{value:{sign if value else ''}.3g}"


def subject_text(nudge: Nudge) -> str:
    """What is nudged."""
    return f"{nudge.kind} {nudge.name}"


def size_text(nudge: Nudge, size: float) -> str:
    """The size of a fault without its sign: of a parameter in percent of its value, if it has one; else in its unit."""
    if nudge.kind == PARAMETER and nudge.value:
        return f"{digits(100.0 * size / abs(nudge.value))} %"
    return f"{digits(size)} {nudge.unit}".rstrip()


def range_text(nudge: Nudge, low: float, high: float) -> str:
    """From where to where a fault passes unseen: `-31 to +92 %`, or `± 2.51 °C`."""
    if not (np.isfinite(low) and np.isfinite(high)):
        return "any size"
    percent = nudge.kind == PARAMETER and bool(nudge.value)
    scale, unit = (100.0 / abs(nudge.value), "%") if percent else (1.0, nudge.unit)
    first, last = digits(scale * low, "+"), digits(scale * high, "+")
    both = f"± {last[1:]}" if first[1:] == last[1:] and first != last else f"{first} to {last}"
    return f"{both} {unit}".rstrip()


def fault_text(nudge: Nudge, low: float, high: float) -> str:
    """A fault that passes unseen: `parameter magnet_ambient, -31 to +92 %`."""
    return f"{subject_text(nudge)}, {range_text(nudge, low, high)}"


MOST_STATES = 64
"""States beyond which a model is too large to be folded again for each of its nudges."""

MOST_EVENTS = 20_000
"""Events that are folded again; of a longer log the last."""

MOST_NUMBERS = 32_000_000
"""Numbers that the responses may take together."""

MOST_WORK = 2_000_000_000
"""Events times nudges times nx³, as a covariance costs: some ten seconds."""


def reason_against(model: StateSpaceModel, log: Log) -> str:
    """Why sensitivities are not computed, in words, or nothing."""
    if model.grid is not None or model.nx > MOST_STATES:
        return f"{model.name} has {model.nx:,} states; sensitivities are computed up to {MOST_STATES}"
    if not (log.kind[: log.n] == READING).any():
        return "the log has no reading, so nothing can be seen"
    return ""


def most_events(model: StateSpaceModel, nudges: int) -> int:
    """How many events are folded again for so many nudges, by what that takes."""
    numbers = nudges * (2 * model.ny + 2 * len(model.shown))
    return max(1, min(MOST_EVENTS, MOST_NUMBERS // numbers, MOST_WORK // (nudges * model.nx**3)))
