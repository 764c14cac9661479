"""Measurements on a twin and its log, each made once when first needed; claims; and numbers in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.detectors import detector_of
from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.repeats import RepeatFinding, find_repeats, sensor_rows
from estimators.diagnostics.score import score
from estimators.diagnostics.sensitivity import Gramian, gramian
from estimators.diagnostics.sensitivity.checklist import MIN_DIFFERENCE, Linearity, linearity
from estimators.diagnostics.sensitivity.posterior import Peaks, peaks
from estimators.diagnostics.sensitivity.responses import digits, stand_in
from estimators.errors import NisusError
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.model.state_space import StateSpaceModel
from estimators.registry import find_entry, unfit

from ...twin.twin import Twin
from ..compare import fold_within

BUDGET_S = 20.0  # seconds of one processor for a fold; of a log that takes longer the first part is folded
MAX_EXCLUDED_SHARE = 0.5  # of a row's readings in faults: with more, not the sensor is wrong but the twin


@dataclass(frozen=True)
class TimedFold:
    """A fold over the log, or the part of it that the budget allows, and the seconds of one processor a reading."""

    fold: Fold
    seconds: float


class Exclusion(NamedTuple):
    """Readings of a sensor row from `start` to `end`, s, that are left out because of a fault."""

    row: str
    cause: str
    start: float
    end: float
    readings: int


def without_faults(twin: Twin, log: Log, known: Sequence[Episode] | None = None) -> tuple[Log, tuple[Exclusion, ...]]:
    """Return the log without the readings of sensors in fault episodes, and these exclusions.

    A fault is an alarm for which the sensor, not the tuning, is examined: biased, rejected, stuck, beyond its limits. A
    row that is in fault for most of the log keeps its readings: they are what the twin has to explain. Episodes that
    are not `known` are found by folding the log with the twin's estimator.
    """
    if known is None:
        known = episodes(Measured(twin, log).folded(twin.estimator).fold)
    t, clean = log.events.t * 1e-9, log.copy()
    found: list[Exclusion] = []
    for sensor, row, column, readings in sensor_rows(twin.model, log.events):
        left_out, listed = np.zeros(log.n, bool), []
        for item in known:
            detector = detector_of(item.cause)
            if item.subject not in (row, sensor) or not (detector.sensor_lost or detector.isolate):
                continue
            end = float(t[-1]) if item.end is None else item.end
            rows = readings & (t >= item.start) & (t <= end)
            if rows.any():
                left_out |= rows
                listed.append(Exclusion(row, item.cause, item.start, end, int(rows.sum())))
        if listed and left_out.sum() <= MAX_EXCLUDED_SHARE * readings.sum():
            clean.value[: log.n, column][left_out] = np.nan
            found += listed
    return (clean, tuple(sorted(found, key=lambda item: (item.start, item.row)))) if found else (log, ())


def repeats_of(model: StateSpaceModel, log: Log) -> dict[str, RepeatFinding]:
    """Return how the measurements of each sensor row repeat."""
    return {
        row: find_repeats(log.events.t[known], log.events.value[:, column][known])
        for _, row, column, known in sensor_rows(model, log.events)
        if known.any()
    }


def repeat_lines(found: Mapping[str, RepeatFinding]) -> list[str]:
    """Return the sensor rows whose measurements are repeats, with the remedy, a line each."""
    lines = []
    for name, one in found.items():
        remedy = f"give its channel in `source` the key repeats: {one.key}" if one.key else "feed it what was measured"
        lines += [f"{name}: {one.reason}; {remedy}, and tune again"] if one.found else []
    return lines


@dataclass
class AdviceProgress:
    """Progress of an advice, for another thread to read.

    `question` is being answered; `done` of about `expected` units of work are over, one for each fold of the log.
    """

    question: str = ""
    done: float = 0.0
    expected: float = 0.0
    check: Callable[[], object] = lambda: None

    def left(self, seconds: float) -> float | None:
        """Return the seconds to come at the rate so far; None before the first answer."""
        return seconds * (self.expected - self.done) / self.done if self.done else None


@dataclass
class Measured:
    """A twin with a log, and its cached measurements; `excluded` readings of the recording are missing in the log.

    `executor` is that of the Gramian, see `gramian`.
    """

    twin: Twin
    log: Log
    excluded: tuple[Exclusion, ...] = ()
    progress: AdviceProgress = field(default_factory=AdviceProgress)
    executor: Executor | str | None = "threads"
    _folds: dict[tuple[str, tuple[tuple[str, float], ...]], TimedFold] = field(default_factory=dict)

    @cached_property
    def rate(self) -> float:
        """Readings per second over the log."""
        times = self.log.events.t[self.log.events.kind == READING]
        span = float(times[-1] - times[0]) * 1e-9 if times.size else 0.0
        return (times.size - 1) / span if span > 0.0 else 0.0

    @cached_property
    def linearity(self) -> Linearity:
        """Comparison of the linearised with the unscented filter."""
        return linearity(self.twin.model, self.twin.tuning, self.log)

    @cached_property
    def gramian(self) -> Gramian:
        """Observability Gramian of the log."""
        name = self.twin.estimator
        if unfit(find_entry(name), self.twin.model):
            name = stand_in("pf", self.twin.model)[0]
        tuning = self.twin.tuning.with_options(self.twin.options_of(name))
        return gramian(name, self.twin.model, tuning, self.log, executor=self.executor)

    @cached_property
    def peaks(self) -> Peaks:
        """Peaks of the posterior, by the twin's own particle cloud if it has one."""
        own = find_entry(self.twin.estimator)
        name = self.twin.estimator if own.peaks is not None else "pf"
        return peaks(name, self.twin.model, self.twin.tuning.with_options(self.twin.options_of(name)), self.log)

    def folded(self, estimator: str, options: Mapping[str, float] | None = None, budget: float = BUDGET_S) -> TimedFold:
        """The log folded by a filter, with the options that the twin has for it, and these.

        Raises:
            EstimatorError: If the filter does not apply.
        """
        given = {**self.twin.options_of(estimator), **(options or {})}
        key = estimator, tuple(sorted(given.items()))
        if key not in self._folds:
            self._folds[key] = self._fold(estimator, given, budget)
        return self._folds[key]

    def likelihood(self, estimator: str) -> float:
        """As `likelihood_of` a fold of the log; minus infinity where it fails."""
        try:
            fold = self.folded(estimator).fold
        except NisusError:
            return -np.inf
        return likelihood_of(fold, fold.n)

    def _fold(self, estimator: str, options: Mapping[str, float], budget: float) -> TimedFold:
        twin, log = self.twin, self.log
        tuning = replace(twin.tuning, baseline=None).with_options(options)
        fold = Fold(estimator, twin.model, tuning, log.copy(), policy=twin.policy, expected=twin.expected)
        seconds = fold_within(fold, budget, check=self.progress.check)
        # The fold ends where the budget ended.
        fold.log.n = fold.n
        readings = int(np.sum(log.kind[: fold.n] == READING))
        return TimedFold(fold, seconds * fold.n / max(1, readings))


