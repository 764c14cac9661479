"""The faults of one source, scheduled and injected; changed from any thread while another reads."""

from __future__ import annotations

import heapq
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from estimators.errors import SourceError
from estimators.log import INPUT, Events
from estimators.model.state_space import StateSpaceModel

from ..source import Source, is_endless, span_of
from .effects import ActiveFault, FaultedEvent, events_of, items_of, ns
from .kinds import NEVER_NS, Change, Changeable, Fault, find_kind, problem

LINGER_NS = ns(60.0)
"""Time of the source after the end of a fault when it is removed; measurements from its window that arrive even later
are not affected."""


@dataclass
class _Entry:
    """A fault with its number, and its window in ns once it is known."""

    number: int
    fault: Fault
    scheduled: bool
    base: int | None
    end: int = NEVER_NS
    change: Change | None = None

    def window(self, base: int) -> tuple[int, int]:
        last = NEVER_NS if self.fault.end == inf else base + ns(self.fault.end)
        return base + ns(self.fault.start), min(self.end, last)


@dataclass(frozen=True)
class FaultStatus:
    """A current or future fault: its number, its start (ns; None: not yet), affected and removed events."""

    number: int
    fault: Fault
    since: int | None
    touched: int
    lost: int


class Faults:
    """Applies faults to a source's events, one after the other in order of their number.

    The same events, seed and faults give the same bits, for any batches. A delayed event is held back until a later
    arrival or `release`. Only a silence removes events, and counts them.

    Raises:
        SourceError: If a scheduled fault does not fit the model, with its number and remedy.
    """

    def __init__(self, model: StateSpaceModel, scheduled: Sequence[Fault] = (), *, seed: int = 0) -> None:
        self._model, self._seed = model, seed
        self._lock = threading.Lock()
        self._asset: Changeable | None = None
        self._entries: list[_Entry] = []
        for number, fault in enumerate(scheduled):
            self._check(fault, f"fault {number + 1}")
            self._entries.append(_Entry(number, fault, True, None))
        self._next = len(scheduled)
        self._begin()

    def _check(self, fault: Fault, name: str) -> None:
        wrong = problem(fault, self._model)
        if wrong:
            raise SourceError(f"{name}: {' '.join(part for part in wrong if part)}")

    def _begin(self) -> None:
        """Reset to the state before the first event."""
        self._active: list[tuple[_Entry, ActiveFault]] = []
        self._waiting: list[tuple[int, int, FaultedEvent]] = []
        self._lost = 0
        self._sent = 0
        self._origin: int | None = None
        self._newest: int | None = None
        self._clock: int | None = None
        self._inputs = np.full(len(self._model.inputs), np.nan)

    # From any thread

    def inject(self, fault: Fault) -> int:
        """Begin a fault with the next event, from which its start and end count; return its number.

        Raises:
            SourceError: If it does not fit the model, or it needs a simulated asset and the source is none.
        """
        self._check(fault, "fault")
        if find_kind(fault.kind).name == "model":
            # With the asset's next step, whose time is not known yet.
            fault = replace(fault, start=0.0, end=fault.end - fault.start)
        with self._lock:
            entry = _Entry(self._next, fault, False, None if self._newest is None else self._newest + 1)
            if find_kind(fault.kind).name == "model":
                self._change(entry)
            self._next += 1
            self._entries.append(entry)
            if self._origin is not None:
                self._activate(entry)
            return entry.number

    def clear(self, number: int | None = None) -> int:
        """End the fault of that number, or all, with the next event; return how many there were.

        Raises:
            SourceError: If there is none of that number.
        """
        with self._lock:
            found = [
                item
                for item in self._entries
                if number in (None, item.number)
                and not self._over(item)
                # A model changes back with its asset's next step.
                and (item.change is None or item.end == NEVER_NS)
            ]
            if number is not None and not found:
                raise SourceError(f"there is no fault {number} that could end")
            for entry in found:
                self._end(entry)
            return len(found)

    def status(self) -> tuple[FaultStatus, ...]:
        """Return current and future faults."""
        with self._lock:
            running = {entry.number: active for entry, active in self._active}
            found = []
            for entry in self._entries:
                active = running.get(entry.number)
                if self._over(entry):
                    continue
                since, touched, lost = (active.since, active.touched, active.lost) if active else (None, 0, 0)
                found.append(FaultStatus(entry.number, entry.fault, since, touched, lost))
            return tuple(found)

    @property
    def lost(self) -> int:
        """Events that faults have removed since the source began."""
        with self._lock:
            return self._lost + sum(active.lost for _, active in self._active)

    @property
    def can_change(self) -> bool:
        """Whether the source simulates an asset, so that parameter faults are possible."""
        return self._asset is not None

    def attach(self, source: object) -> None:
        """Attach a source that was opened, and schedule its changes of the model.

        Raises:
            SourceError: If there are some, and it is not a simulated asset.
        """
        with self._lock:
            self._asset = source if isinstance(source, Changeable) else None
            for entry in self._entries:
                if find_kind(entry.fault.kind).name == "model":
                    self._change(entry)

    # On the thread that reads

    def restart(self) -> None:
        """Begin again with the source; faults keep their times."""
        with self._lock:
            self._begin()

    def pass_on(self, batch: Events) -> Events:
        """Return the events in place of a batch."""
        with self._lock:
            if not len(batch):
                return batch
            if self._origin is None:
                self._origin = int(batch.t[0])
                for entry in self._entries:
                    self._activate(entry)
            width = batch.value.shape[1]
            if self._active or self._waiting:
                out: list[FaultedEvent] = []
                for item in items_of(batch):
                    self._clock = item.arrival if self._clock is None else max(self._clock, item.arrival)
                    out += self._due(self._clock - 1)
                    out += self._send(self._through([item]))
                    out += self._send(self._leave(item.at))
                passed = events_of(out, width)
            else:
                self._clock = max(int(batch.arrival.max()), self._clock if self._clock is not None else -NEVER_NS)
                passed = batch
            self._newest = max(int(batch.t.max()), self._newest if self._newest is not None else -NEVER_NS)
            self._note_inputs(passed)
            return passed

    def release(self, now: int) -> Events:
        """Return the delayed events that have arrived by `now`, ns; call it when no earlier arrival is pending."""
        with self._lock:
            return events_of(self._due(now), self._model.width)

    def finish(self) -> Events:
        """Return the events that are still held back when the source has ended."""
        with self._lock:
            kept: list[FaultedEvent] = []
            for k, (_, active) in enumerate(self._active):
                kept += self._through(active.flush(), k + 1)
            return events_of(self._send(kept) + self._due(NEVER_NS), self._model.width)

    # With the lock held

    def _through(self, items: list[FaultedEvent], first: int = 0) -> list[FaultedEvent]:
        for _, active in self._active[first:]:
            items = active.process(items)
        return items

    def _leave(self, at: int) -> list[FaultedEvent]:
        """Remove faults that ended long ago, which would slow every event; return the events that they hold back."""
        gone = [k for k, (_, active) in enumerate(self._active) if active.ended and at > active.end + LINGER_NS]
        kept: list[FaultedEvent] = []
        for k in gone:
            kept += self._through(self._active[k][1].flush(), k + 1)
            self._lost += self._active[k][1].lost
        if gone:
            self._active = [item for k, item in enumerate(self._active) if k not in gone]
        return kept

    def _send(self, items: list[FaultedEvent]) -> list[FaultedEvent]:
        """Return events that have arrived; the others wait."""
        out = []
        for item in items:
            if self._clock is not None and item.arrival > self._clock:
                heapq.heappush(self._waiting, (item.arrival, self._sent, item))
                self._sent += 1
            else:
                out.append(item)
        return out

    def _due(self, until: int) -> list[FaultedEvent]:
        out = []
        while self._waiting and self._waiting[0][0] <= until:
            out.append(heapq.heappop(self._waiting)[2])
        return out

    def _note_inputs(self, events: Events) -> None:
        rows = events.value[events.kind == INPUT][:, : self._inputs.size]
        for k in range(self._inputs.size if len(rows) else 0):
            known = rows[~np.isnan(rows[:, k]), k]
            if known.size:
                self._inputs[k] = known[-1]

    def _activate(self, entry: _Entry) -> None:
        assert self._origin is not None
        if entry.base is None:
            entry.base = self._origin
        start, end = entry.window(entry.base)
        active = ActiveFault(
            entry.fault,
            self._model,
            (self._seed, entry.number),
            start,
            end,
            scheduled=entry.scheduled,
            inputs=self._inputs,
        )
        self._active.append((entry, active))

    def _over(self, entry: _Entry) -> bool:
        """Return whether a fault has ended, or ends with the next event."""
        if entry.base is None or self._newest is None:
            return False
        return entry.window(entry.base)[1] <= self._newest + 1

    def _end(self, entry: _Entry) -> None:
        entry.end = self._newest + 1 if self._newest is not None else -NEVER_NS
        begun = any(item is entry and active.begun for item, active in self._active)
        if entry.change is not None and self._asset is not None:
            self._asset.end(entry.change)
            if not self._asset.live:
                entry.end = entry.change.end
        if not begun:
            self._entries.remove(entry)
            self._active = [(item, active) for item, active in self._active if item is not entry]
        for item, active in self._active:
            if item is entry:
                active.end = entry.end

    def _change(self, entry: _Entry) -> None:
        """Schedule a change of the asset's model."""
        fault = entry.fault
        if self._asset is None:
            raise SourceError("a fault of kind model needs a simulated asset; this source has none")
        start = None
        if entry.scheduled:
            start = ns(fault.start)
        elif entry.change is not None and not self._asset.live:
            start = entry.change.start
        length = None if fault.end == inf else ns(fault.end - fault.start)
        change = self._asset.change(str(fault.parameter), float(fault.size or 0.0), start, length)
        if entry.end != NEVER_NS and entry.change is not None:
            change.end = entry.change.end
        entry.change = change
        if not (self._asset.live or entry.scheduled):
            entry.base = change.start


