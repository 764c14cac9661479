"""The clock guard between a source and the log: it rejects lone wrong timestamps and corrects clocks that were set.

One measurement stamped an hour ahead would make all later ones stale. The guard therefore holds an event whose time is
far from the expected time of its channel, until the following events show the cause:

- *ahead*: later than all events so far by more than the horizon (half of it if arrivals are known) and by many periods
  of the channel, and, if arrivals are known, with a larger t - arrival than lately. If the next events return to the
  expected time, the held event is rejected as a lone wrong timestamp. If they continue from the held one, there was
  either a gap in the data, and they pass unchanged, or the clock was set.
- *back*: earlier than the newest event of the channel by more than the horizon, so that the log would drop it as stale.
  If the following events continue from it, the clock was set back; otherwise they pass to the log, which drops and
  counts them like any late event.

After a clock was set, its timestamps are shifted so that they continue without a step. With known arrivals the shift is
the step of the largest t - arrival, since delays only reduce that; otherwise the channel continues at its own pace. A
clock that returns to an earlier offset, or to the offset of another channel, gets exactly that offset, so that errors
of the delay do not accumulate.

A clock that is set to UTC is ahead if it is later than the arrival by more than a second (less if the horizon is
short), however late what it sends may come; it is then corrected to this machine's. A time that is near its arrival is
right, and is never corrected. What was corrected and is late by more than that is held like what goes back.

With known arrivals, held events do not pass merely because time has reached them: a clock slightly farther ahead than
the horizon would be accepted after a while, and the events of all other clocks would be stale from then on. An event
that fits but was measured before the held ones arrived does not contradict them.

The guard is a pure function of the events in order of arrival: the outcome does not depend on how they were cut into
batches. Queries and resets pass. Each sensor is a channel; so are all inputs together and all true states together,
since events do not name their source.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from .batch import BEFORE, COLUMN_TYPES, INPUT, READING, TRUTH, Events
from .clock_expected import (
    AHEAD,
    ARRIVED,
    BACK,
    FIRST,
    FITS,
    GAP_FROM,
    GAP_TO,
    HOLDING,
    LAST,
    LIVE,
    MAX_PERIODS_AHEAD,
    MIN_AGREEING_EVENTS,
    OFFSET,
    SECOND_NS,
    SEEN,
    STEPS,
    TOTAL,
    compiled,
)

MIN_STEP_BACK_NS = SECOND_NS  # By which arrivals go back if this machine's clock was set; a moment's are unordered
SETTLING_TIME_NS = 2 * SECOND_NS  # Time, by the source's clock, over which held events must agree before they pass
ZONE_STEP_NS = 900 * SECOND_NS  # Time zones, and daylight saving time, differ by a multiple of 15 minutes
MAX_HELD, MAX_HELD_LIVE = 1 << 17, 4096  # Largest number of held events of a channel, without and with known arrivals


class ClockGuard:
    """Filter between a source and a log: `take` each batch, and `finish` at the end."""

    def __init__(self, sensors: int, horizon: int, utc: bool = False) -> None:
        """Guard the events of a model with `sensors` sensors.

        `horizon` is the log's, ns. `utc`: the arrivals of all events are known, and their times are those of clocks
        that are set to UTC, as this machine's.
        """
        self._sensors, self._horizon = sensors, horizon
        self._utc = max(min(horizon // 2, SECOND_NS), SECOND_NS // 10) if utc else -1
        self._agree = min(max(SECOND_NS // 2, horizon // 2), SETTLING_TIME_NS)
        self._settled = max(SETTLING_TIME_NS, 2 * self._agree)
        self._spread = self._agree + (0 if utc else horizon)
        self._everything = sensors + 2
        self._state = np.zeros((sensors + 3, 11), np.int64)
        self._shift = np.zeros(sensors + 2, np.int64)
        self._steps: list[int] = []
        self._arrived = BEFORE
        self.set_back = 0
        """Time by which this machine's clock was set back, ns, and arrivals are corrected."""
        self._runs: dict[int, HeldRun] = {}
        self._held = Events.empty(0)
        self._raw = np.zeros(0, np.int64)
        self._reach, self._judge, self._note, self._scan = compiled()

    @property
    def held(self) -> int:
        """Number of held events."""
        return len(self._held)

    @property
    def waiting(self) -> np.ndarray:
        """Arrivals of the held events as they came, ns, shape (held,)."""
        return self._held.arrival - self.set_back

    def state(self) -> dict[str, object]:
        """Return a copy of the state, of arrays, lists and numbers, for `restore`."""
        return {
            "clocks": self._state.copy(),
            "shift": self._shift.copy(),
            "steps": self._steps.copy(),
            "arrived": self._arrived,
            "set_back": self.set_back,
            "runs": {row: vars(deepcopy(run)) for row, run in self._runs.items()},
            "held": tuple(self._held),
            "raw": self._raw,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from the `state` of another guard of the same sensors, of which JSON may have made lists.

        Raises:
            ValueError: If it is of other sensors, or no such state.
        """
        clocks, shift = (np.array(state[name], np.int64) for name in ("clocks", "shift"))
        if clocks.shape != self._state.shape or shift.shape != self._shift.shape:
            raise ValueError("it is of other sensors")
        self._state, self._shift, self._steps = clocks, shift, list(state["steps"])
        self._arrived, self.set_back = int(state["arrived"]), int(state["set_back"])
        self._raw = np.array(state["raw"], np.int64)
        held = Events(*map(np.array, state["held"])) if self._raw.size else Events.empty(0)
        self._held = plain_events(held)
        self._runs = {int(row): HeldRun.restored(run) for row, run in state["runs"].items()}

    def extend(self, sensors: int) -> None:
        """Make room for more sensors, while no inputs or true states are held."""
        more = sensors - self._sensors
        self._state = np.insert(self._state, [self._sensors] * more, 0, axis=0)
        self._shift = np.insert(self._shift, [self._sensors] * more, 0)
        self._sensors, self._everything = sensors, sensors + 2

    def forget(self, sensor: int) -> None:
        """Take a sensor as one without events from now on; those of it that are held are dropped."""
        if sensor in self._runs:
            work = self._work(Events.empty(self._held.value.shape[1]))
            self._end(sensor)
            self._leave(work)
        self._state[sensor] = self._shift[sensor] = 0

    def continue_from(self, sensors: np.ndarray, t: np.ndarray, arrival: np.ndarray) -> None:
        """Take the last event of each of some sensors as before a restart, at times and arrivals of that shape, ns."""
        self._state[sensors, SEEN] = self._state[sensors, LIVE] = 1
        self._state[sensors, LAST] = self._state[sensors, FIRST] = t
        self._state[sensors, OFFSET], self._state[sensors, ARRIVED] = t - arrival, arrival

    def take(self, batch: Events) -> Passed:
        """Take the next events, in order of arrival, and return those that may enter the log now."""
        if not len(batch):
            return Passed(batch, np.zeros(0, np.bool_), [], [])
        batch = self._arrivals_in_order(batch)
        if not self._runs and not self._shift.any():
            batch = plain_events(batch)
            rows = self._rows_of(batch)
            at = self._scan(self._state, batch.t, batch.t, batch.arrival, rows, 0, self._horizon, self._utc)
            if at == len(batch):
                return Passed(batch, np.zeros(len(batch), np.bool_), [], [])
            work = self._work(batch)
            work.emit(range(at))
        else:
            work = self._work(batch)
            at = work.begin
        while at < len(work.t):
            columns = work.t, work.raw, work.arrival, work.rows
            stop = int(self._scan(self._state, *columns, at, self._horizon, self._utc))
            work.emit(range(at, stop))
            if stop < len(work.t):
                self._suspect(work, stop)
            at = stop + 1
        return self._leave(work)

    def _arrivals_in_order(self, batch: Events) -> Events:
        """Return the events with arrivals as if this machine's clock had not been set back.

        A step of the source's clock shows in t - arrival, where a step of both does not.
        """
        live = np.flatnonzero((batch.arrival != batch.t) | (self._utc > 0))
        if not live.size:
            return batch
        arrival = batch.arrival[live] + self.set_back
        while True:
            before = np.maximum.accumulate(np.concatenate(([self._arrived], arrival)))[:-1]
            back = np.flatnonzero(arrival < before - max(MIN_STEP_BACK_NS, self._horizon))
            if not back.size:
                break
            step = int(before[back[0]] - arrival[back[0]])
            arrival[back[0] :] += step
            self.set_back += step
        self._arrived = int(max(self._arrived, arrival.max()))
        if not self.set_back:
            return batch
        arrivals = batch.arrival.copy()
        arrivals[live] = arrival
        return batch._replace(arrival=arrivals)

    def finish(self) -> Passed:
        """Decide on the held events at the end of the source.

        Events held ahead pass, as nothing contradicts them, except a lone one farther ahead than the log is long.
        """
        work = self._work(Events.empty(0))
        for row in sorted(self._runs):
            if row in self._runs:
                run = self._runs[row]
                first, last = (int(self._state[self._everything, k]) for k in (FIRST, LAST))
                lone = len(run.at) == 1 and run.t[0] - last > last - first
                if not lone if run.ahead else not run.live and self._shows_a_step(run, row, ended=True):
                    self._anchor(work, row)
                else:
                    self._dissolve(work, row)
        return self._leave(work)

    def _work(self, batch: Events) -> Work:
        """Return the held events and a batch whose times are shifted by the steps so far."""
        batch = plain_events(batch)
        rows = self._rows_of(batch)
        wrong = (rows >= 0) & (np.abs(batch.t - batch.arrival) > self._utc)
        moved = batch._replace(t=batch.t + np.where(wrong, self._shift[rows], 0))
        events = Events.concat([self._held, moved], batch.value.shape[1]) if self._runs else moved
        rows = np.concatenate((self._rows_of(self._held), rows))
        return Work(events, rows, np.concatenate((self._raw, batch.t)), len(self._held), self._utc)

    def _rows_of(self, batch: Events) -> np.ndarray:
        """Return the row of the state for each event; -1 for events that always pass, or that the log rejects."""
        reading = (batch.kind == READING) & (batch.channel >= 0) & (batch.channel < self._sensors)
        cases = [reading, batch.kind == INPUT, batch.kind == TRUTH]
        return np.select(cases, [batch.channel, self._sensors, self._sensors + 1], -1).astype(np.int64)

    def _verdict(self, work: Work, i: int) -> int:
        given = work.rows[i], work.t[i], work.raw[i], work.arrival[i], work.live[i]
        return int(self._judge(self._state, *given, self._horizon, self._utc))

    def _let_in(self, work: Work, i: int) -> None:
        self._note(self._state, work.rows[i], work.t[i], work.arrival[i], work.live[i], self._horizon)

    def _suspect(self, work: Work, i: int) -> None:
        """Handle an event that does not fit, or whose channel has held events."""
        row = int(work.rows[i])
        run = self._runs.get(row)
        if run is not None and self._has_come(work, run):
            self._release(work, row)
            run = None
        verdict = self._verdict(work, i)
        if run is not None and run.ahead and run.live and verdict == BACK:
            if int(work.arrival[i]) - run.arrived <= self._settled:
                # A late event; it tells nothing about the present clock.
                work.emit([i])
                return
        rest: list[int] = []
        if run is not None and (
            self._contradicts(work, run, i) if verdict == FITS else run.full or not self._agrees(work, run, i)
        ):
            if verdict != FITS and run.live and not run.full:
                rest = [k for k in run.at if abs(work.offset(k) - work.offset(i)) <= self._spread]
            self._dissolve(work, row, rest)
            run = None
        if verdict == FITS or (run is None and verdict == BACK and not self._can_be_set_back(work, row, i)):
            if verdict == FITS:
                self._let_in(work, i)
            work.emit([i])
            return
        if run is None:
            live = work.live[i] or self._state[row, LIVE] > 0
            begin = int(self._state[row if self._utc > 0 and self._state[row, SEEN] else self._everything, LAST])
            run = self._runs[row] = HeldRun(
                verdict == AHEAD, live, begin, self._agree, MAX_HELD_LIVE if live else MAX_HELD
            )
            self._state[row, HOLDING] = 1
        for k in (*rest, i):
            run.add(k, int(work.t[k]), int(work.arrival[k]))
        if self._shows_a_step(run, row):
            self._anchor(work, row)

    def _has_come(self, work: Work, run: HeldRun) -> bool:
        """Return whether time has reached the events held ahead; the last of them, if arrivals are known."""
        return run.ahead and self._verdict(work, run.at[-1 if run.live else 0]) == FITS

    def _contradicts(self, work: Work, run: HeldRun, i: int) -> bool:
        """Return whether an event that fits contradicts the held ones.

        By an unchanged clock it was measured at t - `OFFSET` of the host's time at the earliest. It contradicts the
        held events if that is after the arrival of the first of them; otherwise it may have been delayed.
        """
        return not run.live or int(work.t[i]) - int(self._state[work.rows[i], OFFSET]) > run.begun + self._agree

    def _agrees(self, work: Work, run: HeldRun, i: int) -> bool:
        """Return whether an event implies the same clock as the held ones, except for delays."""
        t = int(work.t[i])
        if run.live:
            lower = run.top - work.offset(i)
            # Delayed, while others arrive on time.
            delayed = lower > 0 and int(work.arrival[i]) - run.arrived <= self._settled
            return delayed or abs(lower) <= self._spread
        if t < run.t[-1] - self._horizon:
            return False
        reach = int(self._reach(self._state, work.rows[i], self._horizon, False))
        return run.ahead or reach < 0 or t <= run.t[-1] + reach

    def _shows_a_step(self, run: HeldRun, row: int, ended: bool = False) -> bool:
        """Return whether held events agree for long enough, and show a step of their clock.

        Events of a table that went back may also be files in the wrong order. They show a step if they reach into what
        was measured before, if another channel's clock made the same step, or if the step is a change of time zone or
        daylight saving time. Files of whole quarter-hours in the wrong order look like that too; those end where the
        channel begins, which is known once the source has `ended`.
        """
        if len(run.at) < MIN_AGREEING_EVENTS or run.span < self._settled:
            return False
        begin = int(self._state[row, FIRST])
        if run.ahead or run.live or run.highest > begin + self._horizon:
            return True
        step = self._step_back(run, row)
        if any(abs(abs(known) - step) <= self._agree for known in self._steps):
            return True
        if step % ZONE_STEP_NS:
            return False
        near = self._precision(row)
        if ended:
            return begin - run.highest > self._horizon + MAX_PERIODS_AHEAD * near
        return abs(begin - run.t[0] - nearest_zone(begin - run.t[0])) > near

    def _step_back(self, run: HeldRun, row: int) -> int:
        """Return the step (ns) by which a table's clock went back if its channel went on at its own pace.

        The exact change of a time zone where it is near one: irregular samples do not tell their pace exactly.
        """
        step = int(self._state[row, LAST]) + self._period(row) - run.t[0]
        near = nearest_zone(step)
        return near if near and abs(near - step) <= self._precision(row) else step

    def _period(self, row: int) -> int:
        return int(self._state[row, TOTAL] // max(1, self._state[row, STEPS]))

    def _precision(self, row: int) -> int:
        """Return how exactly (ns) the times of a channel show a step of its clock."""
        return min(max(self._agree, self._period(row)), ZONE_STEP_NS // 15)

    def _can_be_set_back(self, work: Work, row: int, i: int) -> bool:
        """Return whether a time that went back may be due to a clock rather than to a block of late measurements.

        With known arrivals it always may. Otherwise events that fill the channel's last gap are late ones.
        """
        begin, end = self._state[row, [GAP_FROM, GAP_TO]]
        in_gap = begin < end and begin - self._horizon <= work.t[i] <= end + self._horizon
        return bool(work.live[i] or self._state[row, LIVE] or not in_gap)

    def _anchor(self, work: Work, row: int) -> None:
        """Accept the held events, and correct their clock if it was set."""
        run, state = self._runs[row], self._state[row]
        first = run.at[0]
        now = int(self._state[self._everything, LAST])
        step = 0
        if run.live:
            known = row if state[SEEN] else self._everything
            step = (0 if self._utc > 0 else int(self._state[known, OFFSET])) - run.top
        elif not run.ahead:
            step = self._step_back(run, row)
        elif now > run.begin:
            # Other channels continued meanwhile, so this was not a gap.
            step = run.begin - run.t[0]
        if step:
            step = self._likely(row, step)
            work.moved.append(Moved(int(work.kind[first]), int(work.channel[first]), int(work.raw[first]), -step))
            self._shift[row] += step
            work.shift(row, run.at, step)
        self._release(work, row)
        for other in sorted(self._runs):
            if self._has_come(work, self._runs[other]):
                self._release(work, other)

    def _likely(self, row: int, step: int) -> int:
        """Return a known step close to the measured one, or the measured step if there is none.

        Sensors of one source share its clock, and so its steps and offset; and a clock may return to an earlier offset.
        """
        shift = self._shift - self._shift[row]
        steps = [*self._steps, *(-known for known in self._steps), *shift.tolist(), -int(self._shift[row])]
        near = [known for known in steps if known and abs(known - step) <= self._agree]
        if near:
            return min(near, key=lambda known: (abs(known + int(self._shift[row])) > 0, abs(known - step)))
        self._steps = [*self._steps[-7:], step]
        return step

    def _release(self, work: Work, row: int) -> None:
        run = self._end(row)
        for i in run.at:
            self._let_in(work, i)
        work.emit(run.at, settled=True)

    def _dissolve(self, work: Work, row: int, rest: Sequence[int] = ()) -> None:
        """Reject the held events if they are ahead; pass those that are back to the log, which drops them as stale.

        The events of `rest` stay held.
        """
        run = self._end(row)
        gone = [i for i in run.at if i not in set(rest)] if rest else run.at
        if not run.ahead:
            for i in gone:
                # What came within the horizon is not late for having been held.
                work.emit([i], settled=work.t[i] >= run.begin - self._horizon)
            return
        for i in gone:
            stamp, shift = int(work.raw[i]), int(self._shift[row])
            work.refused.append(Refused(int(work.kind[i]), int(work.channel[i]), stamp, run.begin - shift))

    def _end(self, row: int) -> HeldRun:
        """Remove and return the held events of a row."""
        self._state[row, HOLDING] = 0
        return self._runs.pop(row)

    def _leave(self, work: Work) -> Passed:
        """Return the events that pass, and keep the held ones for the next batch."""
        kept = sorted(i for run in self._runs.values() for i in run.at)
        place = {i: k for k, i in enumerate(kept)}
        for run in self._runs.values():
            run.at = [place[i] for i in run.at]
        self._held, self._raw = work.select(kept), work.raw[kept]
        return Passed(work.select(work.order), np.array(work.settled, np.bool_), work.refused, work.moved)


class Refused(NamedTuple):
    """Rejected event whose time was far ahead: kind, channel, time (ns) and expected time (ns)."""

    kind: int
    channel: int
    t: int
    expected: int


class Moved(NamedTuple):
    """Clock that was set: kind, channel and timestamp (ns) of its first event after the step, and the step (ns)."""

    kind: int
    channel: int
    t: int
    by: int


class Passed(NamedTuple):
    """Events for the log, in order. Those of the mask `settled` (N,) were held, so no horizon applies to them."""

    events: Events
    settled: np.ndarray
    refused: list[Refused]
    moved: list[Moved]


def nearest_zone(step: int) -> int:
    """Return the nearest multiple of `ZONE_STEP_NS`."""
    return (step + ZONE_STEP_NS // 2) // ZONE_STEP_NS * ZONE_STEP_NS


def plain_events(batch: Events) -> Events:
    """Return the batch with columns of the types that the compiled functions read; itself if it has them."""
    columns = [np.ascontiguousarray(column, kind) for column, kind in zip(batch, COLUMN_TYPES.values(), strict=False)]
    if all(a is b for a, b in zip(columns, batch, strict=False)):
        return batch
    return Events._make([*columns, batch.value])


class HeldRun:
    """Held events of one channel that agree on another time.

    `ahead` or back; `live` if arrivals are known. `begin` is the newest time of all events before. `agree` is the
    largest spread of t - arrival among events on time. `top` is the largest t - arrival, `begun` the first arrival,
    `arrived` the last arrival of events on time, `highest` the largest time. All in ns.
    """

    def __init__(self, ahead: bool, live: bool, begin: int, agree: int, most: int) -> None:
        self.ahead, self.live, self.begin = ahead, live, begin
        self._agree, self._most = agree, most
        self.at: list[int] = []
        self.t: list[int] = []
        self.top = self.begun = self.arrived = self.highest = self._lowest = 0
        self._on_time: deque[tuple[int, int, int]] = deque()

    @staticmethod
    def restored(fields: Mapping[str, Any]) -> HeldRun:
        """Return the run of these fields, of which JSON may have made lists."""
        run = HeldRun(False, False, 0, 0, 0)
        vars(run).update(fields)
        run._on_time = deque(map(tuple, fields["_on_time"]))
        return run

    @property
    def full(self) -> bool:
        """Whether no more events may be held."""
        return len(self.at) >= self._most

    @property
    def span(self) -> int:
        """Time over which the events agree, ns, by their own clock and, if arrivals are known, by arrivals too.

        A delayed block that arrives at once has no span.
        """
        if not self.live:
            return self.highest - self._lowest
        (_, t, arrival), (_, newest, arrived) = self._on_time[0], self._on_time[-1]
        return min(newest - t, arrived - arrival)

    def add(self, i: int, t: int, arrival: int) -> None:
        """Add an event: its place in the work, its time and its arrival."""
        offset = t - arrival
        first = not self.at
        self.begun = arrival if first else self.begun
        self.top = offset if first else max(offset, self.top)
        self.highest, self._lowest = (t, t) if first else (max(t, self.highest), min(t, self._lowest))
        self.at.append(i)
        self.t.append(t)
        if offset >= self.top - self._agree:
            self._on_time.append((offset, t, arrival))
            self.arrived = arrival
        while self._on_time[0][0] < self.top - self._agree:
            self._on_time.popleft()


class Work:
    """Held events followed by a batch, and the decisions on them."""

    def __init__(self, events: Events, rows: np.ndarray, raw: np.ndarray, begin: int, utc: int) -> None:
        """`rows` (n,) of the state, timestamps `raw` (n,), the number `begin` of held events; `utc` of the guard."""
        self._events = events
        self.t, self.arrival, self.kind, self.channel = events[:4]
        self.rows, self.raw, self.begin = rows, raw, begin
        self._wrong = np.abs(raw - self.arrival) > utc
        self.live = (raw != self.arrival) | (utc > 0)
        self.order: list[int] = []
        self.settled: list[bool] = []
        self.refused: list[Refused] = []
        self.moved: list[Moved] = []

    def emit(self, at: Sequence[int], *, settled: bool = False) -> None:
        """Pass the events at these places, in this order."""
        self.order.extend(at)
        self.settled.extend([settled] * len(at))

    def shift(self, row: int, held: list[int], step: int) -> None:
        """Shift the held and the following times of a row."""
        later = np.flatnonzero((self.rows == row) & self._wrong)
        self.t[held] += step
        self.t[later[later > held[-1]]] += step

    def offset(self, i: int) -> int:
        """Return t - arrival of an event, ns."""
        return int(self.t[i]) - int(self.arrival[i])

    def select(self, at: list[int]) -> Events:
        """Return the events at these places."""
        return self._events.select(np.array(at, np.int64))
