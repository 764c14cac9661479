"""The fold's loop over the new events of many assets, in one compiled call on all cores.

The memory of an asset is one block of 64-bit words (`Block`): its state, two snapshots, and its most recent events and
judged rows. Each thread copies the events of an asset into a log and a track of its own and calls the kernels of a
single fold, so the results are the same bits.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import from_dtype, prange
from numba.extending import intrinsic

from .compiled.context import _FIELDS as CONTEXT_FIELDS
from .diagnostics.health import MAX_ROWS_PER_READING, Bounds, HealthPolicy
from .estimator import Code
from .fold_kernel import run_and_judge, run_and_judge_signature
from .gate.rejection_runs import Rule
from .log import _ORDER, READING, RESET
from .numerics.jit import address, caller, counts, flag_rows, flags, floats, i64, ints, jit, masks, matrix, part
from .numerics.workspace import declare_layout
from .track import FAILED, GATED, NONE, USED, WHITENED, Track

N, JUDGED, STALE_EVENTS, HEALTH, FLAGS, VERDICT = range(6)
"""Columns of `Block.head`: events folded; judged rows ever, of which the last are kept; events dropped as stale; then
health, flags and verdict of the last event."""

T, AGE, NIS_MEAN, NIS_LOW, NIS_HIGH, CONSISTENCY = range(6)
"""Columns of `State.last`, of the last row: time (int64, ns) and the columns of the track of that name."""

State, state_at = declare_layout(
    "State", "nu, state, evidence, edge, sensors",
    clock="int 1", u="nu", filter="state", evidence="evidence", edge="edge", doubt="sensors, 8", last="6",
)  # fmt: skip
"""State of an asset's fold before an event; the first fields are those of `Snapshot`."""

Block, block_at = declare_layout(
    "Block", "size, kept, recent, columns, nx",
    head="int 6", mean="nx", std="nx", now="size", snapshots="2, size", codes="int kept", nis="kept", t="int recent",
    place="int recent", value="recent, columns",
)  # fmt: skip
"""Memory of an asset: head, last estimate, state, two snapshots, judged rows (`codes`, `nis`), and the recent events as
time, place in the order of a log, and values."""

_ROW_BITS, _CHANNEL_BITS = 28, 14

_PLAN = """
    memory stride visited starts count t place value tunings contexts r crews crew_places rows_before fold start predict
    update describe soft never nx nu state evidence edge sensors rows ny width work window kept recent columns size
    low high quantiles
    degraded_after stale_after diverged_nis diverged_gated false_alarm_every silent_periods
""".split()
PLAN = np.dtype([(name, np.float64 if k > _PLAN.index("quantiles") else np.int64) for k, name in enumerate(_PLAN)])
"""What the call reads: addresses and sizes; the last are limits of `HealthPolicy`."""

CREW = (*Track._fields, "context", "r", "spare", "work", "score", "events_t", "kind", "channel", "events_value",
        "tail_t", "tail_place", "tail_value", "stops")  # fmt: skip
"""Scratch of a thread, as addresses."""

_CONTEXT, _R, _SPARE, _WORK, _SCORE, _T, _KIND, _CHANNEL, _VALUE, _TAIL_T, _TAIL_PLACE, _TAIL_VALUE, _STOPS = range(
    len(Track._fields), len(CREW)
)
_CONTEXT_WORDS, _AT_R = len(CONTEXT_FIELDS), CONTEXT_FIELDS.index("r")
_KINDS = np.array(_ORDER, np.int8)

_plan_type = from_dtype(PLAN)
_call_fold = caller(run_and_judge_signature)


@intrinsic
def _plan_at(typing_context, place):
    """Return the plan at an address."""

    def codegen(lowering, builder, signature, given):
        return builder.inttoptr(given[0], lowering.get_value_type(_plan_type))

    return _plan_type(i64), codegen


def rows_before(window: int) -> int:
    """Return how many rows of a thread's track lie before the first new one; `assess` looks back as far."""
    return MAX_ROWS_PER_READING * window + 2


@part
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


@part
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


@part
def _copy(source, target):
    for k in range(source.size):
        target[k] = source[k]


