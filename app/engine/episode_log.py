"""Track the episodes of the running twin, and report when they begin and end, in a repeated background job.

New rows are pulled with a cursor, as a view does, and fed to an `EpisodeTracker`. Another revision, or a late
measurement that belongs before the rows it keeps, begins a new tracker; what lasts through that is not reported again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.episodes import ALARM_KEYS, Episode, EpisodeTracker, TrackedEpisode
from estimators.diagnostics.episodes.tracker import MAX_ROWS
from estimators.diagnostics.held_out import Offset, offsets
from estimators.registry import find_estimator
from estimators.track import ADVISORY, DIVERGED, HEALTH_NAMES, TRACKING, WAITING, estimated_rows

from ..format_time import duration_text
from ..leading import leading, severity
from .copies import Pull
from .counts import last_run
from .history_copy import follow
from .jobs import Job
from .running_fold import Running

EPISODES_PERIOD_S, MAX_EPISODES_PERIOD_S = 0.4, 3.0
"""Seconds between two updates: when they are cheap, and at most."""

PROCESSOR_SHARE = 0.05
"""Share of a processor that updates may take: expensive ones come less often."""

MAX_CLOSED = 1000
"""Closed episodes that are kept; older ones are in the recording."""

MAX_NOTICES = 5
"""Episodes of one update that are reported one by one."""

SENSOR_KEYS = (*ALARM_KEYS, "silence")
"""First parts of the keys of a sensor's episodes; the second is its name."""


class EpisodeSummary(NamedTuple):
    """Entries of one moment in the order of their start, those that last, and offsets of held-out sensors.

    `revision` is that of the rows.
    """

    entries: tuple[TrackedEpisode, ...] = ()
    lasting: tuple[TrackedEpisode, ...] = ()
    offsets: tuple[Offset, ...] = ()
    revision: int = -1

    def at(self, seconds: float) -> EpisodeSummary:
        """Return the summary of an earlier time, s: of the episodes that lasted then."""
        lasting = tuple(item for item in self.entries if item.episode.start <= seconds < (item.episode.end or np.inf))
        return self._replace(lasting=lasting, offsets=())

    @property
    def episodes(self) -> list[Episode]:
        """All of them."""
        return [entry.episode for entry in self.entries]

    @property
    def open(self) -> list[Episode]:
        """Those that last."""
        return [entry.episode for entry in self.lasting]

    @property
    def in_alarm(self) -> frozenset[str]:
        """Sensors with an open episode, whose rejected measurements need no report of their own."""
        return frozenset(entry.key[1] for entry in self.lasting if entry.key[0] in ALARM_KEYS)

    def of_sensors(self, states: Mapping[str, str]) -> dict[str, tuple[str, str]]:
        """Return the state of each sensor, with the text of its most severe open episode."""
        found = {name: (state, "") for name, state in states.items()}
        for entry in sorted(self.lasting, key=lambda entry: severity(entry.episode), reverse=True):
            kind, name = entry.key
            if kind in SENSOR_KEYS and found[name][0] not in ("waiting", "tracking"):
                found[name] = (found[name][0], entry.episode.text)
        for offset in sorted(self.offsets, key=lambda offset: offset.beyond):
            if found[offset.sensor][0] == "held out":
                found[offset.sensor] = "held out", offset.words
        return found


