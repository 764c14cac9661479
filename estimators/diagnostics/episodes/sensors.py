"""Episodes of a sensor: runs of alarms of its measurements, and the effect that its innovations show since then."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...gate.isolation import maintained
from ...log import RESET
from ...track import GATED, NO_VALUE, REASONS, SCREENED, USED
from ..detectors import (
    ADVISORY_ALARM,
    AGREEING,
    BITS,
    DETECTORS,
    DISAGREEING,
    LOST,
    REFUSED,
    STUCK,
    Detector,
    detector_of,
    log_ratios,
)
from ..effects import EVIDENCE, KINDS, InnovationEffect, against, common_scale, effects, onset
from .episode import JOINED, AlarmRun, Episode, FoundEpisode, JudgedRows, runs, standardised, without_baseline
from .wording import SensorFacts, return_text

MAX_MEASUREMENTS = 4000  # Measurements of an episode, and before it, from which onset and size are estimated

WANDERING_CORRELATION = 0.5
"""Lag-1 correlation from which innovations that are too large are explained by a moving mean, not by noise."""

RECOVERED_NATS = float(np.log(1000.0))
"""log Λ from which measurements after an effect are normal again: a thousand times more likely without it."""

REMAINING_NATS = 2.0  # log Λ below which no effect remains: that of a size at the end of its 95 % interval
LOSS_SHARE = 0.5  # Share of rejected or repeated measurements of an episode from which it is a loss of the sensor
ALARMS_OF = {kind: detector_of(kind).bits for kind in KINDS}  # Alarms by the effect that they show
LOSSES = tuple(detector.name for detector in DETECTORS if detector.sensor_lost)  # Causes of which a sensor is lost
OF_ALL_ROWS = {"disagreeing": "narrow", "agreeing": "wide"}
"""Causes of a sensor as a whole, not of one of its rows, and the effects that they are."""

UNKNOWN_EFFECTS = tuple(detector for detector in DETECTORS if detector.alarms and not detector.effect)
"""Detectors whose alarms have episodes of their own, sized by their own tests."""

KNOWN_EFFECTS = sum(detector.bits for detector in DETECTORS if detector.effect)  # Alarms of all others

ALARM_KEYS = {"sensor": KNOWN_EFFECTS, "lost": LOST, **{detector.name: detector.bits for detector in UNKNOWN_EFFECTS}}
"""Alarms by the first part of the keys of a sensor's episodes."""


