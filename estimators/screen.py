"""The screen: which rows of a reading are refused at the edge, before the filter sees them.

A pure function of the readings in the order of measured time, so the log keeps every reading as it came and a fold that
goes back screens them alike. Nothing of it depends on the estimate or the tuning: a reading is judged by what its
sensor can say at all (model/limits.py) and by what it said before.

A row is stuck without being told how long, by its quantum q: noise of standard deviation σ about a value that stands
still gives the same code again with a probability of at most p = erf(q / (2√2 σ)), that of the best placed code, so m
more in a row with pᵐ at most. At n readings a day, a run of m ≥ ln n / -ln p repetitions comes less than once a day.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types

from .log import READING
from .model.limits import NOISES, Stuck
from .model.state_space import StateSpaceModel
from .numerics.jit import B1, F1, F2, I1, borrowed, borrowed_rows, i64, inlined, ints, jit
from .numerics.linalg import wrap
from .track import DUPLICATE, RANGE, RATE, REASONS, REPEATED, SATURATED

DAY = 86400.0

# A sensor's part of the state: how many readings, the time of the first, and of the one that later ones may repeat.
_COUNT, _FIRST, _ORIGINAL = range(3)
SENSOR = 3
"""Numbers in the state for each sensor."""

# A row's part: the value that may be repeated; the last that kept all limits, and its time; the value, begin and length
# of the run of equal ones.
_VALUE, _KEPT, _KEPT_AT, _RUN, _RUN_BEGAN, _RUN_LENGTH = range(6)
ROW = 6
"""Numbers in the state for each row."""


class Screen(NamedTuple):
    """The limits of all sensors as columns.

    row_start, row_count, limited (sensors,) int64: whether a sensor has limits of its values; duplicates (sensors,)
    int64, ns. Of the rows: low, high; clip_low, clip_high; rate, units a second, and slack, units; half the quantum;
    repetitions and lasting (s) of a run that is stuck, infinite where only surprise counts: -ln p, 0 where there is no
    such rule; circular int64.
    """

    row_start: Any
    row_count: Any
    limited: Any
    duplicates: Any
    low: Any
    high: Any
    clip_low: Any
    clip_high: Any
    rate: Any
    slack: Any
    half: Any
    repetitions: Any
    lasting: Any
    surprise: Any
    circular: Any


screen_type = types.NamedTuple((I1, I1, I1, I1, *[F1] * 10, I1), Screen)


def screen_of(model: StateSpaceModel) -> Screen:
    """The limits of a model's sensors."""
    count = len(model.sensors)
    rows = len(model.row_names)
    screen = Screen(
        row_start=np.array(model.row_start[:count], np.int64),
        row_count=np.array([len(sensor.rows) for sensor in model.sensors], np.int64),
        limited=np.zeros(count, np.int64),
        duplicates=np.zeros(count, np.int64),
        low=np.full(rows, -np.inf),
        high=np.full(rows, np.inf),
        clip_low=np.full(rows, -np.inf),
        clip_high=np.full(rows, np.inf),
        rate=np.full(rows, np.inf),
        slack=np.zeros(rows),
        half=np.zeros(rows),
        repetitions=np.full(rows, np.inf),
        lasting=np.full(rows, np.inf),
        surprise=np.zeros(rows),
        circular=np.array([row.circular for sensor in model.sensors for row in sensor.rows], np.int64),
    )
    for k, sensor in enumerate(model.sensors):
        limits = sensor.limits
        if limits is None:
            continue
        own = slice(screen.row_start[k], screen.row_start[k] + screen.row_count[k])
        std = np.sqrt([row.variance for row in sensor.rows])
        screen.duplicates[k] = round(limits.duplicates * 1e9)
        screen.limited[k] = bool(limits.range or limits.saturation or limits.rate or limits.stuck)
        if limits.range:
            screen.low[own], screen.high[own] = np.array(limits.range).T
        if limits.saturation:
            screen.clip_low[own], screen.clip_high[own] = np.array(limits.saturation).T
        if limits.rate:
            screen.rate[own], screen.slack[own] = limits.rate, NOISES * std
        if limits.stuck is not None:
            _be_stuck(screen, own, limits.stuck, std)
    return screen


def _be_stuck(screen: Screen, own: slice, stuck: Stuck, std: np.ndarray) -> None:
    quantum = np.broadcast_to(np.array(stuck.quantum or (0.0,)), std.shape)
    screen.half[own] = 0.5 * quantum
    if stuck.readings is not None:
        screen.repetitions[own] = stuck.readings - 1
    if stuck.seconds is not None:
        screen.lasting[own] = stuck.seconds
    if stuck.readings is None and stuck.seconds is None:
        sigma = np.broadcast_to(np.array(stuck.std or std), std.shape)
        screen.surprise[own] = [surprise(q, s) for q, s in zip(quantum, sigma, strict=True)]


def surprise(quantum: float, std: float) -> float:
    """-ln p of one repetition, p = erf(q / (2√2 σ)): 0 where noise never moves the code, so nothing can be told."""
    if not std > 0.0:
        return 0.0
    # By its complement, which keeps its digits where p is nearly 1.
    return -math.log1p(-math.erfc(quantum / (math.sqrt(8.0) * std)))


