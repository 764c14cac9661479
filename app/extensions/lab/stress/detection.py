"""Expected and actual detection of a deliberate fault: visible, invisible, or by chance.

A mistake that moves the means of the innovations moves them by as much in every log: the same noise is folded with and
without it, by a filter without chance, and the difference is put to the criterion of the smallest visible fault
(visibility.py). One that changes their noise, or what comes when, is rehearsed: made in other logs of the asset. Of a
recording there is only this one: a fault is made in it at other times, a wrong belief begins later in it. What is
found in all of them, in half the time that it lasts, is visible: the time to an alarm has an exponential tail. What is
found in none is invisible.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from app.twin.twin import Twin
from estimators.diagnostics.detectors import OUTSIDE
from estimators.diagnostics.episodes import episodes
from estimators.diagnostics.score import Score, score
from estimators.diagnostics.sensitivity import Sensitivity, sensitivities, worse_faults
from estimators.diagnostics.sensitivity.responses import DETERMINISTIC_FILTERS, astray, stand_in
from estimators.diagnostics.sensitivity.visibility import fault_tests
from estimators.fold import Fold
from estimators.log import READING
from estimators.numerics.linalg import wrapped

from .scenario import (
    Bench,
    Mistake,
    StressFold,
    accused,
    asset_of,
    first_word,
    green_share,
    heard_in,
    quiet_of,
    recovery,
    said_at,
)

VISIBLE, INVISIBLE, CHANCE = FORETOLD = ("visible", "invisible", "by chance")

DETECTION = 0.95  # probability of detection of a visible fault, and of no alarm for an invisible one
REHEARSALS = 5  # logs in which a mistake is rehearsed
DETECTION_SHARE = 0.5  # share of the time that a mistake lasts within which each rehearsal must find what is visible
REHEARSAL_SEED = 1000  # seeds from here on are of rehearsals


class Foretold(NamedTuple):
    """Whether a mistake will be seen, one of `FORETOLD`; `multiple`: of its size, from which on it would be.

    Infinite where nothing moves, NaN where that is not known.
    """

    verdict: str
    multiple: float = np.nan


class Oracle:
    """Foretells mistakes with a twin, each rehearsal made once.

    Args:
        twin: As it ships.
        duration: Seconds of the logs.
    """

    def __init__(self, twin: Twin, duration: float) -> None:
        self.twin, self.duration = twin, duration
        self._benches: list[Bench] = []
        self._whole: Bench | None = None
        self._rehearsed: dict[tuple[str, str], Foretold] = {}
        self._checked: dict[str, tuple[Sensitivity, ...]] = {}

    def listed(self, bench: Bench, mistake: Mistake, estimator: str) -> bool:
        """Return whether `nisus check` lists every part of a mistake as undetectable, on the undamaged log.

        If the check computes nothing, any fault counts as listed. Simultaneous faults are also undetectable if their
        effects cancel.

        Raises:
            NisusError: As `Bench.run`.
        """
        if estimator not in self._checked:
            calm = bench.fold(None, estimator, self.twin.tuning.gate).fold
            every = self.twin.policy.false_alarm_every
            self._checked[estimator] = sensitivities(estimator, calm.model, calm.tuning, calm.log, false_alarm=every)
        known = self._checked[estimator]
        if all(one.reason for one in known):
            return bool(mistake.nudges)
        ranges = {(fault.nudge.kind, fault.nudge.name): (fault.low, fault.high) for fault, _ in worse_faults(*known)}
        nothing = (0.0, 0.0)
        alone = all(
            ranges.get((kind, name), nothing)[0] <= size <= ranges.get((kind, name), nothing)[1]
            for kind, name, size in mistake.nudges
        )
        return bool(mistake.nudges) and (alone or any(one.multiple(mistake.nudges) > 1.0 for one in known))

    def foretell(self, bench: Bench, mistake: Mistake, estimator: str) -> Foretold:
        """Whether a mistake will be seen on a bench with a filter.

        Raises:
            NisusError: As `Bench.run`.
        """
        if mistake.shifts:
            shifted = shift_of(bench, mistake, estimator)
            if shifted is not None:
                return shifted
        key = mistake.name, estimator
        if key not in self._rehearsed:
            self._rehearsed[key] = self._rehearse(mistake, estimator)
        return self._rehearsed[key]

    def _rehearse(self, mistake: Mistake, estimator: str) -> Foretold:
        recorded = asset_of(self.twin, 0) is None
        if mistake.whole and mistake.fault is not None and recorded:
            return Foretold(CHANCE)  # there is no other log of it
        if mistake.fault is None and recorded:
            after = self._later(mistake, estimator)
        else:
            while len(self._benches) < REHEARSALS:
                k = len(self._benches)
                begin = (k + 0.5) / REHEARSALS * 2.0 / 3.0 if recorded else 1.0 / 3.0
                self._benches.append(Bench(self.twin, REHEARSAL_SEED + k, self.duration, begin))
            after = [bench.found_after(mistake, estimator) for bench in self._benches]
        if not after:
            return Foretold(CHANCE)
        if max(after) <= DETECTION_SHARE:
            return Foretold(VISIBLE)
        return Foretold(CHANCE if min(after) < 1.0 else INVISIBLE)

    def _later(self, mistake: Mistake, estimator: str) -> list[float]:
        """When a wrong belief is found that begins later in a recording: a share for each length of the logs."""
        if self._whole is None:
            self._whole = Bench(self.twin, REHEARSAL_SEED, (REHEARSALS + 1) * self.duration)
        whole, step = self._whole, round(self.duration * 1e9)
        begins = [whole.origin + k * step for k in range(1, round(whole.length / self.duration))]
        return [whole.found_within(mistake, estimator, begin, begin + step) for begin in begins]


def shift_of(bench: Bench, mistake: Mistake, estimator: str) -> Foretold | None:
    """Return the expected detection by the shift of the means; None where no deterministic filter tracks the asset.

    Rejected measurements still count for the detectors, so a twin with a gate is folded with and without it.
    """
    name, _ = stand_in(estimator, bench.twin.model)
    if name != estimator and name not in DETERMINISTIC_FILTERS:
        return None
    calm = bench.fold(None, name, None).fold
    if astray(estimator, name, calm.track.select(slice(0, calm.n))):
        return None
    seen = []
    for gate in dict.fromkeys((None, bench.twin.tuning.gate)):
        found = _seen(bench, bench.fold(None, name, gate).fold, bench.fold(mistake, name, gate).fold, mistake)
        if found is None:
            return None
        seen.append(found)
    likely, possible, _ = np.array(seen).max(axis=0)
    return Foretold(VISIBLE if likely else CHANCE if possible else INVISIBLE, seen[0][2])


def _seen(bench: Bench, clean: Fold, wrong: Fold, mistake: Mistake) -> tuple[bool, bool, float] | None:
    """Whether the bank sees a mistake surely, or at all, and the multiple of it that it would see surely."""
    own, other = _readings(clean), _readings(wrong)
    if own.size != other.size or np.any(clean.log.t[own] != wrong.log.t[other]):
        return None
    model, (start, end) = bench.twin.model, bench.span(mistake)
    during = (clean.log.t[own] >= start) & (clean.log.t[own] < end)
    moved = np.where(during[:, None], wrong.track.innovation[other] - clean.track.innovation[own], 0.0)
    for s, sensor in enumerate(model.sensors):
        mine, rows = clean.log.channel[own] == s, slice(0, len(sensor.rows))
        moved[mine, rows] = wrapped(moved[mine, rows], [row.circular for row in sensor.rows])
    standardised = np.full_like(clean.track.innovation, np.nan)
    # The bank knows S of the fold that is wrong.
    standardised[own] = moved / wrong.track.innovation_std[other]
    tests = fault_tests(
        model,
        clean.tuning,
        clean.log,
        clean.track,
        every=bench.twin.policy.false_alarm_every,
        detection=DETECTION,
        bank=True,
    )
    flagged, before = wrong.track.flags[other] & OUTSIDE != 0, clean.track.flags[own] & OUTSIDE != 0
    # A range is not left by chance: states and inputs are what they are.
    outside = bool(np.any(flagged & ~before & during))
    likely, possible = tests.detects(standardised)
    multiple = np.nan if outside else tests.multiple(standardised, standardised)
    return likely or outside, possible or outside, multiple


def _readings(fold: Fold) -> np.ndarray:
    return np.flatnonzero(fold.events.kind == READING)


GATE = 0.9973  # gate of the defended fold, where the twin has none


OUTCOMES = NAMED, MISNAMED, MISSED, UNSEEN, RIGHTLY_SILENT, FALSE = (
    "named",
    "misnamed",
    "MISSED",
    "unseen",
    "rightly silent",
    "false alarm",
)
"""Outcomes of a fault: detected, by its name or another; missed though visible (wrong and green); not detected, as
expected or by chance. Outcomes of a harmless change: no alarm, false alarm."""


@dataclass(frozen=True)
class Trial:
    """Outcome of one fault.

    `foretold`: visible, invisible or by chance, before it was made; `visible_from`: the multiple of its size from which
    on it would be visible, NaN where that is not known. `outcome`: one of `OUTCOMES`. `delay`: seconds from its start
    to the first episode with its cause and one of its subjects; `word`: to the first row that is not green; None is
    never. `named`: the first episode after the start, subject and cause; `accused`: whom it tells a user to look at,
    once all has been seen until the mistake's end. What is heard of without the mistake, too, does not count. `early`:
    episodes that were heard of before it began. `green`: share of green rows while it lasted. `error` and `bare`: RMSE
    by state over the truth meanwhile, with a gate and without; `calm`: of the same filter over the same time, without
    the mistake; `coverage`: share of the truth in the 95 % band, by state. `recovery`: seconds from its end until green
    for good; None is never, or that it does not end. `suspects`: all that explain it equally well. `wrong`: state whose
    truth leaves its band most, if it stays inside without the mistake. `listed`: whether `nisus check` lists it.
    """

    mistake: str
    estimator: str
    seed: int
    start: float
    end: float
    foretold: str
    visible_from: float
    outcome: str
    delay: float | None
    word: float | None
    named: str | None
    accused: str | None
    cause_right: bool
    subject_right: bool
    early: int
    green: float
    error: dict[str, float]
    bare: dict[str, float]
    calm: dict[str, float]
    coverage: dict[str, float]
    recovery: float | None
    stale: int
    suspects: tuple[str, ...] = ()
    wrong: str | None = None
    listed: bool = False

    @property
    def detected(self) -> bool:
        """Whether health changed while it lasted."""
        return self.outcome in (NAMED, MISNAMED, FALSE)


MIN_COVERAGE = 0.8  # share of the truth in the 95 % band of a state below which it is wrong


def make(bench: Bench, mistake: Mistake, estimator: str, foretold: Foretold, *, listed: bool = False) -> Trial:
    """Make a mistake with a filter, of which it was told before what would be seen.

    Raises:
        NisusError: If the filter does not apply, or the mistake cannot be made.
    """
    gate = bench.twin.tuning.gate
    gated, bare = bench.fold(mistake, estimator, gate or GATE), bench.fold(mistake, estimator, None)
    ships = gated if gate is not None else bare
    shipped = ships.fold
    start, end = bench.window(mistake)
    begun, ended = bench.span(mistake)
    undisturbed = bench.fold(None, estimator, gate)
    told = heard_in(shipped, undisturbed.fold)
    since = [(at, item) for at, item in told if at >= begun]
    after = [(at, item) for at, item in since if at < ended]
    blamed = cache(lambda item: accused(shipped, item, ended))
    fits = (at for at, item in after if mistake.right_cause(item) and any(map(mistake.right_subject, blamed(item))))
    fit = next(fits, None)
    # That the estimate is lost is no cause, and is said sooner than one can be told.
    first = next((item for _, item in after if item.cause != "diverged"), after[0][1] if after else None)
    word = first_word(shipped, begun, undisturbed.fold, quiet_of(mistake))
    heard = word is not None and word < (ended - begun) / 1e9
    scores = {name: _score(item, begun, ended) for name, item in (("gated", gated), ("bare", bare))}
    calm = _score(undisturbed, begun, ended)
    coverage = {name: fit.coverage for name, fit in scores["gated" if ships is gated else "bare"].states.items()}
    off = [name for name, share in coverage.items() if share < MIN_COVERAGE <= calm.states[name].coverage]
    return Trial(
        mistake=mistake.name,
        estimator=estimator,
        seed=bench.seed,
        start=start,
        end=end,
        foretold=foretold.verdict,
        visible_from=foretold.multiple,
        outcome=_outcome(mistake, foretold.verdict, heard, fit is not None),
        delay=(fit - begun) / 1e9 if fit is not None else None,
        word=word,
        named=f"{first.subject} {first.cause}" if first is not None else None,
        accused=blamed(first)[0] if first is not None else None,
        cause_right=first is not None and mistake.right_cause(first),
        subject_right=first is not None and any(map(mistake.right_subject, blamed(first))),
        early=sum(said_at(undisturbed.fold, item) < begun for item in episodes(undisturbed.fold)),
        green=green_share(shipped, begun, ended),
        error={name: fit.rmse for name, fit in scores["gated"].states.items()},
        bare={name: fit.rmse for name, fit in scores["bare"].states.items()},
        calm={name: fit.rmse for name, fit in calm.states.items()},
        coverage=coverage,
        recovery=None if mistake.whole else recovery(shipped, ended),
        stale=ships.stale,
        suspects=blamed(first) if first is not None else (),
        wrong=min(off, key=lambda name: coverage[name]) if off else None,
        listed=listed,
    )


def _outcome(mistake: Mistake, foretold: str, heard: bool, named: bool) -> str:
    if not mistake.causes:
        return FALSE if heard else RIGHTLY_SILENT
    if not heard:
        return MISSED if foretold == VISIBLE else UNSEEN
    return NAMED if named else MISNAMED


def _score(folded: StressFold, start: int, end: int) -> Score:
    t = folded.truth.t
    rows = (t >= start) & (t <= end)
    track = folded.fold.track.select(slice(0, t.size)).select(rows)
    return score(track, folded.truth.select(rows), folded.fold.model)
