"""Episodes of a sensor: the alarms of its readings that follow each other, and what its innovations show since then."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...log import READING, RESET
from ...track import GATED, REASONS, SCREENED, USED
from .. import words
from ..detectors import (
    AGREEING,
    ALTERNATING,
    BITS,
    CORRELATED,
    DISAGREEING,
    NARROW,
    REFUSED,
    SHIFTED_DOWN,
    SHIFTED_UP,
    SPIKY,
    STUCK,
    WIDE,
)
from ..effects import KINDS, Effect, against, common_scale, effects, onset
from .course import JOINED, Course, Run, runs, standardised, unusual
from .episode import Episode, Found

LOOKED_AT = 4000
"""Readings of an episode, and before it, of which the size is made."""

WANDERING = 0.5
"""Lag-1 correlation from which innovations that are too large are those of a mean that moves: noise does not wander."""

DECISIVE = float(np.log(1000.0))
"""log Λ from which readings that follow an effect are back to normal: they are a thousand times likelier without it."""

LEFT = 2.0
"""Likelihood ratio, nats, below which nothing of an effect is left: that of a size on the edge of its 95 % interval."""

MOST = 0.5
"""Share of the readings of an episode that are refused, or repeat themselves, from which it is one of that."""

TOLD_BY = {
    "shifted": SHIFTED_UP | SHIFTED_DOWN, "narrow": NARROW, "wide": WIDE, "correlated": CORRELATED,
    "alternating": ALTERNATING, "spiky": SPIKY,
}  # fmt: skip
"""Which tests say so of each kind of effect."""

LOSSES = ("stuck", "refused", "screened")
"""Causes of which a sensor is lost."""

OF_ALL_ROWS = ("disagreeing", "agreeing")
"""Causes that are of a sensor as a whole, not of one of its rows."""

UNITS = {"shifted": "σ", "narrow": "×", "wide": "×", "disagreeing": "×", "agreeing": "×"}
"""Of the sizes; one that is stuck has its row's."""


class Shown(NamedTuple):
    """What the readings of an episode show.

    Row `k` of the sensor, its readings `begun` to `over`, and the effect: `cause` and `size` with its 95 % interval.
    `correlation`: lag 1, of its innovations, where it is needed to say whether Q or R is to blame for their scale.
    `back`: whether what follows is back to normal, though the slowest of the tests has not fallen yet.
    """

    k: int
    begun: int
    over: int
    cause: str
    size: float
    low: float = np.nan
    high: float = np.nan
    correlation: float = 0.0
    back: bool = False


def of_sensors(course: Course) -> Iterator[Found]:
    """Sensors of which a row is in alarm, one after the other."""
    events, track, model = course.events, course.track, course.model
    if not track.alarms.any():
        return
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero((events.kind == READING) & (events.channel == s))
        masks = track.alarms[rows, : len(sensor.rows)]
        lost = [item for bit in (STUCK, REFUSED) for item in runs((masks & bit != 0).any(axis=1), JOINED)]
        for run in runs(masks.any(axis=1), JOINED):
            before = course.alarmed[s] if course.alarmed is not None and run.begin <= JOINED else 0
            own = sorted(item for item in lost if run.begin <= item.begin < run.end)
            later = [item for item in own if before + item.begin - run.begin > JOINED]
            shown, hidden = _shown_of_both(course, s, rows, masks, run, later)
            for kind, part, what in (("sensor", run, shown), *(("lost", *item) for item in hidden)):
                if what is None:
                    continue
                episode = _episode(course, s, rows, part, what)
                yield Found((kind, sensor.name), part.begin, int(events.t[rows[part.begin]]), episode)


def _shown_of_both(
    course: Course, s: int, rows: np.ndarray, masks: np.ndarray, run: Run, later: list[Run]
) -> tuple[Shown | None, list[tuple[Run, Shown]]]:
    """What explains a run of alarms, and what it would hide: the parts of it, `later`, in which the sensor is lost.

    What began so long before a sensor is lost is not explained by that. It goes on until it is seen to be over, and of
    a sensor that is lost nothing else can be seen: None where it is from the first of these rows to the last.
    """
    hidden: list[tuple[Run, Shown]] = []
    shown = None
    for part in later:
        what = _lost(course, s, rows, masks, part)
        # In the course of anything a coarse sensor repeats itself for a while; for how long is not seen of one that
        # does so from the first of these rows on.
        if what is None or what.cause == "stuck" and part.begin > run.begin and what.over - what.begun <= JOINED:
            continue
        if not hidden:
            begin, end = (run.begin, what.begun) if what.begun > run.begin else (part.end, run.end)
            rest = Run(begin, end, run.lasts)
            shown = _shown(course, s, rows, masks, rest) if begin < end else None
        before = hidden[-1][1] if hidden else shown
        if before is None or before.cause not in LOSSES or what.begun >= before.over:
            hidden.append((part, what))
    if not hidden:
        return _shown(course, s, rows, masks, run), []
    if shown is not None and shown.cause not in LOSSES and not shown.back:
        shown = shown._replace(over=run.end)
    return shown, hidden


