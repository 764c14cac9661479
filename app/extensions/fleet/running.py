"""A fleet that runs: its source is read and folded in a thread; others read the table."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from app.engine.fold_json import tuning_to_json
from app.engine.jobs import LoopThread
from app.engine.outcomes import Outcomes
from app.engine.store import RETRY_PERIOD_S, Store
from app.result import JsonObject
from app.twin.ingest import CLOCK_MOVED, clock_lines, refusal
from app.twin.twin import Twin
from estimators.errors import SourceError, is_blank, quoted, reason_of
from estimators.events.clocks import ClockGuard, Passed
from estimators.fleet.table import FleetTable
from estimators.log import BEFORE, READING, Events
from estimators.track import STALE
from sources.messages import FORGOTTEN, Messages
from sources.source import NO_ASSET, WRONG_TIME, Acknowledging, AssetEvents, Marked, Report, is_utc

from .plan import FleetPlan
from .silent_assets import SilentAssets

FIRST_ROOM = 256
"""Assets for which there is room at the start, unless their number is given; it is doubled as they come."""

MAX_ASSETS = 100_000
"""Assets that senders may name, unless the YAML has their number: 1 GB, depending on the model."""

MAX_PENDING = 500_000
"""Events that are folded at once while a table is read to its end."""

READ_S = 0.1
"""Longest wait for measurements, s."""

BLOCK = 1024
"""Assets whose state is one block of the store; only blocks that have changed are written."""

STORE_PERIOD_S, STORE_SHARE = 1.0, 0.1
"""Shortest time between two transactions of the store, and the share of time that they may take."""

TICKS_PER_DELAY = 4
"""Checks for silent assets in the time after which one is degraded."""

MAX_UNACKNOWLEDGED = 0.5
"""Share of the messages that a broker sends without acknowledgement after which the store is written at once."""

STORE, STOPPED = "store", "failed"
"""Keys of reports that the store cannot be written, or is again, and that nothing is folded any more."""

UNKNOWN = -1
"""In place of the position of an asset: it is refused."""


class EventSink(Protocol):
    """Takes the events of a fleet."""

    def append(self, at: np.ndarray, events: Events) -> None:
        """Take events of the assets at the positions `at` (N,), at once."""

    def written(self, rows: Sequence[tuple[np.ndarray, Events]]) -> AbstractContextManager[JsonObject]:
        """Write events for a transaction of the store in this context; yield what that must have."""

    def start(self) -> None:
        """Begin."""

    def stop(self) -> None:
        """End, with all events that were taken."""


class Passing(NamedTuple):
    """Events of messages that are not folded yet, the places of their assets (n,), and whether they are late (n,)."""

    at: np.ndarray
    events: Events
    late: np.ndarray


class RunningFleet:
    """Reads the source of a fleet, folds it, and answers with the table of its assets."""

    def __init__(
        self,
        plan: FleetPlan,
        report: Report,
        *,
        threads: int | None = None,
        store: Path | None = None,
    ) -> None:
        """Compile the filter, open the source, and continue from the store.

        Args:
            plan: The fleet.
            report: Called as report(key, text) for what cannot be used; counted in `counts`.
            threads: Threads that fold; None for all.
            store: File in which the state of the fleet is kept with the position in its source; None for none.

        Raises:
            NisusError: If the estimator is not for fleets, the source cannot be opened, or the store is of another
                fleet.
        """
        given = plan.config.assets
        self.plan, self._report = plan, report
        self.counts: Counter[str] = Counter()
        """Reports by key."""
        self._given = frozenset(given) if isinstance(given, tuple) else None
        self.names: list[str] = list(plan.values.names)
        """Names of the assets; appended to, and changed where an asset is forgotten."""
        self._places = {name: k for k, name in enumerate(self.names)}
        senders = None if plan.reads_files else max(MAX_ASSETS, len(self.names))
        self._most = given if isinstance(given, int) else senders if self._given is None else len(self.names)
        self._once: dict[int, None] = {}
        """Places of assets that sent one message, the oldest first: they are forgotten for others."""
        self._unused = b""
        """State of an asset before its first event."""
        room = max(FIRST_ROOM, len(self.names)) if given is None else self._most
        self.fleet = plan.fleet(room or FIRST_ROOM, threads)
        self._silent = SilentAssets(self.fleet)
        self._last = np.full(len(self.fleet.assets), BEFORE, np.int64)
        self._heard = self._last.copy()
        """Arrival of the last event of each asset, ns."""
        begun = time.time_ns() - time.monotonic_ns()
        self.clock: Callable[[], int] = lambda: begun + time.monotonic_ns()
        """This machine's time, ns, without the steps of its clock since the start."""
        self._newest = self._looked = BEFORE
        self._silence = round(plan.twin.policy.degraded_after * 1e9)
        self._pending = 0
        self.version = 0
        """Increases with each fold."""
        self.ended = False
        """Whether the source has ended."""
        self.failure = ""
        """Why the source failed."""
        self._lock = threading.Lock()
        self._shown: tuple[int, FleetTable] | None = None
        self._thread = LoopThread(self._run, "fleet")
        self.outcomes = Outcomes()
        self._passed: list[Passing] = []
        self._changed: set[int] = set()
        self._unarchived: list[tuple[np.ndarray, Events]] = []
        self.archive: EventSink | None = None
        """What keeps the events; None for nothing. It is started and stopped with the fleet."""
        self._due, self._asked, self._kept = 0.0, False, -1
        self._unwritten = False
        """Whether the store could not be written at the last attempt."""
        self.archived: JsonObject | None = None
        """Numbers of the archive that the store has; None without a store, or without an archive in it."""
        self.end_publishing: Callable[[], None] = lambda: None
        """Called with the last state, before the store is closed, which has the alerts."""
        self.file = None if store is None else Store(store)
        try:
            self.source = plan.open(self.note, stored=store is not None)
            messages = getattr(self.source, "messages", self.source)
            if isinstance(messages, Messages) and self._given is None:
                messages.room = self._room
            horizon = round(plan.twin.config.time.max_delay * 1e9)
            self._guard = ClockGuard(self._last.size, horizon, True) if is_utc(self.source) else None
            if self.file is not None:
                self._continue(self.file)
        except BaseException:
            if self.file is not None:
                self.file.close()
            if hasattr(self, "source"):
                self.source.close()
            raise

    @property
    def store(self) -> RunningFleet | None:
        """What keeps its state, see `StateWriter`; None without a store."""
        return None if self.file is None else self

    def request_write(self) -> None:
        """See `StateWriter`."""
        self._asked = True

    def has(self, mark: int) -> bool | None:
        """See `StateWriter`."""
        return None if self.failure or self._unwritten else self._kept >= mark

    @property
    def twin(self) -> Twin:
        """The twin of each asset, with the source of the fleet."""
        return replace(self.plan.twin, loaded=self.plan.source.loaded)

    def note(self, key: str, text: str) -> None:
        """Count and pass on a report of the source."""
        self.counts[key] += 1
        self._report(key, text)

    def start(self) -> None:
        """Read and fold in a thread of its own."""
        self._thread.start()

    def run(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Read and fold in this thread until the source ends, or `go_on` returns False."""
        if self.archive is not None:
            self.archive.start()
        while go_on() and self.step():
            pass
        if self._guard is not None:
            self._enter(self._guard.finish())
        self._fold()
        self._keep()

    def stop(self) -> None:
        """Stop, and close the source."""
        self._thread.stop(30.0)
        self.source.close()
        self.end_publishing()
        if self.file is not None:
            self.file.close()
        if self.archive is not None:
            self.archive.stop()

    def _run(self) -> None:
        try:
            self.run(lambda: not self._thread.stopping.is_set())
        except Exception as error:  # noqa: BLE001  the overview stays, and says why nothing is folded any more
            self.failure = reason_of(error)
            self.note(STOPPED, f"the fleet stands still: {self.failure}")
            self.source.close()  # senders and brokers keep what would not be folded

    def step(self) -> bool:
        """Read the next events and fold what waits; return False at the end of the source."""
        batch: Any = self.source.read(READ_S)
        if batch is None:
            self._fold()
            self._query(0)
            self.ended = True
            self.version += 1
            self._keep(at_once=True)
            return False
        if len(batch.code):
            self._add(batch)
        if self._pending and (self.source.live or self._pending >= MAX_PENDING):
            self._fold()
        elif isinstance(self.source, Messages):
            self._tell(self.source.mark, (), {})
        if not self._pending:
            self._query(self._silence // TICKS_PER_DELAY)
            self._keep()
        return True

    def _add(self, batch: AssetEvents) -> None:
        """Add the events of the assets that are known or new."""
        used, names = np.unique(batch.code).tolist(), batch.names
        places = np.array([self._places.get(name, UNKNOWN) for name in names], np.int64)
        new = [code for code in used if places[code] == UNKNOWN]
        if self._once:
            for code in used:
                self._once.pop(int(places[code]), None)
        if new:
            spare = self._spare()
            for code in new:
                places[code] = self._place(names[code], spare)
            first, last = np.full(len(names), np.iinfo(np.int64).max), np.full(len(names), BEFORE)
            np.minimum.at(first, batch.code, batch.events.t)
            np.maximum.at(last, batch.code, batch.events.t)
            self._once.update((int(places[code]), None) for code in new if first[code] == last[code])
            self._once.pop(UNKNOWN, None)
        at, events = places[batch.code], batch.events
        known = at != UNKNOWN
        if not known.all():
            at, events = at[known], events.select(known)
        if self._guard is None:
            self._take(at, events)
        else:
            # To the guard an asset is a sensor: its measurements and inputs are of one clock.
            own = np.column_stack((events.value, events.kind, events.channel))
            kinds = np.full(at.size, READING, np.int8)
            self._enter(self._guard.take(Events(events.t, events.arrival, kinds, at.astype(np.int32), own)))

    def _enter(self, passed: Passed) -> None:
        """Take what the guard lets pass, and report what it does not."""
        for refused in passed.refused:
            self.note(WRONG_TIME, refusal(f"asset {quoted(self.names[refused.channel])}", refused))
        for line in clock_lines(passed.moved, lambda item: f"asset {quoted(self.names[item.channel])}"):
            self.note(CLOCK_MOVED, line)
        t, arrival, _, at, own = passed.events
        if at.size:
            kind, channel = own[:, -2].astype(np.int8), own[:, -1].astype(np.int32)
            self._take(at.astype(np.int64), Events(t, arrival, kind, channel, np.ascontiguousarray(own[:, :-2])))

    def _take(self, at: np.ndarray, events: Events) -> None:
        self._newest = max(self._newest, int(events.t.max(initial=BEFORE)))
        self._pending += at.size
        with self._lock:
            self._silent.put_back(np.unique(at))
            self.fleet.add_events(at, events)
        if self.archive is not None and at.size:
            self._unarchived.append((at, events))
        if isinstance(self.source, Messages):
            self._passed.append(Passing(at, events, events.t < self._last[at]))
        self._changed.update(np.unique(at // BLOCK).tolist())
        np.maximum.at(self._last, at, events.t)
        self._heard[at] = self.clock()

    def _room(self, name: str) -> float:
        """Return how many assets can still be added, from any thread; infinity for a known one or without a limit."""
        known = self._most is None or name in self._places
        return math.inf if known else (self._most or 0) - len(self.names) + len(self._once)

    def _spare(self) -> Iterator[int]:
        """Forget the asset whose only message is the oldest, and yield its place, as often as one is asked for.

        Those are kept whose events wait for the archive, which knows them by their place.
        """
        waiting = {place for at, _ in self._unarchived for place in at.tolist()}
        for place in [place for place in self._once if place not in waiting]:
            self._fold()
            with self._lock:
                self._silent.forget(place, self._unused)
            if self._guard is not None:
                self._guard.forget(place)
            name = self.names[place]
            del self._once[place], self._places[name]
            self._last[place] = self._heard[place] = BEFORE
            self._changed.add(place // BLOCK)
            text = f"{self.plan.path.name}: asset {quoted(name)} is forgotten after its only message, to make room"
            self.note(FORGOTTEN, f"{text}; enlarge assets")
            yield place

    def _place(self, name: str, spare: Iterator[int] | None = None) -> int:
        """Return the position of an asset with a new name, also one of the `spare` ones; UNKNOWN if it is refused."""
        if is_blank(name):
            self.note(NO_ASSET, f"{self.plan.path.name}: asset {quoted(name)} is blank; name it in the source")
            return UNKNOWN
        if self._most is not None and len(self.names) >= self._most:
            place = None if spare is None else next(spare, None)
            if place is not None:
                self.names[place] = name
                self._places[name] = place
                return place
            rule = f"is beyond {self._most}" if self._given is None else "is not among assets"
            self.note(NO_ASSET, f"{self.plan.path.name}: asset {quoted(name)} {rule}; add it to assets")
            return UNKNOWN
        if len(self.names) == len(self.fleet.assets):
            with self._lock:
                self.fleet.extend(len(self.names))
            self._last, self._heard = (
                np.concatenate([column, np.full(column.size, BEFORE)]) for column in (self._last, self._heard)
            )
            if self._guard is not None:
                self._guard.extend(self._last.size)
        place = self._places[name] = len(self.names)
        self.names.append(name)
        self._unused = self._unused or self.fleet.state(slice(place, place + 1))
        return place

    def _query(self, period: int) -> None:
        """Show the assets that have been silent for long as of now, if the last look is `period` ns ago.

        For a live source, now is each asset's last time plus the time since its arrival: the clocks of assets may
        differ.
        """
        live = self.source.live
        now = self.clock() if live else self.source.now()
        now = self._newest if now is None else now
        if now == BEFORE or now - self._looked < period:
            return
        self._looked = now
        present = self._last + (now - self._heard) if live else np.full(self._last.size, now)
        silent = np.flatnonzero((self._last > BEFORE) & (present - self._last > self._silence))
        if silent.size:
            with self._lock:
                self._silent.query(silent, present[silent])
                self.version += 1

    def _identity(self) -> JsonObject:
        """Return what a store must have been written with."""
        plan, model, given = self.plan, self.plan.twin.model, self.plan.config.assets
        names = [model.name, *model.state_names, *model.row_names, *(given if isinstance(given, tuple) else ())]
        tuning = tuning_to_json(plan.twin.tuning, plan.twin.estimator)
        known = {"version": version("nisus"), "tuning": tuning}
        own = {"late": plan.config.late, "values": {k: repr(v.tolist()) for k, v in plan.values.columns.items()}}
        return known | {"policy": [*plan.twin.policy], "names of": names} | own

    def _keep(self, at_once: bool = False) -> None:
        """Write what has changed to the store, with the position in the source; all events are folded."""
        begun, source = time.monotonic(), self.source
        if self.file is None or self._unwritten:  # rather than wait in memory for as long as that lasts
            self._hand_over()
        if self.file is None:
            return
        urgent = at_once or self._asked
        if isinstance(source, Acknowledging):
            urgent = urgent or source.unacknowledged > MAX_UNACKNOWLEDGED
        urgent = at_once if self._unwritten else urgent
        mark = source.mark if isinstance(source, Marked) else 0
        if (begun < self._due and not urgent) or (mark == self._kept and not self._changed and not at_once):
            return
        self._asked = False
        state = self._identity() | {"newest": self._newest, "counts": self.counts, "names": self.names}
        state["once"] = [*self._once]
        state["source"] = source.numbers(mark) if isinstance(source, Marked) else {}
        blocks: dict[tuple[str, int], bytes] = {}
        for number in sorted(self._changed):
            part = slice(number * BLOCK, min(len(self.names), (number + 1) * BLOCK))
            blocks["assets", number] = self._silent.state(part)
            blocks["last", number] = np.concatenate((self._last[part], self._heard[part])).tobytes()
        rows, self._unarchived = self._unarchived, []
        try:
            # Before: a kill loses no row that the store has. Messages that it has not come again.
            with nullcontext(self.archived) if self.archive is None else self.archive.written(rows) as state["archive"]:
                self.file.write_blocks(blocks | {("state", 0): json.dumps(state).encode()})
        except SourceError as error:
            if at_once:
                raise
            if not self._unwritten:
                self.note(STORE, f"{error}; the fleet goes on without it, and tries again")
            self._unwritten, self._due = True, begun + RETRY_PERIOD_S
            return
        if self._unwritten:
            self._unwritten = False
            self._report(STORE, f"store {self.file.path}: it is written again")
        self._changed.clear()
        self._kept = mark
        if isinstance(source, Acknowledging):
            source.acknowledge()
        self._due = begun + max(STORE_PERIOD_S, (time.monotonic() - begun) / STORE_SHARE)

    def _hand_over(self) -> None:
        """Pass the events to the archive, without the store."""
        if self.archive is not None:
            for at, events in self._unarchived:
                self.archive.append(at, events)
            self._unarchived.clear()

    def _continue(self, store: Store) -> None:
        blocks = store.read_blocks("state", "assets", "last")
        state: JsonObject = json.loads(blocks.get(("state", 0), b"{}"))
        if state:
            for key, value in self._identity().items():
                if state.get(key) != value:
                    what = "another " + ("version of Nisus" if key == "version" else "model, tuning or assets")
                    raise SourceError(f"store {store.path}: was written with {what}; remove it, or choose another path")
            for name in state["names"]:
                self._place(name)
            for (kind, number), data in blocks.items():
                if kind == "assets":
                    self._silent.restore(number * BLOCK, data)
                elif kind == "last":
                    last, heard = np.frombuffer(data, np.int64).reshape(2, -1)
                    part = slice(number * BLOCK, number * BLOCK + last.size)
                    self._last[part], self._heard[part] = last, heard
            if self._guard is not None:
                at = np.flatnonzero(self._last > BEFORE)
                self._guard.continue_from(at, self._last[at], self._heard[at])
            self._newest, self.archived = state["newest"], state.get("archive")
            self._once = dict.fromkeys(state.get("once", ()))
            self.counts.update(state["counts"])
        if isinstance(self.source, Marked):
            self.source.restore(state.get("source", {}))

    def _fold(self) -> None:
        if self._pending:
            passed, self._passed = self._passed, []
            assets = np.unique(np.concatenate([item[0] for item in passed])) if passed else np.zeros(0, np.int64)
            with self._lock:
                before = self.fleet.stale[assets]
                self.fleet.advance()
                dropped = self.fleet.stale[assets] - before
                self._pending = 0
                self.version += 1
            if isinstance(self.source, Messages):
                self._tell(self.source.mark, passed, dict(zip(assets.tolist(), dropped.tolist(), strict=True)))

    def _tell(self, mark: int, passed: Sequence[Passing], dropped: Mapping[int, int]) -> None:
        """Note what became of messages; `dropped` are the events of each asset that were too old."""
        events = Events.concat([item.events for item in passed], self.plan.twin.model.width)
        none = np.zeros(0, np.int64)
        at = np.concatenate([none, *(item.at for item in passed)])
        late = np.concatenate([none, *(item.late for item in passed)]).astype(np.bool_)
        stale = np.zeros(at.size, np.bool_)
        for asset, count in dropped.items():  # of those that are folded at once the oldest
            own = np.flatnonzero(at == asset) if count else none
            stale[own[np.argsort(events.t[own], kind="stable")[:count]]] = True
        guard = self._guard
        waiting, back = (none, 0) if guard is None else (guard.waiting, guard.set_back)
        self.outcomes.note(mark, events, events.arrival - back, waiting, late, stale)

    def _dated(self, table: FleetTable) -> FleetTable:
        """Date the health of silent assets by their silence: their state is put back before each query."""
        silent, policy = self._silent.places, self.plan.twin.policy
        by_query = silent[table.since[silent] == table.seconds[silent]]
        limit = np.where(table.health[by_query] == STALE, policy.stale_after, policy.degraded_after)
        table.since[by_query] = np.minimum(self._last[by_query] * 1e-9 + limit, table.seconds[by_query])
        return table

    def find(self, name: str) -> str | None:
        """Return the name of an asset if there is one of that name; from any thread."""
        return name if name in self._places else None

    def table(self) -> tuple[int, list[str], FleetTable]:
        """Return the version, the names, and the table of all assets; from any thread."""
        with self._lock:
            if self._shown is None or self._shown[0] != self.version:
                self._shown = self.version, self._dated(self.fleet.table())
            version, table = self._shown
            names = self.names[:]
        count = len(names)
        return version, names, FleetTable(names, *(column[:count] for column in table[1:]))
