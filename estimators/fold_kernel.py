"""The fold's loop over events, compiled once for all filters and models."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import types
from numba.core.registry import CPUDispatcher

from .compiled.context import context_at, context_type, prior, sensor_rows, steps_of
from .compiled.verdict import limit_of
from .diagnostics.detector_state import row_part
from .diagnostics.detector_watch import watch_rows
from .diagnostics.health import NORMALS, assess, bounds_type, policy_type
from .diagnostics.memory import after_update, before_update, carry_memory, forget_memory, memory_flags
from .estimator import call_describe, call_predict, call_start, call_update, code_type
from .gate.rejection_runs import forget, note, rule_type
from .gate.soften import soften
from .interpreted.fold_loop import MAX_PREDICT_STEPS, UNSET
from .log import INPUT, MARK, READING, RESET, TICK, TRUTH
from .numerics.jit import B1, F1, F2, I1, borrowed, embedded, floats, i64, inlined, ints, jit, linkable, part
from .plausibility import pass_on, screen_reading, screen_signature
from .track import ANCESTORS, EFFECTIVE, GATED, MISSING, NONE, SCREENED, USED, WHITENED, borrowed_columns, track_type


@embedded
def advance_to(code, context, u, clock, t, index, state, work, memory=0):
    """Predict from the clock to time t, in steps of at most `max_step`.

    After a time of more than `MAX_PREDICT_STEPS` steps the state is reset to the prior. `memory` is the address of the
    memory of the states (`diagnostics/memory.py`), or 0.
    """
    if clock == UNSET or t <= clock:
        return
    dt = (t - clock) * 1e-9
    if dt > MAX_PREDICT_STEPS * context.max_step:
        prior_mean, prior_cov = prior(context)
        call_start(code.start, context, prior_mean, prior_cov, state)
        if memory != 0:
            forget_memory(memory, context.nx)
        return
    steps = steps_of(dt, context.max_step)
    for _ in range(steps):
        if memory != 0:
            carry_memory(context, memory, state[: context.nx], u, dt / steps)
        call_predict(code.predict, context, u, dt / steps, index, state, work)


@inlined
def asks(kind):
    """Return whether an event is a query: a true state, tick or mark."""
    return kind == TRUTH or kind == TICK or kind == MARK


@part
def exchange(r, own, kept):
    """r (ny,) ← the measurement's own variances where they are finite; `kept` (ny,) gets the previous ones."""
    for k in range(r.size):
        kept[k] = r[k]
        if k < own.size and np.isfinite(own[k]):
            r[k] = own[k]


