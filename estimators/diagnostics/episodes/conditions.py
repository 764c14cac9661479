"""Episodes of dropouts, ranges, particles and the twin's health: conditions of single rows."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...log import INPUT
from ...model.state_space import Input, State
from ...track import DIVERGED, GATED, HEALTH_NAMES, SCREENED, STALE, USED, WAITING
from ..detectors import (
    IMPOSSIBLE_AT,
    IMPOVERISHED,
    REFUSED,
    SENSOR_FLAGS,
    SENSOR_MASK,
    SHIFTED_DOWN,
    SHIFTED_UP,
    STUCK,
    beyond_range,
    detector_of,
    memory_flag,
)
from ..health import HealthPolicy
from ..references import HALF_WIDTH
from .episode import JOINED, AlarmRun, Episode, FoundEpisode, JudgedRows, runs
from .wording import SensorFacts, TwinFacts

CONTRADICTING = REFUSED | STUCK | SHIFTED_UP | SHIFTED_DOWN  # Alarms of a sensor that contradicts the estimate


def _found(
    kind: str, facts: TwinFacts | SensorFacts, end: float | None, low: float, high: float, run: AlarmRun, t: np.ndarray
) -> FoundEpisode:
    """Return the episode of these facts; `t`: times of the rows to which the run belongs, ns."""
    row = detector_of(facts.cause)
    unit = row.unit or facts.unit
    text = row.text(facts)
    episode = Episode(facts.start, end, facts.name, facts.cause, facts.size, low, high, unit, text, row.grade)
    return FoundEpisode((kind, facts.name), run.begin, int(t[run.begin]), int(t[run.end - 1]), episode)


def dropouts(judged: JudgedRows) -> Iterator[FoundEpisode]:
    """Yield the dropouts of the sensors; those that share the last bit are told apart by their own gaps."""
    events, model, flags = judged.events, judged.model, judged.track.flags
    t = events.t
    if not flags.any():
        return
    own_bits = len(model.sensors) if len(model.sensors) <= SENSOR_FLAGS else SENSOR_FLAGS - 1
    shared = flags >> (SENSOR_FLAGS - 1) & 1 != 0
    last_sensor = len(model.sensors) if shared.any() else own_bits
    for s in range(last_sensor):
        if model.sensors[s].by_chance:
            continue  # it may share its bit with one that dropped out
        heard = judged.measured(s)
        earlier = 0 if judged.last_heard is None else int(judged.last_heard[s])
        for run in runs(flags >> s & 1 != 0 if s < own_bits else shared & _in_gap(t, heard)):
            before = heard[heard < run.begin]
            last = int(t[before[-1]]) if before.size else earlier
            cause = "silent" if last else "never heard"
            start, over = (last or int(t[0])) * 1e-9, run.over(t)
            size = (t[run.end - 1] * 1e-9 if over is None else over) - start
            facts = SensorFacts(
                model=model, s=s, cause=cause, start=start, size=size, lasted=None if run.lasts else size
            )
            yield _found("silence", facts, over, np.nan, np.nan, run, t)


def _in_gap(t: np.ndarray, heard: np.ndarray) -> np.ndarray:
    """Return whether a sensor with measurements in the rows `heard` has dropped out, for each row; see `note_time`."""
    found = np.zeros(t.size, bool)
    if heard.size < 3:
        return found
    gaps = np.diff(t[heard])
    count = np.arange(2, heard.size)  # gaps before each measurement from the third on
    usual = HealthPolicy().silent_periods * np.cumsum(gaps)[1:] / count
    due = t[heard[2:]] + np.maximum(usual, 2.0 * np.maximum.accumulate(gaps)[1:])
    ends = np.append(heard[3:], t.size)
    for k in np.flatnonzero(t[ends - 1] > due):
        found[np.searchsorted(t, due[k], side="right") : ends[k]] = True
    return found


def left_ranges(judged: JudgedRows) -> Iterator[FoundEpisode]:
    """Yield shown states and inputs outside their fitted range, states that are impossible or corrected too much."""
    events, model, track = judged.events, judged.model, judged.track
    t = events.t
    if not np.any(track.flags & ~SENSOR_MASK):
        return
    told = np.flatnonzero((track.verdict == USED) | (track.verdict == GATED))  # of corrections
    for column, state in enumerate(model.shown_states):
        mean, half = track.mean[:, column], HALF_WIDTH * track.std[:, column]
        yield from _outside(state, mean, t)
        if state.limits is not None:
            low, high = state.limits
            rows = (mean + half < low) | (mean - half > high) | (track.flags & memory_flag(column, IMPOSSIBLE_AT) != 0)
            yield from _beyond(state, "impossible", rows, mean, t, state.limits)
        if state.watched:
            yield from _beyond(state, "corrected", track.flags[told] & memory_flag(column) != 0, mean[told], t[told])
    rows = np.flatnonzero(events.kind == INPUT)
    for j, item in enumerate(model.inputs):
        value = events.value[rows, j]
        known = np.isfinite(value)
        yield from _outside(item, value[known], t[rows[known]])


def _outside(item: State | Input, value: np.ndarray, t: np.ndarray) -> Iterator[FoundEpisode]:
    low, high = beyond_range(item)[0]
    yield from _beyond(item, "outside", (value < low) | (value > high), value, t, item.fitted or (low, high))


def _beyond(
    item: State | Input,
    cause: str,
    rows: np.ndarray,
    value: np.ndarray,
    t: np.ndarray,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> Iterator[FoundEpisode]:
    """Yield the times in which a condition of an item holds, rows (n,), with its most extreme value there."""
    low, high = limits
    for run in runs(rows, JOINED):
        own = value[run.begin : run.end]
        smallest, largest = float(np.nanmin(own)), float(np.nanmax(own))
        facts = TwinFacts(
            name=item.name,
            cause=cause,
            start=run.start(t),
            size=largest if largest > high else smallest,
            unit=item.unit,
            limits=f"{low:g} to {high:g}",
        )
        yield _found(cause, facts, run.over(t), smallest, largest, run, t)


def impoverished_particles(judged: JudgedRows) -> Iterator[FoundEpisode]:
    """Yield the times in which few particles carry the estimate."""
    t, track = judged.events.t, judged.track
    for run in runs(track.flags & IMPOVERISHED != 0):
        rows = slice(run.begin, run.end)
        effective = track.effective[rows]
        effective = effective[np.isfinite(effective)]
        if not effective.size:
            continue
        low, high = (float(np.quantile(effective, share)) for share in (0.025, 0.975))
        size = float(np.median(effective))
        ancestors = float(np.nanmin(track.ancestors[rows]))
        same = (track.std[rows] == 0.0) & (np.asarray(judged.model.shown) != judged.model.mode)
        words = "one particle" if ancestors < 2.0 or same.any() else f"{ancestors:.0f} particles"
        facts = TwinFacts(name="twin", cause="impoverished", start=run.start(t), size=size, ancestors=words)
        yield _found("particles", facts, run.over(t), low, high, run, t)


def contradicting_sensors(judged: JudgedRows, end: int) -> tuple[str, ...]:
    """Return the used sensors whose last measurement before row `end` was rejected, shifted or repeated."""
    track, off = judged.track, []
    for s, sensor in enumerate(judged.model.sensors):
        rows = judged.measured(s)
        rows = rows[rows < end]
        if not rows.size or not judged.tuning.used[s]:
            continue
        last = rows[-1]
        if track.verdict[last] in (GATED, SCREENED) or np.any(track.alarms[last] & CONTRADICTING):
            off.append(sensor.name)
    return tuple(off)


def lost_estimates(judged: JudgedRows) -> Iterator[FoundEpisode]:
    """Yield the times in which the twin is stale or has diverged."""
    t, track, sensors = judged.events.t, judged.track, len(judged.model.sensors)
    for code in (STALE, DIVERGED):
        for run in runs(track.health == code):
            start = run.start(t) - (float(track.age[run.begin]) if code == STALE else 0.0)
            size = float(t[run.end - 1]) * 1e-9 - start
            off = contradicting_sensors(judged, run.end) if code == DIVERGED else ()
            cause = HEALTH_NAMES[code]
            facts = TwinFacts(name="twin", cause=cause, start=start, size=size, off=off, sensors=sensors)
            yield _found(cause, facts, run.over(t), np.nan, np.nan, run, t)


def silent_gaps(judged: JudgedRows) -> Iterator[FoundEpisode]:
    """Yield the gaps of a recording in which no event shows that the estimate was stale; a running twin has ticks."""
    t, track, health = judged.events.t, judged.track, judged.track.health
    silent = track.age[:-1] + np.diff(t) * 1e-9 > judged.stale_after
    silent &= (health[:-1] != STALE) & (health[1:] != STALE) & (health[:-1] != WAITING)
    for k in np.flatnonzero(silent).tolist():
        start, end = float(t[k]) * 1e-9 - float(track.age[k]), float(t[k + 1]) * 1e-9
        facts = TwinFacts(name="twin", cause=HEALTH_NAMES[STALE], start=start, size=end - start)
        yield _found("gap", facts, end, np.nan, np.nan, AlarmRun(k + 1, k + 2, False), t)
