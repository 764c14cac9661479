"""Range, rate, saturation, repetition and duplicate checks of measurements before the filter.

A pure function of the measurements in the order of their time: the log keeps every measurement, and a fold that goes
back gets the same verdicts. It depends neither on the estimate nor on the tuning, only on the limits of the sensor
(`model/limits.py`) and its earlier measurements.

Without a limit for the length of a run, a row is stuck by its quantum q: noise of standard deviation σ about a constant
value repeats a code with a probability of at most p = erf(q / (2√2 σ)), so m times in succession with at most pᵐ. At n
measurements a day, a run of m ≥ ln n / -ln p repetitions occurs less than once a day.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from .compiled.context import circular_rows, context_type, sensor_rows
from .model.parts import RATE_NOISE_STDS, Stuck
from .model.state_space import StateSpaceModel
from .numerics.jit import F1, embedded, floats, i64, inlined, ints, linkable_embedded
from .numerics.linalg import wrap
from .track import DUPLICATE, RANGE, RATE, REASONS, REPEATED, SATURATED

DAY = 86400.0

# Sensor: number of measurements, time of the first, and time of the one that later ones may duplicate.
_COUNT, _FIRST, _ORIGINAL = range(3)
SENSOR = 3
"""Numbers in the state for each sensor."""

# Row: the value that may be duplicated; the last one within all limits, and its time; value, begin and length of the
# run of equal values.
_VALUE, _KEPT, _KEPT_AT, _RUN, _RUN_BEGAN, _RUN_LENGTH = range(6)
ROW = 6
"""Numbers in the state for each row."""


_LOW, _HIGH, _CLIP_LOW, _CLIP_HIGH, _RATE, _SLACK, _HALF, _REPETITIONS, _LASTING, _SURPRISE = range(10)
COLUMNS = 10
"""Columns of the limits: lowest and highest value; values at which the converter clips; rate, units per second, and
slack, units; half the quantum; repetitions and seconds of a stuck run, infinite where the surprise -ln p decides, 0
where it does not."""


def limits_of(model: StateSpaceModel) -> dict[str, np.ndarray]:
    """Return the entries of these checks in a filter's context.

    Returns:
        `limits` (rows, COLUMNS); `limited` (sensors,), whether a sensor has limits of its values; `duplicates`
        (sensors,), ns within which equal measurements are duplicates.
    """
    count, rows = len(model.sensors), len(model.row_names)
    limits = np.tile([-np.inf, np.inf, -np.inf, np.inf, np.inf, 0.0, 0.0, np.inf, np.inf, 0.0], (rows, 1))
    limited, duplicates = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for k, sensor in enumerate(model.sensors):
        given = sensor.limits
        if given is None:
            continue
        own = limits[model.row_start[k] : model.row_start[k] + len(sensor.rows)]
        std = np.sqrt([row.variance for row in sensor.rows])
        duplicates[k] = round(given.duplicates * 1e9)
        limited[k] = bool(given.range or given.saturation or given.rate or given.stuck)
        if given.range:
            own[:, [_LOW, _HIGH]] = given.range
        if given.saturation:
            own[:, [_CLIP_LOW, _CLIP_HIGH]] = given.saturation
        if given.rate:
            own[:, _RATE], own[:, _SLACK] = given.rate, RATE_NOISE_STDS * std
        if given.stuck is not None:
            _be_stuck(own, given.stuck, std)
    return {"limits": limits, "limited": limited, "duplicates": duplicates}


def _be_stuck(own: np.ndarray, stuck: Stuck, std: np.ndarray) -> None:
    quantum = np.broadcast_to(np.array(stuck.quantum or (0.0,)), std.shape)
    own[:, _HALF] = 0.5 * quantum
    if stuck.readings is not None:
        own[:, _REPETITIONS] = stuck.readings - 1
    if stuck.seconds is not None:
        own[:, _LASTING] = stuck.seconds
    if stuck.readings is None and stuck.seconds is None:
        sigma = np.broadcast_to(np.array(stuck.std or std), std.shape)
        own[:, _SURPRISE] = [surprise(q, s) for q, s in zip(quantum, sigma, strict=True)]


def surprise(quantum: float, std: float) -> float:
    """Return -ln p of one repetition, p = erf(q / (2√2 σ)); 0 where noise never changes the code."""
    if not std > 0.0:
        return 0.0
    # The complement keeps its digits where p is nearly 1.
    return -math.log1p(-math.erfc(quantum / (math.sqrt(8.0) * std)))


def fresh_screen(model: StateSpaceModel) -> np.ndarray:
    """Return the state before the first event; its times are int64, its other numbers float64."""
    sensors = len(model.sensors)
    state = np.zeros(sensors * SENSOR + len(model.row_names) * ROW)
    each = state[sensors * SENSOR :].reshape(-1, ROW)
    each[:, [_VALUE, _KEPT, _RUN]] = np.nan
    return state


@inlined
def _same(a, b):
    """Return whether two values are equal, or both missing."""
    return a == b or np.isnan(a) and np.isnan(b)


@inlined
def _is_duplicate(now, y, s, first, count, within, begin, state, times):
    """Return whether a measurement repeats the one before within the time in which it counts as a duplicate."""
    own = s * SENSOR
    if state[own + _COUNT] == 0.0 or now - times[own + _ORIGINAL] > within:
        return False
    for k in range(count):
        if not _same(y[k], state[begin + (first + k) * ROW + _VALUE]):
            return False
    return True


@embedded
def _repeats(now, y, at, a_day, limit, state, times):
    """Return whether a row has repeated its value for too long."""
    if not np.isfinite(state[at + _RUN]) or abs(y - state[at + _RUN]) > limit[_HALF]:
        state[at + _RUN], state[at + _RUN_LENGTH] = y, 0.0
        times[at + _RUN_BEGAN] = now
        return False
    state[at + _RUN_LENGTH] += 1.0
    length = state[at + _RUN_LENGTH]
    if length >= limit[_REPETITIONS] or (now - times[at + _RUN_BEGAN]) * 1e-9 >= limit[_LASTING]:
        return True
    return limit[_SURPRISE] > 0.0 and length * limit[_SURPRISE] >= math.log(max(a_day, math.e))


@embedded
def _reasons(now, y, circular, at, a_day, limit, state, times):
    """Return the bits of the limits that a row of a measurement violates."""
    bits = 0
    if y < limit[_LOW] or y > limit[_HIGH]:
        bits |= RANGE
    if y <= limit[_CLIP_LOW] or y >= limit[_CLIP_HIGH]:
        bits |= SATURATED
    if np.isfinite(limit[_RATE]) and np.isfinite(state[at + _KEPT]):
        change = y - state[at + _KEPT]
        if circular != 0:
            change = wrap(change)
        if abs(change) > limit[_RATE] * (now - times[at + _KEPT_AT]) * 1e-9 + limit[_SLACK]:
            bits |= RATE
    if _repeats(now, y, at, a_day, limit, state, times):
        bits |= REPEATED
    if bits == 0:
        state[at + _KEPT] = y
        times[at + _KEPT_AT] = now
    return bits


@linkable_embedded
def screen_reading(i, now, s, y, context, state, screened):
    """Fill row i of `screened` (N, ny) with the bits of the limits that each row of measurement y violates.

    `state` evolves with the measurements, so the result does not depend on the pieces of a fold.

    Returns:
        Whether any row is rejected.
    """
    times = ints(state.ctypes.data, state.size)
    begin = context.n_sensors * SENSOR
    first, count = sensor_rows(context, s)
    own = s * SENSOR
    within = ints(context.duplicates, context.n_sensors)[s]
    if _is_duplicate(now, y, s, first, count, within, begin, state, times):
        copied = False
        for k in range(count):
            if not np.isnan(y[k]):
                screened[i, k] = DUPLICATE
                copied = True
        return copied
    if state[own + _COUNT] == 0.0:
        times[own + _FIRST] = now
    times[own + _ORIGINAL] = now
    elapsed = (now - times[own + _FIRST]) * 1e-9
    a_day = DAY * state[own + _COUNT] / elapsed if elapsed > 0.0 else np.inf
    state[own + _COUNT] += 1.0
    limited = ints(context.limited, context.n_sensors)[s] != 0
    refused = False
    for k in range(count):
        at = begin + (first + k) * ROW
        state[at + _VALUE] = y[k]
        if limited and not np.isnan(y[k]):
            limit = floats(context.limits + 8 * (first + k) * COLUMNS, COLUMNS)
            bits = _reasons(now, y[k], circular_rows(context, s)[k], at, a_day, limit, state, times)
            screened[i, k] = bits
            refused |= bits != 0
    return refused


B2 = types.int8[:, ::1]
screen_signature = types.boolean(i64, i64, i64, F1, context_type, F1, B2)


def reasons_by_sensor(sensors: int, channel: np.ndarray, screened: np.ndarray) -> np.ndarray:
    """Count the measurements of a track that were rejected, in whole or in part, by reason, (sensors, reasons)."""
    rows = np.flatnonzero(screened.any(axis=1))
    bits = np.bitwise_or.reduce(screened[rows], axis=1)
    counts = [np.bincount(channel[rows[bits & (1 << k) != 0]], minlength=sensors) for k in range(len(REASONS))]
    return np.stack(counts, axis=1)


@linkable_embedded
def pass_on(value, screened, i, out):
    """Copy measurement i to `out` with NaN in the rejected rows; return whether any row is left."""
    left = False
    for k in range(out.size):
        out[k] = value[i, k]
        if k < screened.shape[1]:
            if screened[i, k] != 0:
                out[k] = np.nan
            elif np.isfinite(out[k]):
                left = True
    return left
