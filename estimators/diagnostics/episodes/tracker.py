"""Episodes of a fold as its rows arrive, in bounded memory: the one form for a whole log and for a running twin.

The tracker keeps the most recent rows and finds episodes among them. When they are too many, it drops the older half,
at row counts that depend on nothing but the number of rows, so the episodes are the same however the rows are divided
into chunks. What began before the kept rows is carried on: its onset, size and text stay, and the sums on which its
most likely end depends are kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...fold import Fold
from ...log import READING, Events
from ...model.state_space import StateSpaceModel
from ...track import GATED, MISSING, SCREENED, Track
from ...tuning import Tuning
from ..detectors import detector_of
from ..effects import EVIDENCE, MAX_SIGMA, NO_SUMS, Sums, gains
from .conditions import dropouts, impoverished_particles, left_ranges, lost_estimates, silent_gaps
from .episode import JOINED, Episode, FoundEpisode, JudgedRows, standardised, without_baseline
from .sensors import ALARM_KEYS, LOSSES, OF_ALL_ROWS, UNKNOWN_EFFECTS, evidence, joint_scale, sensor_alarms

MAX_ROWS = 16_384  # Rows kept at most; at least half of them once there were as many
MAX_BYTES = 16 * 2**20  # Memory of the kept rows; rows of a large field are fewer

CONDITIONS = (sensor_alarms, dropouts, left_ranges, impoverished_particles, lost_estimates, silent_gaps)

JOINED_ROWS = dict.fromkeys([*ALARM_KEYS, "outside", "impossible", "corrected"], JOINED)
"""Rows without an alarm that an episode bridges, by the first part of its key; 0 for the others."""

REJECTIONS = {"refused": GATED, "screened": SCREENED}  # Verdict on the measurements of an episode, by its cause


def episodes(fold: Fold) -> list[Episode]:
    """Return the episodes of a fold, in the order of their start."""
    return episodes_of(judged_rows(fold))


def episodes_of(judged: JudgedRows) -> list[Episode]:
    """Return the episodes of consecutive rows, in the order of their start."""
    tracker = EpisodeTracker(judged.model, judged.tuning, judged.marginal, stale_after=judged.stale_after)
    tracker.feed(judged.events, judged.track)
    return tracker.episodes


def judged_rows(fold: Fold) -> JudgedRows:
    """Return the rows of a fold so far, as views."""
    events, stale_after = fold.events, fold.policy.stale_after
    return JudgedRows(fold.model, fold.tuning, fold.marginal, events, fold.track, stale_after=stale_after)


def found_in(judged: JudgedRows) -> list[FoundEpisode]:
    """Return the episodes among these rows alone, in the order of their start."""
    found = [item._replace(episode=_plain(item.episode)) for condition in CONDITIONS for item in condition(judged)]
    return sorted(found, key=lambda item: (item.episode.start, item.episode.subject))


def _plain(episode: Episode) -> Episode:
    """Return an episode with Python floats."""
    end = None if episode.end is None else float(episode.end)
    start, size, low, high = (float(x) for x in (episode.start, episode.size, episode.low, episode.high))
    return episode._replace(start=start, end=end, size=size, low=low, high=high)


class DroppedRows(NamedTuple):
    """Summary of the measurements of an episode that are no longer kept.

    sums: of its innovations since the onset; end: its most likely end (s), with log-likelihood ratio gain; quiet:
    measurements without an alarm since the last one in alarm; readings: measurements since the onset.
    """

    sums: Sums = NO_SUMS
    gain: float = 0.0
    end: float = -np.inf
    quiet: int = 0
    readings: int = 0

    def after(self, judged: JudgedRows, key: tuple[str, str], episode: Episode, at: int) -> DroppedRows:
        """Return the summary after further rows; `at`: time of the first alarm, ns."""
        events = judged.events
        s = judged.model.sensor_names.index(key[1])
        rows = judged.measured(s)
        rows = rows[events.t[rows] * 1e-9 >= episode.start]
        alarms = np.flatnonzero((judged.track.alarms[rows] & ALARM_KEYS[key[0]] != 0).any(axis=1))
        quiet = rows.size - 1 - int(alarms[-1]) if alarms.size else self.quiet + int(np.sum(events.t[rows] > at))
        e, kind = _effect_series(judged, s, rows, episode)
        known = np.flatnonzero(np.isfinite(e))
        gain, sums = gains(e[known], kind, self.sums)
        best = int(np.argmax(gain)) if gain.size else -1
        summary = self._replace(sums=sums, quiet=quiet, readings=self.readings + rows.size)
        if best < 0 or gain[best] <= self.gain:
            return summary
        return summary._replace(gain=float(gain[best]), end=float(events.t[rows[known[best]]] * 1e-9))


def _effect_series(judged: JudgedRows, s: int, rows: np.ndarray, episode: Episode) -> tuple[np.ndarray, str]:
    """Return innovations (n,) of measurements of sensor s, NaN where there is none, and the kind of their effect.

    A loss is certain in each measurement: one that shows it counts as an outlier.
    """
    track, cause = judged.track, episode.cause
    if cause in OF_ALL_ROWS:
        return joint_scale(judged, rows), OF_ALL_ROWS[cause]
    k = judged.model.row_names.index(episode.subject) - judged.model.row_start[s]
    if cause in LOSSES:
        equal = judged.events.value[rows, k] == episode.size
        shows = track.verdict[rows] == REJECTIONS[cause] if cause in REJECTIONS else equal
        return np.where(shows, MAX_SIGMA, 0.0), "spiky"
    detector = detector_of(cause)
    if detector in UNKNOWN_EFFECTS:
        e = np.full(rows.size, np.nan)
        known, ratios = evidence(judged, s, rows, k, detector)
        e[known] = ratios
        return e, EVIDENCE
    e = standardised(judged, rows, k)
    known = np.isfinite(e)
    if known.any():
        e[known] = without_baseline(judged, s, k, e[known])
    return e, cause


class TrackedEpisode(NamedTuple):
    """An episode with its key, times of its first and last row in alarm, ns, and the summary of its dropped rows."""

    key: tuple[str, str]
    at: int
    until: int
    episode: Episode
    dropped: DroppedRows = DroppedRows()

    def after(self, judged: JudgedRows) -> TrackedEpisode:
        """Return the same with further rows in its summary."""
        if self.key[0] not in ALARM_KEYS:
            return self
        return self._replace(dropped=self.dropped.after(judged, self.key, self.episode, self.at))

    def likely_end(self, otherwise: float) -> float:
        """Return when it ended, s, if it did: that of a sensor not before its first alarm."""
        return max(self.dropped.end, self.at * 1e-9) if self.key[0] in ALARM_KEYS else otherwise


class EpisodeTracker:
    """Episodes of one fold.

    Args:
        model: The model.
        tuning: Of the fold; may be replaced by an equal one.
        marginal: Whether the filter's predictions are not Gaussian.
        first: Index of the first row.
        max_rows: Rows kept at most.
        max_closed: Closed episodes kept at most, the last; None for all.
        stale_after: See `JudgedRows`.
    """

    def __init__(
        self,
        model: StateSpaceModel,
        tuning: Tuning,
        marginal: bool,
        *,
        first: int = 0,
        max_rows: int = MAX_ROWS,
        max_closed: int | None = None,
        stale_after: float = np.inf,
    ) -> None:
        self.model, self.tuning, self.marginal = model, tuning, marginal
        self.first, self.n = first, 0
        self._max_rows, self._max_closed = max_rows, max_closed
        self._stale_after = stale_after
        self._columns: list[np.ndarray] = []
        self._last_heard = np.zeros(len(model.sensors), np.int64)
        self._closed: list[TrackedEpisode] = []
        self._carried: dict[tuple[str, str], TrackedEpisode] = {}
        self._entries: list[TrackedEpisode] | None = []

    @property
    def events(self) -> Events:
        """Views of the events that are kept."""
        return Events(*(column[: self.n] for column in self._columns[:5]))

    @property
    def track(self) -> Track:
        """Views of their rows."""
        return Track(*(column[: self.n] for column in self._columns[5:]))

    @property
    def entries(self) -> list[TrackedEpisode]:
        """All episodes so far, in the order of their start."""
        if self._entries is None:
            self._entries = self._find()
        return self._entries

    @property
    def episodes(self) -> list[Episode]:
        """The same without their keys."""
        return [entry.episode for entry in self.entries]

    def feed(self, events: Events, track: Track, first: int | None = None) -> None:
        """Add rows, which replace those from index `first` on; None to append.

        Raises:
            IndexError: If `first` is before the kept rows.
        """
        if first is not None:
            if not self.first <= first <= self.first + self.n:
                raise IndexError(f"row {first} is not among rows {self.first} to {self.first + self.n}")
            self.n = first - self.first
        done, total = 0, len(events)
        self._entries = None if total or first is not None else self._entries
        while done < total:
            if not self._columns:
                self._allocate(events, track)
            count = min(total - done, self._room - self.n)
            rows = slice(done, done + count)
            self._put([*(column[rows] for column in events), *(column[rows] for column in track)], count)
            done += count
            if self.n == self._room:
                self._cut(self._find())

    def _allocate(self, events: Events, track: Track) -> None:
        row = sum(column[:1].nbytes for column in track) + 8 * self.model.width
        self._room = max(2, min(self._max_rows, MAX_BYTES // max(1, row)))
        self._columns = [column[:0] for column in (*events, *track)]

    def _put(self, new: list[np.ndarray], count: int) -> None:
        end = self.n + count
        for k, column in enumerate(new):
            kept = self._columns[k]
            # A measurement with variances of its own makes events wider.
            if end > len(kept) or column.shape[1:] > kept.shape[1:]:
                shape = (min(self._room, max(end, 2 * self.n)), *max(kept.shape[1:], column.shape[1:]))
                self._columns[k] = np.zeros(shape, column.dtype)
                _copy(kept[: self.n], self._columns[k])
            _copy(column, self._columns[k][self.n : end])
        self.n = end

    def _judged(self, rows: slice) -> JudgedRows:
        known = (self._carried.get(("sensor", name)) for name in self.model.sensor_names)
        alarmed = [0 if e is None or e.episode.cause in LOSSES else e.dropped.readings for e in known]
        events, track = self.events.select(rows), self.track.select(rows)
        return JudgedRows(
            self.model,
            self.tuning,
            self.marginal,
            events,
            track,
            self._last_heard,
            np.array(alarmed),
            self._stale_after,
        )

    def _find(self) -> list[TrackedEpisode]:
        """Return all episodes, those of the kept rows joined with those carried on."""
        left, found = dict(self._carried), []
        ended: list[TrackedEpisode] = []
        if self.n:
            judged = self._judged(slice(None))
            first = int(judged.events.t[0])
            for item in found_in(judged):
                known = left.get(item.key)
                joined = JOINED_ROWS.get(item.key[0], 0)
                if known is not None and (known.at == item.at or known.dropped.quiet + item.begin <= joined):
                    del left[item.key]
                    found.append(_continued(known, item, judged))
                else:
                    found.append(TrackedEpisode(item.key, item.at, item.until, item.episode))
            # An alarm that a late measurement has removed was none.
            ended = [_ended(entry, judged) for entry in left.values() if entry.at < first]
        return sorted([*self._closed, *ended, *found], key=lambda e: (e.episode.start, e.episode.subject))

    def _cut(self, entries: list[TrackedEpisode]) -> None:
        """Drop the older half of the rows, and keep a summary of their episodes."""
        count = self.n // 2
        dropped = self._judged(slice(0, count))
        first = int(self.events.t[count])
        begun = [entry for entry in entries if entry.episode.start * 1e9 < first]
        # An alarm clears later than its cause ends.
        closed = [
            entry.episode.end is not None and max(entry.episode.end * 1e9, entry.until) < first for entry in begun
        ]
        kept = [entry for entry, over in zip(begun, closed, strict=True) if over]
        self._carried = {}
        for entry in (entry for entry, over in zip(begun, closed, strict=True) if not over):
            kept += [self._carried[entry.key]] if entry.key in self._carried else []
            self._carried[entry.key] = entry.after(dropped)
        self._closed = kept if self._max_closed is None else kept[-self._max_closed :]
        heard = (dropped.events.kind == READING) & (dropped.track.verdict != MISSING)
        # Times ascend: the last of equal indices stays.
        self._last_heard[dropped.events.channel[heard]] = dropped.events.t[heard]
        for column in self._columns:
            column[: self.n - count] = column[count : self.n].copy()
        self.first, self.n = self.first + count, self.n - count


def _copy(column: np.ndarray, to: np.ndarray) -> None:
    """Copy rows to the first ones of a column that may be wider, with NaN beyond."""
    if column.ndim == 1:
        to[: len(column)] = column
        return
    to[: len(column), : column.shape[1]] = column
    if column.shape[1] < to.shape[1]:
        to[: len(column), column.shape[1] :] = np.nan


def _continued(known: TrackedEpisode, item: FoundEpisode, judged: JudgedRows) -> TrackedEpisode:
    """Return an episode that began before the kept rows, updated by these."""
    old, new, dropped = known.episode, item.episode, known.dropped
    if item.at == known.at and new.cause != old.cause:
        # All its alarms are kept, and show more than the first of them.
        return TrackedEpisode(item.key, item.at, item.until, new)
    end = new.end
    if new.cause in LOSSES and old.cause not in LOSSES:
        # All that shows it is in these rows.
        old, dropped = new._replace(start=old.start), DroppedRows()
    elif end is not None:
        end = known.after(judged).likely_end(end)
    size = (new.end or float(judged.events.t[-1]) * 1e-9) - old.start if old.unit == "s" else old.size
    return TrackedEpisode(known.key, known.at, item.until, old._replace(end=end, size=size), dropped)


def _ended(known: TrackedEpisode, judged: JudgedRows) -> TrackedEpisode:
    """Return an episode that began before the kept rows, of which none is in alarm."""
    after = known.after(judged)
    if known.key[0] in ALARM_KEYS and after.dropped.quiet <= JOINED:
        return known._replace(episode=known.episode._replace(end=None))
    end = known.episode.end or after.likely_end(float(judged.events.t[0] * 1e-9))
    return known._replace(episode=known.episode._replace(end=end))
