"""Monitors of the running fold: episodes, alerts, protection levels, root causes, clock, latency, silence."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import numpy as np

from estimators.diagnostics.clock_fit import ClockFit, LeastDelays
from estimators.diagnostics.detectors import detector_of
from estimators.diagnostics.episodes import Episode, TrackedEpisode
from estimators.diagnostics.repeats import HELD, RECENT, UNDECIDED, latest_repeats, sensor_rows
from estimators.log import INPUT, READING, Events
from estimators.track import STALE, WAITING
from sources.source import LOST_FRAMES, Source, controls_of, is_utc

from ..twin.ingest import dropped_episode
from .episode_log import EPISODES_PERIOD_S, EpisodeLog
from .failure_notices import Alerts
from .fault_monitors import LEVELS_PERIOD_S, ROOT_CAUSE_PERIOD_S, ProtectionMonitor, RootCause
from .jobs import Job
from .notices import Notices
from .running_fold import Running

LOSS_CAUSE_S = 10.0  # Seconds for which frames that the bus lost are the cause of a poor health


class Watchers:
    """The monitors of one engine."""

    def __init__(self, engine: Running) -> None:
        section, notices = engine.twin.config.time, engine.notices
        self._jobs, self._monitors, self._notices = engine.jobs, engine.monitors, notices
        self.latency = Latency()
        self.clock = HostClock(notices, section.max_delay)
        self.dropped = DroppedShare()
        self.repeats = RepeatedValues(engine)
        self.episode_log = EpisodeLog(engine, others=lambda: (*self.dropped.entries, *self.repeats.entries))
        self.alerts = Alerts(notices, lambda: self.episode_log.summary.in_alarm)
        self.silence = SilentSource(notices, section.stale_after)
        self.integrity = ProtectionMonitor(engine.last_events, engine.policy.false_alarm_every)
        self.root_cause = RootCause(
            lambda: self.episode_log.summary.episodes, engine.last_events, notices, self.integrity
        )

    def start(self) -> None:
        """Begin to monitor."""
        self._monitors.run("episodes", self.episode_log.update_in_job, every=EPISODES_PERIOD_S)
        self._jobs.run("protection levels", self.integrity.update, every=LEVELS_PERIOD_S)
        self._jobs.run("root cause", self.root_cause.update, every=ROOT_CAUSE_PERIOD_S)
        self._monitors.run("repeated values", self.repeats.check, every=REPEATS_PERIOD_S)

    def arrived(self, batch: Events, passed: Events) -> None:
        """Note a batch of a live source that was folded, and those of its events that passed."""
        self.latency.note(batch)
        self.clock.note(passed)

    def episodes(self) -> list[Episode]:
        """Return all episodes in the order of their start, with their root cause where it is known."""
        return list(map(self.root_cause.with_fault, self.episode_log.summary.episodes))

    def episodes_of(self, revision: int) -> tuple[Episode, ...]:
        """Return the episodes if they are those of a revision; else none."""
        account = self.episode_log.summary
        return tuple(map(self.root_cause.with_fault, account.episodes)) if account.revision == revision else ()

    def cause(self, found: Sequence[Episode], words: str, *, past: bool = False) -> str:
        """Return the cause of a health: of what `leading` returns, unless the bus loses frames at present."""
        losing = None if past or not words else self._notices.latest(LOST_FRAMES, LOSS_CAUSE_S)
        if losing is not None or not found:
            return losing or words
        return self.root_cause.with_fault(self.root_cause.primary(found)).text


class IdleTicks:
    """Decides when to predict without measurements, so that the growing uncertainty shows."""

    def __init__(self, tick: float) -> None:
        """`tick`: seconds without events before the first prediction."""
        self._tick = tick
        self.since = time.monotonic()
        """Monotonic time of the last arrival of events that were used and folded, s."""
        self.late = 0.0
        """Age of the newest measurement when it arrived, s, of a source whose times are UTC."""
        self._newest: int | None = None
        self._measured = 0
        self._begun = time.time_ns()
        self._waiting: tuple[float, int] | None = None

    def broken(self, newest: int, ago: float = 0.0) -> None:
        """Note an arrival some seconds `ago`; `newest` is the time of the log's newest event, ns."""
        self.since = time.monotonic() - ago
        self._newest = newest

    @property
    def heard(self) -> float:
        """Monotonic time of the newest measurement that was used and folded, s; of its arrival if not in UTC."""
        return self.since - self.late

    def arrived(self, source: Source, events: Events, newest: int) -> None:
        """Note events in the log, until `folded`; those of a live source arrived when they say, others now."""
        now, ago = time.monotonic(), 0.0
        if source.live and (stamped := events.arrival[events.arrival >= self._begun]).size:
            ago = max(0.0, (time.time_ns() - int(stamped.max())) * 1e-9)
            if is_utc(source):
                self._measured = max(self._measured, int(events.t.max()))
                self.late = max(0.0, (int(stamped.max()) - self._measured) * 1e-9)
        self._waiting = max(self.since, now - ago), newest

    def folded(self) -> None:
        """Note that all events have been folded."""
        if self._waiting is not None:
            (self.since, self._newest), self._waiting = self._waiting, None

    def asks(self, source: Source, last: int) -> int | None:
        """Return the time (ns) to predict for, after the log's last event at `last`; None for not yet."""
        silent = time.monotonic() - self.since
        if silent < self._tick:
            return None
        if source.live:
            # Counted from the newest reading: a driver's clock need not be this machine's.
            now: int | None = (last if self._newest is None else self._newest) + int(silent * 1e9)
        elif (paced := controls_of(source)) is not None and (paced.paused or paced.speed == np.inf):
            # As fast as possible, the playhead is ahead of what has been read.
            now = None
        else:
            now = source.now()
        # The longer the dropout, the rarer the predictions: a night must not fill the log.
        apart = max(self._tick, silent / 20)
        return None if now is None or now <= last + apart * 0.9e9 else now