@part
def _window(block, first, n, window, channel, kind, track):
    """Write the judged rows of the window before row `first` of a track; return the row before the oldest of them."""
    oldest = first
    at = block.head[JUDGED] % block.codes.size
    for _ in range(min(block.head[JUDGED], window)):
        at = at - 1 if at > 0 else block.codes.size - 1
        code = block.codes[at]
        i = first - (n - (code >> _ROW_BITS))
        if i < 2:
            break
        dof = (code & (1 << _CHANNEL_BITS) - 1) - 1
        channel[i] = code >> _CHANNEL_BITS & (1 << _ROW_BITS - _CHANNEL_BITS) - 1
        track.verdict[i] = USED if dof >= 0 else GATED
        track.dof[i] = dof
        track.nis[i] = block.nis[at]
        oldest = i
    # Where the search for the window ends.
    kind[oldest - 1] = RESET
    return oldest - 1


@part
def _fold_rows(plan, code, rule, policy, bounds, context_place, block, now, m, t, kind, channel, value, stops, spare,
               work, score, track):  # fmt: skip
    """Fold and judge the m events from row `rows_before` on, as a single fold does."""
    first, n = plan.rows_before, block.head[N]
    last = now.last
    last_t = ints(last.ctypes.data, 1)
    before = first - 1
    t[before] = last_t[0] if n > 0 else t[first]
    track.age[before] = last[AGE]
    track.nis_mean[before] = last[NIS_MEAN]
    track.nis_low[before] = last[NIS_LOW]
    track.nis_high[before] = last[NIS_HIGH]
    track.consistency[before] = int(last[CONSISTENCY])
    oldest = _window(block, first, n, plan.window, channel, kind, track)
    stops[0] = first + m
    _call_fold(
        plan.fold, code, context_place, rule, n - first, first, stops, t, kind, channel, value, plan.columns,
        now.clock, now.u, now.filter, now.doubt, now.edge, spare, work, score, track, policy, bounds, now.evidence,
        stops[:0],
    )  # fmt: skip
    for i in range(oldest, first):
        kind[i] = READING
        track.verdict[i] = NONE
    kept = block.codes.size
    for i in range(first, first + m):
        verdict = track.verdict[i]
        if verdict == USED or verdict == GATED or verdict == FAILED:
            at = block.head[JUDGED] % kept
            dof = track.dof[i] if verdict == USED else -1
            block.codes[at] = (n + i - first) << _ROW_BITS | channel[i] << _CHANNEL_BITS | (dof + 1)
            block.nis[at] = track.nis[i]
            block.head[JUDGED] += 1
    i = first + m - 1
    last_t[0] = t[i]
    last[AGE] = track.age[i]
    last[NIS_MEAN] = track.nis_mean[i]
    last[NIS_LOW] = track.nis_low[i]
    last[NIS_HIGH] = track.nis_high[i]
    last[CONSISTENCY] = track.consistency[i]
    block.head[N] = n + m


