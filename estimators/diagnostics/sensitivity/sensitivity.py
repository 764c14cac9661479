"""Minimal detectable faults, protection levels and Fisher information of a twin, by refolding its log with nudges.

A nudge is a small change of a sensor, an input or a parameter. The protection level (integrity bound) of a state is the
bound of its error under an undetectable fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from ...errors import EstimatorError
from ...log import Log
from ...model.state_space import StateSpaceModel
from ...numerics.quantiles import normal_quantile
from ...registry import find_estimator
from ...snapshots import Base
from ...track import USED
from ...tuning import Tuning
from ..health import HealthPolicy
from .gramian import Uncertainty, information, uncertainty
from .responses import (
    KINDS,
    Nudge,
    Response,
    astray,
    each,
    fault_text,
    most_events,
    nudges_of,
    range_text,
    reason_against,
    respond,
    size_text,
    start,
    subject_text,
)
from .visibility import fault_tests, undetectable_fault

MAX_NONLINEARITY = 0.5
"""Median nonlinearity of the nudges from which the result has a note that derivatives are unreliable."""

BANK, BEST = WITNESSES = ("bank", "best")
"""Tests for a fault: the detectors of the twin, or the optimal test of a known fault."""


class Sensitivity(NamedTuple):
    """Sensitivity of a fold to k nudges over its last N events.

    estimator: the filter that was nudged. reason: why nothing was computed and all arrays are empty, or ""; note: a
    remark on the result, or "". t (N,): times of the events, ns; first: index of the first in the log. std (N, shown):
    σ of the states without nudge.

    fisher (k, k), deviation (k,) and correlation (k, k): see `Uncertainty`, for all nudges unknown together; `among`
    gives them for some.

    h (rows,) are the thresholds of the tests by sensor row, noncentrality the λ that passes them with the probability
    asked for. smallest_visible (k,): the size of the smallest fault of each nudge that is seen, if it is there in all N
    events; infinite if none in its range is. unseen (k, 2): from where to where faults can pass, both signs, within
    the range. nonlinearity (k,): how much another size is visible than the derivative says, as a share.

    integrity_bias, integrity (shown,): at the end, the largest error of each state by one unseen fault, and the same
    plus 1.96 σ; integrity_cause (shown,): index of the nudge that causes it, -1 for none. `over_time` has the same for
    every event.
    """

    estimator: str
    reason: str
    note: str
    first: int
    t: np.ndarray
    std: np.ndarray
    responses: tuple[Response, ...]
    fisher: np.ndarray
    deviation: np.ndarray
    correlation: np.ndarray
    h: np.ndarray
    noncentrality: float
    smallest_visible: np.ndarray
    unseen: np.ndarray
    nonlinearity: np.ndarray
    integrity_bias: np.ndarray
    integrity: np.ndarray
    integrity_cause: np.ndarray
    over_time: ErrorBounds

    @property
    def nudges(self) -> tuple[Nudge, ...]:
        """The nudges, in the order of the arrays."""
        return tuple(response.nudge for response in self.responses)

    def place(self, kind: str, name: str) -> int:
        """Return the index of a nudge in the arrays.

        Raises:
            KeyError: If there is no such nudge.
        """
        for k, nudge in enumerate(self.nudges):
            if (nudge.kind, nudge.name) == (kind, name):
                return k
        raise KeyError(f"no nudge of {kind} {name!r}; there are {', '.join(n.name for n in self.nudges)}")

    def among(self, indices: Sequence[int]) -> Uncertainty:
        """Return the uncertainty of some nudges if these are unknown and all others are known."""
        some = list(indices)
        return uncertainty(self.fisher[np.ix_(some, some)], [self.nudges[k] for k in some])


def sensitivity(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    *,
    base: Base | None = None,
    kinds: Sequence[str] = KINDS,
    most: int | None = None,
    seen_by: str = BANK,
    false_alarm: float = HealthPolicy().false_alarm_every,
    detection: float = 0.95,
    executor: Executor | str | None = "threads",
) -> Sensitivity:
    """Nudge every sensor row, input and parameter, and refold the log.

    A fault is constant over all events, and folded at its own size, so the model need not be linear; `fisher` is
    computed from derivatives.

    Args:
        estimator: Of the twin; particle and ensemble filters are replaced by a deterministic one, see `note`.
        model: Of at most 64 states.
        tuning: As the twin's.
        log: The events; it must not grow meanwhile (give a copy). Refused readings stay refused.
        base: Where the log starts, if older events were dropped; see `Fold.base_at`.
        kinds: Which nudges, of "sensor", "input", "parameter".
        most: Events to look at, from the end; None for what takes seconds and 256 MB at most.
        seen_by: "bank" for the detectors of the twin, "best" for the optimal test of a known fault, a bound for all
            tests.
        false_alarm: Mean time between false alarms of all tests together, s.
        detection: Probability with which the smallest visible fault is seen.
        executor: "threads", an Executor, or None to fold one after the other. The results are the same bits.

    Raises:
        EstimatorError: As `Fold`; if `seen_by` is unknown.
        ModelError: As `Fold`.
    """
    find_estimator(estimator, model)
    if seen_by not in WITNESSES:
        raise EstimatorError(f"seen_by is {seen_by!r}; it must be one of {', '.join(WITNESSES)}")
    reason = reason_against(model, log)
    if reason:
        return _nothing(estimator, reason, len(model.shown))
    count = len(model.row_names) + model.nu + len(model.parameters)
    begun = start(estimator, model, tuning, log, base, most or most_events(model, count))
    reason = astray(estimator, begun.estimator, begun.track)
    if reason:
        return _nothing(estimator, reason, len(model.shown))
    nudges = nudges_of(model, tuning, begun.given.log, kinds)
    if not nudges:
        return _nothing(estimator, f"{model.name} has nothing to nudge of {', '.join(kinds)}", len(model.shown))
    responses = each(lambda nudge: respond(begun, nudge), nudges, executor)
    track, still = begun.track, begun.given.log
    used = track.verdict == USED
    fisher = information([response.whitened[used] for response in responses])
    told = uncertainty(fisher, nudges)
    t = still.t[: still.n].copy()
    tests = fault_tests(
        model,
        tuning,
        still,
        track,
        every=false_alarm,
        detection=detection,
        bank=seen_by == BANK,
    )
    faults = each(lambda response: undetectable_fault(begun, response, tests), responses, executor)
    bounds = integrity([item.error for item in faults], track.std)
    notes = [begun.note]
    if np.median([item.nonlinearity for item in faults]) > MAX_NONLINEARITY:
        notes.append(f"{begun.estimator} responds nonlinearly to nudges: Fisher information is unreliable here")
    return Sensitivity(
        estimator=begun.estimator,
        reason="",
        note="; ".join(filter(None, notes)),
        first=begun.first,
        t=t,
        std=track.std.copy(),
        responses=tuple(responses),
        fisher=fisher,
        deviation=told.deviation,
        correlation=told.correlation,
        h=tests.h,
        noncentrality=tests.noncentrality,
        smallest_visible=np.array([item.visible for item in faults]),
        unseen=np.array([(item.low, item.high) for item in faults]),
        nonlinearity=np.array([item.nonlinearity for item in faults]),
        integrity_bias=bounds.bias[-1],
        integrity=bounds.bound[-1],
        integrity_cause=bounds.cause[-1],
        over_time=bounds,
    )


def _nothing(estimator: str, reason: str, shown: int) -> Sensitivity:
    none, rows, square = np.zeros(0), np.zeros((0, shown)), np.zeros((0, 0))
    unknown = np.full(shown, np.nan)
    cause = np.full(shown, -1)
    return Sensitivity(
        estimator=estimator,
        reason=reason,
        note="",
        first=0,
        t=np.zeros(0, np.int64),
        std=rows,
        responses=(),
        fisher=square,
        deviation=none,
        correlation=square,
        h=none,
        noncentrality=np.nan,
        smallest_visible=none,
        unseen=np.zeros((0, 2)),
        nonlinearity=none,
        integrity_bias=unknown,
        integrity=unknown,
        integrity_cause=cause,
        over_time=ErrorBounds(rows, rows, np.zeros((0, shown), int)),
    )


PROBABILITY = 0.95
"""Probability that an error stays below the protection level, under the worst undetectable fault."""


class ErrorBounds(NamedTuple):
    """Bounds of the error of each state, row by row, under one undetectable fault from the first row on.

    bias (N, shown): the largest |dx| of any undetectable fault. bound (N, shown): bias + 1.96 σ, exceeded by the error
    with at most 5 %. cause (N, shown): the index of the nudge that causes it, -1 for none.
    """

    bias: np.ndarray
    bound: np.ndarray
    cause: np.ndarray


def integrity(errors: Sequence[np.ndarray], std: np.ndarray) -> ErrorBounds:
    """Return the bounds from the error (N, shown) of the largest undetectable fault of each nudge, and σ (N, shown)."""
    bias = np.zeros(std.shape)
    cause = np.full(std.shape, -1)
    for k, error in enumerate(errors):
        worse = error > bias
        bias[worse], cause[worse] = error[worse], k
    return ErrorBounds(bias, bias + normal_quantile(0.5 + PROBABILITY / 2.0) * std, cause)


TWO_SIGMA = normal_quantile(0.5 + PROBABILITY / 2.0)
"""Half width of a 95 % band in standard deviations, "± 2 σ", as in the protection level."""


class Bound(NamedTuple):
    """Protection level of one state, in `unit`: bounds of its error with a probability of 95 %.

    two_sigma: by the covariance, without a fault; bound: under the worst undetectable fault, which moves it by bias.
    fault: that fault with its undetectable range; "" if none moves the state.
    """

    unit: str
    bound: float
    bias: float
    two_sigma: float
    fault: str


def bounds_of(model: StateSpaceModel, found: Sensitivity) -> dict[str, Bound]:
    """Return the protection levels by state at the last event; none where there is a reason against it."""
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