MAX_DRIFT_PPM = 200.0
"""Parts per million beyond which a drift is reported; a crystal stays within 100."""


FIT_PERIOD_NS = 2 * 10**9
"""Nanoseconds of arrival between two fits, which take about a millisecond."""


class HostClock:
    """Compares the times of a live source with their arrival; a clock that was set has been corrected before."""

    def __init__(self, notices: Notices, horizon: float) -> None:
        """`horizon`: seconds of lateness allowed, beyond which an offset is reported."""
        self._notices, self._horizon = notices, horizon
        self._delays = LeastDelays()
        self._due = 0
        self._reported: set[str] = set()
        self.estimate: ClockFit | None = None

    def note(self, events: Events) -> None:
        """Note events that were accepted."""
        # What was there before the twin, such as the history in a file, has no arrival of its own.
        stamped = ((events.kind == READING) | (events.kind == INPUT)) & (events.arrival != events.t)
        if not stamped.any():
            return
        arrival = events.arrival[stamped]
        self._delays.note(events.t[stamped], arrival)
        if abs(int(arrival[-1]) - self._due) >= FIT_PERIOD_NS:
            self._due = int(arrival[-1])
            self.estimate = self._delays.fit()
            self._look(self.estimate)

    def _look(self, fit: ClockFit | None) -> None:
        if fit is None or math.isnan(fit.drift_ppm):
            return
        if "offset" not in self._reported and abs(fit.offset) > max(1.0, self._horizon):
            self._reported.add("offset")
            side = "ahead of" if fit.offset > 0 else "behind"
            self._notices.say(
                f"the source's clock is {abs(fit.offset):.3g} s {side} this machine's, or its measurements take that "
                "long; times shown are the source's",
                level="warn",
            )
        if "drift" not in self._reported and abs(fit.drift_ppm) - fit.drift_error_ppm > MAX_DRIFT_PPM:
            self._reported.add("drift")
            self._notices.say(
                f"the source's clock drifts by {fit.drift_ppm:+.0f} ± {fit.drift_error_ppm:.0f} ppm against this "
                "machine's; synchronise them",
                level="warn",
            )


MAX_DROPPED_SHARE, MIN_DROPPED, DROPPED_PERIOD_S = 0.1, 10, 60.0
"""Share of the measurements of so many seconds, and their number, beyond which there is an episode."""


class DroppedShare:
    """Episodes in which many measurements of a live source are too late for the log, or have impossible times."""

    def __init__(self) -> None:
        self._recent: deque[tuple[float, int, int]] = deque()
        self._taken = self._dropped = 0
        self.entries: list[TrackedEpisode] = []

    def note(self, newest: int, taken: int, dropped: int) -> None:
        """Note measurements that were taken when the log's newest event was that of `newest`, ns; of these the dropped.

        An episode ends when their share is half of that with which it begins.
        """
        now = time.monotonic()
        self._recent.append((now, taken, dropped))
        self._taken, self._dropped = self._taken + taken, self._dropped + dropped
        while self._recent[0][0] <= now - DROPPED_PERIOD_S:
            _, before, lost = self._recent.popleft()
            self._taken, self._dropped = self._taken - before, self._dropped - lost
        if self._dropped >= max(MIN_DROPPED, MAX_DROPPED_SHARE * self._taken):
            _begin(self.entries, newest, dropped_episode(newest * 1e-9, self._dropped, self._taken))
        elif self._dropped < 0.5 * MAX_DROPPED_SHARE * self._taken:
            _end(self.entries, newest, "dropped", "twin")


