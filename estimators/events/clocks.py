"""The guard before the log: readings whose time cannot be true, and clocks that have moved.

One reading stamped an hour ahead would make all that follow it stale. So a lone time far from where the clock of its
source was expected is refused, and held until what comes next tells which it was:

- *ahead*: after all that was said, by more than the horizon (half of it where arrival is known) and many of its own
  periods, and, where arrival is known, ahead of it by more than ever lately. If the next readings are back in time it
  was a lone one, and is refused. If they stay there, nothing was said for a while (a gap) and they are let in as they
  are; or the clock was set.
- *back*: before the newest of its own channel by more than the horizon, so that the log would drop it as stale. If the
  next agree on it the clock was set back; else they go to the log, which drops and counts them, as any that is late.

Where a clock was set, what it stamps from then on is moved so that its time goes on without a step: with known arrivals
by the step of the largest t - arrival, as a delay makes it only smaller, without by continuing its channel at its own
pace. A clock that comes back to where it was, or to where that of another channel is, is taken to be there exactly:
else the delays of the moment would add up from one step to the next.

With known arrivals that time comes to where the held ones are says nothing: a clock that is a little more ahead than
the horizon would be let in after a while, and all that other clocks stamp would be stale from then on. And a reading
that fits but was measured before the held ones had come says nothing of the clock now, so it does not contradict them.

It is a pure function of the events in the order of arrival: the outcome does not depend on how they were cut into
batches. Queries and resets, which are ours, pass. Readings are judged by sensor, inputs together, true states together:
events do not tell their source.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .batch import INPUT, READING, TRUTH, Events
from .clock_expected import (
    AHEAD,
    BACK,
    ENOUGH,
    FIRST,
    FITS,
    GAP_FROM,
    GAP_TO,
    HOLDING,
    LAST,
    LIVE,
    OFFSET,
    PERIODS,
    SECOND,
    SEEN,
    STEPS,
    TOTAL,
    compiled,
)

SETTLED = 2 * SECOND
"""Of the source's own time for which they must agree at least."""

ZONE = 900 * SECOND
"""Time zones, and daylight saving time, differ by a multiple of 15 minutes."""

MOST, MOST_LIVE = 1 << 17, 4096
"""Events that are held of one channel, without and with known arrivals; more that never settle are no clock."""


