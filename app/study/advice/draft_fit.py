"""Fit structure and noises of a draft by maximum likelihood to the first half of its recording; check it on the second.

The states of a draft are independent, so each is fitted by itself, with its sensors and inputs. For every structure (a
random walk, or a speed; process noise white or with a correlation time; sensor errors white or with one) the noises are
fitted as `nisus tune` does, and the structure of the highest likelihood is kept, each parameter at a price.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimators.errors import NisusError
from estimators.fit.entries import entries_of
from estimators.fit.objective import FitProgress, Objective, scaled_rounds
from estimators.fit.recording import Recording
from estimators.model.coloured import ColouredError, coloured, disturbance_time, error_time, errors_of
from estimators.model.state_space import StateSpaceModel
from estimators.tuning import Tuning

from .draft_check import ALTERNATE_PARTS, HALVES_DIFFER, DraftFold, ModelFiles, Turns, log_of, split_of, with_options
from .plan import DraftPlan, Moves, Reads, reads_of
from .relations import pairs
from .signals import MIN_VALUES, Signal, noise_of

MAX_FIT_READINGS = 4000  # readings of a state and its sensors that are fitted, in windows over the first half
WINDOWS = 4  # windows, if there are more readings
ROUNDS = 2  # rounds of the optimiser
MIN_START_SHARE = 1e-3  # of the power of the differences of a signal, where the fit of its noise begins
MIN_FITTED = (
    200  # readings of a state in the fitted parts, with less of which it is fitted again to all after the check
)
MARGIN = 10.0  # nats by which two filters on the first half are alike
PRICE = 5.0  # nats that a further parameter must gain


Options = Mapping[str, str | float]

OPTIONS: tuple[Options, ...] = (
    {},
    {"adapt": "Q", "memory": 200.0, "bound": 1000.0},
    {"adapt": "Q", "memory": 50.0, "bound": 1000.0},
)
"""Options of the filter that are tried: an asset that rests and moves has no one process noise."""


class Structure(NamedTuple):
    """How a state moves: with a speed of its own, with coloured process noise, and with coloured sensor errors."""

    smooth: bool
    over: bool = False
    errors: bool = False


class FittedStructure(NamedTuple):
    """A structure, its log-likelihood less the price of its parameters, and the state with the fitted noises."""

    structure: Structure
    options: Options
    value: float
    item: Moves


def windows_of(item: Moves, split: Turns) -> list[tuple[int, int]]:
    """Return windows of the fitted parts with at most `MAX_FIT_READINGS` readings together."""
    t = np.sort(np.concatenate([reads.signal.series.t for reads in item.sensors]))
    ends = [*split.edges, int(t[-1]) + 1]
    begins = [int(t[0]), *ends[1::2]]
    parts = [(t[(t >= begin) & (t < end)], end) for begin, end in zip(begins, ends[::2], strict=False)]
    parts = [(own, end) for own, end in parts if own.size]
    if sum(own.size for own, _ in parts) <= MAX_FIT_READINGS:
        return [(int(own[0]), end) for own, end in parts]
    count = max(1, WINDOWS // len(parts))
    each = MAX_FIT_READINGS // (count * len(parts))
    windows = []
    for own, end in parts:
        if own.size <= each:
            windows.append((int(own[0]), end))
            continue
        windows += [(int(own[k]), int(own[k + each])) for k in np.linspace(0, own.size - each - 1, count).astype(int)]
    return windows


def fitted(
    item: Moves,
    inputs: Sequence[tuple[str, Signal]],
    split: Turns,
    span: float,
    files: ModelFiles,
    progress: FitProgress,
) -> list[FittedStructure | None]:
    """Return the best structure of a state, fitted with each of `OPTIONS`; none if it cannot be fitted.

    Args:
        item: The state with its sensors.
        inputs: Inputs that it follows.
        split: Parts that are fitted.
        span: Length of the recording, s, beyond which no time constant is.
        files: Models of this draft.
        progress: Of the whole draft; once it is to stop, structures that were not begun are left out.
    """
    rated = any(reads.rate for reads in item.sensors)
    fit = partial(_fit, inputs=inputs, split=split, span=span, progress=progress)
    models: dict[bool, tuple[Moves, StateSpaceModel]] = {}
    for smooth in (True,) if rated else (False, True):
        moving = _begun(item, smooth)
        with suppress(NisusError):
            models[smooth] = moving, files.model([moving], inputs)

    def best(structures: Iterable[Structure], options: Options = OPTIONS[0]) -> FittedStructure | None:
        tried = [
            fit(*models[one.smooth], one, options) for one in structures if one.smooth in models and not progress.stop
        ]
        return max((one for one in tried if one is not None), key=lambda one: one.value, default=None)

    def better(one: FittedStructure, structures: Iterable[Structure]) -> FittedStructure:
        return max(one, best(structures) or one, key=lambda each: each.value)

    white = best(Structure(smooth) for smooth in models)
    if white is None:
        return []
    # A coloured acceleration is tried only where a white one is better than a white speed.
    chosen = white = better(white, [Structure(smooth, True) for smooth in models if smooth <= white.structure.smooth])
    if len(item.sensors) > 1:
        chosen = better(white, [white.structure._replace(errors=True)])
    return [chosen, *(best([chosen.structure], options) for options in OPTIONS[1:])]


def _begun(item: Moves, smooth: bool) -> Moves:
    """Return the state where its fit begins; a variance far below that of the differences would not be found."""
    q = item.q if smooth == item.smooth else noise_of(item.signal.series, smooth)[1]
    sensors = []
    for reads in item.sensors:
        least = MIN_START_SHARE * float(np.mean(np.diff(reads.signal.series.values) ** 2))
        sensors.append(replace(reads, r=max(reads.r, least)))
    return replace(item, smooth=smooth, q=q, sensors=tuple(sensors))


def _fit(
    item: Moves,
    model: StateSpaceModel,
    structure: Structure,
    options: Options,
    *,
    inputs: Sequence[tuple[str, Signal]],
    split: Turns,
    span: float,
    progress: FitProgress,
) -> FittedStructure | None:
    def counted(folds: int) -> bool:
        progress.folds += folds
        return True

    noise = model.noises[0].name
    period = min(1.0 / reads.signal.rate for reads in item.sensors)
    slowest = max(1.0 / reads.signal.rate for reads in item.sensors)
    noises = {noise: 10.0 * slowest} if structure.over else {}
    errors = {}
    if structure.errors:
        errors = {r.name: ColouredError((r.r,), min(50.0 * slowest, span / 4.0)) for r in item.sensors}
    try:
        larger = coloured(model, noises, errors)
        tuning = with_options(Tuning.of(larger), options)
        keys, bounds = _keys(item, noise, structure, span, period, tuning)
        zero = int(min(reads.signal.series.t[0] for reads in item.sensors))
        log = log_of(larger, item.sensors, inputs, windows_of(item, split), zero)
        entries, _ = entries_of("kf", tuning, [log], keys, bounds)
        recording = Recording(log, 1.0, np.zeros(log.n, bool))
        objective = Objective("kf", tuning, tuple(entries), (recording,), go=counted, progress=progress)
        x, value = scaled_rounds(objective, objective.start, rounds=ROUNDS)
    except NisusError:
        return None
    setting = objective.setting(x).tuning
    return FittedStructure(
        structure, options, value - PRICE * len(entries), _written(item, noise, structure, larger, setting)
    )


def _keys(
    item: Moves, noise: str, structure: Structure, span: float, period: float, tuning: Tuning
) -> tuple[list[str], dict[str, tuple[float, float]]]:
    """Return the fitted entries and their ranges: no variance below that of the resolution, no time beyond the log."""
    keys, bounds = [f"Q.{noise}"], {}
    times = [disturbance_time(noise)] if structure.over else []
    for reads in item.sensors:
        floor = reads.signal.resolution**2 / 12.0
        keys.append(f"R.{reads.name}")
        # Values in the model's file are rounded.
        bounds[f"R.{reads.name}"] = (0.99 * min(floor, reads.r) if floor else 0.0, np.inf)
        if structure.errors:
            times.append(error_time(reads.name))
            keys.append(f"Q.{reads.name}_error")
    for name in times:
        keys.append(f"p.{name}")
        bounds[f"p.{name}"] = (min(period, float(tuning.get(f"p.{name}") or period)), span)
    return keys, bounds


def _written(item: Moves, noise: str, structure: Structure, model: StateSpaceModel, tuning: Tuning) -> Moves:
    """Return the state with fitted noises."""

    def value(key: str) -> float:
        return float(tuning.get(key) or 0.0)

    sensors: list[Reads] = []
    for reads in item.sensors:
        error = None
        if structure.errors:
            name = errors_of(model.sensors[model.sensor_names.index(reads.name)])[0]
            error = value(f"Q.{name}"), value(f"p.{error_time(reads.name)}")
        sensors.append(replace(reads, r=value(f"R.{reads.name}"), error=error))
    over = value(f"p.{disturbance_time(noise)}") if structure.over else None
    return replace(item, q=value(f"Q.{noise}"), sensors=tuple(sensors), over=over)


class DraftStep(NamedTuple):
    """Progress of a draft: the present step, and at the end the draft's file and its content in words."""

    doing: str
    file: str | None = None
    summary: str = ""


