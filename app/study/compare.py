"""Comparison of filters over one log, with several seeds for filters that draw random members."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimators.diagnostics.score import Fit, score
from estimators.errors import EstimatorError, NisusError
from estimators.estimator import Estimator
from estimators.fold import Fold
from estimators.log import MARK, Events, Log
from estimators.registry import ESTIMATORS, find_entry, find_estimator, unfit
from estimators.track import DIVERGED

from ..columns import units_by_name
from ..twin.twin import Twin, load_twin, with_held
from .processes import results
from .scores import FilterScore, Spread, pictures_of

SEEDS = 8  # folds of a filter that draws random members; others are folded once
BUDGET_S = 20.0  # default processor seconds for the folds of one filter
MIN_TIMED_S = 0.2  # processor seconds for which a fold is timed


def draws(entry: Estimator) -> bool:
    """Return whether the filter draws random members, so that its estimate depends on the seed."""
    return any(option.name in ("particles", "members") for option in entry.options)


def fold_row(
    twin: Twin,
    estimator: str,
    logs: Sequence[Events],
    budget: float = BUDGET_S,
    scored: tuple[int, int] | None = None,
) -> FilterScore:
    """Fold one filter over each of the logs, or, if it draws and there is one log, over that with several seeds.

    A filter that takes more than `budget` seconds of one processor folds a shorter span of the log; but the one that
    the twin runs first folds all of it, whatever that takes. A filter that cannot consider parameters holds them.
    `scored` are the times, ns, between which it is scored.
    """
    twin = able(twin, estimator)
    entry = find_estimator(estimator, twin.model)
    options = dict(twin.options_of(estimator))
    folds = max(len(logs), SEEDS if draws(entry) else 1)
    share = np.inf if estimator == twin.estimator else budget / folds
    outcomes: list[FilterScore] = []
    span = None
    try:
        for k in range(folds):
            events = within(logs[k % len(logs)], span)
            fold, seconds = timed(
                twin, estimator, events, k, share if k == 0 else np.inf, MIN_TIMED_S if k == 0 else 0.0
            )
            if fold.n < len(events):
                span = tidy(fold.events.seconds)
                events = within(events, span)
            outcomes.append(outcome_of(fold, events, seconds, scored))
    except NisusError as error:
        nothing = Spread(np.nan)
        return FilterScore(estimator, {}, nothing, (np.nan, np.nan), nothing, np.nan, options, failure=str(error))
    return mean_of(outcomes, span)


def able(twin: Twin, estimator: str) -> Twin:
    """Return a twin as a filter can fold it: with its parameters held, if it cannot consider them."""
    return twin if find_entry(estimator).considers else with_held(twin)


def within(events: Events, span: float | None) -> Events:
    """The events of the first `span` seconds."""
    if span is None or not len(events):
        return events
    return events.select(slice(0, int(np.searchsorted(events.t, events.t[0] + round(span * 1e9), side="right"))))


def tidy(seconds: float) -> float:
    """The next lower of 1, 2, 5, 10, 20, ... (or 0.5, 0.2, ...)."""
    power = 10.0 ** np.floor(np.log10(seconds))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= seconds))


def timed(
    twin: Twin, estimator: str, events: Events, seed: int, budget: float, enough: float = MIN_TIMED_S
) -> tuple[Fold, float]:
    """Return a fold of the events, or of those that the budget allows, and its seconds an event: see `fold_within`."""
    log = Log.resume(twin.model, None, events)
    tuning = replace(twin.tuning.with_options(twin.options_of(estimator)), seed=seed)
    fold = Fold(estimator, twin.model, tuning, log, pairs=twin.pairs, policy=twin.policy, expected=twin.expected)
    return fold, fold_within(fold, budget, enough)


def fold_within(fold: Fold, budget: float, enough: float = 0.0, check: Callable[[], object] = lambda: None) -> float:
    """Fold what a budget (s) allows, and again for `enough` seconds, as other work disturbs a short fold.

    `check` is called now and then, and may raise. Return the shortest time an event, s of one processor.
    """
    log, took = fold.log, list[float]()
    while not took or (sum(took) < enough and fold.n == log.n):
        fold.rewind(0)
        begun = time.process_time()
        limit, spent = 1, 0.0
        while fold.advance(limit if np.isfinite(budget) else None) and spent < budget:
            check()
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
    return min(took) / max(1, fold.n)


def outcome_of(fold: Fold, events: Events, seconds: float, scored: tuple[int, int] | None = None) -> FilterScore:
    """Return the scores of one fold over its first events, or over those between two times, ns.

    Raises:
        NisusError: If it ended before them.
    """
    part = slice(*(map(int, np.searchsorted(events.t, scored)) if scored else (0, len(events))))
    if part.start >= part.stop:
        raise EstimatorError("its budget ends before the scored part; raise --budget")
    fold.finish()
    pictures = pictures_of(fold, part)
    model, track, events = fold.model, fold.track.select(part), events.select(part)
    result = score(track, events, model, pictures, gate=fold.tuning.gate, baseline=fold.tuning.baseline)
    fits, units = result.states, units_by_name(model)
    if result.field is not None and model.grid is not None:
        fits, units = {model.grid.name: result.field}, {model.grid.name: model.grid.unit}
    if not fits:
        fits = result.held_out
    groups: dict[str, list[Fit]] = {}
    for name, fit in fits.items():
        groups.setdefault(units[name], []).append(fit)
    # A probability has no band (see `StateSpaceModel.label`).
    mode = model.jump.state if model.jump else None
    covered = [fit.coverage for name, fit in fits.items() if name != mode]
    lost = np.flatnonzero(track.health == DIVERGED)
    return FilterScore(
        fold.estimator.name,
        rmse={unit: Spread(float(np.sqrt(np.mean([fit.rmse**2 for fit in group])))) for unit, group in groups.items()},
        nis=Spread(result.nis),
        nis_bounds=(result.nis_low, result.nis_high),
        coverage=Spread(float(np.mean(covered)) if covered else np.nan),
        seconds_per_step=seconds,
        options=dict(fold.tuning.options),
        diverged=int(lost.size > 0),
        since=float((events.t[lost[0]] - events.t[0]) * 1e-9) if lost.size else np.nan,
        lost=lost.size / len(track),
        refused=result.refused if result.gated else 0.0,
        nis_dof=result.nis_verdict.dof,
        nis_judged=result.nis_verdict.measure,
    )


def mean_of(outcomes: Sequence[FilterScore], span: float | None) -> FilterScore:
    """Return the scores of several seeds or logs as one row."""

    def mean(name: str) -> float:
        return float(np.mean([getattr(outcome, name) for outcome in outcomes]))

    return replace(
        outcomes[0],
        rmse={unit: _spread([outcome.rmse[unit] for outcome in outcomes]) for unit in outcomes[0].rmse},
        nis=_spread([outcome.nis for outcome in outcomes]),
        nis_bounds=tuple(np.mean([outcome.nis_bounds for outcome in outcomes], axis=0).tolist()),  # type: ignore[arg-type]
        coverage=_spread([outcome.coverage for outcome in outcomes]),
        seconds_per_step=min(outcome.seconds_per_step for outcome in outcomes),
        nis_dof=mean("nis_dof"),
        nis_judged=mean("nis_judged"),
        seeds=len(outcomes),
        span=span,
        diverged=sum(outcome.diverged for outcome in outcomes),
        since=min((outcome.since for outcome in outcomes if outcome.diverged), default=np.nan),
        lost=mean("lost"),
        refused=mean("refused"),
    )


def best_text(rows: Sequence[FilterScore]) -> str:
    """Return the filter with the smallest error over the whole log so far; empty if no error is known."""
    unit = next((unit for row in rows for unit in row.rmse), "")
    errors = {row.estimator: row.rmse[unit].value for row in rows if unit in row.rmse and row.span is None}
    errors = {name: value for name, value in errors.items() if np.isfinite(value)}
    if not errors:
        return ""
    name = min(errors, key=lambda name: errors[name])
    return f"best so far {name}, RMSE {errors[name]:.3g} {unit}".rstrip()


def _spread(figures: Sequence[Spread]) -> Spread:
    values = [figure.value for figure in figures]
    return Spread(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else np.nan)


_shared: list[tuple[Twin, list[Events]]] = []
"""Twin and logs of a worker process."""


def without_marks(events: Events) -> Events:
    """Return the events without fault marks, which are no steps of the asset."""
    return events.select(events.kind != MARK)


def applicable(twin: Twin, names: Sequence[str] = ()) -> list[str]:
    """Return the filters that apply to a twin, or check those that are named.

    Raises:
        EstimatorError: If a named filter does not apply.
    """
    for name in names:
        find_estimator(name, able(twin, name).model)
    fit = (name for name, entry in ESTIMATORS.items() if not unfit(entry, able(twin, name).model))
    return list(dict.fromkeys(names)) or list(fit)


def compare(
    twin: str,
    overrides: Mapping[str, str],
    names: Sequence[str],
    logs: Sequence[Events],
    budget: float = BUDGET_S,
    scored: tuple[int, int] | None = None,
    *,
    jobs: int | None = None,
    cluster: str | None = None,
) -> Iterator[FilterScore]:
    """Fold each filter over the logs, in processes of their own; rows come as they are done.

    The twin is a name or path, with overrides as of `load_twin`; `logs`, `scored` and `budget`, the seconds for a
    filter, are those of `fold_row`; `jobs` and `cluster` those of `results`.
    """
    given = (twin, dict(overrides), [tuple(log) for log in logs])
    # The last filters of the catalogue are the slow ones.
    calls = [(name, budget, scored) for name in reversed(names)]
    for _, row in results(_fold, calls, jobs=jobs, cluster=cluster, begin=_share, given=given):
        yield row


def _share(name: str, overrides: dict[str, str], logs: list[tuple[np.ndarray, ...]]) -> None:
    _shared[:] = [(load_twin(name, overrides=overrides), [Events(*columns) for columns in logs])]


def _fold(estimator: str, budget: float, scored: tuple[int, int] | None) -> FilterScore:
    twin, logs = _shared[0]
    return fold_row(twin, estimator, logs, budget, scored)
