"""Tempering: the power of the likelihood, chosen by data that took no part in the fit.

    p(θ | y) ∝ p(y | θ)^η p(θ),    0 < η ≤ 1

If the model is right, η = 1. The model of a real asset has slow errors, so that a thousand measurements carry the
information of ten, and the likelihood is overconfident: it fits noises to one stretch of time under which the states
that are not measured leave their bands. A smaller power discounts the measurements, and entries go back to their
start, the least identified first.

With the aim `likelihood` the power is 1 unless there is evidence against it: among the powers that worsen no held-out
prediction, the largest whose prediction of the held-out blocks is within chance (two standard errors of the difference)
of the best. With references, whose independent errors are few, it is the smallest of those with which the fit is
proposed, preferably with all references in their bands.

The maximum at a power is taken from the parabola at the maximum x̂ of power 1, with H minus its second derivatives, D
those of the prior at x_0: x(η) = x_0 + (η (H - D) + D)⁻¹ η H (x̂ - x_0). Each is scored by folding.

Sources: Grünwald & van Ommen (2017), doi:10.1214/17-BA1085, for a power learnt by prediction; Breiman, Friedman, Olshen
& Stone, Classification and Regression Trees (1984), 3.4.3, for the simplest candidate that is no worse than by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .aims import LIKELIHOOD, Aim
from .entries import Setting
from .judge import MIN_COVERAGE, MIN_SIGMAS, Verdict, Worth, gain, verdict
from .objective import Objective
from .uncertainty import Curvature

POWERS = tuple(0.25**k for k in range(9))
"""Powers to try: at the last, 65,536 measurements count as one."""


class Tempered(NamedTuple):
    """The chosen power, its point x (k,) and covariance (k, k), and the scores before and after."""

    power: float
    x: np.ndarray
    cov: np.ndarray
    before: Worth
    after: Worth
    verdict: Verdict


def tempered(
    objective: Objective,
    x: np.ndarray,
    shape: Curvature,
    setting: Callable[[np.ndarray], Setting],
    judged: Callable[[Sequence[Setting]], list[Worth]],
    *,
    aim: Aim,
    powers: Sequence[float] = POWERS,
) -> Tempered:
    """Choose the power.

    Args:
        objective: The objective.
        x: Its maximum, (k,).
        shape: Its curvature there.
        setting: Setting to fold at a point.
        judged: Scores of settings.
        aim: Aim of the fit.
        powers: Powers to try, from 1 on, falling.
    """
    found = [at_power(objective, x, shape, power) for power in powers]
    own, *others = judged([setting(objective.start), *(setting(point) for point, _ in found)])
    verdicts = [verdict(own, other, aim, changed=x.size > 0) for other in others]
    k = _chosen(own, others, verdicts, aim)
    return Tempered(powers[k], *found[k], own, others[k], verdicts[k])


def at_power(objective: Objective, x: np.ndarray, shape: Curvature, power: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the maximum (k,) at a power, and its covariance (k, k)."""
    if power == 1.0 or not x.size:
        return x, shape.cov
    H = np.linalg.inv(shape.cov)
    start = objective.start
    cov = np.linalg.inv(power * H + (1.0 - power) * np.diag(objective.precision))
    low, high = np.array(objective.limits).T
    return np.clip(start + cov @ (power * H @ (x - start)), low, high), cov


def _chosen(own: Worth, others: Sequence[Worth], verdicts: Sequence[Verdict], aim: Aim) -> int:
    """Return the index of the power; 0 (power 1, whose reasons are reported) if none qualifies.

    With the likelihood, harmless fits qualify: proposed ones may win by chance when several powers are tried.
    """
    if aim.kind == LIKELIHOOD:
        qualified = [k for k, item in enumerate(verdicts) if item.harmless]
    else:
        qualified = [k for k, item in enumerate(verdicts) if item.proposed]
        qualified = [k for k in qualified if _in_band(own, others[k])] or qualified
    best = max(qualified, key=lambda k: verdicts[k].gain, default=0)
    if aim.kind == LIKELIHOOD:
        return next((k for k in qualified if _as_good(others[k], others[best])), 0)
    return next((k for k in reversed(qualified) if _as_good(others[k], others[best])), 0) if aim.weights else best


def _as_good(one: Worth, best: Worth) -> bool:
    """Return whether a prediction of the held-out blocks is within chance of the best."""
    less, error = gain(one.held_out.aimed, best.held_out.aimed)
    return less <= MIN_SIGMAS * error


def _in_band(own: Worth, other: Worth) -> bool:
    """Return whether the bands of all references, fitted and held out, are wide enough or no narrower."""
    pairs = [
        (old, new[name])
        for one, two in ((own.fitted, other.fitted), (own.held_out, other.held_out))
        for olds, new in ((one.withheld, two.withheld), (one.states, two.states))
        for name, old in olds.items()
        if name in new
    ]
    return all(new.coverage >= min(MIN_COVERAGE, old.coverage) for old, new in pairs)
