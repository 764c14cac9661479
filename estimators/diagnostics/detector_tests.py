"""Sequential tests of one sensor row, of all rows of a sensor together, and of its sample times.

Each way in which innovations can be wrong is another density of the standardised innovation e (`detectors.py`), tested
by the accumulated log-likelihood ratio (CUSUM):

    W ← min(max(W, 0) + log Λ, cap);  alarm when W ≥ h,  cleared when W < 0.85 h

With h = log(measurements between false alarms × tests) the mean time between false alarms of all tests together is at
least the requested one, whatever is wrong and however long it lasts. The test in alarm names the cause.

If a tuning was accepted although its innovations are not white, a `baseline` holds their bias, scale and
correlation. e is standardised by it first, and the threshold of each test is raised by the highest W that the accepted
data reached.

Sources: Page (1954), doi:10.1093/biomet/41.1-2.100; Lorden (1971), doi:10.1214/aoms/1177693055, for the bound on false
alarms; Basseville & Nikiforov (1993), Detection of Abrupt Changes, chapter 2; Shin, Ramdas & Rinaldo (2024),
doi:10.51387/23-NEJSDS51.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from ..numerics.jit import embedded, inlined, jit, part
from ..numerics.simd_ir import LANES, Lanes, in_vectors, integer, sizes, vector_code
from .detector_state import (
    ACTED_ON,
    ADVISED,
    CALM_FOR,
    COUNT,
    COUNTED,
    COUNTED_OUT,
    DUE,
    EQUAL,
    EXPECTED,
    FIRST,
    KNOWN,
    LAST,
    LAST_STD,
    LEFT,
    LEFT_VARIANCE,
    LONGEST_GAP,
    MEAN_E,
    MOVED,
    MOVED_SQUARES,
    MOVED_VARIANCE,
    NEXT_DUE,
    OUT,
    QUANTUM,
    RAW,
    RESETTING,
    ROW,
    RUN,
    SILENT,
    SILENT_SENSORS,
    SQUARE_E,
    STD_BEFORE,
    THRESHOLD,
    VALUE,
    WHITE,
    sensor_part,
)
from .detectors import (
    ALTERNATING,
    AT_DENSITIES,
    AT_GAINS,
    AT_REFUSALS,
    AT_REPETITION,
    BITS,
    CONSERVATIVE,
    DENSITIES,
    DENSITY_RATIOS,
    DENSITY_STEPS,
    FADING,
    FOLLOWED,
    GAINS,
    JOINT,
    JOINT_BITS,
    JOINT_RATIOS,
    LAGGED,
    LAGGING,
    MAX_SIGMA,
    NARROW,
    NEW_VALUE,
    OUTLIER_TESTS,
    QUADRATIC,
    RARE_TESTS,
    RATIOS,
    REPEAT_PROBABILITY,
    SHIFTED,
    SPIKY,
    STUCK,
    TESTS,
    UNKNOWN_QUANTUM,
)
from .references import HALF_WIDTH

COEFFICIENTS = np.ascontiguousarray(RATIOS.T)
"""`RATIOS` by coefficient, (5, QUADRATIC)."""

HEADROOM_NATS = 1.0  # Amount by which W may exceed its threshold, so that it falls again when the cause has gone
CLEARING_SHARE = 0.85  # Share of the threshold above which an alarm lasts

CALM_MEASUREMENTS, OUTLIER_FROM = 500, 3.5
"""Measurements without |e| beyond this after which earlier outliers are forgotten."""

KNOWN_PERIOD = 100.0  # Measurements from which the period of a sensor is known; with fewer it may pause for longer

EVIDENT_MOVEMENT, SIGNIFICANT_MOVEMENT, MIN_MOVEMENT_STEPS = 3.0, 4.0, 8.0
"""Movement that a repeated value contradicts: predicted over the run, in quanta or standard deviations of the noise,
whichever is larger; in root sums of squares of its steps, or in its standard deviations after so many steps."""

NOISY_SHARE = 0.04
"""Share of R below which the predicted variance of the change from one measurement to the next makes the sensor's own
noise move it: a repetition is then improbable at rest, too."""

PRIOR_MEASUREMENTS, RECENT_MEASUREMENTS = 20.0, 200.0
"""Measurements for which a mean square of 1 is assumed at first, and over which e is averaged."""

WIDE_SQUARE, COVERED_SQUARE, NORMAL_SQUARE = 0.8, 0.95, 1.3
"""Mean square of the recent e below which bands are wider than necessary, below which they cover the measurements, and
below which they are not too narrow."""

COVERED_S, COVERED_READINGS, COVERED, ONE_SIDED = 600.0, 100.0, 0.9, 1.645
"""Seconds, and at least so many measurements, of which this share must credibly (95 %) lie in the 95 % bands."""

FOLLOWING_SHARE = 0.5  # Share of the estimate's variance in S from which on the estimate follows each measurement

RESET_STD = 1.2
"""Standard deviation of a prediction, relative to that before a reset, from which on the prior dominates it."""


@inlined
def add(W, k, ratio, h, peak):
    """Add log Λ of a measurement to test k; return 2 if it is in alarm, 1 if an alarm may last, else 0.

    A single measurement never raises an alarm: it counts half a threshold at most.
    """
    threshold = h + peak
    W[k] = min(max(W[k], 0.0) + min(ratio, 0.5 * h), threshold + HEADROOM_NATS)
    if W[k] >= threshold:
        return 2
    return 1 if W[k] >= CLEARING_SHARE * threshold else 0


@inlined
def alarm(level, bit, before):
    """Return the bit of a test that is in alarm, from now on or still; 0 otherwise."""
    return bit if level == 2 or level == 1 and before & bit != 0 else 0


@inlined
def _density_ratio(k, e):
    """Return log Λ of density k at e, by linear interpolation."""
    at = (e + MAX_SIGMA) * DENSITY_STEPS
    j = int(at)
    low, high = DENSITY_RATIOS[k, j], DENSITY_RATIOS[k, j + 1]
    return low + (at - j) * (high - low)


def _least(builder, a, b):
    return builder.select(builder.fcmp_ordered("<", b, a), b, a)


def _largest(builder, a, b):
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


@vector_code(types.float64)
def _weigh_quadratic(v, n, own, base, ratios, square, product, old, white, h):
    """Add log Λ to the first n tests W = own[:n], several at a time; return the largest W - `CLEARING_SHARE` base[:n].

    `ratios` (5, QUADRATIC): coefficients of log Λ by test. The result is the same to the bit as that of `add`.
    """
    stride = sizes(v.builder, ratios)[1]
    tops = {wide: Lanes(v.builder, wide) for wide in (True, False)}
    tops = {wide: lanes.variable(lanes.constant(-math.inf)) for wide, lanes in tops.items()}

    def write(v, i):
        builder = v.builder
        ratio = None
        for row, factor in enumerate((square, product, old, white, None)):
            a = v.load(builder.gep(ratios.data, [builder.mul(stride, integer(row))]), i)
            term = a if factor is None else builder.fmul(a, v.spread(factor))
            ratio = term if ratio is None else builder.fadd(ratio, term)
        threshold, peak = v.spread(h), v.load(base.data, i)
        most = builder.fmul(v.constant(0.5), threshold)
        W = builder.fadd(_largest(builder, v.load(own.data, i), v.constant(0.0)), _least(builder, ratio, most))
        W = _least(builder, W, builder.fadd(builder.fadd(threshold, peak), v.constant(HEADROOM_NATS)))
        v.store(W, own.data, i)
        excess = builder.fsub(W, builder.fmul(v.constant(CLEARING_SHARE), peak))
        builder.store(_largest(builder, builder.load(tops[v.wide]), excess), tops[v.wide])

    in_vectors(v, n, write)
    builder, wide = v.builder, v.builder.load(tops[True])
    highest = builder.load(tops[False])
    for k in range(LANES):
        highest = _largest(builder, highest, builder.extract_element(wide, integer(k)))
    return highest


@embedded
def weigh(own, e, h, base, before):
    """Apply the tests of a row to one standardised innovation; return the alarms."""
    raw = min(max((e - base[0]) / base[1], -MAX_SIGMA), MAX_SIGMA)
    phi = base[2]
    white = raw
    if phi != 0.0 and np.isfinite(own[RAW]):
        white = (raw - phi * own[RAW]) / math.sqrt(1.0 - phi * phi)
        white = min(max(white, -MAX_SIGMA), MAX_SIGMA)
    own[RAW] = raw
    last = own[WHITE]
    # The first has no predecessor.
    tests = QUADRATIC
    if not np.isfinite(last):
        last = 0.0
        tests -= LAGGED
    own[WHITE] = white
    square, product, old = white * white, white * last, last * last
    highest = _weigh_quadratic(tests, own, base[3:], COEFFICIENTS, square, product, old, white, h)
    mask = 0
    if highest >= CLEARING_SHARE * h:
        for k in range(tests):
            threshold = h + base[3 + k]
            if own[k] >= threshold or own[k] >= CLEARING_SHARE * threshold and before & BITS[k] != 0:
                mask |= BITS[k]
    for k in range(len(GAINS)):
        off = white - own[EXPECTED + k]
        own[EXPECTED + k] = FADING * own[EXPECTED + k] + FOLLOWED[k, 0] * white
        ratio = 0.5 * square - FOLLOWED[k, 1] * off * off + FOLLOWED[k, 2]
        mask |= alarm(add(own, AT_GAINS + k, ratio, h, base[3 + AT_GAINS + k]), ALTERNATING, before)
    if abs(white) > OUTLIER_FROM:
        own[CALM_FOR] = 0.0
    else:
        own[CALM_FOR] += 1.0
        own[KNOWN] = min(own[KNOWN] + 1.0, RECENT_MEASUREMENTS - PRIOR_MEASUREMENTS)
        share = 1.0 / (own[KNOWN] + PRIOR_MEASUREMENTS)
        own[MEAN_E] += share * (raw - own[MEAN_E])
        own[SQUARE_E] += share * (raw * raw - 1.0 - own[SQUARE_E])
    for k in range(DENSITIES):
        at = AT_DENSITIES + k
        if OUTLIER_TESTS[k] and own[CALM_FOR] >= CALM_MEASUREMENTS:
            own[at] = 0.0
        # An outlier while something else is wrong is not a rare one.
        if RARE_TESTS[k] and mask & ~BITS[at] != 0:
            own[at] = 0.0
            continue
        mask |= alarm(add(own, at, _density_ratio(k, white), h, base[3 + at]), BITS[at], before)
    return mask


@inlined
def note_coverage(own, e, sensor):
    """Note whether a measurement of a sensor lies in its band, of those of the last `COVERED_S` seconds."""
    period = (sensor[LAST] - sensor[FIRST]) / sensor[COUNT]
    most = max(COVERED_READINGS, COVERED_S / max(period, 1e-6))
    own[COUNTED_OUT] = min(own[COUNTED_OUT] + 1.0, most)
    own[OUT] += ((1.0 if abs(e) > HALF_WIDTH else 0.0) - own[OUT]) / own[COUNTED_OUT]


@inlined
def _covers(own):
    """Return whether it is credible that 90 % of the measurements lie in their bands."""
    return own[OUT] <= 1.0 - COVERED + ONE_SIDED * math.sqrt(COVERED * (1.0 - COVERED) / max(own[COUNTED_OUT], 1.0))


@inlined
def grade(own, mask, gated, r, base):
    """Return the grade of the alarms of a row: 0 for none, `ADVISED` if its bands are valid, else `ACTED_ON`.

    Valid are bands that are too wide, and those that hold most measurements (`_covers`) in spite of spikes, of a scale
    that is a little too small, and of a sign that alternates; and those about a mean that is smaller than the accepted
    one. They cover a correlation of e, which tests of unit variance also see where e is merely small, if its mean
    square is small and its mean μ within the band of the estimate itself, μ² ≤ (S - R) / S: an estimate that averages
    many measurements has a narrow band, however wide that of a measurement is. They cover μ ≠ 0 only where the estimate
    follows each measurement, so that no error accumulates. Valid, too, is an estimate from which a gate keeps the
    outliers, if e has the right scale without them.
    """
    if mask == 0:
        return 0.0
    rest = mask & ~CONSERVATIVE
    if gated != 0 and rest & SPIKY != 0:
        rest &= ~SPIKY
        if 1.0 + own[SQUARE_E] < NORMAL_SQUARE:
            rest &= ~NARROW
    if _covers(own):
        rest &= ~(NARROW | SPIKY | ALTERNATING)
    if abs(base[0] + base[1] * own[MEAN_E]) < abs(base[0]):
        rest &= ~SHIFTED
    if rest & (SHIFTED | LAGGING) != 0:
        variance, mean, square = own[LAST_STD] * own[LAST_STD], own[MEAN_E], 1.0 + own[SQUARE_E]
        if mean * mean * variance <= variance - r:
            if variance - r >= FOLLOWING_SHARE * variance and square < COVERED_SQUARE:
                rest &= ~(SHIFTED | LAGGING)
            elif square < WIDE_SQUARE:
                rest &= ~LAGGING
    return ADVISED if rest == 0 else ACTED_ON


@inlined
def resetting(own, std):
    """Return whether the prior of a reset still dominates a prediction of this standard deviation."""
    left = own[RESETTING]
    if left <= 0.0:
        return False
    # The first measurement after a reset is predicted from the prior alone.
    if own[LAST_STD] == 0.0 or not std <= RESET_STD * own[STD_BEFORE]:
        own[RESETTING] = left - 1.0
        return True
    own[RESETTING] = 0.0
    return False


@inlined
def _contradicted(own, innovation, std, r, used, repeated):
    """Return whether the model or other sensors contradict that a row repeats its value.

    Between two measurements the prediction moves by the residual after the earlier update, (R/S) ν, less the next
    innovation, as the measured value is the same. Its predicted variance is the growth of S - R meanwhile. A
    movement contradicts the repetition if it exceeds quantum and noise, and is no sum of random steps. Without
    movement, repetition is improbable only if the change between two measurements is mostly noise.
    """
    if not repeated:
        own[MOVED] = own[MOVED_SQUARES] = own[MOVED_VARIANCE] = 0.0
    found = False
    if np.isfinite(innovation):
        variance = std * std
        if np.isfinite(own[LEFT]):
            grown = max(0.0, variance - r - own[LEFT_VARIANCE])
            if repeated:
                step = own[LEFT] - innovation
                own[MOVED] += step
                own[MOVED_SQUARES] += step * step
                own[MOVED_VARIANCE] += grown
                moved = abs(own[MOVED])
                evident = moved > EVIDENT_MOVEMENT * max(own[QUANTUM], math.sqrt(r))
                coherent = moved > SIGNIFICANT_MOVEMENT * math.sqrt(own[MOVED_SQUARES])
                if own[RUN] >= MIN_MOVEMENT_STEPS:
                    coherent |= moved > SIGNIFICANT_MOVEMENT * math.sqrt(own[MOVED_VARIANCE])
                found = evident and coherent or used and grown < NOISY_SHARE * r
        left = r / variance if used and variance > 0.0 else 1.0
        own[LEFT] = left * innovation
        own[LEFT_VARIANCE] = r * (1.0 - left) if used else variance - r
        own[LAST_STD] = std
    else:
        own[LEFT] = np.nan
    return found


@embedded
def repeat(own, y, r, h, base, before, innovation, std, used):
    """Apply the test of repetition to a value, of this innovation and its standard deviation.

    Two measurements of standard deviation σ, rounded to a quantum q, are equal with a probability of erf(q / 2σ) at
    most; q is the smallest step that the sensor has made so far. An asset at rest repeats itself more often: the share
    of repetitions before the present run counts if it is larger, and a repetition only where the model or other sensors
    predict movement, or the sensor has noise of its own at rest.
    """
    last = own[VALUE]
    own[VALUE] = y
    contradicted = _contradicted(own, innovation, std, r, used, y == last)
    if not np.isfinite(last):
        return 0
    if y == last:
        own[RUN] += 1.0
        chance = UNKNOWN_QUANTUM
        if own[QUANTUM] > 0.0 and r > 0.0:
            chance = max(math.erf(0.5 * own[QUANTUM] / math.sqrt(r)), 0.01, own[EQUAL] / own[COUNTED])
        ratio = math.log(REPEAT_PROBABILITY / min(chance, REPEAT_PROBABILITY)) if contradicted else 0.0
    else:
        step = abs(y - last)
        if own[QUANTUM] == 0.0 or step < own[QUANTUM]:
            own[QUANTUM] = step
        own[EQUAL] += own[RUN]
        own[COUNTED] += own[RUN] + 1.0
        own[RUN] = 0.0
        ratio = NEW_VALUE - h
    return alarm(add(own, AT_REPETITION, ratio, h, base[3 + AT_REPETITION]), STUCK, before)


@jit
def highest(e, refused, y, innovation, std, r, h, base, chances):
    """Return the highest W of each test of a row over its measurements, (TESTS,), with thresholds that never cap it.

    `refused` (n,): 1 where the gate rejected the measurement, 0 where it accepted it, -1 where it did not apply.
    """
    own = np.zeros(ROW)
    own[RAW] = own[WHITE] = own[VALUE] = own[LEFT] = np.nan
    found = np.zeros(TESTS)
    for i in range(e.size):
        if np.isfinite(y[i]):
            repeat(own, y[i], r, h, base, 0, innovation[i], std[i], refused[i] == 0)
        if refused[i] >= 0:
            add(own, AT_REFUSALS, chances[1 - refused[i]], h, base[3 + AT_REFUSALS])
        if np.isfinite(e[i]):
            weigh(own, e[i], h, base, 0)
        for k in range(TESTS):
            found[k] = max(found[k], own[k])
    return found


@embedded
def weigh_joint(own, nis, dof, h, before):
    """Apply the tests of a sensor's common scale to its NIS, chi-square with `dof` under the model.

    They do not apply where the baseline is not that of white innovations.
    """
    mask = 0
    for k in range(JOINT):
        ratio = JOINT_RATIOS[k, 0] * min(nis, dof * MAX_SIGMA * MAX_SIGMA) + dof * JOINT_RATIOS[k, 4]
        mask |= alarm(add(own, k, ratio, h, 0.0), JOINT_BITS[k], before)
    return mask


@embedded
def note_time(own, now, every, tests, policy, expected):
    """Note the time of a measurement: update the sensor's period, its threshold, and when it will have dropped out."""
    count = own[COUNT]
    if count == 0.0:
        own[FIRST] = now
    else:
        own[LONGEST_GAP] = max(own[LONGEST_GAP], now - own[LAST])
    own[LAST] = now
    own[COUNT] = count + 1.0
    n = int(own[COUNT])
    period = (now - own[FIRST]) / count if count > 0.0 else 0.0
    if n <= 16 or n & (n - 1) == 0:
        # The estimate of the rate improves; the threshold follows it in ever wider steps.
        own[THRESHOLD] = max(math.log(every / max(period, 1e-3) * tests), math.log(8.0 * tests))
    # The mean of few gaps is no period yet: after three measurements in quick succession the next gap is no dropout.
    usual = policy.silent_periods * period
    pause = usual
    if n <= KNOWN_PERIOD:
        pause = max(usual, min(usual * KNOWN_PERIOD / n, policy.stale_after))
    own[DUE] = now + max(pause, 2.0 * own[LONGEST_GAP]) if n > 2 and expected >= 0 else np.inf
    own[SILENT] = 0.0


@part
def find_dropouts(state, sensors, now):
    """Mark the sensors that dropped out, and note when the next will."""
    due = np.inf
    for s in range(sensors):
        own = sensor_part(state, s)
        if now > own[DUE]:
            state[SILENT_SENSORS] += 1.0 - own[SILENT]
            own[SILENT] = 1.0
        elif own[DUE] < due:
            due = own[DUE]
    state[NEXT_DUE] = due