def _episode(course: Course, s: int, rows: np.ndarray, run: Run, shown: Shown) -> Episode:
    """The episode of a run of readings of a sensor, whose events are `rows`."""
    events, track, model = course.events, course.track, course.model
    k, begun, over, cause, size, low, high, correlation, back = shown
    nu = track.innovation[rows[begun:over], k]
    about = float(np.nanmean(nu)) if np.isfinite(nu).any() else np.nan
    reasons = ""
    if cause == "screened":
        bits = int(np.bitwise_or.reduce(track.screened[rows[begun:over], k]))
        reasons = " and ".join(reason for place, reason in enumerate(REASONS) if bits >> place & 1)
    start = events.t[rows[begun]] * 1e-9
    text = words.of_sensor(model, course.tuning, s, k, cause, size, about, correlation, start, reasons)
    if run.lasts and over < rows.size and (back or run.end < rows.size):
        text = f"{text}; {words.of_return(cause, events.t[rows[over]] * 1e-9)}"
    return Episode(
        start=start,
        end=None if run.lasts else events.t[rows[max(over - 1, begun)]] * 1e-9,
        subject=model.sensors[s].name if cause in OF_ALL_ROWS else model.row_names[model.row_start[s] + k],
        cause=cause,
        size=size,
        low=low,
        high=high,
        unit=model.sensors[s].rows[k].unit if cause == "stuck" else UNITS.get(cause, ""),
        text=text,
    )


def _shown(course: Course, s: int, rows: np.ndarray, masks: np.ndarray, run: Run) -> Shown:
    """What explains a run best: that the sensor is lost, or else what the innovations show."""
    lost = _lost(course, s, rows, masks, run)
    if lost is not None:
        return lost
    said = np.bitwise_or.reduce(masks[run.begin : run.end])
    if said[0] & (DISAGREEING | AGREEING) and not np.any(said & ~(DISAGREEING | AGREEING)):
        cause = "disagreeing" if said[0] & DISAGREEING else "agreeing"
        return _together(course, rows, masks, run, cause)
    return _most_telling(course, s, rows, masks, np.flatnonzero(said), run)


def _lost(course: Course, s: int, rows: np.ndarray, masks: np.ndarray, run: Run) -> Shown | None:
    """What the edge and the gate did in a run, or that a value repeats itself; None if the sensor is not lost."""
    begin, end, _ = run
    said = np.bitwise_or.reduce(masks[begin:end])
    verdict = course.track.verdict[rows]
    refused = np.flatnonzero(said & REFUSED)
    if refused.size and np.mean(verdict[begin:end] == SCREENED) >= MOST:
        k = int(np.argmax((course.track.screened[rows[begin:end]] != 0).sum(axis=0)))
        return _share(k, verdict, SCREENED, _after_last(verdict[:begin] != SCREENED), run, cause="screened")
    for row in np.flatnonzero(said & STUCK):
        stuck = _stuck(course.events.value[rows, row], masks[:, row], int(row), run)
        if stuck is not None:
            return stuck
    # Other tests fall more slowly than that of refusals: those readings are in order already. A gate that refuses some
    # readings has a reason that shows in the others.
    until = begin + _after_last(np.any(masks[begin:end] & REFUSED, axis=1))
    if refused.size and np.mean(verdict[begin:until] == GATED) >= MOST:
        return _share(int(refused[0]), verdict, GATED, _after_last(verdict[:begin] == USED), run, cause="refused")
    return None


def _share(k: int, verdict: np.ndarray, refusal: int, begun: int, run: Run, *, cause: str) -> Shown:
    """Most readings had this verdict: from where they began until the last of them, and how many they are."""
    over = run.end if run.lasts else begun + _after_last(verdict[begun : run.end] == refusal)
    return Shown(k, begun, over, cause, float(np.mean(verdict[begun:over] == refusal)))


def _stuck(values: np.ndarray, masks: np.ndarray, k: int, run: Run) -> Shown | None:
    """A value that repeats itself: from its first reading until the first that is another.

    None if most alarms until then are of something else, in the course of which a coarse sensor repeats itself, too.
    """
    at = run.begin + int(np.argmax(masks[run.begin : run.end] & STUCK != 0))
    begun = _after_last(values[:at] != values[at])
    others = np.flatnonzero(values[begun : run.end] != values[begun])
    over = begun + int(others[0]) if others.size else run.end
    if np.mean(run.begin + np.flatnonzero(masks[run.begin : over]) >= begun) < MOST:
        return None
    return Shown(k, begun, over, cause="stuck", size=float(values[begun]), back=bool(others.size))


