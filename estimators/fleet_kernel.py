"""The compiled part of `Fleet`: folds the new events of all assets on all cores, in place.

Each asset has a block of memory. A thread folds the events of a share of the assets one by one, with the same functions
as a single fold, so the results are the same bits. These are copied into the thread's loop: handing over their
arguments once per asset takes three times as long as an event.
"""

from __future__ import annotations

import numpy as np
from numba import from_dtype, prange
from numba.extending import intrinsic

from .compiled.context import _FIELDS as CONTEXT_FIELDS
from .compiled.context import context_at
from .diagnostics.detector_watch import watch_row
from .diagnostics.health import NORMALS, Bounds, HealthPolicy, judges, keep_window
from .estimator import Code
from .fleet_window import FLAGS, HEALTH, STALE_EVENTS, VERDICT, N, has_no_baseline, return_to, slide
from .fold_kernel import fold_event
from .gate.rejection_runs import Rule
from .log import _ORDER
from .numerics.jit import counts, embedded, flag_rows, flags, floats, i64, ints, jit, masks, matrix, part
from .numerics.workspace import declare_layout
from .track import WHITENED, Track

T, AGE, NIS_MEAN, NIS_LOW, NIS_HIGH, CONSISTENCY = range(6)
"""Columns of `State.last`, of the last row: time (int64, ns) and the columns of the track of that name."""

State, state_at = declare_layout(
    "State", "nu, state, evidence, edge, sensors",
    clock="int 1", u="nu", filter="state", evidence="evidence", edge="edge", doubt="sensors, 8", last="6",
)  # fmt: skip
"""State of an asset's fold before an event; the first fields are those of `Snapshot`."""

Block, block_at = declare_layout(
    "Block", "size, kept, recent, columns, nx",
    head="int 9", mean="nx", std="nx", now="size", snapshots="2, size", codes="int kept", nis="kept", t="int recent",
    place="int recent", value="recent, columns",
)  # fmt: skip
"""Memory of an asset: head (fleet_window.py), last estimate, state, two snapshots, judged measurements (`codes` and
`nis`), and the recent events as time, place in the order of a log, and values."""

_PLAN = """
    memory stride visited starts count t place value tunings contexts r crews crew_places start predict
    update describe soft never nx nu state evidence edge sensors rows ny width work window kept recent columns size
    low high quantiles
    degraded_after stale_after diverged_nis diverged_gated false_alarm_every silent_periods
""".split()
PLAN = np.dtype([(name, np.float64 if k > _PLAN.index("quantiles") else np.int64) for k, name in enumerate(_PLAN)])
"""What the call reads: addresses and sizes; the last are limits of `HealthPolicy`."""

CREW = (*Track._fields, "context", "r", "spare", "work", "score", "events_t", "kind", "channel", "events_value",
        "passed", "variances", "terms", "tail_t", "tail_place", "tail_value")  # fmt: skip
"""Scratch of a thread, as addresses."""

(_CONTEXT, _R, _SPARE, _WORK, _SCORE, _T, _KIND, _CHANNEL, _VALUE, _PASSED, _VARIANCES, _TERMS, _TAIL_T, _TAIL_PLACE,
 _TAIL_VALUE) = range(len(Track._fields), len(CREW))  # fmt: skip
_CONTEXT_WORDS, _AT_R = len(CONTEXT_FIELDS), CONTEXT_FIELDS.index("r")
_KINDS = np.array(_ORDER, np.int8)

ROWS = 2
"""Rows of a thread's track: the last event of the asset, and the new one."""

_plan_type = from_dtype(PLAN)


@intrinsic
def _plan_at(typing_context, place):
    """Return the plan at an address."""

    def codegen(lowering, builder, signature, given):
        return builder.inttoptr(given[0], lowering.get_value_type(_plan_type))

    return _plan_type(i64), codegen


@embedded
def _track_at(own, rows, nx, ny, width):
    """Return the track of a thread."""
    return Track(
        matrix(floats(own[0], rows * nx), 0, rows, nx),
        matrix(floats(own[1], rows * nx), 0, rows, nx),
        matrix(floats(own[2], 0), 0, rows, 0),
        matrix(floats(own[3], rows * ny), 0, rows, ny),
        matrix(floats(own[4], rows * ny), 0, rows, ny),
        floats(own[5], rows),
        floats(own[6], rows),
        counts(own[7], rows),
        flags(own[8], rows),
        floats(own[9], rows),
        floats(own[10], rows),
        floats(own[11], rows),
        floats(own[12], rows),
        flags(own[13], rows),
        flags(own[14], rows),
        matrix(floats(own[15], rows * ny), 0, rows, ny),
        masks(own[16], rows, width),
        ints(own[17], rows),
        flag_rows(own[18], rows, ny),
        floats(own[19], rows),
        floats(own[20], rows),
    )


