"""The integrity bound of each state beside its band, and the fault that makes it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...model.state_space import StateSpaceModel
from ...numerics.quantiles import normal_quantile
from .integrity import PROBABILITY
from .sensitivity import Sensitivity
from .words import fault_text, range_text, size_text, subject_text

TWO_SIGMA = normal_quantile(0.5 + PROBABILITY / 2.0)
"""Standard deviations to either side in a band of 95 %, "± 2 σ", as the integrity bound has it."""


class Bound(NamedTuple):
    """Of one state, in `unit`: below which its error stays with 95 %.

    `two_sigma` by the covariance, if nothing is wrong; `bound` under the one unseen fault that is worst for it, which
    moves it by `bias`. `fault` says which that is and from where to where it passes unseen; empty if none moves it.
    """

    unit: str
    bound: float
    bias: float
    two_sigma: float
    fault: str


def bounds_of(model: StateSpaceModel, found: Sensitivity) -> dict[str, Bound]:
    """By state, at the end of what was folded; none where there is a reason against it."""
    if found.reason:
        return {}
    bounds = {}
    for k, state in enumerate(model.shown_states):
        cause = int(found.integrity_cause[k])
        bounds[state.name] = Bound(
            unit=state.unit,
            bound=float(found.integrity[k]),
            bias=float(found.integrity_bias[k]),
            two_sigma=TWO_SIGMA * float(found.std[-1, k]),
            fault=fault_text(found.nudges[cause], *found.unseen[cause]) if cause >= 0 else "",
        )
    return bounds


class Smallest(NamedTuple):
    """The smallest fault of one sensor row, input or parameter that is seen, in words: `2.1 °C`, or `none`.

    `share` is its size in units of the nudge's scale (a sensor's σ, an input's spread, a parameter's value), infinite
    if none is seen; `unseen` says from where to where a fault passes.
    """

    subject: str
    size: str
    share: float
    unseen: str


def smallest_of(found: Sensitivity) -> tuple[Smallest, ...]:
    """Of every nudge; none where there is a reason against it."""
    return tuple(
        Smallest(
            subject_text(nudge),
            size_text(nudge, float(size)) if np.isfinite(size) else "none",
            float(size) / nudge.scale,
            range_text(nudge, float(low), float(high)),
        )
        for nudge, size, (low, high) in zip(found.nudges, found.smallest_visible, found.unseen, strict=True)
    )
