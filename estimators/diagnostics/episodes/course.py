"""What episodes are made of: a stretch of events with its track, and the runs of rows that are in alarm."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from ...log import Events, Log
from ...model.state_space import StateSpaceModel
from ...track import GATED, USED, Track
from ...tuning import Tuning

JOINED = 100
"""Readings without an alarm after which another is another episode."""


class Course(NamedTuple):
    """Events, their rows, and with what they were folded.

    `marginal`: whether the predictions are not Gaussian. `heard` (sensors,): when each sensor spoke last before these
    events, ns, 0 where it did not; None if they are the first. `alarmed` (sensors,): for how many readings it had been
    in alarm by then, and not lost.
    """

    model: StateSpaceModel
    tuning: Tuning
    marginal: bool
    events: Events
    track: Track
    heard: np.ndarray | None = None
    alarmed: np.ndarray | None = None


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


def course_of(fold: Folded) -> Course:
    """What a fold has come to so far: views, which change with it."""
    return Course(fold.model, fold.tuning, fold.marginal, fold.log.events.select(slice(0, fold.n)), fold.track)


class Run(NamedTuple):
    """Rows `begin` to `end` in alarm, and whether it lasts at the end of what there is."""

    begin: int
    end: int
    lasts: bool

    def start(self, t: np.ndarray) -> float:
        """Time of its first row, s, of times t (n,), ns."""
        return float(t[self.begin] * 1e-9)

    def over(self, t: np.ndarray) -> float | None:
        """Time of the first row in order again, s; None while it lasts."""
        return None if self.lasts else float(t[min(self.end, t.size - 1)] * 1e-9)


def runs(on: np.ndarray, joined: int = 0) -> Iterator[Run]:
    """The runs of True in `on` (n,) of bool; pauses of at most `joined` are bridged."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], on.astype(np.int8), [0]))))
    begins, ends = edges[::2], edges[1::2]
    if not begins.size:
        return
    apart = np.flatnonzero(begins[1:] - ends[:-1] > joined)
    for begin, end in zip(begins[np.append(0, apart + 1)], ends[np.append(apart, ends.size - 1)], strict=True):
        yield Run(int(begin), int(end), bool(on.size - end <= joined))


def standardised(course: Course, rows: np.ndarray, k: int) -> np.ndarray:
    """e of row k of the readings at `rows`, as the bank sees it; NaN where there is none."""
    track = course.track
    with np.errstate(invalid="ignore", divide="ignore"):  # of an infinite variance, or of none
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