class FaultySource:
    """Source of the events of `inner` under `faults`.

    It stands outside the pacer of a replay, so that an injected fault affects the next events to be played, including
    those that were read ahead. When the pacer begins again by seeking back, so do the faults.
    """

    def __init__(self, inner: Source, faults: Faults) -> None:
        self.inner, self.faults = inner, faults
        self.live = inner.live
        self._restarts = getattr(inner, "restarts", 0)

    @property
    def span(self) -> tuple[int, int] | None:
        """First and last time of the source inside, ns; None if it is not known."""
        return span_of(self.inner)

    @property
    def endless(self) -> bool:
        """Whether the source inside has no end."""
        return is_endless(self.inner)

    def read(self, timeout: float) -> Events | None:
        """Return the next events and the delayed ones that are due; None at the end."""
        now = self.inner.now()
        batch = self.inner.read(timeout)
        restarts = getattr(self.inner, "restarts", 0)
        if restarts != self._restarts:
            self._restarts = restarts
            self.faults.restart()
        if batch is None:
            rest = self.faults.finish()
            return rest if len(rest) else None
        if len(batch) or now is None:
            return self.faults.pass_on(batch)
        # All events that arrived until `now` have been returned.
        return self.faults.release(now)

    def now(self) -> int | None:
        """Return the present time of the source inside, ns."""
        return self.inner.now()

    def close(self) -> None:
        """Close the source inside."""
        self.inner.close()
