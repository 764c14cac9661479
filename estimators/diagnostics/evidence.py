"""Evidence against the filter: a bank of sequential tests on the standardised innovations of every sensor row.

Under the model the standardised innovations e of a row are N(0, 1) and white. Each way of being wrong is another
density of e given the one before, and the cumulated log-likelihood ratio tests it:

    W ← min(max(W, 0) + log Λ, cap);  alarm when W ≥ h,  over when W < 0.85 h

With h = log(readings between false alarms × tests) the mean time between false alarms of the whole bank is at least
what was asked for, whatever is wrong and however long it lasts. The test that speaks names the cause.

Where a tuning was accepted although its innovations are not white (recordings of real assets never leave white ones),
a `baseline` says what was normal then, and e is standardised by that first: bias, scale and correlation are taken out,
and each test's threshold is raised by the highest W that the accepted data reached.

Sources: Page (1954), doi:10.1093/biomet/41.1-2.100; Lorden (1971), doi:10.1214/aoms/1177693055, for the bound on false
alarms; Basseville & Nikiforov (1993), Detection of Abrupt Changes, chapter 2; Shin, Ramdas & Rinaldo (2024),
doi:10.51387/23-NEJSDS51.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..compiled.context import circular_states, sensor_rows, sensor_variances
from ..log import INPUT, READING, RESET, TRUTH
from ..model.state_space import StateSpaceModel
from ..numerics.jit import borrowed, borrowed_rows, floats, inlined, ints, jit
from ..numerics.linalg import wrap
from ..track import (
    DEGRADED,
    DIVERGED,
    DUPLICATE,
    FAILED,
    GATED,
    SCREENED,
    STALE,
    SUSPECT,
    TRACKING,
    USED,
    WAITING,
    borrowed_columns,
)

CAUSES = (
    "narrow", "wide", "high", "low", "correlated", "alternating", "spiky", "refused", "stuck", "disagreeing",
    "agreeing", "missed",
)  # fmt: skip
"""What a test says of a row: its bands are too narrow or too wide; it reads high or low; its innovations are
correlated, or change sign; spikes; the gate refuses it; it repeats itself; the rows of one sensor contradict each
other, or are closer than their noise; the truth that was told is outside the band. Bits of `Track.alarms`, in this
order."""

NARROW, WIDE, HIGH, LOW, CORRELATED, ALTERNATING, SPIKY, REFUSED, STUCK, DISAGREEING, AGREEING, MISSED = (
    1 << k for k in range(len(CAUSES))
)

LOST = REFUSED | STUCK
"""Causes for which a sensor tells nothing more."""

IMPOVERISHED, OUTSIDE, TRUTH_MISSED = 1 << 59, 1 << 60, 1 << 61
"""Bits of `Track.flags` beside those of the sensors that are silent: a few particles carry the estimate; outside the
range in which the model was fitted; the truth that was told is missed."""

SENSORS = 58
"""Sensors that have a bit of their own in `Track.flags`; the others share the last."""

LEARNT = 16.0
"""Readings of a sensor from which on its period is known; before, it is silent the later the fewer there are."""

SCALES = (1.5, 2.5, 6.0, 0.6, 0.3, 0.05)
"""Variances of e that are tested."""

SHIFTS = (0.2, 0.5, 1.5, -0.2, -0.5, -1.5)
"""Means of e that are tested, in standard deviations."""

CORRELATIONS = (0.25, 0.6, -0.25, -0.6)
"""Lag-1 correlations of e that are tested, at unit variance."""

SPIKE_SHARES, SPIKE = (0.03, 0.003), 5.0
"""Spikes: these shares of e have so many standard deviations."""

CALM, FAR_OUT = 500, 3.5
"""Readings without an |e| beyond this after which spikes are forgotten: they say little of what comes long after."""

RARE = 1
"""The share that counts only while no other test of the row but the one before it is in alarm."""


REFUSED_SHARE = 0.3
"""Share of refused readings that is tested against what the gate refuses by chance."""

FURTHEST = 6.0
"""|e| beyond which it counts as this: what is further off says no more."""

REPEATING = 0.999
"""Probability that a sensor which is stuck repeats its last value."""

UNKNOWN_QUANTUM = 0.5
"""Probability of a repeated value that is granted to a sensor which has never changed: its quantum is not known yet."""

SPARE = 1.0
"""By which W may pass its threshold, so that it falls again when the cause has gone."""

LASTING = 0.85
"""Share of the threshold above which an alarm lasts."""

MISSES, MISSES_NO_MORE = 4.5, 3.0
"""Root mean square of (estimate - truth) / σ, over about `TOLD` tellings, from which a truth is missed, and no more."""

TOLD = 10

FEW_PARTICLES = 4.0
"""Effective sample size below which a cloud is poor; it is too if all of it descends from one particle."""

PATIENCE = 60
"""Readings more, poor than not, from which a cloud is impoverished; it is no more at half as many. Three times as many
as lie between two counts of ancestors: of a sound cloud a count may be 1 by chance, hardly three in a row."""

_QUADRATIC = len(SCALES) + len(SHIFTS) + len(CORRELATIONS)
TESTS = _QUADRATIC + len(SPIKE_SHARES) + 2
"""Tests of a row: the quadratic ones, spikes, refusals, repetition."""

_OTHER = math.log((1.0 - REPEATING) / (1.0 - UNKNOWN_QUANTUM))

AT_SPIKES = _QUADRATIC
AT_REFUSALS, AT_REPETITION = range(TESTS - 2, TESTS)

JOINT = len(SCALES)
"""Tests of all rows of a sensor together, by its NIS: that of their scale."""


def _ratios() -> np.ndarray:
    """Coefficients (tests, 5): log Λ = a e² + b e e₋ + c e₋² + d e + f, where e₋ is the one before."""
    rows = [(0.5 - 0.5 / v, 0.0, 0.0, 0.0, -0.5 * math.log(v)) for v in SCALES]
    rows += [(0.0, 0.0, 0.0, m, -0.5 * m * m) for m in SHIFTS]
    for phi in CORRELATIONS:
        rest = 1.0 - phi * phi
        rows.append((0.5 - 0.5 / rest, phi / rest, -0.5 * phi * phi / rest, 0.0, -0.5 * math.log(rest)))
    return np.array(rows)


_RATIOS = _ratios()
_SPIKE_STEPS = 64.0
_SQUARES = np.arange(FURTHEST**2 * _SPIKE_STEPS + 2.0) / _SPIKE_STEPS
_SPIKE_RATIO = np.log1p(
    np.array(SPIKE_SHARES)[:, None] * (np.exp(0.5 * _SQUARES * (1.0 - 1.0 / SPIKE**2)) / SPIKE - 1.0)
)
"""log Λ of spikes, for each share, at so many e² a step, between which it is nearly straight (to 1e-5)."""

BITS = np.array(
    [
        *[NARROW] * 3,
        *[WIDE] * 3,
        *[HIGH] * 3,
        *[LOW] * 3,
        *[CORRELATED] * 2,
        *[ALTERNATING] * 2,
        *[SPIKY] * 2,
        REFUSED,
        STUCK,
    ]
)

# A row's part of the state: its tests' W, then these.
_MASK, _RAW, _BEFORE, _VALUE, _QUANTUM, _RUN, _EQUAL, _COUNTED, _CALM = range(TESTS, TESTS + 9)
ROW = TESTS + 9
"""Numbers in the state for each row."""

# A sensor's part: W of the joint tests, then these.
_COUNT, _FIRST, _LAST, _LONGEST, _THRESHOLD, _DUE, _SILENT, _ALL = range(JOINT, JOINT + 8)
SENSOR = JOINT + 8
"""Numbers in the state for each sensor."""

# The twin's part.
_SUSPECTS, _GONE, _NEXT_DUE, _BEGUN, _HEARD, _MISSED, _QUIET, _POOR, _IMPOVERISHED = range(9)
TWIN = 9

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
        `baseline` (rows, 3 + TESTS); `ranges` (shown + inputs, 2) in which the model was fitted, and `fitted`, 1 if
        there is any; `column` (nx,) of a state in the track, or -1; `expected` (sensors,); `chances` (2,), log Λ of a
        refused and of an accepted reading; `marginal`; `n_tests` in all.
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
    return float(state[TWIN + s * SENSOR + _THRESHOLD])


def fresh(model: StateSpaceModel) -> np.ndarray:
    """The bank's state before the first event."""
    rows, sensors = len(model.row_names), len(model.sensors)
    state = np.zeros(TWIN + sensors * SENSOR + rows * ROW + len(model.shown) * STATE + model.nu)
    state[_NEXT_DUE], state[_BEGUN] = np.inf, np.nan
    for s in range(sensors):
        state[TWIN + s * SENSOR + _DUE] = np.inf
    for k in range(rows):
        own = state[TWIN + sensors * SENSOR + k * ROW :]
        own[_RAW] = own[_BEFORE] = own[_VALUE] = np.nan
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
    return each[:, _MASK].astype(int), own[:, _ALL].astype(int), own[:, _SILENT] > 0.0


