"""One row of a comparison: a filter folded over a log, over several seeds where it draws its members."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.score import Fit, score
from estimators.errors import NisusError
from estimators.estimator import Estimator
from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.registry import find_estimator
from estimators.track import DIVERGED

from ..twin.twin import Twin

SEEDS = 8
"""Folds of a filter that draws its members; one makes do for the others."""

BUDGET = 20.0
"""Seconds of one processor for the folds of one filter, if nobody says otherwise."""

ENOUGH = 0.2
"""Seconds that a fold is timed for."""


class Figure(NamedTuple):
    """A mean over seeds (or logs), and the standard deviation of one of them; NaN where there is only one."""

    value: float
    spread: float = np.nan


@dataclass(frozen=True)
class Row:
    """What one filter made of the log.

    `rmse` by unit: the root mean square over the states of that unit whose truth is known, or, where no truth is,
    over the sensors held out. `coverage` is the share of those errors inside their 95 % band. `span` is the part of
    the log that was folded, s, or None for all of it. `diverged` is how many of the `seeds` folds did, `since` when
    the first of them did (s from the log's start), `lost` the share of all events. `refused` is the share of the
    readings that the gate refused, which are in no other figure. `failure` says why there are no numbers.
    """

    estimator: str
    rmse: Mapping[str, Figure]
    nis: Figure
    nis_bounds: tuple[float, float]
    coverage: Figure
    seconds_per_step: float
    options: Mapping[str, float]
    seeds: int = 1
    span: float | None = None
    diverged: int = 0
    since: float = np.nan
    lost: float = 0.0
    refused: float = 0.0
    failure: str = ""


class Outcome(NamedTuple):
    """What one fold was worth; see `Row`."""

    rmse: dict[str, float]
    nis: float
    nis_bounds: tuple[float, float]
    coverage: float
    seconds_per_step: float
    since: float
    lost: float
    refused: float


def draws(entry: Estimator) -> bool:
    """Whether the filter draws members, so that its estimate depends on the seed."""
    return any(option.name in ("particles", "members") for option in entry.options)


def fold_row(twin: Twin, estimator: str, logs: Sequence[Events], budget: float = BUDGET) -> Row:
    """Fold one filter over each of the logs, or, if it draws and there is one log, over that with several seeds.

    A filter that takes more than `budget` seconds of one processor folds a shorter span of the log; but the one that
    the twin runs first folds all of it, whatever that takes.
    """
    entry = find_estimator(estimator, twin.model)
    options = dict(twin.options_of(estimator))
    folds = max(len(logs), SEEDS if draws(entry) else 1)
    share = np.inf if estimator == twin.estimator else budget / folds
    outcomes: list[Outcome] = []
    span = None
    try:
        for k in range(folds):
            events = within(logs[k % len(logs)], span)
            fold, seconds = timed(twin, estimator, events, k, share if k == 0 else np.inf, ENOUGH if k == 0 else 0.0)
            if fold.n < len(events):
                span = tidy((events.t[fold.n - 1] - events.t[0]) * 1e-9)
                events = within(events, span)
            outcomes.append(outcome_of(fold, events, seconds))
    except NisusError as error:
        nothing = Figure(np.nan)
        return Row(estimator, {}, nothing, (np.nan, np.nan), nothing, np.nan, options, failure=str(error))
    return row_of(estimator, outcomes, options, span)


def refold(twin: Twin, estimator: str, events: Events, seed: int = 0) -> Outcome:
    """Fold one filter over all the events."""
    fold, seconds = timed(twin, estimator, events, seed, np.inf, enough=0.0)
    return outcome_of(fold, events, seconds)


def within(events: Events, span: float | None) -> Events:
    """The events of the first `span` seconds."""
    if span is None:
        return events
    return events.select(slice(0, int(np.searchsorted(events.t, events.t[0] + round(span * 1e9), side="right"))))


def tidy(seconds: float) -> float:
    """The next lower of 1, 2, 5, 10, 20, ... (or 0.5, 0.2, ...)."""
    power = 10.0 ** np.floor(np.log10(seconds))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= seconds))


def timed(
    twin: Twin, estimator: str, events: Events, seed: int, budget: float, enough: float = ENOUGH
) -> tuple[Fold, float]:
    """Fold the events, or what the budget (s) allows; a short fold again and again, as other work disturbs it.

    Returns:
        The fold, and the shortest time an event, s of one processor.
    """
    log = Log.of(twin.model, capacity=max(1, len(events)))
    log.extend(events)
    tuning = replace(twin.tuning.with_options(twin.options_of(estimator)), seed=seed)
    fold = Fold(estimator, twin.model, tuning, log, pairs=twin.pairs, policy=twin.policy, expected=twin.expected)
    took: list[float] = []
    while not took or (sum(took) < enough and fold.n == log.n):
        fold.rewind(0)
        begun = time.process_time()
        limit, spent = 1, 0.0
        while fold.advance(limit if np.isfinite(budget) else None) and spent < budget:
            spent = time.process_time() - begun
            # What the rest of the budget allows, judged by what was folded; not more than that again.
            limit = max(1, int(fold.n * min(1.0, budget / spent - 1.0)))
        t = log.t
        # A span ends between two times, and has a length.
        while fold.n < log.n and (t[fold.n] == t[fold.n - 1] or t[fold.n - 1] == t[0]):
            fold.advance(1)
        took.append(time.process_time() - begun)
        if fold.failure is not None:
            raise fold.failure
    return fold, min(took) / fold.n


def outcome_of(fold: Fold, events: Events, seconds: float) -> Outcome:
    """What a fold was worth over its first events, which are these."""
    model, track = fold.model, fold.track.select(slice(0, len(events)))
    fold.finish()
    pictures = () if fold.pictures is None else [one for one in fold.pictures.taken if one.before <= len(events)]
    result = score(track, events, model, pictures, gate=fold.tuning.gate)
    fits, units = result.states, {state.name: state.unit for state in model.shown_states}
    if result.field is not None and model.grid is not None:
        fits, units = {model.grid.name: result.field}, {model.grid.name: model.grid.unit}
    if not fits:
        fits = result.held_out
        row_units = [row.unit for sensor in model.sensors for row in sensor.rows]
        units = dict(zip(model.row_names, row_units, strict=True))
    groups: dict[str, list[Fit]] = {}
    for name, fit in fits.items():
        groups.setdefault(units[name], []).append(fit)
    # A probability has no band (see `StateSpaceModel.label`).
    mode = model.jump.state if model.jump else None
    covered = [fit.coverage for name, fit in fits.items() if name != mode]
    lost = np.flatnonzero(track.health == DIVERGED)
    return Outcome(
        rmse={unit: float(np.sqrt(np.mean([fit.rmse**2 for fit in group]))) for unit, group in groups.items()},
        nis=result.nis,
        nis_bounds=(result.nis_low, result.nis_high),
        coverage=float(np.mean(covered)) if covered else np.nan,
        seconds_per_step=seconds,
        since=float((events.t[lost[0]] - events.t[0]) * 1e-9) if lost.size else np.nan,
        lost=lost.size / len(track),
        refused=result.refused if result.gated else 0.0,
    )


def row_of(estimator: str, outcomes: Sequence[Outcome], options: Mapping[str, float], span: float | None) -> Row:
    """Outcomes of several seeds or logs as one row."""
    since = [outcome.since for outcome in outcomes if np.isfinite(outcome.since)]
    return Row(
        estimator=estimator,
        rmse={unit: _figure([outcome.rmse[unit] for outcome in outcomes]) for unit in outcomes[0].rmse},
        nis=_figure([outcome.nis for outcome in outcomes]),
        nis_bounds=outcomes[0].nis_bounds,
        coverage=_figure([outcome.coverage for outcome in outcomes]),
        seconds_per_step=min(outcome.seconds_per_step for outcome in outcomes),
        options=options,
        seeds=len(outcomes),
        span=span,
        diverged=len(since),
        since=min(since, default=np.nan),
        lost=float(np.mean([outcome.lost for outcome in outcomes])),
        refused=float(np.mean([outcome.refused for outcome in outcomes])),
    )


def _figure(values: Sequence[float]) -> Figure:
    return Figure(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else np.nan)