def _most_telling(course: Course, s: int, rows: np.ndarray, masks: np.ndarray, said: np.ndarray, run: Run) -> Shown:
    """The row, of those that `said` something, that shows most of what is wrong.

    What moves one way and then back has no mean over the whole: where innovations wander, the part that is shifted
    tells more.
    """
    first = _earliest(course, rows, masks, run)
    unknown = [Effect("narrow", np.nan, np.nan, np.nan, -np.inf)]
    best = int(said[0]) if said.size else 0, run.begin, run.end, unknown, np.zeros(0)
    shifted = best
    for k in said:
        e = standardised(course, rows[first : run.end], int(k))
        known = np.flatnonzero(np.isfinite(e))
        if known.size < 2:
            continue
        e = unusual(course, s, int(k), e[known])
        alarm = min(int(np.searchsorted(known, run.begin - first)), e.size - 1)
        kinds = _kinds(course, s, int(k), masks[run.begin : run.end, k])
        for cause in kinds:
            begun, over = _likeliest(e, alarm, cause)
            ranked = effects(e[begun : min(over, begun + LOOKED_AT)])
            ranked.sort(key=lambda item: item.cause not in kinds)
            if ranked[0].cause != cause:
                continue
            found = int(k), first + int(known[begun]), first + int(known[over - 1]) + 1, ranked, e[over:]
            if ranked[0].ratio > best[3][0].ratio:
                best = found
            if cause == "shifted" and ranked[0].ratio > shifted[3][0].ratio:
                shifted = found
    ranked = best[3]
    if ranked[0].cause == "narrow" and any(item.cause == "correlated" and item.size >= WANDERING for item in ranked):
        if np.isfinite(shifted[3][0].ratio):
            best = shifted
        else:
            best = (*best[:3], sorted(ranked, key=lambda item: item.cause != "correlated"), best[4])
    effect = best[3][0]
    correlation = next((item.size for item in best[3] if item.cause in ("correlated", "alternating")), 0.0)
    back = _is_back(best[4], effect)
    return Shown(*best[:3], effect.cause, effect.size, effect.low, effect.high, correlation, back)


def _is_back(e: np.ndarray, effect: Effect) -> bool:
    """Whether what followed an effect, e (n,), does without it: it is gone for sure, and no lesser one is left of it.

    A filter follows a sensor that is off, so that a shift shrinks while its cause lasts.
    """
    if not e.size or against(e, effect) < DECISIVE:
        return False
    left = (item for item in effects(e) if item.cause == effect.cause and item.size * effect.size > 0.0)
    return all(item.ratio < LEFT for item in left)


def _kinds(course: Course, s: int, k: int, masks: np.ndarray) -> list[str]:
    """The kinds of effects that can be the reason of alarms of row k: what was normal is none unless its test spoke."""
    if course.tuning.baseline is None:
        return list(KINDS)
    peaks = course.tuning.baseline[course.model.row_start[s] + k, 3:]
    said = int(np.bitwise_or.reduce(masks))
    return [kind for kind in KINDS if said & TOLD_BY[kind] or not np.any(peaks[BITS & TOLD_BY[kind] != 0] > 0.0)]


def _together(course: Course, rows: np.ndarray, masks: np.ndarray, run: Run, cause: str) -> Shown:
    """All rows of a sensor together are off more, or less, than their noise.

    The mean of a NIS is its degrees of freedom: the root of their ratio takes the place of e.
    """
    first = _earliest(course, rows, masks, run)
    nis, dof = course.track.nis[rows[first : run.end]], course.track.dof[rows[first : run.end]]
    known = np.flatnonzero(np.isfinite(nis) & (dof > 0))
    e = np.sqrt(nis[known] / dof[known])
    alarm = min(int(np.searchsorted(known, run.begin - first)), e.size - 1)
    begun, over = _likeliest(e, alarm, "narrow" if cause == "disagreeing" else "wide")
    looked_at = slice(begun, min(over, begun + LOOKED_AT))
    _, size, low, high, _ = common_scale(e[looked_at], dof[known][looked_at])
    return Shown(0, first + int(known[begun]), first + int(known[over - 1]) + 1, cause, size, low, high)


def _earliest(course: Course, rows: np.ndarray, masks: np.ndarray, run: Run) -> int:
    """The first reading that can be the onset of a run of alarms: after the alarms before it, and the last reset."""
    first = max(0, run.begin - LOOKED_AT)
    first += _after_last(np.any(masks[first : run.begin], axis=1))
    resets = np.flatnonzero(course.events.kind[rows[first] : rows[run.begin]] == RESET)
    return int(np.searchsorted(rows, rows[first] + resets[-1])) if resets.size else first


def _likeliest(e: np.ndarray, alarm: int, cause: str) -> tuple[int, int]:
    """From which to which of e (n,) it was so, most likely, if it was at `alarm`.

    A test falls more slowly than its cause goes, so the end is looked for as the onset is, backwards.
    """
    begun = onset(e[: alarm + 1], cause)
    run = e[begun:]
    return begun, max(begun + run.size - onset(run[::-1], cause), min(alarm + 1, begun + run.size))


def _after_last(there: np.ndarray) -> int:
    """The index behind the last True in `there` (n,); 0 if there is none."""
    places = np.flatnonzero(there)
    return int(places[-1]) + 1 if places.size else 0