def _begin(entries: list[TrackedEpisode], newest: int, episode: Episode) -> None:
    """Add an episode at the log's newest event (ns), unless one of its cause and subject lasts."""
    key = episode.cause, episode.subject
    if not any(entry.key == key and entry.episode.end is None for entry in entries):
        entries.append(TrackedEpisode(key, newest, newest, episode))


def _end(entries: list[TrackedEpisode], newest: int, *key: str) -> None:
    """End the episode of this cause and subject, if one lasts."""
    for k, entry in enumerate(entries):
        if entry.key == key and entry.episode.end is None:
            entries[k] = entry._replace(until=newest, episode=entry.episode._replace(end=newest * 1e-9))


REPEATS_PERIOD_S, REPEATS_CPU_SHARE = 5.0, 0.01
"""Seconds between two searches for repeats, and the share of a processor that they may take, else they are rarer."""

REPEATS_OVER = 4
"""Searches in a row that find none, after which an episode is over: coarse values hide repeats now and then."""


class RepeatedValues:
    """Episodes in which the rows of a sensor of a live source are repeats, of which each new value is held."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine
        self.entries: list[TrackedEpisode] = []
        self._since = Counter[str]()
        """Searches of each row since repeats were found in it."""

    def check(self, job: Job) -> float:
        """Search the last values of each sensor row; return the seconds to the next time."""
        if not self._engine.source.live:
            return math.inf
        begun, taken = time.thread_time(), self._engine.last_events(RECENT[-1])
        events = Events.empty(1) if taken is None else taken.events
        for _, row, column, known in sensor_rows(self._engine.model, events):
            job.check()
            self._judge(row, events.t[known], events.value[known, column])
        return max(REPEATS_PERIOD_S, (time.thread_time() - begun) / REPEATS_CPU_SHARE)

    def _judge(self, row: str, t: np.ndarray, values: np.ndarray) -> None:
        begun, one = latest_repeats(t, values)
        if one.kind == HELD:
            text = detector_of("repeating").text(SimpleNamespace(name=row, repeats=one))
            episode = Episode(begun * 1e-9, None, row, "repeating", one.share, math.nan, math.nan, "", text)
            _begin(self.entries, int(t[-1]), episode)
            self._since[row] = 0
        elif one.kind != UNDECIDED:
            self._since[row] += 1
            if self._since[row] >= REPEATS_OVER:
                _end(self.entries, int(t[-1]), "repeating", row)


MAX_LATENCIES = 4096
"""Measurements of which the latency is kept."""


class Latency:
    """Recent times from arrival to row, ms, of measurements since the start; a history has none."""

    def __init__(self) -> None:
        self._begun = time.time_ns()
        self._recent: deque[float] = deque(maxlen=MAX_LATENCIES)

    def note(self, batch: Events) -> None:
        """Note a batch that was folded."""
        arrivals = batch.arrival[(batch.kind == READING) & (batch.arrival >= self._begun)][-MAX_LATENCIES:]
        self._recent.extend(((time.time_ns() - arrivals) * 1e-6).tolist())

    def percentile(self, percent: float) -> float | None:
        """Return a percentile, ms; None while there is none."""
        return float(np.percentile(self._recent.copy(), percent)) if self._recent else None


class SilentSource:
    """Health of a twin whose source is open but has no events yet."""

    def __init__(self, notices: Notices, stale_after: float, clock: Callable[[], float] = time.monotonic) -> None:
        """`stale_after`: seconds without an event after which a live source is stale; `clock` returns seconds."""
        self._notices, self._after, self._clock = notices, stale_after, clock
        self._since = clock()
        self._reported = False

    @property
    def health(self) -> int:
        """Waiting, or stale."""
        return STALE if self._reported else WAITING

    @property
    def cause(self) -> str:
        """Reason why the twin is stale, or "" while it waits."""
        if not self._reported:
            return ""
        return f"nothing has come since the twin started, {self._clock() - self._since:.0f} s ago; check the source"

    def check(self, *, live: bool) -> None:
        """Report a live source without events, once it is stale; a recording may be paused."""
        if live and not self._reported and self._clock() - self._since > self._after:
            self._reported = True
            text = f"stale: nothing has come since the twin started, {self._after:g} s ago; check the source"
            self._notices.say(text, level="warn")

    def broken(self) -> None:
        """Note that the first event has arrived."""
        if self._reported:
            self._reported = False
            silent = self._clock() - self._since
            self._notices.say(f"the source speaks, {silent:.0f} s after the twin started")