@embedded
def _precedes(t, place, value, other_t, other_place, other):
    """Return whether an event comes before another in the order of a log (`sorted_order`)."""
    if t != other_t:
        return t < other_t
    if place != other_place:
        return place < other_place
    for k in range(value.size):
        if value[k] < other[k] or np.isnan(other[k]) and not np.isnan(value[k]):
            return True
        if value[k] > other[k] or np.isnan(value[k]) and not np.isnan(other[k]):
            return False
    return False


@embedded
def _copy(source, target):
    for k in range(source.size):
        target[k] = source[k]


@embedded
def _precedes_last(k, t, place, value, block, n):
    """Return whether event k comes before event n - 1 of an asset."""
    at = (n - 1) % block.t.size
    return _precedes(t[k], place[k], value[k], block.t[at], block.place[at], block.value[at])


@part
def _rewind(block, e, stop, t, place, value, recent, window, tail_t, tail_place, tail_value):
    """Return to a snapshot before new events e to `stop`; return the first to fold, and the length of the tail.

    The tail holds the events after the snapshot. Events before the oldest snapshot are counted as stale. There is a
    snapshot before every `recent`-th event, and the last two are kept.
    """
    n = block.head[N]
    ring = block.t.size
    newer = max(0, (n - 1) // recent * recent)
    older = max(0, newer - recent)
    while older > 0 and e < stop and _precedes_last(e, t, place, value, block, older):
        block.head[STALE_EVENTS] += 1
        e += 1
    if e == stop:
        return e, 0
    i = n
    while i > older and _precedes_last(e, t, place, value, block, i):
        i -= 1
    if i == n:
        return e, 0
    at = newer if i >= newer else older
    _copy(block.snapshots[at // recent % 2], block.now)
    for k in range(at, n):
        tail_t[k - at], tail_place[k - at] = block.t[k % ring], block.place[k % ring]
        _copy(block.value[k % ring], tail_value[k - at])
    return_to(at, block, window)
    block.head[N] = at
    return e, n - at


@jit
def _fold_share(place, crew):
    """Fold the new events of one thread's share of the assets."""
    plan = _plan_at(place)
    own = ints(plan.crew_places + 8 * crew * len(CREW), len(CREW))
    columns, recent = plan.columns, plan.recent
    track = _track_at(own, ROWS, plan.nx, plan.ny, plan.width)
    own_t, kind, channel = ints(own[_T], ROWS), flags(own[_KIND], ROWS), counts(own[_CHANNEL], ROWS)
    own_value = matrix(floats(own[_VALUE], ROWS * columns), 0, ROWS, columns)
    passed, variances = floats(own[_PASSED], columns), floats(own[_VARIANCES], 0)
    terms = matrix(floats(own[_TERMS], (1 + NORMALS) * plan.kept), 0, 1 + NORMALS, plan.kept)
    # One more than may be folded again: a late event that precedes it is stale.
    ring = 2 * recent + 1
    tail_t, tail_place = ints(own[_TAIL_T], ring), ints(own[_TAIL_PLACE], ring)
    tail_value = matrix(floats(own[_TAIL_VALUE], ring * columns), 0, ring, columns)
    spare, work, score = (
        floats(own[_SPARE], plan.state),
        floats(own[_WORK], plan.work),
        floats(own[_SCORE], WHITENED + plan.ny),
    )
    code = Code(plan.start, plan.predict, plan.update, plan.describe)
    rule = Rule(plan.soft, plan.never)
    policy = HealthPolicy(
        plan.window, plan.degraded_after, plan.stale_after, plan.diverged_nis, plan.diverged_gated,
        plan.false_alarm_every, plan.silent_periods,
    )  # fmt: skip
    bounds = Bounds(floats(plan.low, plan.quantiles), floats(plan.high, plan.quantiles))
    visited, starts = ints(plan.visited, plan.count), ints(plan.starts, plan.count + 1)
    total = starts[plan.count]
    t, event_place = ints(plan.t, total), ints(plan.place, total)
    value = matrix(floats(plan.value, total * columns), 0, total, columns)
    words = ints(own[_CONTEXT], _CONTEXT_WORDS)
    context = context_at(own[_CONTEXT])
    normal, white, loaded = floats(0, 0), False, -1
    for v in range(crew * plan.count // plan.crews, (crew + 1) * plan.count // plan.crews):
        asset = visited[v]
        tuning = counts(plan.tunings + 4 * asset, 1)[0]
        if tuning != loaded:
            # A copy: a soft gate writes R while a measurement is folded. Scratch may keep F of the other parameters.
            loaded = tuning
            work[:] = np.nan
            _copy(ints(plan.contexts + 8 * tuning * _CONTEXT_WORDS, _CONTEXT_WORDS), words)
            _copy(floats(words[_AT_R], plan.rows), floats(own[_R], plan.rows))
            words[_AT_R] = own[_R]
            normal = floats(context.normal, NORMALS * plan.sensors)
            white = has_no_baseline(normal)
        block = block_at(plan.memory + asset * plan.stride, plan.size, plan.kept, ring, columns, plan.nx)
        now = state_at(block.now.ctypes.data, plan.nu, plan.state, plan.evidence, plan.edge, plan.sensors)
        head, last = block.head, now.last
        last_t = ints(last.ctypes.data, 1)
        e, stop, a, tail = starts[v], starts[v + 1], 0, 0
        if head[N] > 0 and _precedes_last(e, t, event_place, value, block, head[N]):
            e, tail = _rewind(
                block, e, stop, t, event_place, value, recent, plan.window, tail_t, tail_place, tail_value
            )
        if e == stop:
            continue
        while a < tail or e < stop:
            n = head[N]
            if n % recent == 0:
                _copy(block.now, block.snapshots[n // recent % 2])
            at = n % ring
            if a < tail and (
                e == stop or not _precedes(t[e], event_place[e], value[e], tail_t[a], tail_place[a], tail_value[a])
            ):
                block.t[at], block.place[at] = tail_t[a], tail_place[a]
                _copy(tail_value[a], block.value[at])
                a += 1
            else:
                block.t[at], block.place[at] = t[e], event_place[e]
                _copy(value[e], block.value[at])
                e += 1
            own_t[1] = block.t[at]
            kind[1] = _KINDS[block.place[at] >> 32]
            channel[1] = block.place[at] & 0xFFFFFFFF
            _copy(block.value[at], own_value[1])
            fold_event(
                code, context, rule, 1, n, 1, own_t, kind, channel, own_value, columns,
                now.clock, now.u, now.filter, now.doubt, now.edge, spare, work, score, track, variances, passed,
            )  # fmt: skip
            if judges(track.verdict[1]):
                slide(1, n, channel[1], block, normal, white, policy, bounds, terms, track)
            else:
                own_t[0] = last_t[0] if n > 0 else own_t[1]
                track.age[0], track.consistency[0] = last[AGE], int(last[CONSISTENCY])
                track.nis_mean[0], track.nis_low[0], track.nis_high[0] = last[NIS_MEAN], last[NIS_LOW], last[NIS_HIGH]
                keep_window(1, own_t, track)
            watch_row(1, own_t, kind, channel, own_value, context, policy, now.evidence, track)
            last_t[0] = own_t[1]
            last[AGE], last[CONSISTENCY] = track.age[1], track.consistency[1]
            last[NIS_MEAN], last[NIS_LOW], last[NIS_HIGH] = track.nis_mean[1], track.nis_low[1], track.nis_high[1]
            head[HEALTH], head[FLAGS], head[VERDICT] = track.health[1], track.flags[1], track.verdict[1]
            head[N] = n + 1
        _copy(track.mean[1], block.mean)
        _copy(track.std[1], block.std)


@jit(parallel=True)
def _fold_on_threads(place, crews):
    for crew in prange(crews):
        _fold_share(place, crew)


@jit
def fold_assets(place, crews):
    """Fold the new events of all assets; the plan is at the address `place`."""
    if crews > 1:
        _fold_on_threads(place, crews)
    else:
        _fold_share(place, 0)


@jit
def in_asset_order(asset, t, place):
    """Return whether events are strictly ordered by asset, time and place."""
    for i in range(1, t.size):
        if asset[i] < asset[i - 1]:
            return False
        if asset[i] == asset[i - 1] and (t[i] < t[i - 1] or t[i] == t[i - 1] and place[i] <= place[i - 1]):
            return False
    return True