class RunEffect(NamedTuple):
    """InnovationEffect in measurements `begun` to `over` of row k of a sensor: `cause`, `size` and its 95 % interval.

    correlation: lag-1 correlation of the innovations, which decides whether Q or R explains their scale. back: whether
    the measurements that follow are normal again, though the slowest test has not cleared yet.
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


def sensor_alarms(judged: JudgedRows) -> Iterator[FoundEpisode]:
    """Yield the episodes of sensors with a row in alarm."""
    events, track, model = judged.events, judged.track, judged.model
    if not track.alarms.any():
        return
    for s, sensor in enumerate(model.sensors):
        rows = judged.measured(s)
        alarms = track.alarms[rows, : len(sensor.rows)]
        masks = alarms & KNOWN_EFFECTS
        found = [
            (detector.name, run, _own_evidence(judged, s, rows, alarms & detector.bits, run, detector))
            for detector in UNKNOWN_EFFECTS
            for run in runs((alarms & detector.bits != 0).any(axis=1), JOINED)
        ]
        lost = [item for bit in (STUCK, REFUSED) for item in runs((masks & bit != 0).any(axis=1), JOINED)]
        for run in runs(np.any(masks, axis=1), JOINED):
            before = judged.alarmed[s] if judged.alarmed is not None and run.begin <= JOINED else 0
            own = sorted(item for item in lost if run.begin <= item.begin < run.end)
            later = [item for item in own if before + item.begin - run.begin > JOINED]
            shown, hidden = _effect_and_losses(judged, s, rows, masks, run, later)
            if shown is not None and shown.cause == "stuck" and shown.back:
                # It ends with another value, whatever other tests have yet to clear.
                others = run.end - shown.over > JOINED
                found.append(("sensor", AlarmRun(run.begin, shown.over if others else run.end, False), shown))
                run = AlarmRun(shown.over, run.end, run.lasts)
                shown = _shown(judged, s, rows, masks, run) if others else None
            found += [] if shown is None else [("sensor", run, shown)]
            found += [("lost", *item) for item in hidden]
        for kind, run, shown in found:
            episode = _episode(judged, s, rows, run, shown)
            at, until = events.t[rows[[run.begin, run.end - 1]]].tolist()
            yield FoundEpisode((kind, sensor.name), run.begin, at, until, episode)


def _effect_and_losses(
    judged: JudgedRows, s: int, rows: np.ndarray, masks: np.ndarray, run: AlarmRun, later: list[AlarmRun]
) -> tuple[RunEffect | None, list[tuple[AlarmRun, RunEffect]]]:
    """Return the effect that explains a run of alarms, and the parts, of those in `later`, in which the sensor is lost.

    An effect that began long before a loss is not explained by it, and lasts until it is known to be over. While a
    sensor is lost nothing else is known of it: the effect is None where that is all rows.
    """
    hidden: list[tuple[AlarmRun, RunEffect]] = []
    shown = None
    for part in later:
        what = _lost(judged, s, rows, masks, part)
        # A coarse sensor may repeat itself for a while; for how long is unknown if it does so from the first row on.
        if what is None or what.cause == "stuck" and part.begin > run.begin and what.over - what.begun <= JOINED:
            continue
        if not hidden:
            begin, end = (run.begin, what.begun) if what.begun > run.begin else (part.end, run.end)
            rest = AlarmRun(begin, end, run.lasts)
            shown = _shown(judged, s, rows, masks, rest) if begin < end else None
        before = hidden[-1][1] if hidden else shown
        if before is None or before.cause not in LOSSES or what.begun >= before.over:
            hidden.append((part, what))
    if not hidden:
        return _shown(judged, s, rows, masks, run), []
    if shown is not None and shown.cause not in LOSSES and not shown.back:
        shown = shown._replace(over=run.end)
    return shown, hidden


def _episode(judged: JudgedRows, s: int, rows: np.ndarray, run: AlarmRun, shown: RunEffect) -> Episode:
    """Return the episode of a run of measurements of a sensor, whose events are `rows`."""
    events, track, model = judged.events, judged.track, judged.model
    k, begun, over, cause, size, low, high, correlation, back = shown
    nu = track.innovation[rows[begun:over], k]
    about = float(np.nanmean(nu)) if np.isfinite(nu).any() else np.nan
    reasons = ""
    if cause == "screened":
        bits = int(np.bitwise_or.reduce(track.screened[rows[begun:over], k]))
        reasons = " and ".join(reason for place, reason in enumerate(REASONS) if bits >> place & 1)
    start = events.t[rows[begun]] * 1e-9
    detector = detector_of(cause)
    row = model.sensors[s].rows[k]
    facts = SensorFacts(
        model=model, s=s, k=None if cause in OF_ALL_ROWS else k, cause=cause, start=start, size=size, unit=row.unit,
        about=about, correlation=correlation, reasons=reasons,
    )  # fmt: skip
    text = detector.text(facts)
    unit = row.unit if cause == "stuck" else detector.unit if detector.effect else "nats"
    if detector.isolate and maintained(events.kind, int(rows[begun])):
        text = f"{text}; maintenance has changed the asset, so the twin is wrong rather than the sensor"
    if run.lasts and over < rows.size and (back or run.end < rows.size):
        text = f"{text}; {return_text(cause, events.t[rows[over]] * 1e-9)}"
    alarms = track.alarms[rows[run.begin : run.end]]
    alarms = alarms[alarms.any(axis=1)]
    valid = not detector.sensor_lost and np.mean(((alarms == 0) | (alarms & ADVISORY_ALARM != 0)).all(axis=1)) > 0.5
    return Episode(
        start=start,
        end=None if run.lasts else events.t[rows[max(over - 1, begun)]] * 1e-9,
        subject=facts.name,
        cause=cause,
        size=size,
        low=low,
        high=high,
        unit=unit,
        text=text,
        grade="advisory" if valid else "suspect" if detector.conservative else detector.grade,
    )


def _shown(judged: JudgedRows, s: int, rows: np.ndarray, masks: np.ndarray, run: AlarmRun) -> RunEffect | None:
    """Return the effect that explains a run best: a loss of the sensor, else that of the innovations, if known."""
    lost = _lost(judged, s, rows, masks, run)
    if lost is not None:
        return lost
    said = np.bitwise_or.reduce(masks[run.begin : run.end])
    if said[0] & (DISAGREEING | AGREEING) and not np.any(said & ~(DISAGREEING | AGREEING)):
        cause = "disagreeing" if said[0] & DISAGREEING else "agreeing"
        return _joint_effect(judged, rows, masks, run, cause)
    return _best_effect(judged, s, rows, masks, np.flatnonzero(said), run)


def _lost(judged: JudgedRows, s: int, rows: np.ndarray, masks: np.ndarray, run: AlarmRun) -> RunEffect | None:
    """Return the loss of a sensor in a run: screened, stuck or rejected; None if it is not lost."""
    begin, end, _ = run
    said = np.bitwise_or.reduce(masks[begin:end])
    verdict = judged.track.verdict[rows]
    refused = np.flatnonzero(said & REFUSED)
    if refused.size and np.mean(verdict[begin:end] == SCREENED) >= LOSS_SHARE:
        k = int(np.argmax((judged.track.screened[rows[begin:end]] != 0).sum(axis=0)))
        return _share(k, verdict, SCREENED, _after_last(verdict[:begin] != SCREENED), run, cause="screened")
    for row in np.flatnonzero(said & STUCK):
        values = np.where(judged.track.screened[rows, row] & NO_VALUE, np.nan, judged.events.value[rows, row])
        stuck = _stuck(values, masks[:, row], int(row), run)
        if stuck is not None:
            return stuck
    # Other tests clear more slowly than that of rejections. A gate that rejects only some measurements has a reason
    # that shows in the others.
    until = begin + _after_last(np.any(masks[begin:end] & REFUSED, axis=1))
    if refused.size and np.mean(verdict[begin:until] == GATED) >= LOSS_SHARE:
        return _share(int(refused[0]), verdict, GATED, _after_last(verdict[:begin] == USED), run, cause="refused")
    return None


def _share(k: int, verdict: np.ndarray, refusal: int, begun: int, run: AlarmRun, *, cause: str) -> RunEffect:
    """Return the share of measurements with this verdict, from the first to the last of them."""
    over = run.end if run.lasts else begun + _after_last(verdict[begun : run.end] == refusal)
    return RunEffect(k, begun, over, cause, float(np.mean(verdict[begun:over] == refusal)))


def _stuck(values: np.ndarray, masks: np.ndarray, k: int, run: AlarmRun) -> RunEffect | None:
    """Return the run of a repeated value, from its first measurement to the first that differs; gaps have no value.

    None if most alarms until then have another cause, during which a coarse sensor repeats itself, too.
    """
    at = run.begin + int(np.argmax(masks[run.begin : run.end] & STUCK != 0))
    known = np.flatnonzero(np.isfinite(values))
    value = values[known[np.searchsorted(known, at, side="right") - 1]]
    differs = np.isfinite(values) & (values != value)
    begun = int(known[np.searchsorted(known, _after_last(differs[:at]))])
    others = np.flatnonzero(differs[begun : run.end])
    over = begun + int(others[0]) if others.size else run.end
    if np.mean(run.begin + np.flatnonzero(masks[run.begin : over]) >= begun) < LOSS_SHARE:
        return None
    return RunEffect(k, begun, over, cause="stuck", size=float(values[begun]), back=bool(others.size))


def _best_effect(
    judged: JudgedRows, s: int, rows: np.ndarray, masks: np.ndarray, said: np.ndarray, run: AlarmRun
) -> RunEffect | None:
    """Return the effect with the highest likelihood ratio over the rows in alarm, `said`; None of less than two values.

    Innovations that wander have no mean over the whole run: their shifted part is more informative. Where no test in
    alarm explains them, as that of outliers where these are side by side, the effect is one of another kind.
    """
    first = _earliest(judged, rows, masks, run)
    unknown = [InnovationEffect("narrow", np.nan, np.nan, np.nan, -np.inf)]
    best = int(said[0]) if said.size else 0, run.begin, run.end, unknown, np.zeros(0)
    shifted = other = best
    for k in said:
        e = standardised(judged, rows[first : run.end], int(k))
        known = np.flatnonzero(np.isfinite(e))
        if known.size < 2:
            continue
        e = without_baseline(judged, s, int(k), e[known])
        kinds = _kinds(judged, s, int(k), masks[run.begin : run.end, k])
        for cause in kinds:
            own, over, ends = _likeliest(e, known, first, run, cause)
            ranked = effects(e[own])
            ranked.sort(key=lambda item: item.cause not in kinds)
            found = int(k), *ends, ranked, e[over:]
            if ranked[0].cause != cause:
                other = found if ranked[0].ratio > other[3][0].ratio else other
                continue
            if ranked[0].ratio > best[3][0].ratio:
                best = found
            if cause == "shifted" and ranked[0].ratio > shifted[3][0].ratio:
                shifted = found
    best = other if best[3] is unknown else best
    ranked = best[3]
    if ranked is unknown:
        return None
    if ranked[0].cause == "narrow" and any(
        item.cause == "correlated" and item.size >= WANDERING_CORRELATION for item in ranked
    ):
        if np.isfinite(shifted[3][0].ratio):
            best = shifted
        else:
            best = (*best[:3], sorted(ranked, key=lambda item: item.cause != "correlated"), best[4])
    effect = best[3][0]
    correlation = next((item.size for item in best[3] if item.cause in ("correlated", "alternating")), 0.0)
    back = _is_back(best[4], effect)
    return RunEffect(*best[:3], effect.cause, effect.size, effect.low, effect.high, correlation, back)


def _is_back(e: np.ndarray, effect: InnovationEffect) -> bool:
    """Return whether e (n,) after an effect is normal: the effect is over, and no smaller one of its kind remains.

    A filter follows a biased sensor, so that a shift shrinks while its cause lasts.
    """
    if not e.size or against(e, effect) < RECOVERED_NATS:
        return False
    left = (item for item in effects(e) if item.cause == effect.cause and item.size * effect.size > 0.0)
    return all(item.ratio < REMAINING_NATS for item in left)


def _kinds(judged: JudgedRows, s: int, k: int, masks: np.ndarray) -> list[str]:
    """Return the effects that can explain alarms of row k: one of the baseline only if its own test is in alarm."""
    if judged.tuning.baseline is None:
        return list(KINDS)
    peaks = judged.tuning.baseline[judged.model.row_start[s] + k, 3:]
    said = int(np.bitwise_or.reduce(masks))
    return [kind for kind in KINDS if said & ALARMS_OF[kind] or not np.any(peaks[BITS & ALARMS_OF[kind] != 0] > 0.0)]


def _joint_effect(judged: JudgedRows, rows: np.ndarray, masks: np.ndarray, run: AlarmRun, cause: str) -> RunEffect:
    """Return the common scale of all rows of a sensor, from √(NIS / degrees of freedom) in place of e."""
    first = _earliest(judged, rows, masks, run)
    e = joint_scale(judged, rows[first : run.end])
    known = np.flatnonzero(np.isfinite(e))
    e, dof = e[known], judged.track.dof[rows[first + known]]
    own, _, ends = _likeliest(e, known, first, run, OF_ALL_ROWS[cause])
    _, size, low, high, _ = common_scale(e[own], dof[own])
    return RunEffect(0, *ends, cause, size, low, high)


def joint_scale(judged: JudgedRows, rows: np.ndarray) -> np.ndarray:
    """Return √(NIS / degrees of freedom) of the measurements at `rows`; NaN where there is none."""
    nis, dof = judged.track.nis[rows], judged.track.dof[rows]
    return np.sqrt(np.where(dof > 0, nis, np.nan) / np.maximum(dof, 1))


def _own_evidence(
    judged: JudgedRows, s: int, rows: np.ndarray, masks: np.ndarray, run: AlarmRun, detector: Detector
) -> RunEffect:
    """Return the effect of a detector of which nothing but its tests is known: their mean log Λ, nats."""
    first = _earliest(judged, rows, masks, run)
    best = RunEffect(0, run.begin, run.end, detector.name, np.nan)
    for k in np.flatnonzero(masks[run.begin : run.end].any(axis=0)):
        known, ratios = evidence(judged, s, rows[first : run.end], int(k), detector)
        if not known.size:
            continue
        part, _, ends = _likeliest(ratios, known, first, run, EVIDENCE)
        own = ratios[part]
        if np.isnan(best.size) or own.mean() > best.size:
            half = 1.96 * float(own.std()) / np.sqrt(own.size)
            size = float(own.mean())
            best = RunEffect(int(k), *ends, detector.name, size, size - half, size + half)
    return best


def evidence(judged: JudgedRows, s: int, rows: np.ndarray, k: int, detector: Detector) -> tuple[np.ndarray, np.ndarray]:
    """Return which of `rows` have an innovation of row k, (n,), and log Λ of the detector's best test there, (n,)."""
    e = standardised(judged, rows, k)
    known = np.flatnonzero(np.isfinite(e))
    ratios = log_ratios(detector.bits, without_baseline(judged, s, k, e[known])) if known.size else np.zeros((0, 0))
    return (known, ratios[np.argmax(ratios.sum(axis=1))]) if ratios.size else (known[:0], np.zeros(0))


