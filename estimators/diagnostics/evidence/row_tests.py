"""The tests of one sensor row, and those of all rows of a sensor together.

Under the model the standardised innovations e of a row are N(0, 1) and white. Each way of being wrong is another
density of e given those before (hypotheses.py), and the cumulated log-likelihood ratio tests it:

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

import numpy as np

from ...numerics.jit import inlined, jit, part
from .alarms import AGREEING, ALTERNATING, DISAGREEING, SPIKY, STUCK
from .bank import CALM_FOR, COUNTED, EQUAL, EXPECTED, QUANTUM, RAW, ROW, RUN, VALUE, WHITE
from .hypotheses import (
    ANOTHER_VALUE,
    AT_GAINS,
    AT_REFUSALS,
    AT_REPETITION,
    AT_SPIKES,
    BITS,
    CORRELATIONS,
    FADING,
    FOLLOWED,
    FURTHEST,
    GAINS,
    JOINT,
    QUADRATIC,
    RATIOS,
    REPEATING,
    SPIKE_RATIO,
    SPIKE_SHARES,
    SPIKE_STEPS,
    TESTS,
    UNKNOWN_QUANTUM,
)

SPARE = 1.0
"""By which W may pass its threshold, so that it falls again when the cause has gone."""

LASTING = 0.85
"""Share of the threshold above which an alarm lasts."""

CALM, FAR_OUT = 500, 3.5
"""Readings without an |e| beyond this after which spikes are forgotten: they say little of what comes long after."""

RARE = 1
"""The share of spikes that counts only while no other test of the row but the one before it is in alarm."""


@inlined
def add(W, k, ratio, h, peak):
    """Put log Λ of one more reading to test k; 2 where it is in alarm, 1 where an alarm may last, else 0.

    One reading alone never speaks: what an outlier is worth is half a threshold at most.
    """
    threshold = h + peak
    W[k] = min(max(W[k], 0.0) + min(ratio, 0.5 * h), threshold + SPARE)
    if W[k] >= threshold:
        return 2
    return 1 if W[k] >= LASTING * threshold else 0


@inlined
def alarm(said, bit, before):
    """The bit, if a test that said so is in alarm: since now, or still."""
    return bit if said == 2 or said == 1 and before & bit != 0 else 0


@inlined
def _spike_ratio(share, square):
    """log Λ of spikes against none, from e²."""
    at = square * SPIKE_STEPS
    k = int(at)
    low, high = SPIKE_RATIO[share, k], SPIKE_RATIO[share, k + 1]
    return low + (at - k) * (high - low)


@part
def weigh(own, e, h, base, before):
    """Put one standardised innovation to the tests of its row; the causes that are in alarm."""
    raw = min(max((e - base[0]) / base[1], -FURTHEST), FURTHEST)
    phi = base[2]
    white = raw
    if phi != 0.0 and np.isfinite(own[RAW]):
        white = (raw - phi * own[RAW]) / math.sqrt(1.0 - phi * phi)
        white = min(max(white, -FURTHEST), FURTHEST)
    own[RAW] = raw
    last = own[WHITE]
    # Of the first there is nothing that it could be correlated with.
    tests = QUADRATIC
    if not np.isfinite(last):
        last = 0.0
        tests -= len(CORRELATIONS)
    own[WHITE] = white
    square, product, old = white * white, white * last, last * last
    highest = -1.0
    for k in range(tests):
        ratio = (
            RATIOS[k, 0] * square + RATIOS[k, 1] * product + RATIOS[k, 2] * old + RATIOS[k, 3] * white + RATIOS[k, 4]
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
    for k in range(len(GAINS)):
        off = white - own[EXPECTED + k]
        own[EXPECTED + k] = FADING * own[EXPECTED + k] + FOLLOWED[k, 0] * white
        ratio = 0.5 * square - FOLLOWED[k, 1] * off * off + FOLLOWED[k, 2]
        mask |= alarm(add(own, AT_GAINS + k, ratio, h, base[3 + AT_GAINS + k]), ALTERNATING, before)
    own[CALM_FOR] = 0.0 if abs(white) > FAR_OUT else own[CALM_FOR] + 1.0
    for k in range(len(SPIKE_SHARES)):
        if own[CALM_FOR] >= CALM:
            own[AT_SPIKES + k] = 0.0
        # What is far off while something else is wrong is no rare spike.
        if k == RARE and mask & ~SPIKY != 0:
            own[AT_SPIKES + k] = 0.0
            continue
        said = add(own, AT_SPIKES + k, _spike_ratio(k, square), h, base[3 + AT_SPIKES + k])
        mask |= alarm(said, SPIKY, before)
    return mask


@part
def repeat(own, y, r, h, base, before):
    """Put a value to the test of repetition.

    Two readings of standard deviation σ, rounded to a quantum q, are equal with a probability of erf(q / 2σ) at most,
    whatever was measured; q is the smallest step that the sensor has ever made. An asset at rest repeats itself more
    often: the share of its repetitions so far, but for those of the present run, counts if it is larger.
    """
    last = own[VALUE]
    own[VALUE] = y
    if not np.isfinite(last):
        return 0
    if y == last:
        own[RUN] += 1.0
        chance = UNKNOWN_QUANTUM
        if own[QUANTUM] > 0.0 and r > 0.0:
            chance = max(math.erf(0.5 * own[QUANTUM] / math.sqrt(r)), 0.01, own[EQUAL] / own[COUNTED])
        ratio = math.log(REPEATING / min(chance, REPEATING))
    else:
        step = abs(y - last)
        if own[QUANTUM] == 0.0 or step < own[QUANTUM]:
            own[QUANTUM] = step
        own[EQUAL] += own[RUN]
        own[COUNTED] += own[RUN] + 1.0
        own[RUN] = 0.0
        ratio = ANOTHER_VALUE - h
    return alarm(add(own, AT_REPETITION, ratio, h, base[3 + AT_REPETITION]), STUCK, before)


@jit
def highest(e, refused, y, r, h, base, chances):
    """The highest W of each test of a row, (TESTS,), over its readings: thresholds that are infinite never cut it.

    `refused` (n,): 1 where the gate refused it, 0 where it did not, -1 where it had no say.
    """
    own = np.zeros(ROW)
    own[RAW] = own[WHITE] = own[VALUE] = np.nan
    found = np.zeros(TESTS)
    for i in range(e.size):
        if np.isfinite(y[i]):
            repeat(own, y[i], r, h, base, 0)
        if refused[i] >= 0:
            add(own, AT_REFUSALS, chances[1 - refused[i]], h, base[3 + AT_REFUSALS])
        if np.isfinite(e[i]):
            weigh(own, e[i], h, base, 0)
        for k in range(TESTS):
            found[k] = max(found[k], own[k])
    return found


@part
def weigh_together(own, nis, dof, h, before):
    """Put the NIS of a sensor with several rows to the tests of their common scale: χ² with dof under the model.

    Where something else than white innovations was normal there is no such test.
    """
    mask = 0
    for k in range(JOINT):
        c = RATIOS[k]
        bit = DISAGREEING if k < 3 else AGREEING
        ratio = c[0] * min(nis, dof * FURTHEST * FURTHEST) + dof * c[4]
        mask |= alarm(add(own, k, ratio, h, 0.0), bit, before)
    return mask
