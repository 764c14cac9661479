"""All that `nisus check` measures of a twin."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from estimators.diagnostics.calibration import Calibration
from estimators.diagnostics.episodes import Episode, episodes
from estimators.diagnostics.sensitivity import Gramian, Sensitivity, gramian, sensitivity
from estimators.diagnostics.sensitivity.checklist import Arrivals, Dimension, Linearity, arrivals, dimension, linearity
from estimators.diagnostics.sensitivity.held_out import HeldOut, held_out
from estimators.diagnostics.sensitivity.posterior import Peaks, Tail, peaks, tails
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.registry import find_entry

from ..studies.compare import timed
from ..studies.fold_result import calibration_of
from ..twin.twin import Twin

BUDGET = 20.0
"""Seconds of one processor for the folds with a sensor held out; of a log that takes longer the first part is taken."""


@dataclass(frozen=True)
class Checked:
    """All that was measured of a twin. `span` is the part of the log, from its start, that was folded, s; None: all."""

    twin: Twin
    log: Log
    fold: Fold
    counts: Counter[str]
    span: float | None
    dimension: Dimension
    linearity: Linearity
    peaks: Peaks
    tails: tuple[Tail, ...]
    gramian: Gramian
    sensitivity: Sensitivity
    arrivals: tuple[Arrivals, ...]
    calibration: list[Calibration]
    episodes: list[Episode]
    held_out: HeldOut


def check(twin: Twin, log: Log, counts: Counter[str]) -> Checked:
    """Measure all there is to say of a twin over a log.

    Raises:
        NisusError: If the twin's own filter does not run.
    """
    model, tuning = twin.model, twin.tuning
    speak = np.unique(log.channel[: log.n][log.kind[: log.n] == READING]).size
    fold, seconds = timed(twin, twin.estimator, log.events, tuning.seed, BUDGET / (speak + 2))
    span = None
    if fold.n < log.n:
        span = float(log.t[fold.n - 1] - log.t[0]) * 1e-9
        log.n = fold.log.n = fold.n
    fold.finish()
    readings = int(np.sum(log.kind[: log.n] == READING))
    covariance = fold.estimator.family not in ("particle", "ensemble")
    given = model, tuning, log
    return Checked(
        twin=twin,
        log=log,
        fold=fold,
        counts=counts,
        span=span,
        dimension=dimension(model, _rate(log), seconds * log.n / max(1, readings), covariance=covariance),
        linearity=linearity(*given),
        peaks=_peaks(twin, log),
        tails=tails(model, log, fold.track, marginal=fold.marginal),
        gramian=gramian(twin.estimator, *given),
        sensitivity=sensitivity(twin.estimator, *given, false_alarm=twin.policy.false_alarm_every),
        arrivals=tuple(item for item, fed in zip(arrivals(model, log), twin.expected, strict=True) if fed or item.n),
        calibration=calibration_of(twin, fold),
        episodes=episodes(fold),
        held_out=held_out(twin.estimator, *given),
    )


def _rate(log: Log) -> float:
    """Readings a second."""
    times = log.t[: log.n][log.kind[: log.n] == READING]
    span = float(times[-1] - times[0]) * 1e-9 if times.size else 0.0
    return (times.size - 1) / span if span > 0.0 else 0.0


def _peaks(twin: Twin, log: Log) -> Peaks:
    """By the twin's own cloud, if it has one."""
    own = find_entry(twin.estimator)
    name = twin.estimator if own.peaks is not None else "pf"
    return peaks(name, twin.model, twin.tuning.with_options(twin.options_of(name)), log)
