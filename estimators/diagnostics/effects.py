"""Effects of faults on standardised innovations: size, onset and likelihood ratio against white noise N(0, 1).

Each kind of effect has a size with a 95 % interval, and a generalised likelihood ratio against none, in nats. The kind
with the largest ratio explains a run best.

Source: Basseville & Nikiforov (1993), Detection of Abrupt Changes, 2.4 and 4.2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..numerics.quantiles import normal_quantile
from .detectors import MAX_SIGMA

INTERVAL_SIGMAS = float(normal_quantile(0.975))

OUTLIER_FROM_SIGMA = 4.0  # |e| from which an innovation is an outlier
MIN_PAIRS = 4  # Innovations up to which a correlation is not estimated

KINDS = ("shifted", "narrow", "wide", "correlated", "alternating", "spiky")
"""Detectors whose effect is estimated here, by name."""

EVIDENCE = "evidence"  # Kind of a series of log Λ of a test in place of e, for detectors of which nothing else is known


class InnovationEffect(NamedTuple):
    """Deviation of innovations from white noise.

    cause: one of `KINDS`. size, with its 95 % interval low to high: the mean in σ, the ratio of the standard deviation
    to the predicted one, the lag-1 correlation, or the share of outliers. ratio: log Λ, nats.
    """

    cause: str
    size: float
    low: float
    high: float
    ratio: float


def _effect(
    cause: str, size: float, half: float, ratio: float, low: float = -np.inf, high: float = np.inf
) -> InnovationEffect:
    """Return an effect with an interval of this half width, within `low` to `high`."""
    return InnovationEffect(cause, size, max(low, size - half), min(high, size + half), ratio)


def effects(e: np.ndarray) -> list[InnovationEffect]:
    """Return all deviations of a run e (n,), finite, from white noise, the one with the highest ratio first.

    The mean is removed before the scale is estimated, both before the correlation. Outliers are isolated: several in a
    row on one side are a shift. Their removal must leave the scale of white noise; otherwise the scale explains them.
    Values beyond `MAX_SIGMA` are clipped.
    """
    e = np.clip(e, -MAX_SIGMA, MAX_SIGMA)
    n = e.size
    if n < 2:
        size = float(e[0]) if n else 0.0
        return [_effect("shifted", size, INTERVAL_SIGMAS, 0.5 * size * size)]
    mean = float(e.mean())
    rest = e - mean
    variance = float(np.mean(rest**2))
    floor = max(variance, 1e-12)
    phi = float(np.sum(rest[1:] * rest[:-1]) / max(float(np.sum(rest**2)), 1e-300))
    bounded = float(np.clip(phi, -0.995, 0.995))
    # Correlated noise determines a mean less well than white noise.
    wide = np.sqrt(floor * (1.0 + max(bounded, 0.0)) / (1.0 - max(bounded, 0.0)) / n)
    found = [_effect("shifted", mean, INTERVAL_SIGMAS * wide, 0.5 * n * mean**2)]
    spikes = _alone(rest)
    calm = rest[~spikes]
    share = float(np.mean(spikes))
    if spikes.any() and calm.size > 1:
        own = max(float(np.mean(calm**2)), 1e-12)
        # A few outliers among normal innovations; otherwise it is the scale.
        gain = 0.5 * float(np.sum(rest[spikes] ** 2)) - int(spikes.sum()) * np.log(max(1.0 / max(share, 1e-9), 1.0))
        if own < 1.5 and share < 0.2:
            found.append(_effect("spiky", share, INTERVAL_SIGMAS * np.sqrt(share * (1.0 - share) / n), gain, 0.0, 1.0))
            variance, floor = own, own
    found.append(_scale(variance, floor, n))
    spread = INTERVAL_SIGMAS * np.sqrt((1.0 - bounded**2) / n)
    cause, gain = "correlated" if phi > 0 else "alternating", -0.5 * n * float(np.log(1.0 - bounded**2))
    found.append(_effect(cause, phi, spread, gain, -1.0, 1.0))
    return sorted(found, key=lambda effect: -effect.ratio)


def _scale(variance: float, floor: float, n: float) -> InnovationEffect:
    """Return the effect of a variance, at least `floor` in its logarithm, of n values."""
    deviation = float(np.sqrt(floor))
    half = INTERVAL_SIGMAS / np.sqrt(2.0 * n) * deviation
    gain = 0.5 * n * (variance - 1.0 - float(np.log(floor)))
    return _effect("narrow" if variance > 1.0 else "wide", deviation, half, gain, 0.0)


def against(e: np.ndarray, effect: InnovationEffect) -> float:
    """Return log Λ, nats, of white noise against an effect of this size in e (n,), finite; 0 for rare outliers."""
    e = np.clip(e, -MAX_SIGMA, MAX_SIGMA)
    size = effect.size
    if effect.cause == "shifted":
        return float(np.sum(0.5 * size**2 - size * e))
    if effect.cause in ("narrow", "wide"):
        variance = max(size**2, 1e-12)
        return 0.5 * float(np.sum(np.log(variance) + e**2 / variance - e**2))
    if effect.cause in ("correlated", "alternating"):
        rest = 1.0 - min(size**2, 0.99)
        return 0.5 * float(np.sum(np.log(rest) + (e[1:] - size * e[:-1]) ** 2 / rest - e[1:] ** 2))
    return 0.0


def common_scale(e: np.ndarray, dof: np.ndarray) -> InnovationEffect:
    """Return the common scale of all rows of a sensor, from e = √(NIS / dof) (n,) and degrees of freedom (n,)."""
    whole = float(np.sum(dof))
    variance = max(float(np.sum(dof * e**2)) / whole, 1e-12)
    return _scale(variance, variance, whole)


def _alone(e: np.ndarray) -> np.ndarray:
    """Return which of e (n,) are outliers without a neighbouring one on the same side."""
    side = np.where(np.abs(e) > OUTLIER_FROM_SIGMA, np.sign(e), 0.0)
    beside = np.concatenate(([0.0], side, [0.0]))
    return (side != 0.0) & (beside[:-2] != side) & (beside[2:] != side)


class Sums(NamedTuple):
    """Sufficient statistics of a run e (n,) for the likelihood of its effects.

    n, Σ e, Σ e², Σ e e₋ and Σ e² of those that have one before, e₋; and the last e.
    """

    n: int = 0
    total: float = 0.0
    squares: float = 0.0
    products: float = 0.0
    later: float = 0.0
    last: float = 0.0


NO_SUMS = Sums()


def gains(e: np.ndarray, cause: str, run: Sums = NO_SUMS) -> tuple[np.ndarray, Sums]:
    """Return the likelihood ratio of an effect in a run, up to each of its e.

    Args:
        e: Innovations (n,), finite.
        cause: One of `KINDS`, or `EVIDENCE` for a series of log Λ.
        run: Sums of the values before them.

    Returns:
        Generalised log-likelihood ratios against none, (n,), which for outliers rise with each; and the sums of the
        whole run.
    """
    e = np.clip(e, -MAX_SIGMA, MAX_SIGMA)
    if not e.size:
        return e, run
    n = run.n + np.arange(1, e.size + 1)
    later = e**2
    if run.n == 0:
        later[0] = 0.0
    total, squares = run.total + np.cumsum(e), run.squares + np.cumsum(e**2)
    products = run.products + np.cumsum(e * np.append(run.last, e[:-1]))
    after = run.later + np.cumsum(later)
    sums = Sums(int(n[-1]), *(float(each[-1]) for each in (total, squares, products, after, e)))
    gain = np.zeros(e.size)
    if cause == "shifted":
        gain = 0.5 * total**2 / n
    elif cause in ("narrow", "wide"):
        variance = np.maximum(squares / n, 1e-12)
        side = variance > 1.0 if cause == "narrow" else variance < 1.0
        gain = np.where(side, 0.5 * n * (variance - 1.0 - np.log(variance)), 0.0)
    elif cause in ("correlated", "alternating"):
        phi = np.clip(products / np.maximum(after, 1e-12), -0.995, 0.995)
        side = phi > 0 if cause == "correlated" else phi < 0
        gain = np.where(side & (n > MIN_PAIRS), -0.5 * n * np.log(1.0 - phi**2), 0.0)
    elif cause == "spiky":
        gain = np.where(np.abs(e) > OUTLIER_FROM_SIGMA, n, 0.0)
    elif cause == EVIDENCE:
        gain = total
    return gain, sums


def onset(e: np.ndarray, cause: str) -> int:
    """Return the most likely onset in e (n,) of an effect that is present at the end.

    The start that maximises the generalised likelihood ratio of what follows it; the estimate of the time of change of
    Basseville & Nikiforov (1993), 2.6.
    """
    return e.size - 1 - int(np.argmax(gains(e[::-1], cause)[0]))
