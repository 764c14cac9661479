"""The bank: what it finds in a filter's context, and its state, one flat array as a filter's is."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...model.state_space import StateSpaceModel
from ...numerics.jit import floats, inlined, part
from ..normal_nis import normal_nis
from .hypotheses import GAINS, JOINT, REFUSED_SHARE, TESTS

# The twin's part of the state: rows in alarm and lost; when the next sensor will be silent; when the log began, whether
# a reading came; states whose truth is missed; sensors that are silent; readings more, poor than not, of a cloud of
# particles, and whether it is impoverished.
SUSPECT_ROWS, LOST_ROWS, NEXT_DUE, BEGUN, HEARD, MISSED_STATES, SILENT_SENSORS, POOR, POOR_CLOUD = range(9)
TWIN = 9

# A sensor's part: W of the joint tests, then readings, times of the first and the last, the longest silence between
# two, the tests' threshold, when it will be silent, whether it is, and what the joint tests say.
COUNT, FIRST, LAST, LONGEST, THRESHOLD, DUE, SILENT, TOGETHER = range(JOINT, JOINT + 8)
SENSOR = JOINT + 8
"""Numbers in the state for each sensor."""

# A row's part: W of its tests, then what they say; the last e, and the same without what was normal; the last value;
# its smallest step; how often it stands there already; how often values were repeated, of how many; readings since the
# last one far out; what is expected of the next e by each filter that follows noise.
MASK, RAW, WHITE, VALUE, QUANTUM, RUN, EQUAL, COUNTED, CALM_FOR, EXPECTED = range(TESTS, TESTS + 10)
ROW = EXPECTED + len(GAINS)
"""Numbers in the state for each row."""

# A shown state's part: the mean square of its standardised errors, how often it was told, whether it is missed. After
# them the inputs that hold.
STATE = 3


def no_baseline(model: StateSpaceModel) -> np.ndarray:
    """That of white innovations, (rows, 3 + TESTS)."""
    baseline = np.zeros((len(model.row_names), 3 + TESTS))
    baseline[:, 1] = 1.0
    return baseline


def watched(
    model: StateSpaceModel,
    gate: float | None,
    marginal: bool,
    baseline: np.ndarray,
    expected: np.ndarray | None = None,
) -> dict[str, Any]:
    """What the bank finds in a context.

    Args:
        model: The model.
        gate: Probability that a good reading passes, or None.
        marginal: Whether the filter's predictions are not Gaussian, and `Track.whitened` holds each row by itself.
        baseline: Bias, scale and correlation of what was normal, and the highest W of each test, (rows, 3 + TESTS).
        expected: Sensors that must speak, (sensors,); None for those that have spoken.

    Returns:
        `baseline` (rows, 3 + TESTS); `normal` (sensors, 3), see normal_nis.py; `ranges` (shown + inputs, 2) in which
        the model was fitted, and `fitted`, 1 if there is any; `column` (nx,) of a state in the track, or -1; `expected`
        (sensors,); `chances` (2,), log Λ of a refused and of an accepted reading; `marginal`; `n_tests` in all.
    """
    shown = model.shown
    column = np.full(model.nx, -1, np.int64)
    column[shown] = np.arange(len(shown))
    if model.mode >= 0:
        column[model.mode] = -1
    ranges = np.full((len(shown) + model.nu, 2), [-np.inf, np.inf])
    fitted = [item.fitted for item in model.shown_states] + [item.fitted for item in model.inputs]
    for k, given in enumerate(fitted):
        if given is not None:
            ranges[k] = given
    counts = np.array([len(sensor.rows) for sensor in model.sensors], np.int64)
    several = int(np.sum(counts > 1))
    return {
        "baseline": np.ascontiguousarray(baseline, float),
        "normal": normal_nis(model, baseline),
        "ranges": ranges,
        "fitted": int(np.any(np.isfinite(ranges))),
        "column": column,
        "expected": np.zeros(len(counts), np.int64) if expected is None else np.ascontiguousarray(expected, np.int64),
        "chances": chances_of(gate),
        "marginal": int(marginal),
        "n_tests": int(counts.sum()) * TESTS + several * JOINT,
    }


def chances_of(gate: float | None) -> np.ndarray:
    """log Λ of a refused and of an accepted reading, (2,), with a gate that passes a good one with that probability."""
    chance = min(max(1e-6, 1.0 - gate), 0.5 * REFUSED_SHARE) if gate is not None else 0.5 * REFUSED_SHARE
    return np.log([REFUSED_SHARE / chance, (1.0 - REFUSED_SHARE) / (1.0 - chance)])


def threshold_of(model: StateSpaceModel, state: np.ndarray, s: int) -> float:
    """h of a sensor's tests, as its rate has made it by now."""
    return float(state[TWIN + s * SENSOR + THRESHOLD])


def fresh(model: StateSpaceModel) -> np.ndarray:
    """The bank's state before the first event."""
    rows, sensors = len(model.row_names), len(model.sensors)
    state = np.zeros(TWIN + sensors * SENSOR + rows * ROW + len(model.shown) * STATE + model.nu)
    state[NEXT_DUE], state[BEGUN] = np.inf, np.nan
    for s in range(sensors):
        state[TWIN + s * SENSOR + DUE] = np.inf
    for k in range(rows):
        own = state[TWIN + sensors * SENSOR + k * ROW :]
        own[RAW] = own[WHITE] = own[VALUE] = np.nan
    state[state.size - model.nu :] = [item.default for item in model.inputs]
    return state


def causes_now(model: StateSpaceModel, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the bank says at present.

    Returns:
        Bits of causes by sensor row (rows,), those of each sensor as a whole (sensors,), and whether each sensor is
        silent (sensors,).
    """
    rows, sensors = len(model.row_names), len(model.sensors)
    own = state[TWIN : TWIN + sensors * SENSOR].reshape(sensors, SENSOR)
    each = state[TWIN + sensors * SENSOR :][: rows * ROW].reshape(rows, ROW)
    return each[:, MASK].astype(int), own[:, TOGETHER].astype(int), own[:, SILENT] > 0.0


def heard_last(model: StateSpaceModel, state: np.ndarray) -> np.ndarray:
    """When each sensor spoke last, s (sensors,); NaN for one that has not."""
    own = state[TWIN : TWIN + len(model.sensors) * SENSOR].reshape(-1, SENSOR)
    return np.where(own[:, COUNT] > 0.0, own[:, LAST], np.nan)


@inlined
def sensor_part(state, s):
    """The part of sensor s."""
    return floats(state.ctypes.data + 8 * (TWIN + s * SENSOR), SENSOR)


@inlined
def row_part(state, sensors, row):
    """The part of a row."""
    return floats(state.ctypes.data + 8 * (TWIN + sensors * SENSOR + row * ROW), ROW)


@part
def forget(state, sensors, rows, states):
    """A reset: what the readings said of the estimate before, they do not say of the new one."""
    for s in range(sensors):
        own = sensor_part(state, s)
        own[TOGETHER] = 0.0
        own[:JOINT] = 0.0
    for k in range(rows):
        own = row_part(state, sensors, k)
        own[:TESTS] = 0.0
        own[MASK] = own[CALM_FOR] = 0.0
        own[EXPECTED:ROW] = 0.0
        own[RAW] = own[WHITE] = np.nan
    begin = TWIN + sensors * SENSOR + rows * ROW
    state[begin : begin + states * STATE] = 0.0
    state[SUSPECT_ROWS] = state[LOST_ROWS] = state[MISSED_STATES] = state[POOR] = state[POOR_CLOUD] = 0.0