def likelihood_of(fold: Fold, n: int) -> float:
    """Log-likelihood of a reading, the mean over those used and refused among the first n events, nats."""
    part = slice(0, n)
    found = score(fold.track.select(part), fold.log.events.select(part), fold.model, (), gate=fold.tuning.gate)
    return found.log_likelihood / max(1, found.readings + found.gated)


YES, NO, UNTOLD = "yes", "no", "not told"


@dataclass(frozen=True)
class Claim:
    """A question and its answer.

    `figure` is the number that decides, `threshold` the limit that it is compared with, and `of` names their quantity
    and unit; the figure is None where nothing could be measured, and `answer` is then declared by the model or "not
    told". `reason` has the arithmetic; `remedy` is what to do beside the choice of a filter, if anything.
    """

    key: str
    question: str
    answer: str
    figure: float | None
    threshold: float | None
    of: str
    reason: str
    remedy: str = ""


__all__ = ["apart_text", "bytes_text", "digits", "percent", "seconds_text"]

_BYTES = ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB"), (1.0, "B"))
_SECONDS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))


def apart_text(sigma: float) -> str:
    """Return a distance in σ; a very small one as "less than"."""
    return f"less than {MIN_DIFFERENCE:g} σ" if sigma < MIN_DIFFERENCE else f"{digits(sigma)} σ"


def bytes_text(count: float) -> str:
    """Return a number of bytes with a prefix."""
    return _prefixed(count, _BYTES)


def seconds_text(seconds: float) -> str:
    """Return a time below minutes with a prefix."""
    return _prefixed(seconds, _SECONDS)


def _prefixed(value: float, steps: Sequence[tuple[float, str]]) -> str:
    size, unit = next((step for step in steps if value >= step[0]), steps[-1])
    return f"{value / size:.3g} {unit}"


def percent(share: float) -> str:
    """Return a share in percent: an integer from ten on, two digits below; nearly all is not rounded to all."""
    if not math.isfinite(share):
        return "unknown"
    if 0.995 <= share < 1.0:
        return f"{math.floor(10_000.0 * share) / 100.0:.2f} %"
    return f"{100.0 * share:.0f} %" if share >= 0.1 else f"{100.0 * share:.2g} %"
