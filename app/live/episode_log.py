"""The chronicle: episodes of the running twin, as they begin and end, outside the engine's thread.

It pulls rows with a cursor, as a view does, and looks for episodes among the last of them (tail.py). What began before
those is carried on: its onset, size and words stay as they were when it was seen whole, and of a sensor's what its end
depends on is kept (episodes/going.py). A late reading takes rows back, and another revision begins a new chronicle;
what lasts through that is not said again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from estimators.diagnostics.detectors import LOST
from estimators.diagnostics.episodes import ANY, JOINED, LOSSES, Course, Episode, Found, Going, found_in
from estimators.diagnostics.held_out import Offset, offsets
from estimators.registry import find_estimator
from estimators.track import DIVERGED, HEALTH_NAMES, TRACKING, WAITING, estimated_rows

from .counts import last_run
from .interface import Running
from .recent_rows import ROWS, Tail

PERIOD = 0.4
"""Seconds between two looks, when they are cheap."""

SHARE = 0.05
"""Part of a core that looking may take: dearer looks come less often."""

SLOWEST = 3.0
"""Seconds between two looks at most."""

PULLED = 8192
"""Rows pulled at once, so that the engine's lock is not held for long."""

KEPT = 1000
"""Episodes that are over and kept; older ones stand in the recording."""

SAID = 5
"""Episodes of one look that are said one by one."""

JOINS = {"sensor": JOINED, "lost": JOINED, "truth": JOINED, "range": JOINED}
"""Rows without an alarm that an episode bridges, by what is tested."""

RANKS = {
    "diverged": 0, "stale": 1, "never heard": 2, "silent": 2, "stuck": 2, "refused": 2, "screened": 2, "shifted": 3,
    "missed": 4,
}  # fmt: skip
"""How bad causes are, the worst first; the others come last.

An estimate that misses the truth is what a shifted sensor leads to: the sensor is named, which says what to do.
"""

UNRANKED = 5

OF_READINGS = {"sensor": ANY, "lost": LOST}
"""What is tested of a sensor's readings, with the bits of its alarms."""

OF_SENSORS = (*OF_READINGS, "silence")
"""What is tested of sensors; the second part of such a key is the sensor's name."""


class Entry(NamedTuple):
    """An episode, what it is of, when its first alarm was, ns, and what is kept of its rows that are forgotten."""

    key: tuple[str, str]
    at: int
    episode: Episode
    going: Going = Going()

    def is_at(self, item: Found) -> bool:
        """Whether it goes on in what was found in the rows that are kept."""
        return self.at == item.at or self.going.quiet + item.begin <= JOINS.get(self.key[0], 0)

    def over(self, course: Course) -> Entry:
        """The same after rows that follow those that are forgotten."""
        kind, name = self.key
        if kind not in OF_READINGS:
            return self
        return self._replace(going=self.going.over(course, name, self.episode, self.at, OF_READINGS[kind]))

    def likely_end(self, otherwise: float) -> float:
        """When it ended, s, if it did: of a sensor not before its first alarm."""
        return max(self.going.end, self.at * 1e-9) if self.key[0] in OF_READINGS else otherwise


class Account(NamedTuple):
    """What the chronicle says, all of one moment: episodes in the order of their start, and those that last.

    `offsets` are what the sensors show that are held out; `revision` is that of the rows.
    """

    episodes: tuple[Episode, ...] = ()
    lasting: tuple[Entry, ...] = ()
    offsets: tuple[Offset, ...] = ()
    revision: int = -1

    def leading(self, states: Mapping[str, str]) -> Episode | None:
        """The worst of those that last, the newest of them.

        `states` of the sensors tell which of them is lost, and which is in order again: its episode, which lasts until
        it is certain to be over, comes last.
        """

        def badness(entry: Entry) -> tuple[bool, int, float]:
            kind, name = entry.key
            state = states.get(name) if kind in OF_SENSORS else None
            lost = RANKS["silent"] if state in ("degraded", "stale") else UNRANKED
            return state == "tracking", min(_badness(entry.episode)[0], lost), -entry.episode.start

        first = min(self.lasting, key=badness, default=None)
        return None if first is None else first.episode

    @property
    def in_alarm(self) -> frozenset[str]:
        """Sensors of which something is known to be wrong, so that each refused reading need not be said."""
        return frozenset(entry.key[1] for entry in self.lasting if entry.key[0] in OF_READINGS)

    def of_sensors(self, names: Sequence[str], states: Sequence[str]) -> dict[str, tuple[str, str]]:
        """State of each sensor, with the text of the worst that lasts of it."""
        found = {name: (state, "") for name, state in zip(names, states, strict=True)}
        for entry in sorted(self.lasting, key=lambda entry: _badness(entry.episode), reverse=True):
            kind, name = entry.key
            if kind in OF_SENSORS and found[name][0] not in ("waiting", "tracking"):
                found[name] = (found[name][0], entry.episode.text)
        for offset in sorted(self.offsets, key=lambda offset: offset.beyond):
            if found[offset.sensor][0] == "held out":
                found[offset.sensor] = "held out", offset.words
        return found


