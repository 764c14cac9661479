"""Episodes: what was wrong from when to when, with whom, by how much, and what can be done about it.

A pure function of log and track. The alarms of one sensor that follow each other are one episode; what its innovations
show since its onset names the cause (effects.py). ALARMS.md says for each cause what it means and what to do.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from ..log import INPUT, READING, TRUTH, Log, truth_of
from ..model.state_space import Input, State, StateSpaceModel
from ..track import DIVERGED, GATED, HEALTH_NAMES, STALE, USED, Track
from ..tuning import Tuning
from .effects import Effect, effects, onset
from .evidence import AGREEING, DISAGREEING, IMPOVERISHED, MISSED, OUTSIDE, REFUSED, SENSORS, STUCK
from .words import of_particles, of_sensor, of_silence, of_truth, of_twin, since

JOINED = 30
"""Readings without an alarm after which another is another episode."""

LOOKED_AT = 4000
"""Readings of an episode, and before it, of which the size is made."""


MOST = 0.5
"""Share of refused readings from which an episode is one of refusals."""


class Episode(NamedTuple):
    """Something that was wrong.

    `start` and `end` in seconds of the log; `end` None while it lasts. `subject`: a sensor, one of its rows, a state,
    an input, or "twin". `cause`: a key of ALARMS.md. `size` in `unit` with its 95 % interval, `low` to `high` (NaN
    where there is none). `text`: one sentence with the remedy.
    """

    start: float
    end: float | None
    subject: str
    cause: str
    size: float
    low: float
    high: float
    unit: str
    text: str


class Folded(Protocol):
    """What episodes are read from: a Fold, or whatever has its log and track.

    `marginal`: whether `Track.whitened` holds each row by itself, as for predictions that are not Gaussian. `baseline`:
    what was normal, see evidence.py.
    """

    @property
    def model(self) -> StateSpaceModel: ...  # noqa: D102
    @property
    def tuning(self) -> Tuning: ...  # noqa: D102
    @property
    def log(self) -> Log: ...  # noqa: D102
    @property
    def track(self) -> Track: ...  # noqa: D102
    @property
    def n(self) -> int: ...  # noqa: D102
    @property
    def marginal(self) -> bool: ...  # noqa: D102
    @property
    def baseline(self) -> np.ndarray: ...  # noqa: D102


def episodes(fold: Folded) -> list[Episode]:
    """All episodes of a fold, in the order of their start."""
    found = [
        *_of_sensors(fold),
        *_of_silence(fold),
        *_of_truth(fold),
        *_of_ranges(fold),
        *_of_particles(fold),
        *_of_twin(fold),
    ]
    return sorted(found, key=lambda episode: (episode.start, episode.subject))


def _runs(on: np.ndarray, joined: int = 0) -> Iterator[tuple[int, int, bool]]:
    """First and end of each run of True in `on`, and whether it lasts at the end; shorter pauses are bridged."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], on.astype(np.int8), [0]))))
    begins, ends = edges[::2], edges[1::2]
    if not begins.size:
        return
    apart = np.flatnonzero(begins[1:] - ends[:-1] > joined)
    for begin, end in zip(begins[np.append(0, apart + 1)], ends[np.append(apart, ends.size - 1)], strict=True):
        yield int(begin), int(end), bool(on.size - end <= joined)


def standardised(fold: Folded, rows: np.ndarray, k: int) -> np.ndarray:
    """e of row k of the readings at `rows`, as the bank sees it; NaN where there is none."""
    track = fold.track
    e = track.innovation[rows, k] / track.innovation_std[rows, k]
    if fold.marginal:
        e = track.whitened[rows, k]
    verdict = track.verdict[rows]
    return np.where((verdict == USED) | (verdict == GATED), e, np.nan)


def unusual(fold: Folded, s: int, k: int, e: np.ndarray) -> np.ndarray:
    """Finite e (n,) of row k of sensor s as it would be drawn from N(0, 1) if it were as it was when accepted."""
    bias, scale, phi = fold.baseline[fold.model.row_start[s] + k, :3]
    e = (e - bias) / scale
    return np.append(e[:1], (e[1:] - phi * e[:-1]) / np.sqrt(1.0 - phi**2)) if phi else e


def _of_sensors(fold: Folded) -> Iterator[Episode]:
    log, track, model = fold.log, fold.track, fold.model
    kind, channel = log.kind[: fold.n], log.channel[: fold.n]
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero((kind == READING) & (channel == s))
        masks = track.alarms[rows, : len(sensor.rows)]
        for begin, end, lasts in _runs(masks.any(axis=1), JOINED):
            yield _of_sensor(fold, s, rows, masks, begin, end, lasts)