def _earliest(judged: JudgedRows, rows: np.ndarray, masks: np.ndarray, run: AlarmRun) -> int:
    """Return the first measurement that can be the onset of a run: after earlier alarms and the last reset."""
    first = max(0, run.begin - MAX_MEASUREMENTS)
    first += _after_last(np.any(masks[first : run.begin], axis=1))
    resets = np.flatnonzero(judged.events.kind[rows[first] : rows[run.begin]] == RESET)
    return int(np.searchsorted(rows, rows[first] + resets[-1])) if resets.size else first


def _likeliest(
    e: np.ndarray, known: np.ndarray, first: int, run: AlarmRun, cause: str
) -> tuple[slice, int, tuple[int, int]]:
    """Return where an effect in a run of alarms most likely is: in e (n,), of the measurements `first` + `known`.

    A test clears later than its cause ends, so the end is estimated like the onset, backwards.

    Returns:
        The part of e that is looked at, the end in e, and the measurements of begin and end.
    """
    alarm = min(int(np.searchsorted(known, run.begin - first)), e.size - 1)
    begun = onset(e[: alarm + 1], cause)
    over = max(e.size - onset(e[begun:][::-1], cause), alarm + 1)
    ends = first + int(known[begun]), first + int(known[over - 1]) + 1
    return slice(begun, min(over, begun + MAX_MEASUREMENTS)), over, ends


def _after_last(there: np.ndarray) -> int:
    """Return the index after the last True in `there` (n,); 0 if there is none."""
    places = np.flatnonzero(there)
    return int(places[-1]) + 1 if places.size else 0