def heard_last(model: StateSpaceModel, state: np.ndarray) -> np.ndarray:
    """When each sensor spoke last, s (sensors,); NaN for one that has not."""
    own = state[TWIN : TWIN + len(model.sensors) * SENSOR].reshape(-1, SENSOR)
    return np.where(own[:, _COUNT] > 0.0, own[:, _LAST], np.nan)


@inlined
def _sensor(state, s):
    """The part of sensor s."""
    return floats(state.ctypes.data + 8 * (TWIN + s * SENSOR), SENSOR)


@inlined
def _row(state, sensors, row):
    """The part of a row."""
    return floats(state.ctypes.data + 8 * (TWIN + sensors * SENSOR + row * ROW), ROW)


@inlined
def _add(W, k, ratio, h, peak):
    """Put log Λ of one more reading to test k; 2 where it is in alarm, 1 where an alarm may last, else 0.

    One reading alone never speaks: what an outlier is worth is half a threshold at most.
    """
    threshold = h + peak
    W[k] = min(max(W[k], 0.0) + min(ratio, 0.5 * h), threshold + SPARE)
    if W[k] >= threshold:
        return 2
    return 1 if W[k] >= LASTING * threshold else 0


@inlined
def _alarm(said, bit, before):
    """The bit, if a test that said so is in alarm: since now, or still."""
    return bit if said == 2 or said == 1 and before & bit != 0 else 0


