"""An episode of a sensor whose rows are forgotten while it goes on: when it ended, most likely.

The likelihood of each end needs no more of the rows before it than a few sums, so the end is the one that all rows
would give from the same onset; where innovations were correlated when accepted, but for the first e of each stretch,
which is taken without the one before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...log import READING
from ...track import GATED, SCREENED
from ..effects import FURTHEST, NOTHING, Sums, gains
from .course import Course, standardised, unusual
from .episode import Episode
from .sensors import OF_ALL_ROWS

ANY = -1
"""Bits of all alarms."""

REFUSALS = {"refused": GATED, "screened": SCREENED}
"""Verdicts on the readings of an episode, by its cause."""


class Going(NamedTuple):
    """What is kept of rows that are forgotten.

    `sums` of its innovations since its onset, the likeliest `end` (s) with its log-likelihood ratio `gain`, and how
    many readings were in order (`quiet`) since the last that was in alarm; `readings` since the onset in all.
    """

    sums: Sums = NOTHING
    gain: float = 0.0
    end: float = -np.inf
    quiet: int = 0
    readings: int = 0

    def over(self, course: Course, sensor: str, episode: Episode, at: int, bits: int = ANY) -> Going:
        """The same after the rows of a course, which follow; `at`: when its first alarm, one of `bits`, was, ns."""
        model, events = course.model, course.events
        s = model.sensor_names.index(sensor)
        mine = (events.kind == READING) & (events.channel == s)
        rows = np.flatnonzero(mine & (events.t * 1e-9 >= episode.start))
        alarms = np.flatnonzero((course.track.alarms[rows] & bits != 0).any(axis=1))
        quiet = rows.size - 1 - int(alarms[-1]) if alarms.size else self.quiet + int(np.sum(events.t[rows] > at))
        e, kind = _signs(course, s, rows, episode)
        known = np.flatnonzero(np.isfinite(e))
        gain, sums = gains(e[known], kind, self.sums)
        best = int(np.argmax(gain)) if gain.size else -1
        after = self._replace(sums=sums, quiet=quiet, readings=self.readings + rows.size)
        if best < 0 or gain[best] <= self.gain:
            return after
        return after._replace(gain=float(gain[best]), end=float(events.t[rows[known[best]]] * 1e-9))


def _signs(course: Course, s: int, rows: np.ndarray, episode: Episode) -> tuple[np.ndarray, str]:
    """Innovations (n,) of readings of sensor s, NaN where there is none, and in what way they differ.

    Of what is certain of each reading (refused, stuck), one that shows it is a spike.
    """
    track, cause = course.track, episode.cause
    if cause in OF_ALL_ROWS:
        nis, dof = track.nis[rows], track.dof[rows]
        e = np.sqrt(np.where(dof > 0, nis, np.nan) / np.maximum(dof, 1))
        return e, "narrow" if cause == "disagreeing" else "wide"
    model = course.model
    k = model.row_names.index(episode.subject) - model.row_start[s]
    if cause in REFUSALS or cause == "stuck":
        stays = course.events.value[rows, k] == episode.size
        shows = track.verdict[rows] == REFUSALS[cause] if cause in REFUSALS else stays
        return np.where(shows, FURTHEST, 0.0), "spiky"
    e = standardised(course, rows, k)
    known = np.isfinite(e)
    if known.any():
        e[known] = unusual(course, s, k, e[known])
    return e, cause
