"""Decisions on the rejected sensors of a fleet's assets, from the records that compiled code keeps of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..fold_machine import Machine
from ..gate.isolation import MAX_COMPARED_EVENTS, MAX_DECISIONS, Decision, decide
from ..gate.rejection_runs import RUN, SINCE, fresh
from ..log import Events, Log
from ..model.state_space import StateSpaceModel
from ..numerics.workspace import WORD, size_of, view
from ..snapshots import Snapshot, Story
from ..track import Track
from .kernel import KINDS
from .memory import FIRST, LAST, NEXT, PINNED, REWOUND, N, Record, record_at
from .record import FREE, MAX_FREE, record_sizes


class AssetFold:
    """Fold of an asset since a snapshot of its record, as far as a decision needs it (`ReopeningFold`)."""

    def __init__(self, machine: Machine, now: Snapshot, begun: Snapshot, log: Log) -> None:
        """Fold the events of a log from the snapshot `begun` again; `now` is the state after them."""
        self.model: StateSpaceModel = machine.model
        self.log, self.gate_limits = log, machine.gate_limits
        self._machine, self._now, self._begun = machine, now, begun
        # Rows do not depend on the record of rejections, which would ask for decisions and end the loop.
        begun = begun.copy()._replace(doubt=fresh(len(self.model.sensors)))
        self.track: Track = machine.run_apart(log, 0, log.n, begun)[0]
        """Rows of the log."""

    def second_story(self, start: int, stop: int, sensor: int, *, every: bool = False) -> Story:
        """See `Fold.second_story`."""
        innovation = self.track.innovation[start]
        return self._machine.second_story(self.log, 0, self._begun, start, stop, sensor, innovation, every)

    def go_on_with(self, story: Story) -> None:
        """See `Fold.go_on_with`."""
        self._now.copy_from(story.end, 3)


class _Sizes(NamedTuple):
    """Sizes of a record: numbers in a state, snapshots, recent events, events, and values of an event."""

    size: int
    slots: int
    ring: int
    rows: int
    columns: int


class FleetGates:
    """Records of the assets with a rejected sensor, and the decisions on them."""

    def __init__(
        self, count: int, crews: int, recent: int, size: int, columns: int,
        snapshot: Callable[[np.ndarray], Snapshot],
    ) -> None:  # fmt: skip
        """Allocate the first records.

        Args:
            count: Assets.
            crews: Threads.
            recent: Events between two snapshots of an asset.
            size: Numbers in the state of an asset.
            columns: Values of an event.
            snapshot: Reads a snapshot from the numbers of a state, as views.
        """
        slots, rows = record_sizes(recent)
        self._sizes, self._snapshot = _Sizes(size, slots, 2 * recent + 1, rows, columns), snapshot
        self._words = size_of(record_at, *self._sizes)
        self.places = np.zeros(count, np.int64)
        """Address of the record of each asset, 0 for none, (assets,)."""
        self.free = np.zeros((crews, MAX_FREE + 1), np.int64)
        """Free records of each thread: their number, then their addresses."""
        self._records: dict[int, np.ndarray] = {}
        self._decisions: dict[int, list[Decision]] = {}
        self.refill()

    def extend(self, count: int) -> None:
        """Append assets without a record."""
        self.places = np.concatenate([self.places, np.zeros(count, np.int64)])

    def refill(self) -> None:
        """Give each thread enough free records for the next call."""
        if self.free[:, 0].min() >= FREE // 2:
            return
        left = [int(place) for line in self.free for place in line[1 : 1 + line[0]]]
        crews = len(self.free)
        if len(left) < FREE * crews:
            more = np.zeros((FREE * crews - len(left), self._words))
            left += [self._added(words) for words in more]
        for k, line in enumerate(self.free):
            mine = left[k::crews]
            line[0], line[1 : 1 + len(mine)] = len(mine), mine

    def _added(self, words: np.ndarray) -> int:
        self._records[words.ctypes.data] = words
        return int(words.ctypes.data)

    def _record(self, asset: int) -> Any:
        words = self._records[int(self.places[asset])]
        parts = record_at(0, *self._sizes)
        found = {name: view(part, words) for name, part in zip(Record._fields, parts, strict=True) if name != "end"}
        integers = ("head", "at", "tail_place", "tail_t", "t", "place")
        return Record(**{k: v.view(np.int64) if k in integers else v for k, v in found.items()}, end=0)

    def decisions(self, asset: int) -> list[Decision]:
        """Return the decisions on sensors of an asset, the latest `MAX_DECISIONS`."""
        return list(self._decisions.get(asset, ()))

    def rewound(self, asset: int) -> None:
        """Drop the decisions on events that were folded again."""
        head = self._record(asset).head
        kept = [each for each in self._decisions.get(asset, ()) if each.row < head[REWOUND]]
        if asset in self._decisions:
            self._decisions[asset] = kept
        head[REWOUND] = -1

    def decide(self, asset: int, head: np.ndarray, state: np.ndarray, machine: Machine) -> None:
        """Decide on the sensor of the last event of an asset.

        Args:
            asset: Position of the asset.
            head: Head of its block.
            state: Numbers of its state, which a decision changes.
            machine: Machine of its tuning.
        """
        record, now, n = self._record(asset), self._snapshot(state), int(head[N])
        sensor = int(record.place[(n - 1 - record.head[FIRST]) % self._sizes.rows] & 0xFFFFFFFF)
        own = now.doubt[sensor]
        since = n - 1 if own[RUN] == 0.0 else max(int(own[SINCE]), n - 1 - MAX_COMPARED_EVENTS)
        slot = int(np.argmax(np.where(record.at <= since, record.at, -1)))
        at = int(record.at[slot])
        log = self._log(record, at, n, machine.model)
        fold = AssetFold(machine, now, self._snapshot(record.snapshots[slot]), log)
        assert machine.tuning.reopen is not None
        decision, changed = decide(fold, n - 1 - at, now.doubt, machine.tuning.reopen)
        if decision is not None:
            self._decisions.setdefault(asset, []).append(decision)
            del self._decisions[asset][:-MAX_DECISIONS]
        if changed:
            slot = record.head[NEXT] % self._sizes.slots
            record.at[slot], record.snapshots[slot] = n, state
            record.head[NEXT] += 1
            record.head[LAST] = record.head[PINNED] = n

    def _log(self, record: Any, begin: int, end: int, model: StateSpaceModel) -> Log:
        """Return the events of a record from `begin` to `end`."""
        at = (np.arange(begin, end) - record.head[FIRST]) % self._sizes.rows
        t, place = record.t[at], record.place[at]
        value = np.full((end - begin, model.width), np.nan)
        used = min(model.width, self._sizes.columns)
        value[:, :used] = record.value[at, :used]
        log = Log(model.width, max(1, t.size))
        log.model, log.layout, log.first, log.floor = model, model.layout, begin, int(t[0])
        log.extend(Events(t, t, KINDS[place >> 32], (place & 0xFFFFFFFF).astype(np.int32), value))
        return log

    def state(self, first: int, last: int) -> list[bytes]:
        """Return the records of assets `first` to `last`, each after its asset's place among them."""
        found: list[bytes] = []
        for asset in (first + np.flatnonzero(self.places[first:last])).tolist():
            words = self._records[int(self.places[asset])]
            found.append(np.array([asset - first], np.int64).tobytes() + words.tobytes())
        return found

    def restore(self, first: int, count: int, state: bytes) -> bool:
        """Take over the `state` of the records of `count` assets from a position on; return whether it is one."""
        lines, rest = divmod(len(state), WORD * (1 + self._words))
        if rest:
            return False
        for asset in (first + np.flatnonzero(self.places[first : first + count])).tolist():
            del self._records[int(self.places[asset])]
            self.places[asset] = 0
        for line in np.frombuffer(state).reshape(lines, 1 + self._words):
            if not 0 <= int(line[:1].view(np.int64)[0]) < count:
                return False
            words = line[1:].copy()
            self.places[first + int(line[:1].view(np.int64)[0])] = self._added(words)
        return True
