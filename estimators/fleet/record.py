"""Record of an asset of which a sensor is being rejected, as compiled code keeps it.

A decision on a rejected sensor compares two folds since its first rejection (gate/isolation.py), which may be before
the oldest snapshot of the asset's block. Few assets need a record at one time, so records come from a pool: an asset
takes one when the snapshot before a first rejection would be overwritten or a decision is due, and returns it when no
decision can go back beyond the snapshots of the block.
"""

from __future__ import annotations

from ..gate.isolation import MAX_COMPARED_EVENTS
from ..gate.rejection_runs import RUN
from ..numerics.jit import embedded, ints, part
from ..numerics.linalg import copy_vector
from .memory import ASKED, FIRST, FLOOR, LAST, NEXT, PHASE, PINNED, REWOUND, N, record_at, state_at

SPACING = 256
"""Least number of events between two snapshots of a record, unless more than so many are recent."""

FREE = 64
"""Free records for each thread at the start of a call."""

MAX_FREE = 4096
"""Records that assets return to a thread at most before those are given to others."""


def record_sizes(recent: int) -> tuple[int, int]:
    """Return the numbers of snapshots and of events in a record."""
    spacing = max(SPACING, recent)
    rows = MAX_COMPARED_EVENTS + spacing + 4 * recent
    return rows // spacing + 2 + 2 * recent, rows


@embedded
def snapshots_of(head, n, recent):
    """Return the events before which there are the newer and the older snapshot of an asset of n events."""
    phase = head[PHASE]
    newer = max(0, (n - 1 + phase) // recent * recent - phase)
    return newer, max(0, newer - recent)


@embedded
def slot_of(head, event, recent):
    """Return the place in its block of the snapshot before an event."""
    return (event + head[PHASE]) // recent % 2


@part
def store(record, n, state):
    """Add a snapshot before event n."""
    head = record.head
    slot = head[NEXT] % record.at.size
    record.at[slot] = n
    copy_vector(state, record.snapshots[slot])
    head[NEXT] += 1
    head[LAST] = n


@part
def append(record, n, t, place, value):
    """Add event n."""
    k = (n - record.head[FIRST]) % record.t.size
    record.t[k], record.place[k] = t, place
    copy_vector(value, record.value[k])


@part
def allocate(asset, block, oldest, recent, records, free, slots, rows):
    """Give an asset a free record, with its events since the oldest snapshot of its block; return its address."""
    place = free[free[0]]
    free[0] -= 1
    records[asset] = place
    head, ring = block.head, block.t.size
    record = record_at(place, block.now.size, slots, ring, rows, block.value.shape[1])
    record.head[:] = 0
    record.head[FIRST] = record.head[FLOOR] = oldest
    record.head[REWOUND] = -1
    record.at[:] = -1
    store(record, oldest, block.snapshots[slot_of(head, oldest, recent)])
    for k in range(oldest, head[N]):
        append(record, k, block.t[k % ring], block.place[k % ring], block.value[k % ring])
    return place


@part
def cut(record, at):
    """Drop what follows from the events from `at` on, which are folded again."""
    head = record.head
    head[LAST] = 0
    for k in range(record.at.size):
        if record.at[k] > at:
            record.at[k] = -1
        head[LAST] = max(head[LAST], record.at[k])
    head[PINNED], head[ASKED] = min(head[PINNED], at), min(head[ASKED], at)
    head[REWOUND] = at if head[REWOUND] < 0 else min(head[REWOUND], at)


@part
def _rejects(state, nu, size, evidence, edge, sensors):
    """Return whether a sensor is in a run of rejections in a snapshot."""
    doubt = state_at(state.ctypes.data, nu, size, evidence, edge, sensors).doubt
    for s in range(sensors):
        if doubt[s, RUN] > 0.0:
            return True
    return False


@part
def before_snapshot(
    asset, block, oldest, newer, recent, records, free, slots, rows, nu, size, evidence, edge, sensors
):  # fmt: skip
    """Take or return the record of an asset before the oldest snapshot of its block is overwritten; return its address.

    `oldest` and `newer` are the events of the block's snapshots. Those of the record are farther apart.
    """
    head = block.head
    n, place = head[N], records[asset]
    needed = _rejects(block.snapshots[slot_of(head, newer, recent)], nu, size, evidence, edge, sensors)
    if place == 0:
        return allocate(asset, block, oldest, recent, records, free, slots, rows) if needed else place
    record = record_at(place, block.now.size, slots, block.t.size, rows, block.value.shape[1])
    own = record.head
    if not needed and newer >= max(own[PINNED], own[ASKED]) and own[REWOUND] < 0 and free[0] < MAX_FREE:
        free[0] += 1
        free[free[0]] = place
        records[asset] = 0
        return 0
    if n - own[LAST] >= max(SPACING, recent):
        store(record, n, block.now)
    return place


@embedded
def free_records(place, crew):
    """Return the free records of a thread: their number, then their addresses."""
    return ints(place + 8 * crew * (MAX_FREE + 1), MAX_FREE + 1)
