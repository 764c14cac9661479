"""Snapshots of a fold: where it can go back to, and where one begins whose oldest events were dropped."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .track import Track

EVERY, LATELY = 64, 1024
"""Events between snapshots of the last `LATELY` events, where late readings fall."""

WIDER_EVERY, RECENT = 256, 4096
"""The same of the last `RECENT`: the later a reading, the less a few events more count beside those behind it."""

SPARSE_EVERY = 1024
"""Events between the snapshots kept for ever."""

MEMORY = 256 * 2**20
"""Bytes that the snapshots of a fold may take, half for the recent ones; large states are kept at wider steps."""

PINNED = 64
"""Snapshots behind a decision that changed the state: the events before it do not lead to it by themselves."""


class Base(NamedTuple):
    """Where a fold starts whose log has lost its oldest events: clock, inputs, and what the dropped events left.

    mean (nx,) and cov (nx, nx), or the variances (1, nx) of a large state, stand for it in any filter. `state` is all
    that the filter `estimator` had (modes, members, particles, what an adaptation learned), for that filter alone.
    `first` is the absolute index of the first event that is folded from here. `evidence` is what had been gathered
    against the filter, `doubt` what is remembered of sensors that were refused, for the same filter; `edge` what the
    screen remembers of the sensors, for any. `version` is the model's there (events/maintenance.py).
    """

    mean: np.ndarray
    cov: np.ndarray
    clock: int
    u: np.ndarray
    estimator: str = ""
    state: np.ndarray | None = None
    first: int = 0
    evidence: np.ndarray | None = None
    edge: np.ndarray | None = None
    version: int = 1
    doubt: np.ndarray | None = None


class Snapshot(NamedTuple):
    """What a fold goes on from before an event.

    Clock (1,) in ns, inputs (nu,), state of the filter, evidence against it, state of the screen, doubts of the
    sensors.
    """

    clock: np.ndarray
    u: np.ndarray
    state: np.ndarray
    evidence: np.ndarray
    edge: np.ndarray
    doubt: np.ndarray

    def copy(self) -> Snapshot:
        """Another one, which does not change with this."""
        return Snapshot(*(part.copy() for part in self))

    def put(self, other: Snapshot) -> None:
        """Take over what another one holds."""
        for mine, its in zip(self, other, strict=True):
            mine[:] = its


class Story(NamedTuple):
    """Events folded apart: their track, where that ended, and by how much each state was widened before (nx,)."""

    track: Track
    end: Snapshot
    widened: np.ndarray


class Snapshots:
    """Snapshots by the absolute index of the event before which they were taken: the denser the later they are."""

    def __init__(self, nbytes: int) -> None:
        """`nbytes`: of one state. At least one old snapshot, the start, and a recent one are kept, however large."""
        self._most = max(1, MEMORY // 2 // nbytes)
        self._every = EVERY
        while RECENT // self._every > self._most:
            self._every *= 2
        self._sparse = max(SPARSE_EVERY, self._every)
        self._wider = max(min(WIDER_EVERY, self._sparse), self._every)
        self._kept: dict[int, Snapshot] = {}
        self._pinned: list[int] = []

    @property
    def every(self) -> int:
        """Events between two of the latest: how far a reading that is a little late takes a fold back at worst."""
        return self._every

    @property
    def places(self) -> list[int]:
        """The absolute indices of the events before which they were taken, in order."""
        return sorted(self._kept)

    def __contains__(self, at: int) -> bool:
        """Whether there is one before the event at an absolute index."""
        return at in self._kept

    def __getitem__(self, at: int) -> Snapshot:
        """The one before the event at an absolute index."""
        return self._kept[at]

    def next_stop(self, at: int, end: int) -> int:
        """The absolute index, after `at`, at which a fold on its way to `end` should take the next one."""
        # Before the end, only the snapshots that are kept there are worth stopping for.
        zones = (0, self._sparse), (end - RECENT, self._wider), (end - LATELY, self._every)
        return min(-(-max(at + 1, begin) // stride) * stride for begin, stride in zones)

    def keep(self, at: int, first: int, snapshot: Snapshot, pinned: bool = False) -> None:
        """Keep one; drop what is too close to others for its age. `first`: absolute index of the log's first event."""
        self._kept[at] = snapshot
        if pinned:
            self._pinned = [key for key in (*self._pinned, at) if key in self._kept][-min(PINNED, self._most) :]
        for old, stride in ((at - LATELY, self._wider), (at - RECENT, self._sparse)):
            if old % stride and old in self._kept and old != first and old not in self._pinned:
                del self._kept[old]
        for_ever = [key for key in self._kept if key <= at - RECENT and key not in self._pinned]
        if len(for_ever) > self._most + 1:
            self._sparse *= 2
            for key in for_ever:
                if key % self._sparse and key != first:
                    del self._kept[key]

    def last(self, at: int) -> int:
        """The absolute index of the last one at or before `at`."""
        return max(key for key in self._kept if key <= at)

    def forget_after(self, at: int) -> None:
        """Drop those after `at`: their events will be folded again."""
        for key in [key for key in self._kept if key > at]:
            del self._kept[key]

    def forget_before(self, at: int) -> None:
        """Drop those before `at`: their events are gone."""
        for key in [key for key in self._kept if key < at]:
            del self._kept[key]