@part
def _to_snapshot(block, n, recent):
    """Return the index of the last snapshot of n events: one precedes every `recent`-th."""
    return max(0, (n - 1) // recent * recent)


@part
def _begin(block, now, e, stop, t, place, value, recent, tail_t, tail_place, tail_value):
    """Return to a snapshot if new events belong before the last; return the first event to fold, and the tail's length.

    The tail holds the events after the snapshot. Events before the oldest snapshot are counted as stale.
    """
    n = block.head[N]
    ring = block.t.size
    if n == 0 or not _precedes(
        t[e], place[e], value[e], block.t[(n - 1) % ring], block.place[(n - 1) % ring], block.value[(n - 1) % ring]
    ):
        return e, 0
    newer = _to_snapshot(block, n, recent)
    older = max(0, newer - recent)
    if older > 0:
        at = (older - 1) % ring
        while e < stop and _precedes(t[e], place[e], value[e], block.t[at], block.place[at], block.value[at]):
            block.head[STALE_EVENTS] += 1
            e += 1
        if e == stop:
            return e, 0
    i = n
    while i > older and _precedes(
        t[e], place[e], value[e], block.t[(i - 1) % ring], block.place[(i - 1) % ring], block.value[(i - 1) % ring]
    ):
        i -= 1
    if i == n:
        return e, 0
    at = newer if i >= newer else older
    _copy(block.snapshots[at // recent % 2], block.now)
    for k in range(at, n):
        tail_t[k - at], tail_place[k - at] = block.t[k % ring], block.place[k % ring]
        _copy(block.value[k % ring], tail_value[k - at])
    while block.head[JUDGED] > 0 and block.codes[(block.head[JUDGED] - 1) % block.codes.size] >> _ROW_BITS >= at:
        block.head[JUDGED] -= 1
    block.head[N] = at
    return e, n - at


@part
def _fold_asset(plan, code, rule, policy, bounds, context_place, block, now, e, stop, t, place, value, log, tail, stops,
                spare, work, score, track):  # fmt: skip
    """Fold the new events `e` to `stop` of an asset where they belong."""
    own_t, kind, channel, own_value = log
    tail_t, tail_place, tail_value = tail
    first, recent, ring = plan.rows_before, plan.recent, block.t.size
    e, tail_size = _begin(block, now, e, stop, t, place, value, recent, tail_t, tail_place, tail_value)
    if e == stop:
        return
    a = 0
    while a < tail_size or e < stop:
        n = block.head[N]
        if n % recent == 0:
            _copy(block.now, block.snapshots[n // recent % 2])
        m = 0
        while m < recent - n % recent and (a < tail_size or e < stop):
            i, at = first + m, (n + m) % ring
            if a < tail_size and (
                e == stop or not _precedes(t[e], place[e], value[e], tail_t[a], tail_place[a], tail_value[a])
            ):
                block.t[at], block.place[at] = tail_t[a], tail_place[a]
                _copy(tail_value[a], block.value[at])
                a += 1
            else:
                block.t[at], block.place[at] = t[e], place[e]
                _copy(value[e], block.value[at])
                e += 1
            own_t[i] = block.t[at]
            kind[i] = _KINDS[block.place[at] >> 32]
            channel[i] = block.place[at] & 0xFFFFFFFF
            _copy(block.value[at], own_value[i])
            m += 1
        _fold_rows(plan, code, rule, policy, bounds, context_place, block, now, m, own_t, kind, channel, own_value,
                   stops, spare, work, score, track)  # fmt: skip
        i = first + m - 1
    _copy(track.mean[i], block.mean)
    _copy(track.std[i], block.std)
    head = block.head
    head[HEALTH], head[FLAGS], head[VERDICT] = track.health[i], track.flags[i], track.verdict[i]


@jit
def _fold_share(place, crew):
    """Fold the new events of one thread's share of the assets."""
    plan = _plan_at(place)
    own = ints(plan.crew_places + 8 * crew * len(CREW), len(CREW))
    rows = plan.rows_before + plan.recent
    track = _track_at(own, rows, plan.nx, plan.ny, plan.width)
    log = (
        ints(own[_T], rows),
        flags(own[_KIND], rows),
        counts(own[_CHANNEL], rows),
        matrix(floats(own[_VALUE], rows * plan.columns), 0, rows, plan.columns),
    )
    # One more than may be folded again: a late event that precedes it is stale.
    ring = 2 * plan.recent + 1
    tail = (
        ints(own[_TAIL_T], ring),
        ints(own[_TAIL_PLACE], ring),
        matrix(floats(own[_TAIL_VALUE], ring * plan.columns), 0, ring, plan.columns),
    )
    spare = floats(own[_SPARE], plan.state)
    work = floats(own[_WORK], plan.work)
    score = floats(own[_SCORE], WHITENED + plan.ny)
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
    value = matrix(floats(plan.value, total * plan.columns), 0, total, plan.columns)
    stops = ints(own[_STOPS], 1)
    words = ints(own[_CONTEXT], _CONTEXT_WORDS)
    loaded = -1
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
        block = block_at(plan.memory + asset * plan.stride, plan.size, plan.kept, ring, plan.columns, plan.nx)
        now = state_at(block.now.ctypes.data, plan.nu, plan.state, plan.evidence, plan.edge, plan.sensors)
        _fold_asset(plan, code, rule, policy, bounds, own[_CONTEXT], block, now, starts[v], starts[v + 1], t,
                    event_place, value, log, tail, stops, spare, work, score, track)  # fmt: skip


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


@lru_cache(maxsize=1)
def fold_address() -> int:
    """Return the address of the loop of a single fold."""
    return address(run_and_judge, run_and_judge_signature)