@inlined
def _spike_ratio(share, square):
    """log Λ of spikes against none, from e²."""
    at = square * _SPIKE_STEPS
    k = int(at)
    low, high = _SPIKE_RATIO[share, k], _SPIKE_RATIO[share, k + 1]
    return low + (at - k) * (high - low)


@jit
def _weigh(own, e, h, base, before):
    """Put one standardised innovation to the tests of its row; the causes that are in alarm."""
    raw = min(max((e - base[0]) / base[1], -FURTHEST), FURTHEST)
    phi = base[2]
    white = raw
    if phi != 0.0 and np.isfinite(own[_RAW]):
        white = (raw - phi * own[_RAW]) / math.sqrt(1.0 - phi * phi)
        white = min(max(white, -FURTHEST), FURTHEST)
    own[_RAW] = raw
    last = own[_BEFORE]
    # Of the first there is nothing that it could be correlated with.
    tests = _QUADRATIC
    if not np.isfinite(last):
        last = 0.0
        tests -= len(CORRELATIONS)
    own[_BEFORE] = white
    square, product, old = white * white, white * last, last * last
    highest = -1.0
    for k in range(tests):
        ratio = (
            _RATIOS[k, 0] * square
            + _RATIOS[k, 1] * product
            + _RATIOS[k, 2] * old
            + _RATIOS[k, 3] * white
            + _RATIOS[k, 4]
        )
        W = min(max(own[k], 0.0) + min(ratio, 0.5 * h), h + base[3 + k] + SPARE)
        own[k] = W
        highest = max(highest, W - LASTING * base[3 + k])
    mask = 0
    if highest >= LASTING * h:
        for k in range(tests):
            threshold = h + base[3 + k]
            if own[k] >= threshold or own[k] >= LASTING * threshold and before & BITS[k] != 0:
                mask |= BITS[k]
    own[_CALM] = 0.0 if abs(white) > FAR_OUT else own[_CALM] + 1.0
    for k in range(len(SPIKE_SHARES)):
        if own[_CALM] >= CALM:
            own[AT_SPIKES + k] = 0.0
        # What is far off while something else is wrong is no rare spike.
        if k == RARE and mask & ~SPIKY != 0:
            own[AT_SPIKES + k] = 0.0
            continue
        said = _add(own, AT_SPIKES + k, _spike_ratio(k, square), h, base[3 + AT_SPIKES + k])
        mask |= _alarm(said, SPIKY, before)
    return mask


