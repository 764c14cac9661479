"""State of the detectors, one flat array that evolves with the events, and their constants in a filter's context."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..events.batch import READING, Events
from ..model.state_space import StateSpaceModel
from ..numerics.jit import floats, inlined, part
from ..track import HELD_OUT, MISSING, Track
from .detectors import (
    ADVISORY_ALARM,
    AT_REPETITION,
    GAINS,
    JOINT,
    LOST,
    REJECTED_SHARE,
    SENSOR_FLAGS,
    TESTS,
    beyond_range,
)
from .health import HealthPolicy, normal_nis

# Twin: rows in alarm, of which the bands are valid and wider than necessary; rows lost; time at which the next sensor
# drops out; time of the first event, whether a measurement has arrived; sensors that dropped out; measurements more,
# poor than not, of a particle filter, and whether it is impoverished; measurements until divergence is judged after a
# reset.
SUSPECT_ROWS, ADVISED_ROWS, LOST_ROWS, NEXT_DUE, BEGUN, HEARD, SILENT_SENSORS, POOR, POOR_CLOUD, UNSETTLED = range(10)
TWIN = 10

# Sensor: W of the joint tests, then the number of measurements, time of the first and the last, longest gap, threshold
# of the tests, time at which it drops out, whether it has, alarms of the joint tests.
COUNT, FIRST, LAST, LONGEST_GAP, THRESHOLD, DUE, SILENT, JOINT_MASK = range(JOINT, JOINT + 8)
SENSOR = JOINT + 8  # Numbers in the state for each sensor

# Row: W of its tests, then its alarms; the last e, and the same whitened by the baseline; the last value; its
# smallest step; length of the present run of equal values; repeated values, of how many; measurements since the last
# outlier; mean and mean square of the recent e that are no outliers, and their number; grade of the alarms (0,
# `ADVISED` or `ACTED_ON`); innovation that is left after the last update, and its variance; movement that was
# predicted during the present run, the sum of squares of its steps, and their predicted variance; standard deviation
# of the last prediction, of that before a reset, and measurements until the tests begin again after it; the next e
# that each filter of `GAINS` predicts; the share of recent measurements outside their bands, and the number of these.
# The inputs that hold come after the rows, then the memory of the states, if it is followed.
MASK, RAW, WHITE, VALUE, QUANTUM, RUN, EQUAL, COUNTED = range(TESTS, TESTS + 8)
CALM_FOR, MEAN_E, SQUARE_E, KNOWN, GRADE, LEFT, LEFT_VARIANCE = range(TESTS + 8, TESTS + 15)
MOVED, MOVED_SQUARES, MOVED_VARIANCE, LAST_STD, STD_BEFORE, RESETTING, EXPECTED = range(TESTS + 15, TESTS + 22)
OUT, COUNTED_OUT = EXPECTED + len(GAINS), EXPECTED + len(GAINS) + 1
ROW = EXPECTED + len(GAINS) + 2  # Numbers in the state for each row

ADVISED, ACTED_ON = 1.0, 2.0

SENSOR_STATES = ("waiting", "tracking", "advisory", "suspect", "degraded", "stale", "held out")
"""State of a sensor: no measurement yet; consistent; in alarm, with valid bands; in alarm; dropped out, stuck or
rejected; dropped out for so long that a twin without other sensors would be stale; predicted and scored, never used."""


def no_baseline(model: StateSpaceModel) -> np.ndarray:
    """Return the baseline of white innovations, (rows, 3 + TESTS)."""
    baseline = np.zeros((len(model.row_names), 3 + TESTS))
    baseline[:, 1] = 1.0
    for first, sensor in zip(model.row_start, model.sensors, strict=True):
        if sensor.limits is not None and sensor.limits.rests:
            baseline[first : first + len(sensor.rows), 3 + AT_REPETITION] = np.inf
    return baseline


def detector_context(
    model: StateSpaceModel, gate: float | None, marginal: bool, baseline: np.ndarray, expected: np.ndarray | None = None
) -> dict[str, Any]:
    """Return the detectors' entries of a filter's context.

    Args:
        model: The model.
        gate: Probability that a good measurement passes, or None.
        marginal: Whether predictions are not Gaussian, so that `Track.whitened` holds each row by itself.
        baseline: Bias, scale and correlation of the baseline, and the highest W of each test, (rows, 3 + TESTS).
        expected: Sensors that must report, (sensors,); None for those that have reported. None that reports by chance.

    Returns:
        `baseline` (rows, 3 + TESTS); `normal` (sensors, 3), see `normal_nis`; `ranges` (shown + inputs, 3, 2), of
        `beyond_range`, and physical limits; `fitted`, 1 if there is any; `expected` (sensors,): 1 for one that must
        report, -1 by chance, else 0; `chances` (2,), log Λ of a rejected and of an accepted measurement; `gated`,
        whether outliers are rejected; `marginal`; `n_tests` in all.
    """
    ranges = np.full((len(model.shown) + model.nu, 3, 2), [-np.inf, np.inf])
    for own, state in zip(ranges, model.shown_states, strict=False):
        own[:] = *beyond_range(state), state.limits or own[2]
    for own, item in zip(ranges[len(model.shown) :], model.inputs, strict=True):
        own[:2] = beyond_range(item)
    counts = np.array([len(sensor.rows) for sensor in model.sensors], np.int64)
    by_chance = [sensor.by_chance for sensor in model.sensors]
    return {
        "baseline": np.ascontiguousarray(baseline, float),
        "normal": normal_nis(model, baseline),
        "ranges": ranges,
        "fitted": int(np.any(np.isfinite(ranges))),
        "expected": np.where(by_chance, -1, 0 if expected is None else expected).astype(np.int64),
        "chances": gate_log_ratios(gate),
        "gated": int(gate is not None),
        "marginal": int(marginal),
        "n_tests": int(counts.sum()) * TESTS + int(np.sum(counts > 1)) * JOINT,
    }


def gate_log_ratios(gate: float | None) -> np.ndarray:
    """Return log Λ of a rejected and of an accepted measurement, (2,); `gate`: probability that a good one passes."""
    chance = min(max(1e-6, 1.0 - gate), 0.5 * REJECTED_SHARE) if gate is not None else 0.5 * REJECTED_SHARE
    return np.log([REJECTED_SHARE / chance, (1.0 - REJECTED_SHARE) / (1.0 - chance)])


def threshold_of(model: StateSpaceModel, state: np.ndarray, s: int) -> float:
    """Return the present threshold h of the tests of sensor s."""
    return float(state[TWIN + s * SENSOR + THRESHOLD])


def fresh(model: StateSpaceModel, memory: np.ndarray | None = None) -> np.ndarray:
    """Return the state before the first event, with that of the states' memory (`memory.py`) if it is followed."""
    rows, sensors = len(model.row_names), len(model.sensors)
    state = np.zeros(TWIN + sensors * SENSOR + rows * ROW)
    state[NEXT_DUE], state[BEGUN] = np.inf, np.nan
    _sensors(model, state)[:, DUE] = np.inf
    _rows(model, state)[:, [RAW, WHITE, VALUE, LEFT]] = np.nan
    return np.concatenate((state, model.default_inputs, () if memory is None else memory))