@embedded
def fold_event(
    code, context, rule, i, index, start, t, kind, channel, value, width,
    clock, u, state, doubt, edge, spare, work, score, track, kept, passed, memory,
):  # fmt: skip
    """Fold event i, of absolute index `index`, into row i of the track; see `run`.

    `spare` holds the answer of the event before, if that was a query and i is not `start`. kept (rows,) and passed
    (columns of `value`,) are scratch.

    Returns:
        Whether the event asks for a decision on its sensor.
    """
    nu = u.size
    variances = value.shape[1] > width
    mean, std, cross = track.mean, track.std, track.cross
    innovation, innovation_std, whitened = track.innovation, track.innovation_std, track.whitened
    screened = track.screened
    what = kind[i]
    for j in range(innovation.shape[1]):
        screened[i, j] = 0
        innovation[i, j] = np.nan
        innovation_std[i, j] = np.nan
        score[WHITENED + j] = np.nan
    score[0] = np.nan
    score[1] = 0.0
    score[2] = np.nan
    score[EFFECTIVE] = np.nan
    score[ANCESTORS] = np.nan
    verdict = NONE
    asked = False
    if what == READING or what == INPUT:
        advance_to(code, context, u, clock[0], t[i], index, state, work, memory)
        clock[0] = t[i]
        if what == INPUT:
            for j in range(nu):
                if np.isfinite(value[i, j]):
                    u[j] = value[i, j]
        else:
            sensor = np.int64(channel[i])  # int32 would be a second type, and compile every callee twice
            if variances:
                row, rows = sensor_rows(context, sensor)
                r = floats(context.r, context.n_rows)[row : row + rows]
                exchange(r, value[i, width:], kept)
            given = floats(value[i:].ctypes.data, value.shape[1])
            verdict = SCREENED
            left = True
            if screen_reading(i, t[i], sensor, given, context, edge, screened):
                left = pass_on(value, screened, i, passed)
                given = passed
            if memory != 0:
                before_update(context, memory, state)
            if left:
                verdict = call_update(
                    code.update, context, u, sensor, given, index, state, work, innovation[i], innovation_std[i], score
                )
            if verdict == GATED and rule.soft != 0:
                verdict = soften(
                    code, context, u, sensor, given, index, state, work, innovation[i], innovation_std[i], score
                )
            if variances:
                for k in range(rows):
                    r[k] = kept[k]
            if verdict == GATED or verdict == USED:
                if memory != 0:
                    after_update(context, memory, state, sensor, innovation[i], innovation_std[i])
                beyond = score[0] > limit_of(context, sensor, int(score[1]))
                asked = note(doubt[sensor], rule.most, beyond, index, float(t[i]))
        call_describe(code.describe, context, state, mean[i], std[i], cross[i])
    elif what == RESET:
        prior_mean, prior_cov = prior(context)
        call_start(code.start, context, prior_mean, prior_cov, state)
        if memory != 0:
            forget_memory(memory, context.nx)
        forget(doubt)
        clock[0] = t[i]
        call_describe(code.describe, context, state, mean[i], std[i], cross[i])
    else:
        if clock[0] == UNSET:
            clock[0] = t[i]
        # Several true states at one time are one query: `spare` still holds the answer.
        if i == start or not asks(kind[i - 1]) or t[i] != t[i - 1]:
            for j in range(state.size):
                spare[j] = state[j]
            advance_to(code, context, u, clock[0], t[i], index, spare, work)
        call_describe(code.describe, context, spare, mean[i], std[i], cross[i])
    track.nis[i] = score[0] if verdict != MISSING else np.nan
    track.dof[i] = int(score[1])
    track.log_likelihood[i] = score[2]
    track.verdict[i] = verdict
    track.effective[i] = score[EFFECTIVE]
    track.ancestors[i] = score[ANCESTORS]
    track.factor[i] = 1.0
    track.flags[i] = memory_flags(context, memory, track.factor[i]) if memory != 0 else 0
    for j in range(whitened.shape[1]):
        whitened[i, j] = score[WHITENED + j]
    return asked


# Not `linkable`, as an event takes a third less time when the loop is optimised by itself before it is linked.
@jit
def run(
    code, context, rule, first, start, end, t, kind, channel, value, width,
    clock, u, state, doubt, edge, spare, work, score, track, kept, passed, memory,
):  # fmt: skip
    """Fold events `start` to `end`: update clock (1,), u (nu,) and state in place, and fill one track row per event.

    Stops after the first measurement that asks for a decision on its sensor (gate/doubt.py), and returns its row; -1 if
    none does.

    A tick, a truth or a mark is a query: it is answered from a copy of the state, so it never changes the estimate.
    Variances of a measurement (columns of `value` from `width` on) replace the tuned R while it is folded, in every
    filter. Rows that are rejected before the filter are NaN for it; without any row left it only predicts. kept (rows,)
    and passed (columns of `value`,) are scratch; `memory` is the address of the memory of the states, or 0.
    """
    t, kind, channel, value = borrowed(t), borrowed(kind), borrowed(channel), borrowed(value)
    clock, u, state, doubt = borrowed(clock), borrowed(u), borrowed(state), borrowed(doubt)
    edge, spare, work, score = borrowed(edge), borrowed(spare), borrowed(work), borrowed(score)
    kept, passed, track = borrowed(kept), borrowed(passed), borrowed_columns(track)
    for i in range(start, end):
        asked = fold_event(
            code, context, rule, i, first + i, start, t, kind, channel, value, width,
            clock, u, state, doubt, edge, spare, work, score, track, kept, passed, memory,
        )  # fmt: skip
        if asked:
            return i
    return -1