def _of_sensor(fold: Folded, s: int, rows: np.ndarray, masks: np.ndarray, begin: int, end: int, lasts: bool) -> Episode:
    """The episode of the readings `begin` to `end` of a sensor, whose events are `rows`."""
    log, track, model = fold.log, fold.track, fold.model
    said = np.bitwise_or.reduce(masks[begin:end])
    k, begun, ranked = _most_telling(fold, s, rows, np.flatnonzero(said), begin, end)
    effect = ranked[0]
    cause, size, low, high = effect.cause, effect.size, effect.low, effect.high
    values, verdict = log.value[rows], track.verdict[rows]
    stuck = np.flatnonzero(said & STUCK)
    refused = np.flatnonzero(said & REFUSED)
    # A gate that refuses some readings has a reason that shows in the others.
    if refused.size and np.mean(verdict[begin:end] == GATED) < MOST:
        refused = refused[:0]
    if stuck.size:
        k, cause = int(stuck[0]), "stuck"
        begun = _same_since(values[:, k], begin)
        size, low, high = float(values[begun, k]), np.nan, np.nan
    elif refused.size:
        k, cause = int(refused[0]), "refused"
        used = np.flatnonzero(verdict[:begin] == USED)
        begun = int(used[-1]) + 1 if used.size else 0
        size, low, high = float(np.mean(verdict[begun:end] == GATED)), np.nan, np.nan
    elif said[0] & (DISAGREEING | AGREEING) and not np.any(said & ~(DISAGREEING | AGREEING)):
        cause = "disagreeing" if said[0] & DISAGREEING else "agreeing"
    nu = track.innovation[rows[begun:end], k]
    about = float(np.nanmean(nu)) if np.isfinite(nu).any() else np.nan
    row = model.sensors[s].rows[k]
    unit = {"shifted": "σ", "narrow": "×", "wide": "×", "disagreeing": "×", "agreeing": "×", "stuck": row.unit}
    subject = model.row_names[model.row_start[s] + k]
    start = log.t[rows[begun]] * 1e-9
    correlation = next((item.size for item in ranked if item.cause in ("correlated", "alternating")), 0.0)
    return Episode(
        start=start,
        end=None if lasts else log.t[rows[end - 1]] * 1e-9,
        subject=subject,
        cause=cause,
        size=size,
        low=low,
        high=high,
        unit=unit.get(cause, ""),
        text=of_sensor(model, fold.tuning, s, k, cause, size, about, correlation, start),
    )


def _most_telling(
    fold: Folded, s: int, rows: np.ndarray, said: np.ndarray, begin: int, end: int
) -> tuple[int, int, list[Effect]]:
    """The row that shows most of what is wrong, the reading since when, and what it shows, the likeliest first."""
    first = max(0, begin - LOOKED_AT)
    best: tuple[int, int, list[Effect]] = (int(said[0]) if said.size else 0, begin, [_UNKNOWN])
    for k in said:
        e = standardised(fold, rows[first:end], int(k))
        known = np.flatnonzero(np.isfinite(e))
        if known.size < 2:
            continue
        e = unusual(fold, s, int(k), e[known])
        alarm = min(int(np.searchsorted(known, begin - first)), e.size - 1)
        guess = effects(e[max(0, alarm - JOINED) :][:LOOKED_AT])[0]
        begun = onset(e[: alarm + 1], guess.cause)
        ranked = effects(e[begun:][:LOOKED_AT])
        if ranked[0].ratio > best[2][0].ratio:
            best = int(k), first + int(known[begun]), ranked
    return best


_UNKNOWN = Effect("narrow", np.nan, np.nan, np.nan, -np.inf)


def _same_since(values: np.ndarray, at: int) -> int:
    """The first of the equal values that end at index `at`."""
    others = np.flatnonzero(values[:at] != values[at])
    return int(others[-1]) + 1 if others.size else 0


def _of_silence(fold: Folded) -> Iterator[Episode]:
    log, model = fold.log, fold.model
    t, flags = log.t[: fold.n], fold.track.flags
    if not flags.any():
        return
    for s, sensor in enumerate(model.sensors[:SENSORS]):
        heard = np.flatnonzero((log.kind[: fold.n] == READING) & (log.channel[: fold.n] == s))
        for begin, end, lasts in _runs(flags >> s & 1 != 0):
            before = heard[heard < begin]
            cause = "silent" if before.size else "never heard"
            start = t[before[-1]] * 1e-9 if before.size else t[0] * 1e-9
            yield Episode(
                start=start,
                end=None if lasts else t[min(end, fold.n - 1)] * 1e-9,
                subject=sensor.name,
                cause=cause,
                size=(t[end - 1] - t[begin]) * 1e-9 + (t[begin] * 1e-9 - start),
                low=np.nan,
                high=np.nan,
                unit="s",
                text=of_silence(model, s, cause, start),
            )


