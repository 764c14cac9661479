"""Snapshots, to which a fold can be rewound, and bases, at which a fold starts whose oldest events were dropped."""

from __future__ import annotations

from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from .track import Track

NEAR_SPACING, NEAR_EVENTS = 64, 1024
"""Events between snapshots of the last `NEAR_EVENTS` events, where late measurements fall."""

RECENT_SPACING, RECENT_EVENTS = 256, 4096
"""Events between snapshots of the last `RECENT_EVENTS` events, where few measurements fall back to."""

PERMANENT_SPACING = 1024
"""Events between the snapshots that are never dropped."""

MAX_SNAPSHOT_BYTES = 256 * 2**20
"""Bytes for the snapshots of a fold, half for the recent ones; snapshots of large states are farther apart."""

MAX_PINNED_SNAPSHOTS = 64
"""Snapshots kept after decisions that changed the state, as folding the events before does not reproduce these."""


class Base(NamedTuple):
    """Start of a fold whose log has dropped its oldest events.

    mean (nx,) and cov (nx, nx), or the variances (1, nx) of a large state, start any filter. `state` is the full state
    of the filter `estimator` (modes, members, particles, adapted variances), and of use to that filter only; so are
    `evidence`, the state of the detectors, and `doubt`, the record of rejected sensors. `edge` is the state of the
    screen. `clock` (ns) and `u` (nu,) are time and inputs, `first` the absolute index of the first event that is folded
    from here, `version` the version of the model there (events/maintenance.py).
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
    """State of a fold before an event, in the order of `fold_kernel.remember`.

    Clock (1,) in ns, inputs (nu,), state of the filter, of the detectors and of the screen, record of rejected sensors.
    """

    clock: np.ndarray
    u: np.ndarray
    state: np.ndarray
    evidence: np.ndarray
    edge: np.ndarray
    doubt: np.ndarray

    def copy(self) -> Snapshot:
        """Return an independent copy."""
        return Snapshot(*(part.copy() for part in self))

    def blank(self) -> tuple[Snapshot, int]:
        """Return a snapshot of the same sizes for `fold_kernel.remember` to fill, and the address of its memory."""
        _, u, state, evidence, edge, doubt = (part.size for part in self)
        ends = list(accumulate((1, u, state, evidence, edge, doubt)))
        block = np.empty(ends[-1])
        parts = [block[begin:end] for begin, end in pairwise(ends)]
        parts[-1] = parts[-1].reshape(self.doubt.shape)
        return Snapshot(block[:1].view(np.int64), *parts), block.ctypes.data

    def copy_from(self, other: Snapshot, parts: int = 6) -> None:
        """Copy the numbers of another snapshot into this one; its first three `parts` are nothing of the detectors."""
        for mine, its in zip(self[:parts], other[:parts], strict=True):
            mine[:] = its


Blank = tuple[int, Snapshot, int]
"""Row of the event before which a snapshot is to be taken, the snapshot, and the address of its memory."""


class Story(NamedTuple):
    """Events folded separately: track, snapshot at the end, and by how much each state was widened before (nx,)."""

    track: Track
    end: Snapshot
    widened: np.ndarray


class Snapshots:
    """Snapshots by the absolute index of the event that follows; the older, the farther apart."""

    def __init__(self, nbytes: int) -> None:
        """Plan for states of `nbytes` bytes. The start, an old and a recent snapshot are kept, however large."""
        self._most = max(1, MAX_SNAPSHOT_BYTES // 2 // nbytes)
        self.every = NEAR_SPACING
        """Events between two of the latest: how far a slightly late measurement takes the fold back at most."""
        while RECENT_EVENTS // self.every > self._most:
            self.every *= 2
        self._sparse = max(PERMANENT_SPACING, self.every)
        self._wider = max(min(RECENT_SPACING, self._sparse), self.every)
        self._kept: dict[int, Snapshot] = {}
        self._pinned: list[int] = []

    @property
    def places(self) -> list[int]:
        """Absolute indices of the events that follow the snapshots, ascending."""
        return sorted(self._kept)

    def __contains__(self, at: int) -> bool:
        """Return whether there is a snapshot before the event at an absolute index."""
        return at in self._kept

    def __getitem__(self, at: int) -> Snapshot:
        """Return the snapshot before the event at an absolute index."""
        return self._kept[at]

    def next_stop(self, at: int, end: int) -> int:
        """Return the absolute index after `at` at which a fold that goes on to `end` takes the next snapshot."""
        # Stop only for snapshots that are still kept once the fold has reached the end.
        recent, near = max(at + 1, end - RECENT_EVENTS), max(at + 1, end - NEAR_EVENTS)
        sparse, wider, every = self._sparse, self._wider, self.every
        return min(-(-(at + 1) // sparse) * sparse, -(-recent // wider) * wider, -(-near // every) * every)

    def stops(self, at: int, end: int) -> list[int]:
        """Return the next stops that one call may take together: the first, and others within `PERMANENT_SPACING`."""
        found = [self.next_stop(at, end)]
        while found[-1] < end and (stop := self.next_stop(found[-1], end)) <= at + PERMANENT_SPACING:
            found.append(stop)
        return found

    def keep(self, at: int, first: int, snapshot: Snapshot, pinned: bool = False) -> None:
        """Keep a snapshot; drop those too close to others for their age. `first`: index of the log's first event."""
        self._kept[at] = snapshot
        if pinned:
            self._pinned = [key for key in (*self._pinned, at) if key in self._kept][
                -min(MAX_PINNED_SNAPSHOTS, self._most) :
            ]
        for old, stride in ((at - NEAR_EVENTS, self._wider), (at - RECENT_EVENTS, self._sparse)):
            if old % stride and old in self._kept and old != first and old not in self._pinned:
                del self._kept[old]
        for_ever = [key for key in self._kept if key <= at - RECENT_EVENTS and key not in self._pinned]
        if len(for_ever) > self._most + 1:
            self._sparse *= 2
            for key in for_ever:
                if key % self._sparse and key != first:
                    del self._kept[key]

    def last(self, at: int) -> int:
        """Return the absolute index of the last snapshot at or before `at`."""
        return max(key for key in self._kept if key <= at)

    def forget_after(self, at: int) -> None:
        """Drop the snapshots after `at`, whose events will be folded again."""
        self._kept = {key: kept for key, kept in self._kept.items() if key <= at}

    def forget_before(self, at: int) -> None:
        """Drop the snapshots before `at`, whose events have been dropped."""
        self._kept = {key: kept for key, kept in self._kept.items() if key >= at}