def _badness(episode: Episode) -> tuple[int, float]:
    """The worst first, of them the newest: what has just begun is what somebody has to look at."""
    return RANKS.get(episode.cause, UNRANKED), -episode.start


class Chronicle:
    """Keeps the episodes of one engine; `account` may be read by any thread, and never changes."""

    def __init__(self, engine: Running, rows: int = ROWS) -> None:
        """`rows`: that are looked at, see `Tail`."""
        self._engine = engine
        self._cursor = engine.cursor()
        self._tail = Tail(engine.model, rows)
        self._begin()
        self._health = WAITING
        self.account = Account()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="chronicle", daemon=True)

    def _begin(self) -> None:
        self._tail.begin(0)
        self._over: list[Entry] = []
        self._carried: dict[tuple[str, str], Entry] = {}
        self._entries: list[Entry] = []

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """Look once more, and end."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)
        self._engine.release(self._cursor)

    def _run(self) -> None:
        wait = PERIOD
        while True:
            stopping = self._stopping.wait(wait)
            begun = time.monotonic()
            try:
                self.look()
            except Exception as error:  # noqa: BLE001  what is said of the twin must not stop it
                self._engine.notices.report("chronicle", f"{type(error).__name__}: {error}", level="error")
            if stopping:
                return
            wait = float(np.clip((time.monotonic() - begun) / SHARE, PERIOD, SLOWEST))

    def look(self) -> None:
        """Take the rows that are new, and say what has begun and what is over."""
        before, again = self._entries, False
        while True:
            log, passage = self._cursor.log, self._engine.notices.passage
            pull = self._engine.pull(self._cursor, PULLED)
            if not pull.fresh and pull.first < self._tail.first:
                # A late reading belongs before the rows that are kept: all of them again.
                self._cursor.revision = -1
                continue
            if pull.fresh:
                passage = self._engine.notices.passage
                # Another revision: what lasts is known. Another log: another life, of which nothing was said.
                again = log == self._cursor.log
                before = before if again else []
                self._begin()
                self._tail.begin(pull.first)
            self._tail.put(pull)
            if self._tail.full:
                self._find()
                self._cut()
            if len(pull.events) < PULLED:
                break
        if self._tail.n:
            self._find()
            self._say(before, again, passage)

    def _course(self, rows: slice) -> Course:
        """Some of the rows that are there."""
        tail = self._tail
        tuning, estimator = self._engine.folded_with()
        marginal = find_estimator(estimator, tuning.model).family in ("particle", "ensemble")
        events, track = tail.events.select(rows), tail.track.select(rows)
        known = (self._carried.get(("sensor", name)) for name in self._engine.model.sensor_names)
        alarmed = [0 if e is None or e.episode.cause in LOSSES else e.going.readings for e in known]
        return Course(self._engine.model, tuning, marginal, events, track, tail.heard, np.array(alarmed))

    def _find(self) -> None:
        """Bring the entries up to the rows that are there."""
        course = self._course(slice(None))
        first = int(course.events.t[0])
        left = dict(self._carried)
        entries = []
        for item in found_in(course):
            known = left.get(item.key)
            if known is not None and known.is_at(item):
                del left[item.key]
                entries.append(_continued(known, item, course))
            else:
                entries.append(Entry(item.key, item.at, item.episode))
        # An alarm that is there no more, as a late reading came before it, has been none.
        ended = [_left(entry, course) for entry in left.values() if entry.at < first]
        self._entries = sorted([*self._over, *ended, *entries], key=lambda e: (e.episode.start, e.episode.subject))
        lasting = tuple(e for e in self._entries if e.episode.end is None)
        episodes = tuple(e.episode for e in self._entries)
        shown = tuple(offsets(course.events, course.track, course.tuning))
        self.account = Account(episodes, lasting, shown, self._cursor.revision)

    def _cut(self) -> None:
        """Cut the older rows off, and keep what was found there."""
        gone = self._tail.cut_at
        forgotten = self._course(slice(0, gone))
        first = int(self._tail.events.t[gone])
        begun = [entry for entry in self._entries if entry.episode.start * 1e9 < first]
        over = [e for e in begun if e.episode.end is not None and e.episode.end * 1e9 < first]
        self._over = over[-KEPT:]
        left = [e for e in begun if e.episode.end is None or e.episode.end * 1e9 >= first]
        self._carried = {e.key: e.over(forgotten) for e in left}
        # Last of all: what is forgotten is a view of the rows that move up now.
        self._tail.cut()

    def _say(self, before: list[Entry], again: bool, passage: int) -> None:
        """Say what is new against the entries before; `again`: those of another revision, or of rows taken back.

        A source that has begun again meanwhile, in another passage, has not lived what these rows tell.
        """
        begun, over = _changes(before, self._entries, again)
        say = partial(self._engine.notices.say, passage=passage)
        track, t = self._tail.track, self._tail.events.t
        states = {name: state for name, (state, _) in self._engine.status().sensors.items()}
        leading = self.account.leading(states)
        health = int(track.health[-1])
        if health != self._health:
            self._health = health
            text = f"health: {HEALTH_NAMES[health]}"
            if (
                health not in (WAITING, TRACKING)
                and leading is not None
                and estimated_rows(track.select(slice(-1, None)))[0]
            ):
                new = [entry for entry in begun if entry.episode is leading]
                text += f": {leading.text}" if new else f": {leading.subject} {leading.cause}"
                begun = [entry for entry in begun if entry.episode is not leading]
            level = {WAITING: "info", TRACKING: "info", DIVERGED: "error"}.get(health, "warn")
            say(text, level=level, t=int(t[last_run(track.health)]))
        for entry in begun[:SAID]:
            episode = entry.episode
            lasted = "" if episode.end is None else f"; over after {_duration(episode)}"
            level = "error" if episode.cause == "diverged" else "warn"
            say(f"{episode.text}{lasted}", level=level, t=round(episode.start * 1e9))
        if len(begun) > SAID:
            say(f"and {len(begun) - SAID} more episode(s) of this kind", level="warn")
        for entry in over[:SAID]:
            episode = entry.episode
            what = "heard at last" if episode.cause == "never heard" else f"no longer {episode.cause}"
            assert episode.end is not None
            say(f"{episode.subject}: {what}, after {_duration(episode)}", t=round(episode.end * 1e9))


def _continued(known: Entry, item: Found, course: Course) -> Entry:
    """An episode that began before the rows that are kept."""
    old, new, going = known.episode, item.episode, known.going
    if item.at == known.at and new.cause != old.cause:
        # All its alarms are still there, and say more than the first of them.
        return Entry(item.key, item.at, new)
    end = new.end
    if new.cause in LOSSES and old.cause not in LOSSES:
        # What shows it is all in these rows.
        old, going = new._replace(start=old.start), Going()
    elif end is not None:
        end = known.over(course).likely_end(end)
    size = (new.end or float(course.events.t[-1]) * 1e-9) - old.start if old.unit == "s" else old.size
    return Entry(known.key, known.at, old._replace(end=end, size=size), going)


def _left(known: Entry, course: Course) -> Entry:
    """An episode that began before the rows that are kept, of which none is in alarm."""
    after = known.over(course)
    if known.key[0] in OF_READINGS and after.going.quiet <= JOINED:
        return known._replace(episode=known.episode._replace(end=None))
    # What is not seen in rows that are forgotten ended where those begin that are kept.
    end = known.episode.end or after.likely_end(float(course.events.t[0] * 1e-9))
    return known._replace(episode=known.episode._replace(end=end))


def _changes(before: list[Entry], now: list[Entry], again: bool) -> tuple[list[Entry], list[Entry]]:
    """The entries that have begun and those that are over; `again`: where rows changed, only what lasts is news."""
    if again:
        known = {entry.key for entry in before if entry.episode.end is None}
        return [entry for entry in now if entry.episode.end is None and entry.key not in known], []
    same = {(entry.key, entry.at): entry for entry in before}
    begun, over = [], []
    for entry in now:
        old = same.get((entry.key, entry.at)) or next((item for item in before if _meet(item, entry)), None)
        if old is None:
            begun.append(entry)
        elif old.episode.end is None and entry.episode.end is not None:
            over.append(entry)
    return begun, over


def _meet(one: Entry, other: Entry) -> bool:
    """Whether two entries are one episode, of which a late reading has moved an end."""
    a, b = one.episode, other.episode
    return one.key == other.key and a.start <= (b.end or np.inf) and b.start <= (a.end or np.inf)


def _duration(episode: Episode) -> str:
    assert episode.end is not None
    return f"{episode.end - episode.start:.3g} s"
