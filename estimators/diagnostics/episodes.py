"""Episodes: what was wrong from when to when, with whom, by how much, and what can be done about it.

A pure function of events and track. The alarms of one sensor that follow each other are one episode; what its
innovations show since its onset names the cause (effects.py). ALARMS.md says for each cause what it means and what to
do.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from ..log import INPUT, READING, TRUTH, Events, Log, truth_of
from ..model.state_space import Input, State, StateSpaceModel
from ..track import DIVERGED, GATED, HEALTH_NAMES, REASONS, SCREENED, STALE, USED, Track
from ..tuning import Tuning
from .effects import KINDS, Effect, common_scale, effects, onset
from .evidence import AGREEING, DISAGREEING, IMPOVERISHED, MISSED, OUTSIDE, REFUSED, SENSORS, STUCK
from .words import of_particles, of_sensor, of_silence, of_truth, of_twin, since

JOINED = 100
"""Readings without an alarm after which another is another episode."""

LOOKED_AT = 4000
"""Readings of an episode, and before it, of which the size is made."""


WANDERING = 0.5
"""Lag-1 correlation from which innovations that are too large are those of a mean that moves: noise does not wander."""

MOST = 0.5
"""Share of refused readings from which an episode is one of refusals."""


CAUSES = (
    "shifted", "narrow", "wide", "correlated", "alternating", "spiky", "refused", "screened", "stuck", "disagreeing",
    "agreeing", "silent", "never heard", "missed", "outside", "impoverished", "stale", "diverged", "dropped",
)  # fmt: skip
"""Of episodes; each has its heading in ALARMS.md."""


class Episode(NamedTuple):
    """Something that was wrong.

    `start` and `end` in seconds of the log; `end` None while it lasts. `subject`: a sensor, one of its rows, a state,
    an input, or "twin". `cause`: one of `CAUSES`. `size` in `unit` with its 95 % interval, `low` to `high` (NaN
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


def episode_json(episode: Episode) -> dict[str, float | str | None]:
    """An episode for JSON: its fields by name; null for what is not a number, which JSON does not have."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in episode._asdict().items()}


def anchor(cause: str) -> str:
    """Of its heading in ALARMS.md, as GitHub makes it."""
    return cause.replace(" ", "-")


class Course(NamedTuple):
    """What episodes are made of: events, their rows, and with what they were folded.

    `marginal`: whether the predictions are not Gaussian. `heard` (sensors,): when each sensor spoke last before these
    events, ns, 0 where it did not; None if they are the first.
    """

    model: StateSpaceModel
    tuning: Tuning
    marginal: bool
    events: Events
    track: Track
    heard: np.ndarray | None = None


class Folded(Protocol):
    """A fold, as far as episodes need it; see `Course`."""

    @property
    def model(self) -> StateSpaceModel: ...  # noqa: D102
    @property
    def tuning(self) -> Tuning: ...  # noqa: D102
    @property
    def marginal(self) -> bool: ...  # noqa: D102
    @property
    def log(self) -> Log: ...  # noqa: D102
    @property
    def n(self) -> int: ...  # noqa: D102
    @property
    def track(self) -> Track: ...  # noqa: D102


class Found(NamedTuple):
    """An episode, and where it was found.

    `key`: what is tested, and on whom; of one key there is one episode at a time. `begin`: the first row in alarm,
    among those that are tested; `at`: its time, ns.
    """

    key: tuple[str, str]
    begin: int
    at: int
    episode: Episode


def course_of(fold: Folded) -> Course:
    """What a fold has come to so far: views, which change with it."""
    return Course(fold.model, fold.tuning, fold.marginal, fold.log.events.select(slice(0, fold.n)), fold.track)


def episodes(fold: Folded) -> list[Episode]:
    """All episodes of a fold, in the order of their start."""
    return [item.episode for item in found_in(course_of(fold))]


def found_in(course: Course) -> list[Found]:
    """All episodes of a stretch of events, in the order of their start."""
    found = [
        *_of_sensors(course),
        *_of_silence(course),
        *_of_truth(course),
        *_of_ranges(course),
        *_of_particles(course),
        *_of_twin(course),
    ]
    plain = [item._replace(episode=_plain(item.episode)) for item in found]
    return sorted(plain, key=lambda item: (item.episode.start, item.episode.subject))


def _plain(episode: Episode) -> Episode:
    """With numbers of Python, whatever they came from."""
    end = None if episode.end is None else float(episode.end)
    start, size, low, high = (float(x) for x in (episode.start, episode.size, episode.low, episode.high))
    return episode._replace(start=start, end=end, size=size, low=low, high=high)


def _runs(on: np.ndarray, joined: int = 0) -> Iterator[tuple[int, int, bool]]:
    """First and end of each run of True in `on`, and whether it lasts at the end; shorter pauses are bridged."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], on.astype(np.int8), [0]))))
    begins, ends = edges[::2], edges[1::2]
    if not begins.size:
        return
    apart = np.flatnonzero(begins[1:] - ends[:-1] > joined)
    for begin, end in zip(begins[np.append(0, apart + 1)], ends[np.append(apart, ends.size - 1)], strict=True):
        yield int(begin), int(end), bool(on.size - end <= joined)


def standardised(course: Course, rows: np.ndarray, k: int) -> np.ndarray:
    """e of row k of the readings at `rows`, as the bank sees it; NaN where there is none."""
    track = course.track
    e = track.innovation[rows, k] / track.innovation_std[rows, k]
    if course.marginal:
        e = track.whitened[rows, k]
    verdict = track.verdict[rows]
    return np.where((verdict == USED) | (verdict == GATED), e, np.nan)


def unusual(course: Course, s: int, k: int, e: np.ndarray) -> np.ndarray:
    """Finite e (n,) of row k of sensor s as it would be drawn from N(0, 1) if it were as it was when accepted."""
    if course.tuning.baseline is None:
        return e
    bias, scale, phi = course.tuning.baseline[course.model.row_start[s] + k, :3]
    e = (e - bias) / scale
    return np.append(e[:1], (e[1:] - phi * e[:-1]) / np.sqrt(1.0 - phi**2)) if phi else e


def _of_sensors(course: Course) -> Iterator[Found]:
    events, track, model = course.events, course.track, course.model
    if not track.alarms.any():
        return
    for s, sensor in enumerate(model.sensors):
        rows = np.flatnonzero((events.kind == READING) & (events.channel == s))
        masks = track.alarms[rows, : len(sensor.rows)]
        for begin, end, lasts in _runs(masks.any(axis=1), JOINED):
            episode = _of_sensor(course, s, rows, masks, begin, end, lasts)
            yield Found(("sensor", sensor.name), begin, int(events.t[rows[begin]]), episode)


def _of_sensor(
    course: Course, s: int, rows: np.ndarray, masks: np.ndarray, begin: int, end: int, lasts: bool
) -> Episode:
    """The episode of the readings `begin` to `end` of a sensor, whose events are `rows`."""
    events, track, model = course.events, course.track, course.model
    said = np.bitwise_or.reduce(masks[begin:end])
    k, begun, over, ranked = _most_telling(course, s, rows, np.flatnonzero(said), begin, end, lasts)
    effect = ranked[0]
    cause, size, low, high = effect.cause, effect.size, effect.low, effect.high
    reasons = ""
    values, verdict = events.value[rows], track.verdict[rows]
    stuck = np.flatnonzero(said & STUCK)
    refused = np.flatnonzero(said & REFUSED)
    # A gate that refuses some readings has a reason that shows in the others.
    edge = verdict[begin:end] == SCREENED
    if refused.size and np.mean(edge) >= MOST:
        refused = refused[:0]
        cause, k = "screened", int(np.argmax((track.screened[rows[begin:end]] != 0).sum(axis=0)))
        begun = begin - int(np.argmax(verdict[:begin][::-1] != SCREENED)) if np.any(verdict[:begin] != SCREENED) else 0
        over = end if lasts else begin + int(np.flatnonzero(edge)[-1]) + 1
        size, low, high = float(np.mean(verdict[begun:over] == SCREENED)), np.nan, np.nan
    elif refused.size:
        # Other tests fall more slowly: those readings are in order already.
        until = int(np.flatnonzero((masks[begin:end] & REFUSED).any(axis=1))[-1]) + 1
        if np.mean(verdict[begin : begin + until] == GATED) < MOST:
            refused = refused[:0]
    if cause == "screened":
        bits = int(np.bitwise_or.reduce(track.screened[rows[begun:over], k]))
        reasons = " and ".join(reason for place, reason in enumerate(REASONS) if bits >> place & 1)
    elif stuck.size:
        k, cause = int(stuck[0]), "stuck"
        begun = _same_since(values[:, k], begin)
        others = np.flatnonzero(values[begun:end, k] != values[begun, k])
        over = end if lasts or not others.size else begun + int(others[0])
        size, low, high = float(values[begun, k]), np.nan, np.nan
    elif refused.size:
        k, cause = int(refused[0]), "refused"
        used = np.flatnonzero(verdict[:begin] == USED)
        begun = int(used[-1]) + 1 if used.size else 0
        over = end if lasts else begun + int(np.flatnonzero(verdict[begun:end] == GATED)[-1]) + 1
        size, low, high = float(np.mean(verdict[begun:over] == GATED)), np.nan, np.nan
    elif said[0] & (DISAGREEING | AGREEING) and not np.any(said & ~(DISAGREEING | AGREEING)):
        k, cause = 0, "disagreeing" if said[0] & DISAGREEING else "agreeing"
        begun, over, (_, size, low, high, _) = _together(course, rows, begin, end, cause)
    nu = track.innovation[rows[begun:over], k]
    about = float(np.nanmean(nu)) if np.isfinite(nu).any() else np.nan
    row = model.sensors[s].rows[k]
    unit = {"shifted": "σ", "narrow": "×", "wide": "×", "disagreeing": "×", "agreeing": "×", "stuck": row.unit}
    of_all = cause in ("disagreeing", "agreeing")
    subject = model.sensors[s].name if of_all else model.row_names[model.row_start[s] + k]
    start = events.t[rows[begun]] * 1e-9
    correlation = next((item.size for item in ranked if item.cause in ("correlated", "alternating")), 0.0)
    return Episode(
        start=start,
        end=None if lasts else events.t[rows[max(over - 1, begun)]] * 1e-9,
        subject=subject,
        cause=cause,
        size=size,
        low=low,
        high=high,
        unit=unit.get(cause, ""),
        text=of_sensor(model, course.tuning, s, k, cause, size, about, correlation, start, reasons),
    )


def _most_telling(
    course: Course, s: int, rows: np.ndarray, said: np.ndarray, begin: int, end: int, lasts: bool
) -> tuple[int, int, int, list[Effect]]:
    """The row that shows most of what is wrong, the readings from when to when, and what it shows, the likeliest first.

    A test falls more slowly than its cause goes: an episode that is over ended where that is most likely. What moves
    one way and then back has no mean over the whole: where innovations wander, the part that is shifted tells more.
    """
    first = max(0, begin - LOOKED_AT)
    best: tuple[int, int, int, list[Effect]] = (int(said[0]) if said.size else 0, begin, end, [_UNKNOWN])
    shifted = best
    for k in said:
        e = standardised(course, rows[first:end], int(k))
        known = np.flatnonzero(np.isfinite(e))
        if known.size < 2:
            continue
        e = unusual(course, s, int(k), e[known])
        alarm = min(int(np.searchsorted(known, begin - first)), e.size - 1)
        for cause in KINDS:
            begun = onset(e[: alarm + 1], cause)
            run = e[begun : begun + LOOKED_AT]
            over = max(begun + run.size - onset(run[::-1], cause), min(alarm + 1, begun + run.size))
            ranked = effects(e[begun:over])
            if ranked[0].cause != cause:
                continue
            found = int(k), first + int(known[begun]), first + int(known[over - 1]) + 1, ranked
            if ranked[0].ratio > best[3][0].ratio:
                best = found
            if cause == "shifted" and ranked[0].ratio > shifted[3][0].ratio:
                shifted = found
    ranked = best[3]
    wanders = any(item.cause == "correlated" and item.size >= WANDERING for item in ranked)
    if ranked[0].cause == "narrow" and wanders:
        if np.isfinite(shifted[3][0].ratio):
            return shifted
        return (*best[:3], sorted(ranked, key=lambda item: item.cause != "correlated"))
    return best


def _together(course: Course, rows: np.ndarray, begin: int, end: int, cause: str) -> tuple[int, int, Effect]:
    """From when to when all rows of a sensor together are off more, or less, than their noise, and how much.

    The mean of a NIS is its degrees of freedom: the root of their ratio takes the place of e.
    """
    first = max(0, begin - LOOKED_AT)
    nis, dof = course.track.nis[rows[first:end]], course.track.dof[rows[first:end]]
    known = np.flatnonzero(np.isfinite(nis) & (dof > 0))
    e = np.sqrt(nis[known] / dof[known])
    alarm = min(int(np.searchsorted(known, begin - first)), e.size - 1)
    way = "narrow" if cause == "disagreeing" else "wide"
    begun = onset(e[: alarm + 1], way)
    run = e[begun : begun + LOOKED_AT]
    over = max(begun + run.size - onset(run[::-1], way), min(alarm + 1, begun + run.size))
    found = common_scale(e[begun:over], dof[known][begun:over])
    return first + int(known[begun]), first + int(known[over - 1]) + 1, found


_UNKNOWN = Effect("narrow", np.nan, np.nan, np.nan, -np.inf)


def _same_since(values: np.ndarray, at: int) -> int:
    """The first of the equal values that end at index `at`."""
    others = np.flatnonzero(values[:at] != values[at])
    return int(others[-1]) + 1 if others.size else 0


def _of_silence(course: Course) -> Iterator[Found]:
    events, model, flags = course.events, course.model, course.track.flags
    t = events.t
    if not flags.any():
        return
    for s, sensor in enumerate(model.sensors[:SENSORS]):
        heard = np.flatnonzero((events.kind == READING) & (events.channel == s))
        known = 0 if course.heard is None else int(course.heard[s])
        for begin, end, lasts in _runs(flags >> s & 1 != 0):
            before = heard[heard < begin]
            last = int(t[before[-1]]) if before.size else known
            cause = "silent" if last else "never heard"
            start = (last or int(t[0])) * 1e-9
            over = None if lasts else float(t[min(end, t.size - 1)] * 1e-9)
            size = t[end - 1] * 1e-9 - start if over is None else over - start
            episode = Episode(
                start=start,
                end=over,
                subject=sensor.name,
                cause=cause,
                size=size,
                low=np.nan,
                high=np.nan,
                unit="s",
                text=of_silence(model, s, cause, start, None if lasts else size),
            )
            yield Found(("silence", sensor.name), begin, int(t[begin]), episode)


def _of_truth(course: Course) -> Iterator[Found]:
    events, model, track = course.events, course.model, course.track
    told = np.flatnonzero(events.kind == TRUTH)
    missed = told[track.alarms[told].any(axis=1)]
    if not missed.size:
        return
    for column, (j, state) in enumerate(zip(model.shown, model.shown_states, strict=True)):
        rows, values = truth_of(events, int(j))
        place = int(j) - events.channel[rows]
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
            sure = track.std[own, column] > 0.0
            off = np.abs(error[sure]) / track.std[own[sure], column]
            start = events.t[rows[begin]] * 1e-9
            size = float(np.sqrt(np.mean(off**2)))
            episode = Episode(
                start=start,
                end=None if lasts else events.t[rows[end - 1]] * 1e-9,
                subject=state.name,
                cause="missed",
                size=size,
                low=float(off.min()),
                high=float(off.max()),
                unit="σ",
                text=of_truth(state.name, float(np.sqrt(np.mean(error**2))), state.unit, size, start),
            )
            yield Found(("truth", state.name), begin, int(events.t[rows[begin]]), episode)


def _of_ranges(course: Course) -> Iterator[Found]:
    events, model, track = course.events, course.model, course.track
    t = events.t
    if not np.any(track.flags & OUTSIDE):
        return
    for column, state in enumerate(model.shown_states):
        yield from _outside(state, track.mean[:, column], t)
    rows = np.flatnonzero(events.kind == INPUT)
    for j, given in enumerate(model.inputs):
        value = events.value[rows, j]
        known = np.isfinite(value)
        yield from _outside(given, value[known], t[rows[known]])


def _outside(item: State | Input, value: np.ndarray, t: np.ndarray) -> Iterator[Found]:
    if item.fitted is None:
        return
    low, high = item.fitted
    for begin, end, lasts in _runs((value < low) | (value > high), JOINED):
        start = t[begin] * 1e-9
        least, most = float(np.nanmin(value[begin:end])), float(np.nanmax(value[begin:end]))
        size = most if most > high else least
        episode = Episode(
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
        yield Found(("range", item.name), begin, int(t[begin]), episode)


def _of_particles(course: Course) -> Iterator[Found]:
    t, track = course.events.t, course.track
    for begin, end, lasts in _runs(track.flags & IMPOVERISHED != 0):
        effective = track.effective[begin:end]
        effective = effective[np.isfinite(effective)]
        if not effective.size:
            continue
        start, size = t[begin] * 1e-9, float(np.median(effective))
        episode = Episode(
            start=start,
            end=None if lasts else t[min(end, t.size - 1)] * 1e-9,
            subject="twin",
            cause="impoverished",
            size=size,
            low=float(np.quantile(effective, 0.025)),
            high=float(np.quantile(effective, 0.975)),
            unit="",
            text=of_particles(size, float(np.nanmin(track.ancestors[begin:end])), start),
        )
        yield Found(("particles", "twin"), begin, int(t[begin]), episode)


def _of_twin(course: Course) -> Iterator[Found]:
    t, track = course.events.t, course.track
    for code in (STALE, DIVERGED):
        for begin, end, lasts in _runs(track.health == code):
            start = t[begin] * 1e-9
            if code == STALE:
                start -= float(track.age[begin])
            episode = Episode(
                start=start,
                end=None if lasts else t[min(end, t.size - 1)] * 1e-9,
                subject="twin",
                cause=HEALTH_NAMES[code],
                size=(t[end - 1] - t[begin]) * 1e-9,
                low=np.nan,
                high=np.nan,
                unit="s",
                text=of_twin(code == STALE, start),
            )
            yield Found(("twin", HEALTH_NAMES[code]), begin, int(t[begin]), episode)