class EpisodeLog:
    """Episodes of one engine; any thread may read `summary`, which is replaced, never changed."""

    def __init__(
        self, engine: Running, max_rows: int = MAX_ROWS, others: Callable[[], Iterable[TrackedEpisode]] = tuple
    ) -> None:
        """`max_rows`: see `EpisodeTracker`; `others` returns the episodes that no row shows."""
        self._others = others
        self._engine, self._max_rows = engine, max_rows
        self._cursor = engine.cursor()
        self.tracker = self._new_tracker(engine.rows(0, 0))
        self._entries: list[TrackedEpisode] = []
        self._health = WAITING
        self.summary = EpisodeSummary()
        self._earlier: tuple[TrackedEpisode, ...] = ()
        self._lock = threading.Lock()

    def _new_tracker(self, pull: Pull) -> EpisodeTracker:
        assert pull.settings is not None
        tuning, estimator = pull.settings
        marginal = find_estimator(estimator, tuning.model).marginal
        return EpisodeTracker(
            self._engine.model,
            tuning,
            marginal,
            first=pull.first,
            max_rows=self._max_rows,
            max_closed=MAX_CLOSED,
            stale_after=self._engine.twin.policy.stale_after,
        )

    def restore(self, entries: Iterable[TrackedEpisode]) -> None:
        """Take over the episodes of an earlier session that began before the first event of the log."""
        first = self._engine.span()[0]
        self._earlier = tuple(entry for entry in entries if entry.episode.start * 1e9 < first)

    def stop(self) -> None:
        """Update once more, for the last rows, and give the cursor back."""
        try:
            self.update()
        except Exception as error:  # noqa: BLE001  diagnostics must not keep the twin from ending
            self._engine.notices.report("episodes", f"{type(error).__name__}: {error}", level="error")
        self._engine.release(self._cursor)

    def update_in_job(self, job: Job) -> float:
        """Update, in a repeated job; return the seconds to the next update."""
        begun = time.monotonic()
        self.update()
        return min(max((time.monotonic() - begun) / PROCESSOR_SHARE, EPISODES_PERIOD_S), MAX_EPISODES_PERIOD_S)

    def update(self) -> None:
        """Feed the new rows, and report which episodes have begun and ended."""
        with self._lock:
            self._update()

    def _update(self) -> None:
        before, again = self._entries, False
        log, passage = self._cursor.log, self._engine.notices.passage
        for pull in follow(self._engine, self._cursor):
            if not pull.fresh and pull.first < self.tracker.first:
                # A late measurement belongs before the rows that are kept: pull all of them again.
                self._cursor.revision, self._cursor.next = -1, -1
                continue
            if pull.fresh:
                passage = self._engine.notices.passage
                # In another revision, episodes that last are known. Another log has had none yet.
                again = log == self._cursor.log
                before = before if again else []
                self._earlier = self._earlier if again or log < 0 else ()
                self.tracker = self._new_tracker(pull)
            elif pull.first > self.tracker.first + self.tracker.n:
                # The rows between have left the history unseen.
                self._earlier = tuple(_joined(self._earlier, self.tracker.entries))
                self.tracker = self._new_tracker(pull)
            self.tracker.feed(pull.events, pull.track, pull.first)
            log = self._cursor.log
        tracker = self.tracker
        if tracker.n:
            self._entries = sorted([*tracker.entries, *self._others()], key=lambda entry: entry.episode.start)
            entries = _joined(self._earlier, self._entries)
            self.summary = EpisodeSummary(
                tuple(entries),
                tuple(entry for entry in entries if entry.episode.end is None),
                tuple(offsets(tracker.events, tracker.track, tracker.tuning)),
                self._cursor.revision,
            )
            self._report(before, again, passage)

    def _report(self, before: list[TrackedEpisode], again: bool, passage: int) -> None:
        """Report what is new against the entries before; `again`: those of another revision, or of rows taken back.

        A source that has begun again meanwhile, in another passage, has nothing to do with these rows.
        """
        begun, over = _changes(before, self._entries, again)
        say = partial(self._engine.notices.say, passage=passage)
        track, t = self.tracker.track, self.tracker.events.t
        health = int(track.health[-1])
        if health != self._health:
            self._health = health
            status, text = self._engine.status(), f"health: {HEALTH_NAMES[health]}"
            states = {name: state for name, (state, _) in status.sensors.items()}
            found, words = leading(self.tracker.model, self.summary.open, states, track, status.inputs)
            if words and estimated_rows(track.select(slice(-1, None)))[0]:
                new = [entry for entry in begun if entry.episode in found[:1]]
                text += f": {words if new or not found else f'{found[0].subject} {found[0].cause}'}"
                begun = [entry for entry in begun if entry not in new]
            level = {WAITING: "info", TRACKING: "info", ADVISORY: "info", DIVERGED: "error"}.get(health, "warn")
            say(text, level=level, t=int(t[last_run(track.health)]))
        for episode in (entry.episode for entry in begun[:MAX_NOTICES]):
            lasted = "" if episode.end is None else f"; over after {_duration(episode)}"
            level = {"diverged": "error", "advisory": "info"}.get(episode.grade, "warn")
            say(f"{episode.text}{lasted}", level=level, t=round(episode.start * 1e9))
        if len(begun) > MAX_NOTICES:
            say(f"and {len(begun) - MAX_NOTICES} more episode(s) of this kind", level="warn")
        for episode in (entry.episode for entry in over[:MAX_NOTICES]):
            assert episode.end is not None
            what = "heard at last" if episode.cause == "never heard" else f"no longer {episode.cause}"
            say(f"{episode.subject}: {what}, after {_duration(episode)}", t=round(episode.end * 1e9))


def _joined(earlier: Sequence[TrackedEpisode], entries: Sequence[TrackedEpisode]) -> list[TrackedEpisode]:
    """Return earlier episodes and those of the present rows, of which some are the rest of an earlier one."""
    left, found = list(earlier), []
    for entry in entries:
        old = next((item for item in left if _overlap(item, entry)), None)
        if old is not None:
            left.remove(old)
            entry = entry._replace(at=old.at, episode=entry.episode._replace(start=old.episode.start))
        found.append(entry)
    return [*(item for item in left if item.episode.end is not None), *found]


def _changes(
    before: list[TrackedEpisode], now: list[TrackedEpisode], again: bool
) -> tuple[list[TrackedEpisode], list[TrackedEpisode]]:
    """Return the entries that have begun and those that are over; `again`: rows changed, so only open ones are new."""
    if again:
        known = {entry.key for entry in before if entry.episode.end is None}
        return [entry for entry in now if entry.episode.end is None and entry.key not in known], []
    same = {(entry.key, entry.at): entry for entry in before}
    begun, over = [], []
    for entry in now:
        old = same.get((entry.key, entry.at)) or next((item for item in before if _overlap(item, entry)), None)
        if old is None:
            begun.append(entry)
        elif old.episode.end is None and entry.episode.end is not None:
            over.append(entry)
    return begun, over


def _overlap(one: TrackedEpisode, other: TrackedEpisode) -> bool:
    """Return whether two entries are one episode, of which a late measurement has moved an end."""
    a, b = one.episode, other.episode
    return one.key == other.key and a.start <= (b.end or np.inf) and b.start <= (a.end or np.inf)


def _duration(episode: Episode) -> str:
    assert episode.end is not None
    return duration_text(episode.end - episode.start)