@jit
def begin(code, context, mean, cov, state):
    """Set the state to N(mean, cov)."""
    call_start(code.start, context, mean, cov, state)


@linkable
def judge(start, end, t, kind, channel, value, context, policy, bounds, evidence, track):
    """Fill windowed NIS, alarms and health of the folded rows `start` to `end`."""
    normal = floats(context.normal, NORMALS * context.n_sensors)
    assess(start, end, t, kind, channel, track, normal, policy, bounds)
    watch_rows(start, end, t, kind, channel, value, context, policy, evidence, track)


@part
def remember(place, clock, u, state, evidence, edge, doubt):
    """Copy the state of a fold to the float64s at an address; the order is that of `Snapshot`."""
    ints(place, 1)[0] = clock[0]
    place += 8
    for column in (u, state, evidence, edge, doubt.ravel()):
        kept = floats(place, column.size)
        for k in range(column.size):
            kept[k] = column[k]
        place += 8 * column.size


@jit
def run_and_judge(
    code, context_place, rule, first, start, stops, t, kind, channel, value, width,
    clock, u, state, doubt, edge, spare, work, score, track, policy, bounds, evidence, places,
):  # fmt: skip
    """Fold and judge events `start` to the last of `stops` (n,) in one call: of a few events, a call takes longer.

    At the first stops a snapshot is written to the addresses in `places` (n or fewer,). The context is passed by its
    address, as finding the type of a record takes as long as ten steps.
    """
    context = context_at(context_place)
    kept = np.empty(context.n_rows if value.shape[1] > width else 0)
    passed = np.empty(value.shape[1])
    memory = row_part(evidence, context.n_sensors, context.n_rows).ctypes.data + 8 * u.size
    if context.memory == 0 or policy.window == 0:
        memory = 0
    for k in range(stops.size):
        asking = run(
            code, context, rule, first, start, stops[k], t, kind, channel, value, width,
            clock, u, state, doubt, edge, spare, work, score, track, kept, passed, memory,
        )  # fmt: skip
        end = stops[k] if asking < 0 else asking + 1
        if policy.window > 0:
            judge(start, end, t, kind, channel, value, context, policy, bounds, evidence, track)
        if asking >= 0:
            return asking
        if k < places.size:
            remember(places[k], clock, u, state, evidence, edge, doubt)
        start = end
    return -1


I4 = types.int32[::1]
_log = (I1, B1, I4, F2)
begin_signature = types.void(code_type, context_type, F1, F2, F1)
judge_signature = types.void(i64, i64, *_log, context_type, policy_type, bounds_type, F1, track_type)
_state = I1, F1, F1, F2, F1, F1, F1, F1, track_type
run_signature = i64(code_type, context_type, rule_type, i64, i64, i64, *_log, i64, *_state, F1, F1, i64)
run_and_judge_signature = i64(
    code_type, i64, rule_type, i64, i64, I1, *_log, i64, *_state, policy_type, bounds_type, F1, I1
)


@lru_cache(maxsize=1)
def compiled() -> tuple[CPUDispatcher, CPUDispatcher]:
    """Return `run_and_judge` and `begin`, compiled for their only signatures or loaded from the cache."""
    run_and_judge.compile(run_and_judge_signature.args)
    begin.compile(begin_signature.args)
    return run_and_judge, begin


@lru_cache(maxsize=1)
def compiled_judge() -> CPUDispatcher:
    """Return `judge` for the loop in Python, compiled or loaded from the cache with what else that calls."""
    judge.compile(judge_signature.args)
    screen_reading.compile(screen_signature.args)
    return judge