def _sensors(model: StateSpaceModel, state: np.ndarray) -> np.ndarray:
    return state[TWIN : TWIN + len(model.sensors) * SENSOR].reshape(-1, SENSOR)


def _rows(model: StateSpaceModel, state: np.ndarray) -> np.ndarray:
    begin = TWIN + len(model.sensors) * SENSOR
    return state[begin : begin + len(model.row_names) * ROW].reshape(-1, ROW)


def sensor_states(
    model: StateSpaceModel, used: np.ndarray, state: np.ndarray, now: float, policy: HealthPolicy
) -> dict[str, str]:
    """Return the present state of each sensor by its name, one of `SENSOR_STATES`.

    Args:
        model: The model.
        used: Which sensors are used, (sensors,) of bool.
        state: State of the detectors.
        now: Time of the last event, s.
        policy: Limits of the twin's health.
    """
    own, rows = _sensors(model, state), _rows(model, state)
    masks = np.bitwise_or.reduceat(rows[:, MASK].astype(int), model.row_start)
    grades = np.maximum.reduceat(rows[:, GRADE], model.row_start)
    alarms = masks | own[:, JOINT_MASK].astype(int)
    silent, heard = own[:, SILENT] > 0.0, own[:, COUNT] > 0.0
    cases = {
        "held out": ~used,
        "stale": silent & heard & (now - own[:, LAST] > policy.stale_after),
        "degraded": silent | heard & (alarms & LOST != 0),
        "waiting": ~heard,
        "suspect": grades == ACTED_ON,
        "advisory": alarms != 0,
    }
    words = np.select(list(cases.values()), list(cases), "tracking")
    return dict(zip(model.sensor_names, words.tolist(), strict=True))


def sensor_states_over_time(events: Events, track: Track, s: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the state of sensor s over time, as far as single rows show it: a stale sensor is degraded here.

    Returns:
        Indices of the rows that concern the sensor, ascending (k,), and indices into `SENSOR_STATES` (k,).
    """
    silent = track.flags >> s & 1 != 0 if s < SENSOR_FLAGS else np.zeros(len(events), bool)
    reported = (events.kind == READING) & (events.channel == s) & (track.verdict != MISSING)
    rows = np.flatnonzero(silent | reported)
    own = track.alarms[rows] * reported[rows, None]
    lost, acted_on = (own & LOST != 0).any(axis=1), ((own != 0) & (own & ADVISORY_ALARM == 0)).any(axis=1)
    cases = (track.verdict[rows] == HELD_OUT, silent[rows] | lost, acted_on, own.any(axis=1))
    words = [SENSOR_STATES.index(word) for word in ("held out", "degraded", "suspect", "advisory")]
    return rows, np.select(cases, words, SENSOR_STATES.index("tracking"))


@inlined
def sensor_part(state, s):
    """Return the slice of sensor s."""
    return floats(state.ctypes.data + 8 * (TWIN + s * SENSOR), SENSOR)


@inlined
def row_part(state, sensors, row):
    """Return the slice of a sensor row."""
    return floats(state.ctypes.data + 8 * (TWIN + sensors * SENSOR + row * ROW), ROW)


@part
def forget(state, sensors, rows, window):
    """Clear the evidence at a reset: measurements before it concern another estimate.

    The tests of a row begin again when the prior no longer dominates its predictions, after `window` measurements at
    the latest; divergence is judged again after `window` measurements.
    """
    for s in range(sensors):
        own = sensor_part(state, s)
        own[JOINT_MASK] = 0.0
        own[:JOINT] = 0.0
    for k in range(rows):
        own = row_part(state, sensors, k)
        own[:TESTS] = 0.0
        own[MASK] = 0.0
        before = own[STD_BEFORE] if own[RESETTING] > 0.0 else own[LAST_STD]
        own[CALM_FOR:ROW] = 0.0
        own[STD_BEFORE] = before
        own[RESETTING] = float(window) if before > 0.0 else 0.0
        own[RAW] = own[WHITE] = own[LEFT] = np.nan
    state[SUSPECT_ROWS] = state[ADVISED_ROWS] = state[LOST_ROWS] = state[POOR] = state[POOR_CLOUD] = 0.0
    state[UNSETTLED] = float(window)
