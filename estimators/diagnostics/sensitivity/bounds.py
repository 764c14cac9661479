"""The integrity bound of each state beside its band, and the fault that makes it."""

from __future__ import annotations

from typing import NamedTuple

from ...model.state_space import StateSpaceModel
from ...numerics.quantiles import normal_quantile
from .integrity import PROBABILITY
from .sensitivity import Sensitivity
from .words import fault_text

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
