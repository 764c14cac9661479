"""One recording that is guarded, folded with its accepted tuning and measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from config.files import shown_path
from config.guard_schema import FigureSection, ReferenceSection
from config.tuning_schema import AcceptedSection
from config.tunings import named
from estimators.errors import NisusError, SourceError
from estimators.fold import Fold
from estimators.log import Log
from estimators.snapshots import Base
from estimators.tuning import Tuning

from ..live.tunings.versions import COVERAGE, RMSE, now
from ..studies.guard.figures import allowances, measured
from ..studies.guard.junit import Guarded
from ..studies.guard.reference import fingerprint, read_reference, write_reference
from ..studies.guard.verdict import judge
from ..twin.twin import Twin
from .compare_fold import tidy
from .guard_archive import Archived, folds_of, is_simulated, logs_of, twin_of

BUDGET = 15.0
"""Seconds of one processor for all folds of a recording; of one that would take longer a shorter span is guarded."""

FIRST = 10.0
"""Seconds of the first part of a recording that is timed."""


@dataclass(frozen=True)
class Wanted:
    """What is asked for: to record scores with a note, or None to compare; `overrides` are of the twins' YAML."""

    note: str | None = None
    overrides: Mapping[str, str] | None = None


def guarded(archived: Archived, wanted: Wanted) -> Guarded:
    """Fold a recording, compare it with its recorded scores, and record them if that is asked for."""
    begun = time.monotonic()
    found = Guarded(archived.name)
    try:
        if archived.failure:
            raise SourceError(archived.failure)
        twin = twin_of(archived, dict(wanted.overrides or {}))
        found = replace(found, version=twin.tuning.name)
        known = read_reference(archived.reference)
        if known is None and wanted.note is None:
            text = f"no scores are recorded; `nisus guard {_called(archived)} --accept --note ...` records them"
            return replace(found, absent=text)
        span = known.span if known is not None else _span(archived, twin)
        measures = measure(archived, twin, span, wanted.note)
        if wanted.note is not None:
            write_reference(archived.writes, archived.name, measures)
        if known is not None:
            found = replace(found, judged=judge(known, measures, simulated=is_simulated(archived, twin)))
    except SourceError as error:
        here = "is not there" in str(error)
        found = replace(found, absent=str(error) if here else "", failure="" if here else str(error))
    except NisusError as error:
        found = replace(found, failure=str(error))
    return replace(found, seconds=time.monotonic() - begun)


def measure(archived: Archived, twin: Twin, span: float | None, note: str | None) -> ReferenceSection:
    """All figures of a recording.

    Args:
        archived: The recording.
        twin: As it is folded.
        span: Seconds that are folded; None for all.
        note: Why they are recorded; None if they are not, and what is allowed of them is not asked for.

    Raises:
        NisusError: If it cannot be folded.
    """
    logs, values, allowed = [], [], []
    _, seeds = folds_of(archived, twin)
    for log, base in logs_of(archived, twin, span):
        logs.append(fingerprint(log))
        for seed in range(seeds):
            folds = _folds(twin, log, base, seed)
            values.append(_together(folds, measured))
            allowed.append(_together(folds, allowances) if note is not None else dict.fromkeys(values[-1], 0.0))
    return ReferenceSection(
        accepted=AcceptedSection(at=now(), note=note or ""),
        version=twin.tuning.name,
        estimator=twin.estimator,
        seeds=seeds,
        span=span,
        events=tuple(count for count, _ in logs),
        sums=tuple(total for _, total in logs),
        # What one of the logs does not tell is no figure of all.
        figures={
            name: FigureSection(
                values=tuple(each[name] for each in values), allowed=tuple(each[name] for each in allowed)
            )
            for name in values[0]
            if all(name in each for each in values)
        },
    )


def _folds(twin: Twin, log: Log, base: Base | None, seed: int) -> list[Fold]:
    """That of a log; where nothing is known to compare with, also with each sensor in turn held out and predicted."""
    found = [_folded(twin, twin.tuning, log, base, seed)]
    if any(name.startswith(f"{RMSE}.") for name in measured(found[0])):
        return found
    names = [twin.model.sensor_names[k] for k in twin.plan.fed]
    without = [twin.tuning.set(f"use.{name}", False) for name in names if len(names) > 1]
    return found + [_folded(twin, tuning, log, base, seed) for tuning in without]


def _together(folds: Sequence[Fold], figures: Callable[[Fold], dict[str, float]]) -> dict[str, float]:
    """The figures of the first fold, and the errors of the sensors that the others hold out."""
    first, *others = map(figures, folds)
    kinds = (f"{RMSE}.", f"{COVERAGE}.")
    return first | {name: value for each in others for name, value in each.items() if name.startswith(kinds)}


def _folded(twin: Twin, tuning: Tuning, log: Log, base: Base | None, seed: int) -> Fold:
    fold = _fold(twin, tuning, log, base, seed)
    fold.advance()
    fold.finish()
    if fold.failure is not None:
        raise fold.failure
    return fold


def _fold(twin: Twin, tuning: Tuning, log: Log, base: Base | None, seed: int) -> Fold:
    return Fold(
        twin.estimator,
        twin.model,
        replace(tuning, seed=seed),
        log,
        base=base,
        policy=twin.policy,
        expected=twin.expected,
    )


def _span(archived: Archived, twin: Twin) -> float | None:
    """Seconds of a recording that can be simulated, and folded as often as it is, within the budget; None for all.

    Of longer and longer parts, as all of a large asset would take much longer than that.
    """
    logs, seeds = folds_of(archived, twin)
    part = FIRST
    while True:
        begun = time.process_time()
        log, base = next(logs_of(archived, twin, part))
        # To read a recording takes as long for any part of it.
        read = time.process_time() - begun if is_simulated(archived, twin) else 0.0
        fold = _fold(twin, twin.tuning, log, base, 0)
        # The first call loads what is compiled.
        fold.advance(1)
        begun = time.process_time()
        fold.advance()
        needed = logs * (read + seeds * (time.process_time() - begun))
        seconds = float(log.t[log.n - 1] - log.t[0]) * 1e-9
        if needed > BUDGET:
            return tidy(seconds * BUDGET / needed)
        if seconds < 0.5 * part:
            return None
        part *= 4.0


def _called(archived: Archived) -> str:
    """What is guarded, as the command line takes it."""
    return named(archived.twin) if archived.recording is None else f"--archive {shown_path(archived.recording.parent)}"