@jit
def _repeat(own, y, r, h, base, before):
    """Put a value to the test of repetition.

    Two readings of standard deviation σ, rounded to a quantum q, are equal with a probability of erf(q / 2σ) at most,
    whatever was measured; q is the smallest step that the sensor has ever made. An asset at rest repeats itself more
    often: the share of its repetitions so far, but for those of the present run, counts if it is larger.
    """
    last = own[_VALUE]
    own[_VALUE] = y
    if not np.isfinite(last):
        return 0
    if y == last:
        own[_RUN] += 1.0
        chance = UNKNOWN_QUANTUM
        if own[_QUANTUM] > 0.0 and r > 0.0:
            chance = max(math.erf(0.5 * own[_QUANTUM] / math.sqrt(r)), 0.01, own[_EQUAL] / own[_COUNTED])
        ratio = math.log(REPEATING / min(chance, REPEATING))
    else:
        step = abs(y - last)
        if own[_QUANTUM] == 0.0 or step < own[_QUANTUM]:
            own[_QUANTUM] = step
        own[_EQUAL] += own[_RUN]
        own[_COUNTED] += own[_RUN] + 1.0
        own[_RUN] = 0.0
        ratio = _OTHER - h
    return _alarm(_add(own, AT_REPETITION, ratio, h, base[3 + AT_REPETITION]), STUCK, before)


@jit
def highest(e, refused, y, r, h, base, chances):
    """The highest W of each test of a row, (TESTS,), over its readings: thresholds that are infinite never cut it.

    `refused` (n,): 1 where the gate refused it, 0 where it did not, -1 where it had no say.
    """
    own = np.zeros(ROW)
    own[_RAW] = own[_BEFORE] = own[_VALUE] = np.nan
    found = np.zeros(TESTS)
    for i in range(e.size):
        if np.isfinite(y[i]):
            _repeat(own, y[i], r, h, base, 0)
        if refused[i] >= 0:
            _add(own, AT_REFUSALS, chances[1 - refused[i]], h, base[3 + AT_REFUSALS])
        if np.isfinite(e[i]):
            _weigh(own, e[i], h, base, 0)
        for k in range(TESTS):
            found[k] = max(found[k], own[k])
    return found


@jit
def _weigh_together(own, nis, dof, h, before):
    """Put the NIS of a sensor with several rows to the tests of their common scale: χ² with dof under the model.

    Where something else than white innovations was normal there is no such test.
    """
    mask = 0
    for k in range(JOINT):
        c = _RATIOS[k]
        bit = DISAGREEING if k < 3 else AGREEING
        ratio = c[0] * min(nis, dof * FURTHEST * FURTHEST) + dof * c[4]
        mask |= _alarm(_add(own, k, ratio, h, 0.0), bit, before)
    return mask


@jit
def _time(own, now, every, tests, policy):
    """Note that a sensor has spoken: its period, its threshold, and when it will be silent."""
    count = own[_COUNT]
    if count == 0.0:
        own[_FIRST] = now
    else:
        own[_LONGEST] = max(own[_LONGEST], now - own[_LAST])
    own[_LAST] = now
    own[_COUNT] = count + 1.0
    n = int(own[_COUNT])
    period = (now - own[_FIRST]) / count if count > 0.0 else 0.0
    if n <= 16 or n & (n - 1) == 0:
        # The rate of a sensor is known better and better; the threshold follows it in ever wider steps.
        own[_THRESHOLD] = max(math.log(every / max(period, 1e-3) * tests), math.log(8.0 * tests))
    # A mean of few gaps is no period yet: of three readings that begin in haste the next is no silence.
    usual = policy.silent_periods * period
    patience = max(usual, min(usual * LEARNT / n, policy.stale_after))
    own[_DUE] = now + max(patience, 2.0 * own[_LONGEST]) if n > 2 else np.inf
    own[_SILENT] = 0.0


@jit
def _listen(state, sensors, now):
    """Which sensors are silent; from when on the next will be."""
    due = np.inf
    for s in range(sensors):
        own = _sensor(state, s)
        if now > own[_DUE]:
            state[_QUIET] += 1.0 - own[_SILENT]
            own[_SILENT] = 1.0
        elif own[_DUE] < due:
            due = own[_DUE]
    state[_NEXT_DUE] = due


@jit
def _miss(own, z, before):
    """Whether the truth of a state is missed, after another error of z standard deviations."""
    own[1] = min(own[1] + 1.0, TOLD)
    own[0] += (min(z * z, 1e4) - own[0]) / own[1]
    if own[1] == TOLD and own[0] > MISSES * MISSES:
        return MISSED
    return MISSED if before and own[0] > MISSES_NO_MORE * MISSES_NO_MORE else 0


