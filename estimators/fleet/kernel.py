"""The compiled part of `Fleet`: folds the new events of all assets on all cores, in place.

Each asset has a block of memory. A thread folds the events of a share of the assets one by one, with the same functions
as a single fold, so the results are the same bits. These are copied into the thread's loop: handing over their
arguments once per asset takes three times as long as an event.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import from_dtype, prange, types
from numba.core import cgutils
from numba.extending import intrinsic, register_jitable

from ..compiled.context import _FIELDS as CONTEXT_FIELDS
from ..compiled.context import context_at
from ..diagnostics.detector_watch import watch_row
from ..diagnostics.health import NORMALS, Bounds, HealthPolicy, judges, keep_window
from ..estimator import Code, call_start
from ..fold_kernel import fold_event
from ..gate.rejection_runs import Rule
from ..log import _ORDER
from ..numerics.jit import borrowed, counts, embedded, flag_rows, flags, floats, ints, jit, masks, matrix, part, pointer
from ..numerics.linalg import copy_vector
from ..track import WHITENED, Track, track_type
from .memory import (
    AGE,
    ASKED,
    CONSISTENCY,
    FLAGS,
    FLOOR,
    GRADE,
    HEALTH,
    IN_WINDOW,
    JUDGED,
    NIS_HIGH,
    NIS_LOW,
    NIS_MEAN,
    PHASE,
    SINCE,
    STALE_EVENTS,
    TAIL,
    VERDICT,
    N,
    T,
    block_at,
    record_at,
    state_at,
)
from .order import precedes
from .record import allocate, append, before_snapshot, cut, free_records, slot_of, snapshots_of
from .window import has_no_baseline, return_to, slide

_PLAN = """
    memory stride visited begins ends unfinished asked count order t place value events tunings contexts rules crews
    crew_places records free start predict update describe nx nu state evidence edge sensors rows ny width work window
    corrections kept recent columns size slots hot record_slots record_rows low high quantiles
    degraded_after stale_after diverged_nis diverged_gated false_alarm_every silent_periods
""".split()
PLAN = np.dtype([(name, np.float64 if k > _PLAN.index("quantiles") else np.int64) for k, name in enumerate(_PLAN)])
"""Fields that the call reads: addresses and sizes; the last are limits of `HealthPolicy`."""

CREW = (*Track._fields, "context", "r", "spare", "work", "score", "events_t", "kind", "channel", "events_value",
        "passed", "variances", "terms", "tail_t", "tail_place", "tail_value")  # fmt: skip
"""Scratch of a thread, as addresses."""

(_CONTEXT, _R, _SPARE, _WORK, _SCORE, _T, _KIND, _CHANNEL, _VALUE, _PASSED, _VARIANCES, _TERMS, _TAIL_T, _TAIL_PLACE,
 _TAIL_VALUE) = range(len(Track._fields), len(CREW))  # fmt: skip
_CONTEXT_WORDS, _AT_R = len(CONTEXT_FIELDS), CONTEXT_FIELDS.index("r")
KINDS = np.array(_ORDER, np.int8)

ASKED_FLAG, REWOUND_FLAG = 1, 2
"""Bits of `asked`: the asset's last event asks for a decision on its sensor; an asset with a record was rewound."""

ROWS = 2
"""Rows of a thread's track: the last event of the asset, and the new one."""

_plan_type = from_dtype(PLAN)


_plan_at = pointer(_plan_type)


_TAKE = {
    "float64, 1": "floats(own[{}], rows)",
    "int64, 1": "ints(own[{}], rows)",
    "int8, 1": "flags(own[{}], rows)",
    "int32, 1": "counts(own[{}], rows)",
    "float64, 2": "matrix(floats(own[{}], 0), 0, rows, {})",
    "int32, 2": "masks(own[{}], rows, {})",
    "int8, 2": "flag_rows(own[{}], rows, {})",
}
_widths = iter("nx nx 0 ny ny ny width ny nx".split())
_columns = ", ".join(
    _TAKE[f"{kind.dtype}, {kind.ndim}"].format(k, next(_widths) if kind.ndim == 2 else "")
    for k, kind in enumerate(track_type.types)
)
_named = {item.__name__: item for item in (Track, counts, flag_rows, flags, floats, ints, masks, matrix)}
_track_at = register_jitable(eval(f"lambda own, rows, nx, ny, width: Track({_columns})", _named))
"""Return the track of a thread, whose columns are at the addresses `own`."""