def fit_plan(drafted: DraftPlan, progress: FitProgress | None = None) -> Generator[DraftStep, None, DraftPlan]:
    """Yield the steps of fitting a draft and checking it; return the plan with its `check`.

    It is fitted to the first half of the recording and checked on the second. If these differ, it is fitted to every
    other eighth and checked on the others. `check` is None if the filter fails on the recording.

    Args:
        drafted: The plan.
        progress: Counts folds; once it is to stop, the draft is checked as far as it has been fitted.
    """
    progress = progress or FitProgress()
    found = yield from _fit_split(drafted, split_of(drafted), progress)
    if found.check is not None and HALVES_DIFFER in found.check.reason and not progress.stop:
        yield DraftStep("the halves differ: fitting every other eighth")
        again = yield from _fit_split(drafted, split_of(drafted, ALTERNATE_PARTS), progress)
        found = again if again.check is not None else found
    return found


def _fit_split(drafted: DraftPlan, split: Turns, progress: FitProgress) -> Generator[DraftStep, None, DraftPlan]:
    """Yield the steps of fitting a draft to some parts of its recording; return the plan, checked on the others."""
    t = np.concatenate([reads.signal.series.t for reads in drafted.sensors])
    span = float(t.max() - t.min()) * 1e-9
    drafted = replace(drafted, states=tuple(_scaled_on(item, split) for item in drafted.states))
    with tempfile.TemporaryDirectory() as name:
        files = ModelFiles(Path(name))
        choices: list[list[FittedStructure | None]] = []
        early: list[int] = []  # readings in the fitted parts
        for k, item in enumerate(drafted.states):
            yield DraftStep(f"fitting {item.name}, {k + 1} of {len(drafted.states)} states")
            inputs = [each for each in drafted.inputs if each[0] in item.inputs]
            early.append(sum(int(split.fitted(reads.signal.series.t).sum()) for reads in item.sensors))
            able = early[-1] >= MIN_VALUES and not progress.stop
            choices.append(fitted(item, inputs, split, span, files, progress) if able else [])
        tried: list[DraftFold] = []
        for k, one in enumerate(_combined(drafted, choices)):
            if not tried or not progress.stop:
                yield DraftStep(f"comparing filters, number {k + 1}")
                with suppress(NisusError):  # It diverges.
                    model = files.model(one.states, one.inputs)
                    tried.append(DraftFold(one, model, split, fitted_only=True))
                progress.folds += 1
        if not tried:
            return drafted
        # A filter that adapts must be worth it; an asset may change faster than in the fitted parts, so of those that
        # are alike there, the fastest.
        limit = max(one.log_likelihood for one in tried) - MARGIN
        alike = [one for one in tried if one.log_likelihood >= limit]
        plain = [one for one in alike if not one.drafted.options]
        best = min(plain or alike, key=lambda one: one.memory)
        fitted_plan = best.drafted
        yield DraftStep("checking on the parts left out" if split.alternate else "checking on the second half")
        with suppress(NisusError):
            fitted_plan = replace(fitted_plan, check=DraftFold(fitted_plan, best.model, split).check(span))
            if fitted_plan.check is not None and min(early) < MIN_FITTED and not progress.stop:
                yield DraftStep("fitting all of the short recording")
                whole = Turns((int(t.max()) + 1,))
                again = [_again(item, fitted_plan, whole, span, files, progress) for item in fitted_plan.states]
                check = fitted_plan.check._replace(refitted=True)
                fitted_plan = replace(fitted_plan, states=tuple(again), check=check)
        return fitted_plan


