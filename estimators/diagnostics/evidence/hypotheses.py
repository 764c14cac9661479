"""The ways of being wrong that are tested: each is another density of e given those before, against white N(0, 1)."""

from __future__ import annotations

import math

import numpy as np

from .alarms import ALTERNATING, CORRELATED, NARROW, REFUSED, SHIFTED_DOWN, SHIFTED_UP, SPIKY, STUCK, WIDE

SCALES = (1.5, 2.5, 6.0, 0.6, 0.3, 0.05)
"""Variances of e that are tested."""

SHIFTS = (0.2, 0.5, 1.5, -0.2, -0.5, -1.5)
"""Means of e that are tested, in standard deviations."""

CORRELATIONS = (0.25, 0.6, -0.25, -0.6)
"""Lag-1 correlations of e that are tested, at unit variance."""

GAINS, FADING = (0.2, 0.5), 0.95
"""Gains of a filter that follows noise: it undoes at the next readings what it did at the last. Where nothing moves its
innovations are (1 - L) / (1 - (1 - gain) L) of white noise, L the lag; fading in place of 1 leaves an offset to the
other tests. At unit variance, too. Their lag-1 correlation is small, but they fall below white noise at all long lags
together."""

SPIKE_SHARES, SPIKE = (0.03, 0.003), 5.0
"""Spikes: these shares of e have so many standard deviations."""

REFUSED_SHARE = 0.3
"""Share of refused readings that is tested against what the gate refuses by chance."""

FURTHEST = 6.0
"""|e| beyond which it counts as this: what is further off says no more."""

REPEATING = 0.999
"""Probability that a sensor which is stuck repeats its last value."""

UNKNOWN_QUANTUM = 0.5
"""Probability of a repeated value that is granted to a sensor which has never changed: its quantum is not known yet."""

ANOTHER_VALUE = math.log((1.0 - REPEATING) / (1.0 - UNKNOWN_QUANTUM))
"""log Λ of a value that is not the last one."""

QUADRATIC = len(SCALES) + len(SHIFTS) + len(CORRELATIONS)
"""Tests whose log Λ is quadratic in e and the e before; they come first."""

TESTS = QUADRATIC + len(GAINS) + len(SPIKE_SHARES) + 2
"""Tests of a row: the quadratic ones, noise that is followed, spikes, refusals, repetition."""

AT_GAINS = QUADRATIC
AT_SPIKES = AT_GAINS + len(GAINS)
AT_REFUSALS, AT_REPETITION = range(TESTS - 2, TESTS)

JOINT = len(SCALES)
"""Tests of all rows of a sensor together, by its NIS: that of their scale."""

BITS = np.array(
    [
        *[NARROW] * 3,
        *[WIDE] * 3,
        *[SHIFTED_UP] * 3,
        *[SHIFTED_DOWN] * 3,
        *[CORRELATED] * 2,
        *[ALTERNATING] * 2,
        *[ALTERNATING] * 2,
        *[SPIKY] * 2,
        REFUSED,
        STUCK,
    ]
)
"""What each test of a row says, (TESTS,)."""


def _ratio_of_correlation(phi: float) -> tuple[float, ...]:
    rest = 1.0 - phi * phi
    return 0.5 - 0.5 / rest, phi / rest, -0.5 * phi * phi / rest, 0.0, -0.5 * math.log(rest)


RATIOS = np.array(
    [
        *[(0.5 - 0.5 / v, 0.0, 0.0, 0.0, -0.5 * math.log(v)) for v in SCALES],
        *[(0.0, 0.0, 0.0, m, -0.5 * m * m) for m in SHIFTS],
        *[_ratio_of_correlation(phi) for phi in CORRELATIONS],
    ]
)
"""Coefficients (a, b, c, d, f) of log Λ = a e² + b e e₋ + c e₋² + d e + f, (QUADRATIC, 5); e₋ is the e before."""


def _ratio_of_gain(gain: float) -> tuple[float, ...]:
    step = 1.0 - gain - FADING
    rest = 1.0 / (1.0 + step * step / (1.0 - (1.0 - gain) ** 2))
    return step, 0.5 / rest, -0.5 * math.log(rest)


FOLLOWED = np.array([_ratio_of_gain(gain) for gain in GAINS])
"""Coefficients (a, b, c) of m ← fading m + a e, log Λ = ½ e² - b (e - m)² + c, (gains, 3); m is expected of e."""

SPIKE_STEPS = 64.0
_SQUARES = np.arange(FURTHEST**2 * SPIKE_STEPS + 2.0) / SPIKE_STEPS
SPIKE_RATIO = np.log1p(
    np.array(SPIKE_SHARES)[:, None] * (np.exp(0.5 * _SQUARES * (1.0 - 1.0 / SPIKE**2)) / SPIKE - 1.0)
)
"""log Λ of spikes, for each share, at so many e² a step, between which it is nearly straight (to 1e-5)."""
