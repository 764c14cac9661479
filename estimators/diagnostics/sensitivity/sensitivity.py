"""Minimal detectable faults, protection levels and Fisher information of a twin, by refolding its log with nudges.

A nudge is a small change of a sensor, an input or a parameter. The protection level (integrity bound) of a state is the
bound of its error under an undetectable fault.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ...errors import EstimatorError
from ...log import READING, Log
from ...model.state_space import StateSpaceModel
from ...numerics.quantiles import normal_quantile
from ...registry import find_estimator
from ...snapshots import Base
from ...track import TRACKING, USED, Track
from ...tuning import Tuning
from ..health import HealthPolicy
from .gramian import Uncertainty, information, uncertainty
from .responses import (
    BY_ALARMS,
    CATALOGUE,
    FROM_PRIOR,
    KINDS,
    MAX_CHECKED_EVENTS,
    MAX_REFOLD_OPERATIONS,
    NOISES,
    NOW,
    PRIOR,
    STEP,
    SWAP,
    SWITCHED,
    Nudge,
    Response,
    Start,
    astray,
    each,
    max_events,
    nonlinear_note,
    nudges_of,
    reason_against,
    start,
)
from .visibility import FaultTests, UndetectableFault, fault_tests, undetectable_fault

PROBABILITY = 0.95  # Probability that an error stays below the protection level, under the worst undetectable fault

TWO_SIGMA = normal_quantile(0.5 + PROBABILITY / 2.0)
"""Half width of a 95 % band in standard deviations, "± 2 σ", as in the protection level."""

MAX_NONLINEARITY = 0.5
"""Median nonlinearity of the nudges from which the result has a note that derivatives are unreliable."""

BANK, BEST = WITNESSES = ("bank", "best")
"""Tests for a fault: the detectors of the twin, or the optimal test of a known fault."""


MAX_PRIOR_SHARE = 0.1
"""Share of an error of the prior, in prior deviations, from which on a state remembers it."""

MIN_CHECKED_EVENTS = 1000  # Events that are refolded at least, of logs that have as many

DETECTION_SHARE = 0.25  # Share of the time within which one log must show an alarm that others are to show, too
ALARM_BISECTIONS = 5  # Of the factor on a variance, between 1 and a hundred: to 15 %; of a delay, to a thirtieth


class ErrorBounds(NamedTuple):
    """Bounds of the error of each state, row by row, under one undetectable fault from the first row on.

    bias (N, shown): the largest |dx| of any undetectable fault. bound (N, shown): bias + 1.96 σ, exceeded by the error
    with at most 5 %. Both are at most the distance between the limits of a state. cause (N, shown): the index of the
    nudge that causes it, -1 for none.
    """

    bias: np.ndarray
    bound: np.ndarray
    cause: np.ndarray


NOTHING = np.zeros((0, 0))


class Sensitivity(NamedTuple):
    """Sensitivity of a fold to k nudges over its last N events.

    estimator: the filter that was nudged. reason: why nothing was computed and all arrays are empty, or ""; note: a
    remark on the result, or "". t (N,): times of the events, ns; first: index of the first in the log. std (N, shown):
    σ of the states without nudge. faults: one for each nudge. fisher (k, k): Fisher information of the
    constant nudges, which are the first. h (rows,): thresholds of the tests by sensor row; noncentrality: the λ that
    passes them with the requested probability. bounds: protection levels after each event. begin: beginning of the
    faults, `NOW` (first event) or `PRIOR`. tests: of these innovations, whose deviations are innovation_std (N, ny).
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
    begin: str = NOW
    tests: FaultTests | None = None
    innovation_std: np.ndarray = NOTHING

    @property
    def window(self) -> float:
        """Duration of the faults, s."""
        return float(self.t[-1] - self.t[0]) * 1e-9 if self.t.size else 0.0

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

    def multiple(self, parts: Iterable[tuple[str, str, float]]) -> float:
        """Return the detectable multiple of faults at once, each of a kind, name and size; NaN if it is not known.

        By their derivatives: the effects on the innovations add up, or cancel.
        """
        known = {(fault.nudge.kind, fault.nudge.name): fault.response for fault in self.faults}
        found = [(known.get((kind, name)), size) for kind, name, size in parts]
        responses = [(one, size) for one, size in found if one is not None and one.whitened.size]
        if self.tests is None or len(responses) < len(found):
            return np.nan
        whitened = np.sum([size * one.whitened for one, size in responses], axis=0)
        moved = np.sum([size * one.innovation for one, size in responses], axis=0)
        return self.tests.multiple(whitened, moved / self.innovation_std)

    def among(self, indices: Sequence[int] | None = None) -> Uncertainty:
        """Return the uncertainty of constant nudges if these are unknown and all others known; None for all."""
        some = list(range(len(self.fisher)) if indices is None else indices)
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
    begin: str = NOW,
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
        kinds: Kinds of nudges, of `CATALOGUE`; those of `FROM_PRIOR` only if faults begin there.
        most: Number of events to refold; None for at most seconds and 256 MB.
        begin: `NOW` for faults of the last events, `PRIOR` for faults of the first ones, present from the prior on.
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
    begun = start(estimator, model, tuning, log, base, most or max_events(model, count), begin)
    if begin != PRIOR:
        kinds = [kind for kind in kinds if kind not in FROM_PRIOR]
    nudges = nudges_of(model, tuning, begun.log, kinds, begun.track)
    reason = astray(estimator, begun.estimator, begun.track)
    if reason or not nudges:
        return Sensitivity(estimator, reason or f"{model.name} has nothing to nudge of {', '.join(kinds)}")
    track = begun.track
    bank = seen_by == BANK
    tests = fault_tests(model, tuning, begun.log, track, every=false_alarm, detection=detection, bank=bank)
    constant = [nudge.kind in KINDS for nudge in nudges].count(True)
    own = _for_alarms(begun, estimator, tuning, sum(nudge.kind in BY_ALARMS for nudge in nudges))
    faults = each(partial(_undetectable, begun, own, tests), nudges, executor)
    bias, cause = np.zeros(track.std.shape), np.full(track.std.shape, -1)
    for k, fault in enumerate(faults):
        worse = fault.error > bias
        bias[worse], cause[worse] = fault.error[worse], k
    spans = np.array([np.inf if item.limits is None else np.ptp(item.limits) for item in model.shown_states])
    notes = [begun.note]
    if constant and np.median([fault.nonlinearity for fault in faults[:constant]]) > MAX_NONLINEARITY:
        notes.append(nonlinear_note(begun.estimator, tuning, "Fisher information is unreliable here"))
    used = track.verdict == USED
    return Sensitivity(
        estimator=begun.estimator,
        reason="",
        note="; ".join(filter(None, notes)),
        first=begun.first,
        t=begun.log.events.t.copy(),
        std=track.std.copy(),
        faults=tuple(faults),
        fisher=information([fault.response.whitened[used] for fault in faults[:constant]]),
        h=tests.h,
        noncentrality=tests.noncentrality,
        bounds=ErrorBounds(np.minimum(bias, spans), np.minimum(bias + TWO_SIGMA * track.std, spans), cause),
        begin=begin,
        tests=tests,
        innovation_std=track.innovation_std,
    )


