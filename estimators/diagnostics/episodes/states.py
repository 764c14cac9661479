"""Episodes of states and inputs: the truth that was told is missed; outside the range in which the model was fitted."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...log import INPUT, TRUTH, truth_of
from ...model.state_space import Input, State
from .. import words
from ..detectors import MISSED, OUTSIDE
from .course import JOINED, Course, runs
from .episode import Episode, Found


def of_truth(course: Course) -> Iterator[Found]:
    """States whose truth was told and is far outside their bands."""
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
        for begin, end, lasts in runs(track.alarms[rows, place] & MISSED != 0, JOINED):
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
                text=words.of_truth(state.name, float(np.sqrt(np.mean(error**2))), state.unit, size, start),
            )
            yield Found(("truth", state.name), begin, int(events.t[rows[begin]]), episode)


def of_ranges(course: Course) -> Iterator[Found]:
    """Shown states and inputs beyond where the model was fitted."""
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
    for run in runs((value < low) | (value > high), JOINED):
        own = value[run.begin : run.end]
        least, most = float(np.nanmin(own)), float(np.nanmax(own))
        start, size = run.start(t), most if most > high else least
        episode = Episode(
            start=start,
            end=run.over(t),
            subject=item.name,
            cause="outside",
            size=size,
            low=least,
            high=most,
            unit=item.unit,
            text=words.of_range(item, size, start),
        )
        yield Found(("range", item.name), run.begin, int(t[run.begin]), episode)