def _again(
    item: Moves, drafted: DraftPlan, split: Turns, span: float, files: ModelFiles, progress: FitProgress
) -> Moves:
    """Return a fitted state with the noises of the same structure fitted to other parts."""
    inputs = [each for each in drafted.inputs if each[0] in item.inputs]
    structure = Structure(item.smooth, item.over is not None, any(reads.error for reads in item.sensors))
    found = _fit(
        replace(item, over=None, sensors=tuple(replace(reads, error=None) for reads in item.sensors)),
        files.model([item], inputs),
        structure,
        drafted.options,
        inputs=inputs,
        split=split,
        span=span,
        progress=progress,
    )
    return item if found is None else found.item


def _scaled_on(item: Moves, split: Turns) -> Moves:
    """Return the state with scales and offsets of its other sensors from the fitted parts alone, where these do."""

    def early(one: Signal) -> Signal:
        kept = split.fitted(one.series.t)
        return one._replace(series=replace(one.series, t=one.series.t[kept], values=one.series.values[kept]))

    sensors = [item.sensors[0]]
    for reads in item.sensors[1:]:
        both = [early(one) for one in (item.signal, reads.signal)]
        found = pairs(both) if min(one.series.t.size for one in both) > 1 else []
        if found and found[0].first == 0 and found[0].rate == reads.rate:
            reads = reads_of(reads.name, item.signal, reads.signal, found[0])
        sensors.append(reads)
    return replace(item, sensors=tuple(sensors))


def fit_all(
    drafted: DraftPlan, report: Callable[[str], object] = str, progress: FitProgress | None = None
) -> DraftPlan:
    """Return the fitted plan; `report` is called with each step of `fit_plan`."""
    steps = fit_plan(drafted, progress)
    while True:
        try:
            report(next(steps).doing)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]


def _combined(drafted: DraftPlan, choices: Sequence[Sequence[FittedStructure | None]]) -> Iterator[DraftPlan]:
    """Yield the plans to compare: each of `OPTIONS`, the memory also for all states together."""
    for k, options in enumerate(OPTIONS):
        states = []
        for item, found in zip(drafted.states, choices, strict=True):
            one = next((one for one in (found[k], found[0]) if one is not None), None) if found else None
            states.append(item if one is None else one.item)
        yield replace(drafted, states=tuple(states), options=options)
        if "memory" in options and len(states) > 1:
            longer = {**options, "memory": float(options["memory"]) * len(states)}
            yield replace(drafted, states=tuple(states), options=longer)