def sensitivities(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    *,
    false_alarm: float = HealthPolicy().false_alarm_every,
    executor: Executor | str | None = "threads",
) -> tuple[Sensitivity, ...]:
    """Return the sensitivity to all faults of `CATALOGUE`: present from the prior on, and beginning later, twice.

    Over as many events as the slowest state remembers, from the prior on; for those beginning later, a third of the log
    at most, as shorter faults are harder to detect, at its end and just before: the asset is driven differently there.
    For the arguments see `sensitivity`.
    """
    find_estimator(estimator, model)
    reason = reason_against(model, log)
    if not reason and model.jump is not None:
        # Nudged, it finds faults visible that a filter of the modes follows by a wrong mode.
        reason = f"{model.name} jumps between modes, and a filter that is nudged has one mean of them"
    if reason:
        return Sensitivity(estimator, reason, begin=PRIOR), Sensitivity(estimator, reason)
    most = max_events(model, len(nudges_of(model, tuning, log, CATALOGUE)), MAX_CHECKED_EVENTS)
    window = _remembered(start(estimator, model, tuning, log, None, most, PRIOR), executor)

    def of(begin: str, events: int, log: Log = log) -> Sensitivity:
        return sensitivity(
            estimator, model, tuning, log, kinds=CATALOGUE, most=events, begin=begin, false_alarm=false_alarm,
            executor=executor,
        )  # fmt: skip

    third = max(1, min(window, log.n // 3))
    earlier = log.copy()
    earlier.n = log.n - third
    late = [one for one in (log, earlier) if np.any(one.events.kind == READING)]
    return of(PRIOR, window), *(of(NOW, third, one) for one in late)


def _remembered(begun: Start, executor: Executor | str | None) -> int:
    """Return the number of events from the prior after which its errors are forgotten; all if one never is."""
    states = [int(j) for j in np.flatnonzero(begun.tuning.model.prior_std > 0.0)]
    found = each(partial(_events_of, begun), states, executor)
    return min(begun.log.n, max([MIN_CHECKED_EVENTS, *found]))


def _events_of(begun: Start, j: int) -> int:
    """Return the number of events from the prior after which an error of state j is forgotten."""
    model, scale = begun.tuning.model, begun.tuning.model.prior_std
    uncertain = scale[model.shown] > 0.0
    nudge = Nudge(PRIOR, model.state_names[j], "", STEP * scale[j], -np.inf, np.inf, scale[j])
    left = np.abs(begun.respond(nudge).states[:, uncertain]) * scale[j] / scale[model.shown][uncertain]
    rows = np.flatnonzero(~(left <= MAX_PRIOR_SHARE).all(axis=1))
    return int(rows[-1]) + 2 if rows.size else 1


def _for_alarms(begun: Start, estimator: str, tuning: Tuning, nudges: int) -> Start:
    """Return a start of the twin's own filter, as alarms need no differences, unless so many nudges cost too much."""
    entry, model = find_estimator(estimator, tuning.model), tuning.model
    if begun.estimator == estimator or not nudges:
        return begun
    numbers = entry.state_size(entry.complete(tuning.options), model.nx) * begun.log.n
    if 2 * (ALARM_BISECTIONS + 1) * nudges * numbers > MAX_REFOLD_OPERATIONS:
        return begun
    return Start.of(estimator, replace(tuning, gate=None), begun.log, begun.base._replace(state=None))


def _undetectable(begun: Start, own: Start, tests: FaultTests, nudge: Nudge) -> UndetectableFault:
    """Return the undetectable sizes of a nudge of any kind; `own`: with the twin's own filter, for alarms."""
    if nudge.kind in BY_ALARMS:
        return _undetectable_by_alarms(own, nudge)
    if nudge.kind not in SWITCHED:
        return undetectable_fault(begun, nudge, begun.respond(nudge), tests)
    track = begun.with_fault(nudge, 1.0)
    response = begun.moved(track)
    if nudge.kind == SWAP:
        hidden = tests.multiple(response.whitened, response.innovation / begun.track.innovation_std) > 1.0
    else:
        hidden = not _alarmed(begun, track)
    hidden &= bool(np.all(np.isfinite(response.states)))
    size, error = (1.0, np.abs(response.states)) if hidden else (0.0, np.zeros_like(begun.track.mean))
    return UndetectableFault(nudge, response, 0.0, size, np.inf if hidden else 1.0, error, 0.0)


def _alarmed(begun: Start, track: Track) -> bool:
    """Return whether a refold has an alarm of a sensor that the fold without nudge never has.

    In the first quarter of the time: by then a fault is found that is found in nearly every log, as the time to an
    alarm has an exponential tail. Where health reports something without the fault, too, nobody sees the change.
    """
    log, calm = begun.log, begun.track
    sensor = np.where(log.events.kind == READING, log.events.channel, -1)
    raised = np.zeros_like(calm.alarms)
    for s in np.unique(sensor):
        raised[sensor == s] = np.bitwise_or.reduce(calm.alarms[sensor == s], axis=0)
    soon = log.events.t <= log.t[0] + DETECTION_SHARE * (log.t[log.n - 1] - log.t[0])
    new = np.any(track.alarms & ~raised, axis=1) | ((track.flags != 0) & (calm.flags == 0))
    seen = (calm.health == TRACKING) & (track.health != TRACKING)
    return bool(np.any(new & soon & seen))


def _undetectable_by_alarms(begun: Start, nudge: Nudge) -> UndetectableFault:
    """Return the undetectable factors on a variance, delays, or spikes: the detectors raise no new alarm in this log.

    If the other variance is right, the estimate is off by its change, and its band is that of the other. Measurements
    are delayed with their noise, so that the innovations change by more than their mean.
    """
    calm = begun.track
    none = np.zeros_like(calm.mean)

    def tried(size: float) -> tuple[bool, np.ndarray]:
        track = begun.with_fault(nudge, size)
        error = np.abs(begun.moved(track).states) + TWO_SIGMA * np.maximum(track.std - calm.std, 0.0)
        return _alarmed(begun, track) or not np.all(np.isfinite(error)), error

    def between(one: float, other: float) -> float:
        return float(np.sqrt((1.0 + one) * (1.0 + other))) - 1.0 if nudge.kind in NOISES else 0.5 * (one + other)

    def extent(size: float) -> float:
        return max(1.0 + size, 1.0 / (1.0 + size)) - 1.0 if nudge.kind in NOISES else abs(size)

    sizes, shown, errors = [], np.inf, none
    for limit in (nudge.low, nudge.high):
        if limit == 0.0:
            sizes.append(0.0)
            continue
        hidden = limit
        alarmed, error = tried(limit)
        if alarmed:
            hidden, error, beyond = 0.0, none, limit
            for _ in range(ALARM_BISECTIONS):
                middle = between(hidden, beyond)
                alarmed, moved = tried(middle)
                if alarmed:
                    beyond = middle
                else:
                    hidden, error = middle, moved
            shown = min(shown, extent(beyond))
        sizes.append(hidden)
        errors = np.maximum(errors, error)
    return UndetectableFault(nudge, Response(NOTHING, NOTHING, NOTHING), sizes[0], sizes[1], shown, errors, 0.0)


class Bound(NamedTuple):
    """Protection level of one state, in `unit`: bounds of its error with a probability of 95 %.

    two_sigma: by the covariance, without a fault; bound: under the worst undetectable fault, which moves it by bias.
    fault: that fault with its undetectable range; "" if none moves the state. begin: of the fault, `NOW` or `PRIOR`;
    window: its duration, s.
    """

    unit: str
    bound: float
    bias: float
    two_sigma: float
    fault: str
    begin: str = NOW
    window: float = 0.0


def bounds_of(model: StateSpaceModel, *found: Sensitivity) -> dict[str, Bound]:
    """Return the largest protection level by state at the last event; none where there is a reason against it."""
    bounds: dict[str, Bound] = {}
    for one in found:
        for k, state in enumerate(() if one.reason else model.shown_states):
            bias, bound, cause = (column[-1, k] for column in one.bounds)
            fault = one.faults[cause].text if cause >= 0 else ""
            two_sigma = TWO_SIGMA * float(one.std[-1, k])
            level = Bound(state.unit, float(bound), float(bias), two_sigma, fault, one.begin, one.window)
            if state.name not in bounds or level.bound > bounds[state.name].bound:
                bounds[state.name] = level
    return bounds


def worse_faults(*found: Sensitivity) -> list[tuple[UndetectableFault, Sensitivity]]:
    """Return the fault of every nudge that is harder to detect, with the sensitivity that it belongs to."""
    worse: dict[tuple[str, str], tuple[UndetectableFault, Sensitivity]] = {}
    for one in found:
        for fault in one.faults:
            key = fault.nudge.kind, fault.nudge.name
            known = worse.get(key)
            if known is None or _hidden(fault) > _hidden(known[0]):
                worse[key] = fault, one
    return list(worse.values())


def _hidden(fault: UndetectableFault) -> tuple[float, float]:
    """Return the smallest visible size and the extent of the undetectable range, by which faults are compared."""
    return fault.visible, fault.high - fault.low


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