@intrinsic
def _prefetch_line(typing_context, place):
    """Ask for the cache line at an address, which will be written."""

    def codegen(lowering, builder, signature, given):
        word = ir.IntType(32)
        pointer = builder.inttoptr(given[0], ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, word, word, word])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [pointer, word(1), word(3), word(1)])
        return lowering.get_dummy_value()

    return types.void(types.int64), codegen


@embedded
def _prefetch(place, end):
    """Ask for the memory from an address to another: while it arrives, another asset is folded."""
    for at in range(place, end, 64):
        _prefetch_line(at)


@part
def _prefetch_slots(block, recent):
    """Ask for the slots of a block that its next event reads or writes; its head has arrived."""
    head = block.head
    n, at = head[N], head[N] % block.t.size
    _prefetch_line(block.t.ctypes.data + 8 * at)
    _prefetch_line(block.place.ctypes.data + 8 * at)
    _prefetch_line(block.value.ctypes.data + 8 * at * block.value.shape[1])
    kept = block.codes.size
    newest = head[JUDGED] % kept
    oldest = newest - head[IN_WINDOW]
    _prefetch_line(block.codes.ctypes.data + 8 * newest)
    _prefetch_line(block.codes.ctypes.data + 8 * (oldest if oldest >= 0 else oldest + kept))
    if recent > 0 and (n + head[PHASE]) % recent == 0:
        place = block.snapshots.ctypes.data + 8 * block.now.size * slot_of(head, n, recent)
        _prefetch(place, place + 8 * block.now.size)


@embedded
def _precedes_last(k, t, place, value, block, n):
    """Return whether event k comes before event n - 1 of an asset."""
    at = (n - 1) % block.t.size
    return precedes(t[k], place[k], value[k], block.t[at], block.place[at], block.value[at])


@part
def _rewind(block, e, stop, order, t, place, value, recent, window, tail_t, tail_place, tail_value):
    """Return to a snapshot before new events e to `stop`; return the first to fold, and the length of the tail.

    The tail holds the events after the snapshot. Events before the oldest snapshot are counted as stale. There is a
    snapshot before every `recent`-th event, and the last two are kept; none is where `recent` is 0.
    """
    n = block.head[N]
    ring = block.t.size
    newer, older = snapshots_of(block.head, n, recent) if recent > 0 else (n, n)
    while older > 0 and e < stop and _precedes_last(order[e], t, place, value, block, older):
        block.head[STALE_EVENTS] += 1
        e += 1
    if e == stop:
        return e, 0
    i = n
    while i > older and _precedes_last(order[e], t, place, value, block, i):
        i -= 1
    if i == n:
        return e, 0
    at = newer if i >= newer else older
    copy_vector(block.snapshots[slot_of(block.head, at, recent)], block.now)
    for k in range(at, n):
        tail_t[k - at], tail_place[k - at] = block.t[k % ring], block.place[k % ring]
        copy_vector(block.value[k % ring], tail_value[k - at])
    return_to(at, block, window)
    block.head[N] = at
    return e, n - at


@part
def _resume(record, tail_t, tail_place, tail_value):
    """Fetch the rest of the tail where folding stopped for a decision; return its length."""
    tail = record.head[TAIL]
    for k in range(tail):
        tail_t[k], tail_place[k] = record.tail_t[k], record.tail_place[k]
        copy_vector(record.tail_value[k], tail_value[k])
    record.head[TAIL] = 0
    return tail


@part
def _stop(record, n, oldest, a, tail, tail_t, tail_place, tail_value):
    """Keep the rest of the tail until the decision after event n - 1 has been taken."""
    record.head[ASKED] = n
    record.head[FLOOR] = oldest
    record.head[TAIL] = tail - a
    for k in range(a, tail):
        record.tail_t[k - a], record.tail_place[k - a] = tail_t[k], tail_place[k]
        copy_vector(tail_value[k], record.tail_value[k - a])


