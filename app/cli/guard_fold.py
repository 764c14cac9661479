"""One recording that is guarded, folded with its accepted tuning and measured."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

from config.guard_schema import FigureSection, ReferenceSection
from config.tuning_schema import AcceptedSection
from estimators.errors import NisusError, SourceError
from estimators.fold import Fold
from estimators.log import Log
from estimators.registry import find_entry
from estimators.snapshots import Base
from estimators.track import HELD_OUT
from estimators.tuning import Tuning

from ..guard.figures import measured
from ..guard.junit import Guarded
from ..guard.reference import fingerprint, read_reference, write_reference
from ..guard.verdict import judge
from ..tunings.figures import COVERAGE, RMSE
from ..tunings.keep import now
from ..twin.twin import Twin
from .compare_fold import draws, tidy
from .guard_archive import Archived, folds_of, is_simulated, logs_of, twin_of

BUDGET = 3.0
"""Seconds of one processor for all folds of a recording; of one that would take longer a shorter span is guarded."""


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
        twin = twin_of(archived, dict(wanted.overrides or {}))
        found = replace(found, version=twin.tuning.name)
        known = read_reference(archived.reference)
        if known is None and wanted.note is None:
            text = f"no scores are recorded; `nisus guard {archived.name} --accept --note ...` records them"
            return replace(found, absent=text)
        span = known.span if known is not None and wanted.note is None else None
        measures = measure(archived, twin, span, budget=None if wanted.note is None else BUDGET, wanted=wanted)
        if wanted.note is not None:
            write_reference(archived.writes, archived.name, measures)
            known = known if known is not None and known.span == measures.span else None
        if known is not None:
            found = replace(found, judged=judge(known, measures, simulated=is_simulated(archived, twin)))
    except SourceError as error:
        here = "is not there" in str(error)
        found = replace(found, absent=str(error) if here else "", failure="" if here else str(error))
    except NisusError as error:
        found = replace(found, failure=str(error))
    return replace(found, seconds=time.monotonic() - begun)


def measure(
    archived: Archived, twin: Twin, span: float | None, *, budget: float | None, wanted: Wanted
) -> ReferenceSection:
    """All figures of a recording.

    Args:
        archived: The recording.
        twin: As it is folded.
        span: Seconds that are folded; None for all.
        budget: Seconds for all folds, by which a shorter span is chosen; None for as long as it takes.
        wanted: What is asked for.

    Raises:
        NisusError: If it cannot be folded.
    """
    if budget is not None:
        span = _span(archived, twin, budget)
    figures: dict[str, tuple[list[float], list[float]]] = {}
    logs = []
    for seed, log, base in logs_of(archived, twin, span):
        logs.append(fingerprint(log))
        for name, (value, allowed) in _figures(twin, log, base, seed).items():
            values, all_allowed = figures.setdefault(name, ([], []))
            values.append(value)
            all_allowed.append(allowed)
    return ReferenceSection(
        accepted=AcceptedSection(at=now(), note=wanted.note or ""),
        version=twin.tuning.name,
        estimator=twin.estimator,
        draws=draws(find_entry(twin.estimator)),
        span=span,
        events=tuple(count for count, _ in logs),
        sums=tuple(total for _, total in logs),
        # What one of the logs does not tell is no figure of all.
        figures={
            name: FigureSection(values=tuple(values), allowed=tuple(allowed))
            for name, (values, allowed) in figures.items()
            if len(values) == len(logs)
        },
    )


def _figures(twin: Twin, log: Log, base: Base | None, seed: int) -> dict[str, tuple[float, float]]:
    """Those of one log; where nothing is known to compare with, each sensor in turn is held out and predicted."""
    found = measured(_folded(twin, twin.tuning, log, base, seed))
    if not any(name.startswith(f"{RMSE}.") for name in found):
        names = [twin.model.sensor_names[k] for k in twin.plan.fed]
        for name in names if len(names) > 1 else []:
            fold = _folded(twin, twin.tuning.set(f"use.{name}", False), log, base, seed)
            if (fold.track.verdict == HELD_OUT).any():
                found |= {
                    key: each for key, each in measured(fold).items() if key.startswith((f"{RMSE}.", f"{COVERAGE}."))
                }
    return found


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


def _span(archived: Archived, twin: Twin, budget: float) -> float | None:
    """Seconds of a recording that can be folded as often as it is within a budget; None for all."""
    seed, log, base = next(logs_of(archived, twin, None))
    fold = _fold(twin, twin.tuning, log, base, seed)
    # The first call loads what is compiled.
    fold.advance(1)
    share = budget / folds_of(archived, twin)
    begun = time.process_time()
    while fold.n < log.n and time.process_time() - begun < share:
        fold.advance(max(1, log.n // 200))
    if fold.n >= log.n:
        return None
    return tidy(float(log.t[fold.n - 1] - log.t[0]) * 1e-9)
