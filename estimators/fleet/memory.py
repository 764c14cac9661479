"""Memory of a fleet: layout of an asset's block, and of the record of its events while a gate rejects a sensor."""

from __future__ import annotations

from ..numerics.workspace import declare_layout

N, JUDGED, IN_WINDOW, USED_IN_WINDOW, DOF, STALE_EVENTS, HEALTH, FLAGS, VERDICT, PHASE = range(10)
"""Columns of `Block.head`: events folded; judged measurements ever, of which the last are kept; those in the window,
those of them that were used, and the degrees of freedom of these; events dropped as stale; then health, flags and
verdict of the last event; events by which the asset's snapshots come early, so that not all assets take theirs at
once."""

T, SINCE, AGE, NIS_MEAN, NIS_LOW, NIS_HIGH, CONSISTENCY, GRADE = range(8)
"""Columns of `State.last`, of the last row: its time and that from which on health is as it is there (int64, ns), the
columns of the track of that name, and health."""

State, state_at = declare_layout(
    "State", "nu, state, evidence, edge, sensors",
    clock="int 1", u="nu", filter="state", evidence="evidence", edge="edge", doubt="sensors, 8", last="8",
)  # fmt: skip
"""State of an asset's fold before an event; the first fields are those of `Snapshot`."""

Block, block_at = declare_layout(
    "Block", "size, kept, ring, slots, columns, nx",
    head="int 10", mean="nx", std="nx", now="size", nis="kept", codes="int kept", t="int ring", place="int ring",
    value="ring, columns", snapshots="slots, size",
)  # fmt: skip
"""Memory of an asset: head, last estimate, state, judged measurements (`nis` and `codes`), the recent events as time,
place in the order of a log, and values, and two snapshots, or none where late events are dropped."""

FIRST, PINNED, ASKED, TAIL, FLOOR, NEXT, LAST, REWOUND = range(8)
"""Columns of `Record.head`: number of its first event; event after the last decision that changed the state, and after
the last decision; late events that are yet to be folded again, and event of the block's oldest snapshot meanwhile;
snapshots ever taken, and event of the last; event to which the asset was rewound, -1 for none."""

Record, record_at = declare_layout(
    "Record", "size, slots, ring, rows, columns",
    head="int 8", at="int slots", snapshots="slots, size", tail_t="int ring", tail_place="int ring",
    tail_value="ring, columns", t="int rows", place="int rows", value="rows, columns",
)  # fmt: skip
"""Events of an asset of which a sensor is being rejected, as far back as a decision on it compares (gate/isolation.py),
with snapshots before events `at`, -1 for none; and the rest of the late events where folding stopped for a decision."""