@jit
def _forget(state, sensors, rows, states):
    """A reset: what the readings said of the estimate before, they do not say of the new one."""
    for s in range(sensors):
        own = _sensor(state, s)
        own[_ALL] = 0.0
        own[:JOINT] = 0.0
    for k in range(rows):
        own = _row(state, sensors, k)
        own[:TESTS] = 0.0
        own[_MASK] = own[_CALM] = 0.0
        own[_RAW] = own[_BEFORE] = np.nan
    begin = TWIN + sensors * SENSOR + rows * ROW
    state[begin : begin + states * STATE] = 0.0
    state[_SUSPECTS] = state[_GONE] = state[_MISSED] = state[_POOR] = state[_IMPOVERISHED] = 0.0


@inlined
def _is_copy(i, track):
    """Whether a reading came before: the copies that a gateway makes say nothing for or against anyone."""
    for k in range(track.screened.shape[1]):
        if track.screened[i, k] & DUPLICATE != 0:
            return True
    return False


@jit
def _hear(i, now, y, s, context, policy, state, track):
    """Put a reading y of sensor s, and the variances that it may have brought, to all tests."""
    width = track.alarms.shape[1]
    sensors = context.n_sensors
    chances = floats(context.chances, 2)
    variances = sensor_variances(context, s)
    first, count = sensor_rows(context, s)
    own = _sensor(state, s)
    state[_QUIET] -= own[_SILENT]
    _time(own, now, policy.false_alarm_every, context.n_tests, policy)
    state[_NEXT_DUE] = min(state[_NEXT_DUE], own[_DUE])
    h = own[_THRESHOLD]
    verdict = track.verdict[i]
    judged = verdict == USED or verdict == GATED
    together = 0
    base = floats(context.baseline + 8 * first * (3 + TESTS), 3)
    white = base[0] == 0.0 and base[1] == 1.0 and base[2] == 0.0
    if judged and context.marginal == 0 and count > 1 and white:
        together = _weigh_together(own, track.nis[i], track.dof[i], h, int(own[_ALL]))
        own[_ALL] = together
    for k in range(count):
        if not np.isfinite(y[k]):
            continue
        row = first + k
        each = _row(state, sensors, row)
        before = int(each[_MASK])
        base = floats(context.baseline + 8 * row * (3 + TESTS), 3 + TESTS)
        r = variances[k]
        if width + k < y.size and np.isfinite(y[width + k]):
            r = y[width + k]
        mask = before & ~STUCK | _repeat(each, y[k], r, h, base, before)
        screened = track.screened[i, k] != 0
        if judged or verdict == FAILED or screened:
            ratio = chances[1] if verdict == USED and not screened else chances[0]
            said = _add(each, AT_REFUSALS, ratio, h, base[3 + AT_REFUSALS])
            mask = mask & ~REFUSED | _alarm(said, REFUSED, before)
        if judged and not screened:
            # A prediction that is not Gaussian says nothing where its distribution function is not known.
            e = track.whitened[i, k]
            if context.marginal == 0:
                e = track.innovation[i, k] / track.innovation_std[i, k]
            if np.isfinite(e):
                mask = mask & LOST | _weigh(each, e, h, base, before)
        if k == 0:
            mask = mask & ~(DISAGREEING | AGREEING) | int(own[_ALL])
        each[_MASK] = mask
        track.alarms[i, k] = mask
        state[_SUSPECTS] += (mask != 0) - (before != 0)
        state[_GONE] += (mask & LOST != 0) - (before & LOST != 0)


@jit
def _count_particles(effective, ancestors, state):
    """Whether a cloud is impoverished, after another reading that it used."""
    if effective < FEW_PARTICLES or ancestors < 2.0:
        state[_POOR] = min(state[_POOR] + 1.0, float(PATIENCE))
    else:
        state[_POOR] = max(state[_POOR] - 1.0, 0.0)
    if state[_POOR] == PATIENCE:
        state[_IMPOVERISHED] = 1.0
    elif state[_POOR] <= PATIENCE // 2:
        state[_IMPOVERISHED] = 0.0