def _of_truth(fold: Folded) -> Iterator[Episode]:
    log, model, track = fold.log, fold.model, fold.track
    kind = log.kind[: fold.n]
    told = np.flatnonzero(kind == TRUTH)
    missed = told[track.alarms[told].any(axis=1)]
    if not missed.size:
        return
    for column, (j, state) in enumerate(zip(model.shown, model.shown_states, strict=True)):
        rows, values = truth_of(log.events.select(slice(0, fold.n)), int(j))
        place = int(j) - log.channel[rows]
        within = place < track.alarms.shape[1]
        rows, values, place = rows[within], values[within], place[within]
        if not rows.size:
            continue
        on = track.alarms[rows, place] & MISSED != 0
        for begin, end, lasts in _runs(on, JOINED):
            own = rows[begin:end]
            error = track.mean[own, column] - values[begin:end]
            if state.circular:
                error = (error + np.pi) % (2.0 * np.pi) - np.pi
            off = np.abs(error) / track.std[own, column]
            start = log.t[rows[begin]] * 1e-9
            size = float(np.sqrt(np.mean(off**2)))
            yield Episode(
                start=start,
                end=None if lasts else log.t[rows[end - 1]] * 1e-9,
                subject=state.name,
                cause="missed",
                size=size,
                low=float(off.min()),
                high=float(off.max()),
                unit="σ",
                text=of_truth(state.name, float(np.sqrt(np.mean(error**2))), state.unit, size, start),
            )


def _of_ranges(fold: Folded) -> Iterator[Episode]:
    log, model, track = fold.log, fold.model, fold.track
    t = log.t[: fold.n]
    if not np.any(track.flags & OUTSIDE):
        return
    for column, state in enumerate(model.shown_states):
        yield from _outside(state, track.mean[:, column], t)
    events = np.flatnonzero(log.kind[: fold.n] == INPUT)
    for j, given in enumerate(model.inputs):
        value = log.value[events, j]
        known = np.isfinite(value)
        yield from _outside(given, value[known], t[events[known]])


def _outside(item: State | Input, value: np.ndarray, t: np.ndarray) -> Iterator[Episode]:
    if item.fitted is None:
        return
    low, high = item.fitted
    for begin, end, lasts in _runs((value < low) | (value > high), JOINED):
        start = t[begin] * 1e-9
        least, most = float(np.nanmin(value[begin:end])), float(np.nanmax(value[begin:end]))
        size = most if most > high else least
        yield Episode(
            start=start,
            end=None if lasts else t[min(end, t.size - 1)] * 1e-9,
            subject=item.name,
            cause="outside",
            size=size,
            low=least,
            high=most,
            unit=item.unit,
            text=f"{item.name} is {size:.4g} {item.unit}, outside {low:g} to {high:g} where the model was fitted, "
            f"{since(start)}: bands hold only inside; use a model fitted there",
        )


def _of_particles(fold: Folded) -> Iterator[Episode]:
    t, track = fold.log.t[: fold.n], fold.track
    for begin, end, lasts in _runs(track.flags & IMPOVERISHED != 0):
        effective = track.effective[begin:end]
        effective = effective[np.isfinite(effective)]
        if not effective.size:
            continue
        start, size = t[begin] * 1e-9, float(np.median(effective))
        yield Episode(
            start=start,
            end=None if lasts else t[min(end, fold.n - 1)] * 1e-9,
            subject="twin",
            cause="impoverished",
            size=size,
            low=float(np.quantile(effective, 0.025)),
            high=float(np.quantile(effective, 0.975)),
            unit="",
            text=of_particles(size, float(np.nanmin(track.ancestors[begin:end])), start),
        )


def _of_twin(fold: Folded) -> Iterator[Episode]:
    t, health = fold.log.t[: fold.n], fold.track.health
    for code in (STALE, DIVERGED):
        for begin, end, lasts in _runs(health == code):
            start = t[begin] * 1e-9
            if code == STALE:
                start -= float(fold.track.age[begin])
            yield Episode(
                start=start,
                end=None if lasts else t[min(end, fold.n - 1)] * 1e-9,
                subject="twin",
                cause=HEALTH_NAMES[code],
                size=(t[end - 1] - t[begin]) * 1e-9,
                low=np.nan,
                high=np.nan,
                unit="s",
                text=of_twin(code == STALE, start),
            )
