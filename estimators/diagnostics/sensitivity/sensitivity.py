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
    astray,
    each,
    max_events,
    nonlinear_note,
    nudges_of,
    reason_against,
    start,
)
from .visibility import UndetectableFault, fault_tests, undetectable_fault

PROBABILITY = 0.95  # Probability that an error stays below the protection level, under the worst undetectable fault

TWO_SIGMA = normal_quantile(0.5 + PROBABILITY / 2.0)
"""Half width of a 95 % band in standard deviations, "± 2 σ", as in the protection level."""

MAX_NONLINEARITY = 0.5
"""Median nonlinearity of the nudges from which the result has a note that derivatives are unreliable."""

BANK, BEST = WITNESSES = ("bank", "best")
"""Tests for a fault: the detectors of the twin, or the optimal test of a known fault."""


class ErrorBounds(NamedTuple):
    """Bounds of the error of each state, row by row, under one undetectable fault from the first row on.

    bias (N, shown): the largest |dx| of any undetectable fault. bound (N, shown): bias + 1.96 σ, exceeded by the error
    with at most 5 %. cause (N, shown): the index of the nudge that causes it, -1 for none.
    """

    bias: np.ndarray
    bound: np.ndarray
    cause: np.ndarray


NOTHING = np.zeros((0, 0))


class Sensitivity(NamedTuple):
    """Sensitivity of a fold to k nudges over its last N events.

    estimator: the filter that was nudged. reason: why nothing was computed and all arrays are empty, or ""; note: a
    remark on the result, or "". t (N,): times of the events, ns; first: index of the first in the log. std (N, shown):
    σ of the states without nudge. faults: one for each nudge, k in all. fisher (k, k): Fisher information of the
    nudges. h (rows,): thresholds of the tests by sensor row; noncentrality: the λ that passes them with the requested
    probability. bounds: protection levels after each event.
    """

    estimator: str
    reason: str
    note: str = ""
    first: int = 0
    t: np.ndarray = np.zeros(0, np.int64)
    std: np.ndarray = NOTHING
    faults: tuple[UndetectableFault, ...] = ()
    fisher: np.ndarray = NOTHING
    h: np.ndarray = np.zeros(0)
    noncentrality: float = np.nan
    bounds: ErrorBounds = ErrorBounds(NOTHING, NOTHING, NOTHING)

    @property
    def nudges(self) -> tuple[Nudge, ...]:
        """The nudges, in the order of the arrays."""
        return tuple(fault.nudge for fault in self.faults)

    def place(self, kind: str, name: str) -> int:
        """Return the index of a nudge in the arrays.

        Raises:
            ValueError: If there is no such nudge.
        """
        return [(nudge.kind, nudge.name) for nudge in self.nudges].index((kind, name))

    def among(self, indices: Sequence[int] | None = None) -> Uncertainty:
        """Return the uncertainty of some nudges if these are unknown and all others are known; None for all."""
        some = list(range(len(self.faults)) if indices is None else indices)
        return uncertainty(self.fisher[np.ix_(some, some)])


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
        log: The events; it must not grow meanwhile (give a copy). Rejected measurements stay rejected.
        base: Where the log starts, if older events were dropped; see `Fold.base_at`.
        kinds: Kinds of nudges, of "sensor", "input", "parameter".
        most: Number of events to refold, from the end; None for at most seconds and 256 MB.
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
        return Sensitivity(estimator, reason)
    count = len(model.row_names) + model.nu + len(model.parameters)
    begun = start(estimator, model, tuning, log, base, most or max_events(model, count))
    nudges = nudges_of(model, tuning, begun.log, kinds)
    reason = astray(estimator, begun.estimator, begun.track)
    if reason or not nudges:
        return Sensitivity(estimator, reason or f"{model.name} has nothing to nudge of {', '.join(kinds)}")
    track = begun.track
    bank = seen_by == BANK
    tests = fault_tests(model, tuning, begun.log, track, every=false_alarm, detection=detection, bank=bank)
    responses = each(begun.respond, nudges, executor)
    faults = each(lambda item: undetectable_fault(begun, *item, tests), zip(nudges, responses, strict=True), executor)
    bias, cause = np.zeros(track.std.shape), np.full(track.std.shape, -1)
    for k, fault in enumerate(faults):
        worse = fault.error > bias
        bias[worse], cause[worse] = fault.error[worse], k
    notes = [begun.note]
    if np.median([fault.nonlinearity for fault in faults]) > MAX_NONLINEARITY:
        notes.append(nonlinear_note(begun.estimator, tuning, "Fisher information is unreliable here"))
    used = track.verdict == USED
    return Sensitivity(
        estimator=begun.estimator,
        reason="",
        note="; ".join(filter(None, notes)),
        first=begun.first,
        t=begun.log.t[: begun.log.n].copy(),
        std=track.std.copy(),
        faults=tuple(faults),
        fisher=information([response.whitened[used] for response in responses]),
        h=tests.h,
        noncentrality=tests.noncentrality,
        bounds=ErrorBounds(bias, bias + TWO_SIGMA * track.std, cause),
    )


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
    bounds = {}
    for k, state in enumerate(() if found.reason else model.shown_states):
        bias, bound, cause = (column[-1, k] for column in found.bounds)
        fault = found.faults[cause].text if cause >= 0 else ""
        bounds[state.name] = Bound(state.unit, float(bound), float(bias), TWO_SIGMA * float(found.std[-1, k]), fault)
    return bounds


class Smallest(NamedTuple):
    """The minimal detectable fault of one sensor row, input or parameter, in words: `2.1 °C`, or `none`.

    `share` is its size in units of the nudge's scale (a sensor's σ, an input's spread, a parameter's value), infinite
    if none is detectable; `unseen` is the range of undetectable sizes.
    """

    subject: str
    size: str
    share: float
    unseen: str


def smallest_of(found: Sensitivity) -> tuple[Smallest, ...]:
    """Return the minimal detectable fault of every nudge; none where there is a reason against it."""
    return tuple(
        Smallest(
            fault.nudge.subject,
            fault.nudge.size_text(fault.visible) if np.isfinite(fault.visible) else "none",
            fault.visible / fault.nudge.scale,
            fault.range_text,
        )
        for fault in found.faults
    )