@jit
def _tell(i, first, truth, context, state, track):
    """Compare the estimate with the truth of some states, from `first` on."""
    begin = TWIN + context.n_sensors * SENSOR + context.n_rows * ROW
    columns, circular = ints(context.column, context.nx), circular_states(context)
    for k in range(truth.size):
        if not np.isfinite(truth[k]):
            continue
        column = columns[first + k]
        if column < 0 or not track.std[i, column] > 0.0:
            continue
        error = track.mean[i, column] - truth[k]
        if circular[first + k] != 0:
            error = wrap(error)
        own = floats(state.ctypes.data + 8 * (begin + column * STATE), STATE)
        before = own[2] != 0.0
        missed = _miss(own, error / track.std[i, column], before)
        own[2] = missed
        track.alarms[i, k] = missed
        state[_MISSED] += (missed != 0) - before


@jit
def _range(i, u, context, track):
    """Whether a state, or an input that holds, is outside the range in which the model was fitted."""
    states = track.mean.shape[1]
    ranges = floats(context.ranges, 2 * (states + u.size))
    for k in range(states + u.size):
        value = track.mean[i, k] if k < states else u[k - states]
        if value < ranges[2 * k] or value > ranges[2 * k + 1]:
            return True
    return False


@jit
def watch_rows(first, last, t, kind, channel, value, context, policy, state, track):
    """Fill alarms, flags and health of rows `first` to `last` of a track, whose other columns are there.

    `state` moves on with them, as a filter's state does with the events, so the outcome does not depend on how a fold
    was cut into pieces.
    """
    sensors, rows, nu = context.n_sensors, context.n_rows, context.nu
    track = borrowed_columns(track)
    value = borrowed_rows(value)
    state = borrowed(state)
    width = track.alarms.shape[1]
    expected = ints(context.expected, sensors)
    u = floats(state.ctypes.data + 8 * (state.size - nu), nu)
    for i in range(first, last):
        now = t[i] * 1e-9
        if not np.isfinite(state[_BEGUN]):
            state[_BEGUN] = now
            for s in range(sensors):
                if expected[s] != 0:
                    _sensor(state, s)[_DUE] = now + policy.stale_after
            state[_NEXT_DUE] = now + policy.stale_after
        for k in range(width):
            track.alarms[i, k] = 0
        if kind[i] == READING:
            if track.verdict[i] != SCREENED:
                state[_HEARD] = 1.0
            if not _is_copy(i, track):
                y = floats(value[i:].ctypes.data, value.shape[1])
                _hear(i, now, y, channel[i], context, policy, state, track)
            if np.isfinite(track.effective[i]):
                _count_particles(track.effective[i], track.ancestors[i], state)
        elif kind[i] == TRUTH:
            truth = floats(value[i:].ctypes.data, min(width, context.nx - channel[i]))
            _tell(i, channel[i], truth, context, state, track)
        elif kind[i] == INPUT:
            for k in range(nu):
                if np.isfinite(value[i, k]):
                    u[k] = value[i, k]
        elif kind[i] == RESET:
            _forget(state, sensors, rows, track.mean.shape[1])
        if now > state[_NEXT_DUE]:
            _listen(state, sensors, now)
        flags = 0
        for s in range(sensors if state[_QUIET] > 0.0 else 0):
            if _sensor(state, s)[_SILENT] != 0.0:
                flags |= 1 << min(s, SENSORS - 1)
        silent = flags
        if context.fitted != 0 and _range(i, u, context, track):
            flags |= OUTSIDE
        if state[_MISSED] > 0.0:
            flags |= TRUTH_MISSED
        if state[_IMPOVERISHED] != 0.0:
            flags |= IMPOVERISHED
        track.flags[i] = flags
        track.health[i] = _health(i, now, silent, flags, state, policy, track)


@jit
def _health(i, now, silent, flags, state, policy, track):
    """The state of the twin after an event."""
    finite = True
    for j in range(track.mean.shape[1]):
        finite &= np.isfinite(track.mean[i, j]) & np.isfinite(track.std[i, j])
    if not finite:
        return DIVERGED
    if state[_HEARD] == 0.0:
        return STALE if now - state[_BEGUN] > policy.stale_after else WAITING
    if track.age[i] > policy.stale_after:
        return STALE
    if track.consistency[i] == DIVERGED:
        return DIVERGED
    if track.age[i] > policy.degraded_after or silent != 0 or state[_GONE] > 0.0:
        return DEGRADED
    if state[_SUSPECTS] > 0.0 or flags != 0:
        return SUSPECT
    return TRACKING