@jit
def _fold_share(place, crew):
    """Fold the new events of one thread's share of the assets.

    An asset stops after an event that asks for a decision on its sensor, and the share when no record is free for the
    next asset; another call folds the rest.
    """
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
    rule = Rule(0, 0)
    policy = HealthPolicy(
        plan.window, plan.degraded_after, plan.stale_after, plan.diverged_nis, plan.diverged_gated,
        plan.false_alarm_every, plan.silent_periods, plan.corrections,
    )  # fmt: skip
    bounds = Bounds(floats(plan.low, plan.quantiles), floats(plan.high, plan.quantiles))
    visited, unfinished, asked = (
        ints(plan.visited, plan.count), flags(plan.unfinished, plan.count), flags(plan.asked, plan.count)
    )  # fmt: skip
    begins, ends, order = ints(plan.begins, plan.count), ints(plan.ends, plan.count), ints(plan.order, plan.events)
    t, event_place = ints(plan.t, plan.events), ints(plan.place, plan.events)
    value = matrix(floats(plan.value, plan.events * columns), 0, plan.events, columns)
    reopens = plan.records != 0
    records = ints(plan.records, 0)
    free = free_records(plan.free, crew)
    slots, rows = plan.record_slots, plan.record_rows
    words = ints(own[_CONTEXT], _CONTEXT_WORDS)
    context = context_at(own[_CONTEXT])
    normal, white, loaded = floats(0, 0), False, -1
    last_of_share = (crew + 1) * plan.count // plan.crews
    for v in range(crew * plan.count // plan.crews, last_of_share):
        if reopens and free[0] == 0:
            break
        asset = visited[v]
        if v + 2 < last_of_share:
            following = plan.memory + visited[v + 2] * plan.stride
            _prefetch(following, following + plan.hot)
        if v + 1 < last_of_share:
            following = plan.memory + visited[v + 1] * plan.stride
            _prefetch_slots(block_at(following, plan.size, plan.kept, ring, plan.slots, columns, plan.nx), recent)
        tuning = counts(plan.tunings + 4 * asset, 1)[0]
        if tuning != loaded:
            # A copy: a soft gate writes R while a measurement is folded. Scratch may keep F of the other parameters.
            loaded = tuning
            work[:] = np.nan
            copy_vector(ints(plan.contexts + 8 * tuning * _CONTEXT_WORDS, _CONTEXT_WORDS), words)
            copy_vector(floats(words[_AT_R], plan.rows), floats(own[_R], plan.rows))
            words[_AT_R] = own[_R]
            normal = floats(context.normal, NORMALS * plan.sensors)
            rules = ints(plan.rules + 16 * tuning, 2)
            rule = Rule(rules[0], rules[1])
            white = has_no_baseline(normal)
        block = block_at(
            plan.memory + asset * plan.stride, plan.size, plan.kept, ring, plan.slots, columns, plan.nx
        )  # fmt: skip
        now = state_at(block.now.ctypes.data, plan.nu, plan.state, plan.evidence, plan.edge, plan.sensors)
        head, last = block.head, now.last
        times = ints(last.ctypes.data, 2)
        e, stop, a, tail = begins[v], ends[v], 0, 0
        record_place = records[asset] if reopens else 0
        record = record_at(record_place, plan.size, slots, ring, rows, columns)
        # Event of the block's oldest snapshot; while a tail is folded again, it does not follow from the event count.
        oldest = snapshots_of(head, head[N], recent)[1] if recent > 0 else 0
        if record_place != 0:
            tail = _resume(record, tail_t, tail_place, tail_value)
            oldest = record.head[FLOOR] if tail > 0 else oldest
        # The time of the last event is at hand; the event itself lies in memory that is rarely needed.
        if (
            tail == 0 and head[N] > 0 and t[order[e]] <= times[T]
            and _precedes_last(order[e], t, event_place, value, block, head[N])
        ):  # fmt: skip
            e, tail = _rewind(
                block, e, stop, order, t, event_place, value, recent, plan.window, tail_t, tail_place, tail_value
            )
            if record_place != 0 and tail > 0:
                cut(record, head[N])
                asked[v] |= REWOUND_FLAG
        moved = a < tail or e < stop
        while a < tail or e < stop:
            n = head[N]
            if n == 0 or (n + head[PHASE]) % max(1, recent) == 0:
                newer = snapshots_of(head, n, recent)[0] if recent > 0 else 0
                if newer > oldest:
                    if reopens and rule.most > 0:
                        record_place = before_snapshot(
                            asset, block, oldest, newer, recent, records, free, slots, rows,
                            plan.nu, plan.state, plan.evidence, plan.edge, plan.sensors,
                        )  # fmt: skip
                        record = record_at(record_place, plan.size, slots, ring, rows, columns)
                    oldest = newer
                if recent > 0:
                    copy_vector(block.now, block.snapshots[slot_of(head, n, recent)])
            at = n % ring
            i = order[min(e, stop - 1)]
            if a < tail and (
                e == stop or not precedes(t[i], event_place[i], value[i], tail_t[a], tail_place[a], tail_value[a])
            ):
                block.t[at], block.place[at] = tail_t[a], tail_place[a]
                copy_vector(tail_value[a], block.value[at])
                a += 1
            else:
                block.t[at], block.place[at] = t[i], event_place[i]
                copy_vector(value[i], block.value[at])
                e += 1
            if record_place != 0:
                append(record, n, block.t[at], block.place[at], block.value[at])
            own_t[1] = block.t[at]
            kind[1] = KINDS[block.place[at] >> 32]
            channel[1] = block.place[at] & 0xFFFFFFFF
            copy_vector(block.value[at], own_value[1])
            asks = fold_event(
                code, context, rule, 1, n, 1, own_t, kind, channel, own_value, columns,
                now.clock, now.u, now.filter, now.doubt, now.edge, spare, work, score, track, variances, passed, 0,
            )  # fmt: skip
            track.consistency[0] = int(last[CONSISTENCY])
            if judges(track.verdict[1]):
                slide(1, n, channel[1], block, normal, white, policy, bounds, terms, track)
            else:
                own_t[0], track.age[0] = times[T] if n > 0 else own_t[1], last[AGE]
                track.nis_mean[0], track.nis_low[0], track.nis_high[0] = last[NIS_MEAN], last[NIS_LOW], last[NIS_HIGH]
                keep_window(1, own_t, track)
            watch_row(1, own_t, kind, channel, own_value, context, policy, now.evidence, track)
            times[T] = own_t[1]
            if n == 0 or track.health[1] != int(last[GRADE]):
                times[SINCE], last[GRADE] = own_t[1], track.health[1]
            last[AGE], last[CONSISTENCY] = track.age[1], track.consistency[1]
            last[NIS_MEAN], last[NIS_LOW], last[NIS_HIGH] = track.nis_mean[1], track.nis_low[1], track.nis_high[1]
            head[HEALTH], head[FLAGS], head[VERDICT] = track.health[1], track.flags[1], track.verdict[1]
            head[N] = n + 1
            if asks:
                if record_place == 0:
                    record_place = allocate(asset, block, oldest, recent, records, free, slots, rows)
                    record = record_at(record_place, plan.size, slots, ring, rows, columns)
                _stop(record, n + 1, oldest, a, tail, tail_t, tail_place, tail_value)
                asked[v] |= ASKED_FLAG
                break
        if moved:
            copy_vector(track.mean[1], block.mean)
            copy_vector(track.std[1], block.std)
        begins[v] = e
        unfinished[v] = a < tail or e < stop


@jit
def begin_assets(code, contexts, mean, cov, states):
    """Fill the filter's state before the first event, states (N, numbers), by contexts (N, fields) of one prior."""
    for k in range(contexts.shape[0]):
        call_start(code.start, context_at(contexts[k].ctypes.data), mean, cov, borrowed(states[k]))


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
