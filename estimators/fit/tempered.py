"""How much of a likelihood is believed: a power of it, chosen by what took no part in the fit.

    p(θ | y) ∝ p(y | θ)^η p(θ),    0 < η ≤ 1

If the model is right, η = 1. The model of an asset errs slowly, so that a thousand readings say as much as ten would,
and the likelihood is sure of what it cannot know: it explains the one stretch that it was fitted to, with noises under
which what is not measured leaves its band. A smaller power counts readings for fewer, and entries go back to where they
were, those first of which the data tell least.

Where nothing but readings tells, the likelihood is believed unless there is evidence against it: of the powers that
predict nothing that was held out worse, the largest is taken with which the blocks held out are predicted no worse than
with the best by more than chance (two standard errors of the difference). Where witnesses tell, of which few errors are
independent, it is the smallest of those with which the fit is proposed, if there is one with which all witnesses stay
in their bands.

The maximum at a power is taken from the parabola at the maximum x̂ of power 1, with H minus its second derivatives, D
those of the belief in x_0: x(η) = x_0 + (η (H - D) + D)⁻¹ η H (x̂ - x_0). What each is worth is known by folding.

Sources: Grünwald & van Ommen (2017), doi:10.1214/17-BA1085, for a power learnt by prediction; Breiman, Friedman, Olshen
& Stone, Classification and Regression Trees (1984), 3.4.3, for the simplest of what is no worse than by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .aims import LIKELIHOOD, Aim
from .entries import Setting
from .judge import COVERED, SURE, Verdict, Worth, gain, verdict
from .objective import Objective
from .uncertainty import Curvature

POWERS = tuple(0.25**k for k in range(9))
"""Powers that are tried: at the last, what 65,536 readings say counts as what one would."""


class Tempered(NamedTuple):
    """What is believed: the power, the point x (k,), its covariance (k, k), and what it is worth."""

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
        objective: What was maximised.
        x: Where, (k,).
        shape: Its curvature there.
        setting: What is folded at a point.
        judged: What settings are worth.
        aim: Of the fit.
        powers: From 1 on, falling.
    """
    found = [at_power(objective, x, shape, power) for power in powers]
    own, *others = judged([setting(objective.start), *(setting(point) for point, _ in found)])
    verdicts = [verdict(own, other, aim, changed=x.size > 0) for other in others]
    k = _chosen(own, others, verdicts, aim)
    return Tempered(powers[k], *found[k], own, others[k], verdicts[k])


def at_power(objective: Objective, x: np.ndarray, shape: Curvature, power: float) -> tuple[np.ndarray, np.ndarray]:
    """The maximum (k,) at a power, and its covariance (k, k)."""
    if power == 1.0 or not x.size:
        return x, shape.cov
    H = np.linalg.inv(shape.cov)
    start = objective.start
    cov = np.linalg.inv(power * H + (1.0 - power) * np.diag(objective.precision))
    low, high = np.array(objective.limits).T
    return np.clip(start + cov @ (power * H @ (x - start)), low, high), cov


def _chosen(own: Worth, others: Sequence[Worth], verdicts: Sequence[Verdict], aim: Aim) -> int:
    """Which power: of those with which the fit is proposed; else that of 1, whose reasons are told.

    Where nothing but readings tells, of those that do no harm, as each that is tried may win by chance.
    """
    if aim.kind == LIKELIHOOD:
        harmless = [k for k, item in enumerate(verdicts) if item.harmless]
        best = max(harmless, key=lambda k: verdicts[k].gain, default=0)
        return next((k for k in harmless if _as_good(others[k], others[best])), 0)
    proposed = [k for k, item in enumerate(verdicts) if item.proposed]
    if not proposed:
        return 0
    proposed = [k for k in proposed if _in_band(own, others[k])] or proposed
    best = max(proposed, key=lambda k: verdicts[k].gain)
    if not aim.weights:
        return best
    return next(k for k in reversed(proposed) if _as_good(others[k], others[best]))


def _as_good(one: Worth, best: Worth) -> bool:
    """Whether what one of them predicts of the blocks held out is no worse than the best by more than chance."""
    less, error = gain(one.held_out.aimed, best.held_out.aimed)
    return less <= SURE * error


def _in_band(own: Worth, other: Worth) -> bool:
    """Whether the bands of all witnesses, in the blocks fitted to and held out, are no worse or wide enough."""
    pairs = [
        (old, new[name])
        for one, two in ((own.fitted, other.fitted), (own.held_out, other.held_out))
        for olds, new in ((one.withheld, two.withheld), (one.states, two.states))
        for name, old in olds.items()
        if name in new
    ]
    return all(new.coverage >= min(COVERED, old.coverage) for old, new in pairs)