class ClockGuard:
    """Stands between a source and a log; `take` each batch, and `finish` at the end."""

    def __init__(self, sensors: int, horizon: int) -> None:
        """Of a model with so many sensors; `horizon` is the log's, ns."""
        self._sensors, self._horizon = sensors, horizon
        self._agree = min(max(SECOND // 2, horizon // 2), SETTLED)
        self._settled = max(SETTLED, 2 * self._agree)
        self._spread = horizon + self._agree
        self._everything = sensors + 2
        self._state = np.zeros((sensors + 3, 11), np.int64)
        self._shift = np.zeros(sensors + 2, np.int64)
        self._steps: list[int] = []
        self._runs: dict[int, Run] = {}
        self._held = Events.empty(0)
        self._raw = np.zeros(0, np.int64)
        self._reach, self._judge, self._note, self._scan = compiled()

    @property
    def held(self) -> int:
        """How many events wait for what comes next."""
        return len(self._held)

    def take(self, batch: Events) -> Passed:
        """The next events, in the order of arrival: those that may go to the log now."""
        if not len(batch):
            return Passed(batch, np.zeros(0, np.bool_), [], [])
        if not self._runs and not self._shift.any():
            batch = plain_events(batch)
            at = self._scan(self._state, batch.t, batch.t, *batch[1:4], 0, self._horizon)
            if at == len(batch):
                return Passed(batch, np.zeros(len(batch), np.bool_), [], [])
            work = self._work(batch)
            work.emit(range(at))
        else:
            work = self._work(batch)
            at = work.begin
        while at < len(work.t):
            stop = self._pass(work, at)
            work.emit(range(at, stop))
            if stop < len(work.t):
                self._suspect(work, stop)
            at = stop + 1
        return self._leave(work)

    def finish(self) -> Passed:
        """The source has ended, and nothing contradicts what is held ahead.

        It is let in, but for a lone one that is farther ahead than all that was said is long: that is no gap.
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
        batch = plain_events(batch)
        rows = self._rows_of(batch)
        moved = batch._replace(t=batch.t + np.where(rows >= 0, self._shift[rows], 0))
        events = Events.concat([self._held, moved], batch.value.shape[1]) if self._runs else moved
        rows = np.concatenate((self._rows_of(self._held), rows))
        return Work(events, rows, np.concatenate((self._raw, batch.t)), len(self._held))

    def _rows_of(self, batch: Events) -> np.ndarray:
        """The row of the state for each event, as `_row` has it."""
        rows = np.full(len(batch), -1, np.int64)
        readings = (batch.kind == READING) & (batch.channel >= 0) & (batch.channel < self._sensors)
        rows[readings] = batch.channel[readings]
        rows[batch.kind == INPUT] = self._sensors
        rows[batch.kind == TRUTH] = self._sensors + 1
        return rows

    def _pass(self, work: Work, start: int) -> int:
        columns = work.t, work.raw, work.arrival, work.kind, work.channel
        return int(self._scan(self._state, *columns, start, self._horizon))

    def _verdict(self, work: Work, i: int) -> int:
        return int(self._judge(self._state, work.rows[i], work.t[i], work.arrival[i], work.live[i], self._horizon))

    def _let_in(self, work: Work, i: int) -> None:
        self._note(self._state, work.rows[i], work.t[i], work.arrival[i], work.live[i], self._horizon)

    def _suspect(self, work: Work, i: int) -> None:
        """Deal with an event that does not fit, or whose channel holds some."""
        row = int(work.rows[i])
        run = self._runs.get(row)
        if run is not None and self._has_come(work, run):
            self._release(work, row)
            run = None
        verdict = self._verdict(work, i)
        if run is not None and run.ahead and run.live and verdict == BACK:
            if int(work.arrival[i]) - run.arrived <= self._settled:
                # Late, whatever the clock says now.
                work.emit([i])
                return
        rest: list[int] = []
        if run is not None and (
            self._contradicts(work, run, i) if verdict == FITS else run.full or not self._agrees(work, run, i)
        ):
            if verdict != FITS and run.live and not run.full:
                rest = [k for k in run.at if abs(self._offset(work, k) - self._offset(work, i)) <= self._spread]
            self._dissolve(work, row, rest)
            run = None
        if verdict == FITS or (run is None and verdict == BACK and not self._can_be_set_back(work, i)):
            if verdict == FITS:
                self._let_in(work, i)
            work.emit([i])
            return
        if run is None:
            live = self._is_live(work, i)
            begin = int(self._state[self._everything, LAST])
            run = self._runs[row] = Run(verdict == AHEAD, live, begin, self._agree, MOST_LIVE if live else MOST)
            self._state[row, HOLDING] = 1
        for k in (*rest, i):
            run.add(k, int(work.t[k]), int(work.arrival[k]))
        if self._shows_a_step(run, row):
            self._anchor(work, row)

    def _is_live(self, work: Work, i: int) -> bool:
        return bool(work.live[i] or self._state[work.rows[i], LIVE])

    def _offset(self, work: Work, i: int) -> int:
        return int(work.t[i]) - int(work.arrival[i])

    def _has_come(self, work: Work, run: Run) -> bool:
        """Whether time has come to where those are that are held ahead; to their last one, if arrivals are known."""
        return run.ahead and self._verdict(work, run.at[-1 if run.live else 0]) == FITS

    def _contradicts(self, work: Work, run: Run, i: int) -> bool:
        """Whether an event that fits tells that those that are held do not.

        By a clock that was not set it was measured at t - `OFFSET` of the host's time at the earliest. If that is
        after the first of those that are held had come, it says so; else it may have been on its way meanwhile.
        """
        return not run.live or int(work.t[i]) - int(self._state[work.rows[i], OFFSET]) > run.begun + self._agree

    def _agrees(self, work: Work, run: Run, i: int) -> bool:
        """Whether an event says the same of its clock as those that are held, but for delays."""
        t = int(work.t[i])
        if run.live:
            lower = run.top - self._offset(work, i)
            # On its way for long, while others come on time.
            delayed = lower > 0 and int(work.arrival[i]) - run.arrived <= self._settled
            return delayed or abs(lower) <= self._spread
        if t < run.t[-1] - self._horizon:
            return False
        reach = int(self._reach(self._state, work.rows[i], self._horizon, False))
        return run.ahead or reach < 0 or t <= run.t[-1] + reach

    def _shows_a_step(self, run: Run, row: int, ended: bool = False) -> bool:
        """Return whether held events agree for long enough, and show a step of their clock.

        Events of a table that went back may also be files in the wrong order. They show a step if they reach into what
        was measured before, if another channel's clock made the same step, or if the step is a change of time zone or
        daylight saving time. Files of whole quarter-hours in the wrong order look like that too; those end where the
        channel begins, which is known once the source has `ended`.
        """
        if len(run.at) < ENOUGH or run.span < self._settled:
            return False
        begin = int(self._state[row, FIRST])
        if run.ahead or run.live or run.highest > begin + self._horizon:
            return True
        step = self._step_back(run, row)
        if any(abs(abs(known) - step) <= self._agree for known in self._steps):
            return True
        if step % ZONE:
            return False
        near = self._precision(row)
        if ended:
            return begin - run.highest > self._horizon + PERIODS * near
        return abs(begin - run.t[0] - self._zone(begin - run.t[0])) > near

    def _step_back(self, run: Run, row: int) -> int:
        """Return the step (ns) by which a table's clock went back if its channel went on at its own pace.

        The exact change of a time zone where it is near one: irregular samples do not tell their pace exactly.
        """
        step = int(self._state[row, LAST]) + self._period(row) - run.t[0]
        near = self._zone(step)
        return near if near and abs(near - step) <= self._precision(row) else step

    def _period(self, row: int) -> int:
        return int(self._state[row, TOTAL] // max(1, self._state[row, STEPS]))

    def _precision(self, row: int) -> int:
        """Return how exactly (ns) the times of a channel show a step of its clock."""
        return min(max(self._agree, self._period(row)), ZONE // 15)

    def _zone(self, step: int) -> int:
        """Return the nearest multiple of `ZONE`."""
        return (step + ZONE // 2) // ZONE * ZONE

    def _can_be_set_back(self, work: Work, i: int) -> bool:
        """Whether a time that went back may be a clock's, and not a block of late readings, or files in a wrong order.

        With known arrivals it always may. Without, a channel cannot have measured twice at one time: what fills its
        last gap is late.
        """
        if self._is_live(work, i):
            return True
        state, t, horizon = self._state[work.rows[i]], int(work.t[i]), self._horizon
        return not (state[GAP_TO] > state[GAP_FROM] and state[GAP_FROM] - horizon <= t <= state[GAP_TO] + horizon)

    def _anchor(self, work: Work, row: int) -> None:
        """What is held was true: let it in, with the clock set right if it was one that moved."""
        run, state = self._runs[row], self._state[row]
        first = run.at[0]
        now = int(self._state[self._everything, LAST])
        step = 0
        if run.live:
            known = row if state[SEEN] else self._everything
            step = int(self._state[known, OFFSET]) - run.top
        elif not run.ahead:
            step = self._step_back(run, row)
        elif now > run.begin:
            # The others went on meanwhile, so this was no gap.
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
        """The step that a clock made, of those that are near to the one measured; that itself, if there is none.

        The sensors of one source share its clock, so they make its steps and are where it is. And it may come back.
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
        """What is held was not true: refused if it is ahead; what is back goes to the log, which counts it as stale.

        But for the `rest`, which stays held with what contradicted it.
        """
        run = self._end(row)
        gone = [i for i in run.at if i not in set(rest)] if rest else run.at
        if not run.ahead:
            work.emit(gone)
            return
        for i in gone:
            stamp, shift = int(work.raw[i]), int(self._shift[row])
            work.refused.append(Refused(int(work.kind[i]), int(work.channel[i]), stamp, run.begin - shift))

    def _end(self, row: int) -> Run:
        self._state[row, HOLDING] = 0
        return self._runs.pop(row)

    def _leave(self, work: Work) -> Passed:
        """What passes; what is still held is kept for the next batch."""
        kept = sorted(i for run in self._runs.values() for i in run.at)
        place = {i: k for k, i in enumerate(kept)}
        for run in self._runs.values():
            run.at = [place[i] for i in run.at]
        self._held, self._raw = work.select(kept), work.raw[kept]
        return Passed(work.select(work.order), np.array(work.settled, np.bool_), work.refused, work.moved)


class Refused(NamedTuple):
    """A lone event whose time was far ahead: its kind, channel, time (ns) and where its clock was expected (ns)."""

    kind: int
    channel: int
    t: int
    expected: int


class Moved(NamedTuple):
    """A clock that was set: kind and channel of its first event, its time as stamped, and by how much it moved (ns)."""

    kind: int
    channel: int
    t: int
    by: int


class Passed(NamedTuple):
    """What may go to the log, in order. `settled` (N,) were held: they came in time, so no horizon applies to them."""

    events: Events
    settled: np.ndarray
    refused: list[Refused]
    moved: list[Moved]


def plain_events(batch: Events) -> Events:
    """The batch, its columns as the compiled functions read them; as it is, where it is so."""
    types_ = (np.int64, np.int64, np.int8, np.int32)
    columns = [np.ascontiguousarray(column, kind) for column, kind in zip(batch[:4], types_, strict=True)]
    if all(a is b for a, b in zip(columns, batch, strict=False)):
        return batch
    return Events(columns[0], columns[1], columns[2], columns[3], batch.value)


class Run:
    """Events of one channel that agree on another time, held until it is told whether that is true.

    `ahead` or back; `live` where arrivals are known. `begin` is the newest time of all that was said before. `agree` is
    how far apart t - arrival may be of those that count as on time. `top` is the largest t - arrival, `begun` the
    first arrival, `arrived` the last of those on time, `highest` the largest time. All in ns.
    """

    def __init__(self, ahead: bool, live: bool, begin: int, agree: int, most: int) -> None:
        self.ahead, self.live, self.begin = ahead, live, begin
        self._agree, self._most = agree, most
        self.at: list[int] = []
        self.t: list[int] = []
        self.top = self.begun = self.arrived = self.highest = self._lowest = 0
        self._on_time: deque[tuple[int, int, int]] = deque()

    @property
    def full(self) -> bool:
        """Whether it never settled."""
        return len(self.at) >= self._most

    @property
    def span(self) -> int:
        """For how long they agree, by their own time; where arrivals are known by those too, of the ones on time.

        A block that was held up and comes in one go has no span.
        """
        if not self.live:
            return self.highest - self._lowest
        (_, t, arrival), (_, newest, arrived) = self._on_time[0], self._on_time[-1]
        return min(newest - t, arrived - arrival)

    def add(self, i: int, t: int, arrival: int) -> None:
        """The next of them: its place in the work, its time and its arrival."""
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
    """Events that were held and a batch, one after the other, and what becomes of them."""

    def __init__(self, events: Events, rows: np.ndarray, raw: np.ndarray, begin: int) -> None:
        """The rows of the state (n,), the times as stamped, and how many of the events were held."""
        self._events = events
        self.t, self.arrival, self.kind, self.channel = events[:4]
        self.rows, self.raw, self.begin = rows, raw, begin
        self.live = self.raw != self.arrival
        self.order: list[int] = []
        self.settled: list[bool] = []
        self.refused: list[Refused] = []
        self.moved: list[Moved] = []

    def emit(self, at: Sequence[int], *, settled: bool = False) -> None:
        """These pass, in this order."""
        self.order.extend(at)
        self.settled.extend([settled] * len(at))

    def shift(self, row: int, held: list[int], step: int) -> None:
        """The clock of a row was set: correct what is held, and what is still to come."""
        later = np.flatnonzero(self.rows == row)
        self.t[held] += step
        self.t[later[later > held[-1]]] += step

    def select(self, at: list[int]) -> Events:
        """The events at these places."""
        return self._events.select(np.array(at, np.int64))