def fresh_screen(model: StateSpaceModel) -> np.ndarray:
    """The screen's state before the first event. Times in it are int64, the other numbers float64."""
    sensors = len(model.sensors)
    state = np.zeros(sensors * SENSOR + len(model.row_names) * ROW)
    each = state[sensors * SENSOR :].reshape(-1, ROW)
    each[:, [_VALUE, _KEPT, _RUN]] = np.nan
    return state


@inlined
def _same(a, b):
    """Whether two values are equal, or both missing."""
    return a == b or np.isnan(a) and np.isnan(b)


@jit
def _is_duplicate(now, y, s, screen, begin, state, times):
    """Whether a reading says what the one before said, at the same time or too soon after it to be another."""
    own = s * SENSOR
    if state[own + _COUNT] == 0.0 or now - times[own + _ORIGINAL] > screen.duplicates[s]:
        return False
    for k in range(screen.row_count[s]):
        if not _same(y[k], state[begin + (screen.row_start[s] + k) * ROW + _VALUE]):
            return False
    return True


@jit
def _repeats(now, y, row, at, a_day, screen, state, times):
    """Whether a row has said the same for too long."""
    if not np.isfinite(state[at + _RUN]) or abs(y - state[at + _RUN]) > screen.half[row]:
        state[at + _RUN], state[at + _RUN_LENGTH] = y, 0.0
        times[at + _RUN_BEGAN] = now
        return False
    state[at + _RUN_LENGTH] += 1.0
    length = state[at + _RUN_LENGTH]
    if length >= screen.repetitions[row] or (now - times[at + _RUN_BEGAN]) * 1e-9 >= screen.lasting[row]:
        return True
    return screen.surprise[row] > 0.0 and length * screen.surprise[row] >= math.log(max(a_day, math.e))


@jit
def _reasons(now, y, row, at, a_day, screen, state, times):
    """Bits of the limits that a row of a reading breaks."""
    bits = 0
    if y < screen.low[row] or y > screen.high[row]:
        bits |= RANGE
    if y <= screen.clip_low[row] or y >= screen.clip_high[row]:
        bits |= SATURATED
    if np.isfinite(screen.rate[row]) and np.isfinite(state[at + _KEPT]):
        change = y - state[at + _KEPT]
        if screen.circular[row] != 0:
            change = wrap(change)
        if abs(change) > screen.rate[row] * (now - times[at + _KEPT_AT]) * 1e-9 + screen.slack[row]:
            bits |= RATE
    if _repeats(now, y, row, at, a_day, screen, state, times):
        bits |= REPEATED
    if bits == 0:
        state[at + _KEPT] = y
        times[at + _KEPT_AT] = now
    return bits


@jit
def screen_rows(first, last, t, kind, channel, value, screen, state, screened):
    """Fill `screened` (N, ny) for events `first` to `last`: bits of the limits that each row of a reading breaks.

    `state` moves on with them, so the outcome does not depend on how a fold was cut into pieces.
    """
    times = ints(state.ctypes.data, state.size)
    state = borrowed(state)
    value = borrowed_rows(value)
    begin = screen.row_count.size * SENSOR
    for i in range(first, last):
        for k in range(screened.shape[1]):
            screened[i, k] = 0
        if kind[i] != READING:
            continue
        s, now = channel[i], t[i]
        own, y = s * SENSOR, value[i]
        if _is_duplicate(now, y, s, screen, begin, state, times):
            for k in range(screen.row_count[s]):
                if not np.isnan(y[k]):
                    screened[i, k] = DUPLICATE
            continue
        if state[own + _COUNT] == 0.0:
            times[own + _FIRST] = now
        times[own + _ORIGINAL] = now
        elapsed = (now - times[own + _FIRST]) * 1e-9
        a_day = DAY * state[own + _COUNT] / elapsed if elapsed > 0.0 else np.inf
        state[own + _COUNT] += 1.0
        for k in range(screen.row_count[s]):
            row = screen.row_start[s] + k
            at = begin + row * ROW
            state[at + _VALUE] = y[k]
            if screen.limited[s] != 0 and not np.isnan(y[k]):
                screened[i, k] = _reasons(now, y[k], row, at, a_day, screen, state, times)


B2 = types.int8[:, ::1]
I4 = types.int32[::1]
screen_signature = types.void(i64, i64, I1, B1, I4, F2, screen_type, F1, B2)


def reasons_by_sensor(sensors: int, channel: np.ndarray, screened: np.ndarray) -> np.ndarray:
    """How many readings were refused, wholly or in part, for each reason: (sensors, reasons); of rows of a track."""
    rows = np.flatnonzero(screened.any(axis=1))
    bits = np.bitwise_or.reduce(screened[rows], axis=1)
    counts = [np.bincount(channel[rows[bits & (1 << k) != 0]], minlength=sensors) for k in range(len(REASONS))]
    return np.stack(counts, axis=1)


@inlined
def any_refused(screened, i):
    """Whether a row of reading i is refused."""
    for k in range(screened.shape[1]):
        if screened[i, k] != 0:
            return True
    return False


@jit
def pass_on(value, screened, i, out):
    """out ← reading i with NaN in the rows that are refused; whether any row is left."""
    left = False
    for k in range(out.size):
        out[k] = value[i, k]
        if k < screened.shape[1]:
            if screened[i, k] != 0:
                out[k] = np.nan
            elif np.isfinite(out[k]):
                left = True
    return left
