"""What each channel's clock is expected to say next, and whether a time fits that: compiled, once for each event."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from numba import types

from ..numerics.jit import B1, I1, I2, i64, inlined, jit_brief
from .batch import INPUT, READING, TRUTH

SECOND = 10**9

ENOUGH = 3
"""Readings that must agree on another time, and steps after which the period of a channel is known."""

PERIODS, PERIODS_LIVE = 10, 3
"""A reading may be so many periods ahead of the newest, without and with known arrivals."""

AHEAD_OF_ARRIVAL = SECOND
"""By which t - arrival may exceed its largest lately at least, ns; else by half the horizon."""

RELAX = 1000
"""t - arrival at its largest comes down by one part in so many of the time that passes, where the clock falls back:
no clock is worse, and after minutes of long delays it is still known what the clock says of itself."""

FITS, AHEAD, BACK = range(3)

# Columns of the state, one row a channel and the last for all of them together: whether it has spoken; its newest and
# its first time; how many steps forward it made and their sum; largest t - arrival lately, the last arrival; whether
# arrivals are known; whether events are held; its last gap.
SEEN, LAST, FIRST, STEPS, TOTAL, OFFSET, ARRIVED, LIVE, HOLDING, GAP_FROM, GAP_TO = range(11)


@inlined
def _reach(state, row, horizon, live):
    """How far ahead of the newest the next time of a channel may be, ns; -1 while its period is not known."""
    last = state.shape[0] - 1
    if state[row, STEPS] < ENOUGH:
        row = last
    if state[row, STEPS] < ENOUGH:
        return -1
    period = state[row, TOTAL] // state[row, STEPS]
    # With half a horizon to spare, else what others stamp would be stale if it were on its way for a moment.
    return max(horizon // 2, PERIODS_LIVE * period) if live else max(horizon, PERIODS * period)


@inlined
def _judge(state, row, t, arrival, live, horizon):
    """Whether a time fits its channel's clock, or is far ahead or back."""
    everything = state.shape[0] - 1
    if state[row, SEEN] and t < state[row, LAST] - horizon:
        return BACK
    if not state[everything, SEEN]:
        return FITS
    live = live or state[row, LIVE] > 0
    reach = _reach(state, row, horizon, live)
    if reach < 0 or t <= state[everything, LAST] + reach:
        return FITS
    if live:
        offset = state[row if state[row, SEEN] else everything, OFFSET]
        if t - arrival <= offset + max(horizon // 2, AHEAD_OF_ARRIVAL):
            return FITS
        # By a clock that is right: the others were on their way for longer, and within the horizon that is no fault.
        if -horizon <= offset and t <= arrival:
            return FITS
    return AHEAD


@inlined
def _note(state, row, t, arrival, live, horizon):
    """A time is let in: what its channel, and all together, are expected to say next."""
    everything = state.shape[0] - 1
    for k in (row, everything):
        if not state[k, SEEN]:
            state[k, SEEN], state[k, FIRST], state[k, LAST] = 1, t, t
            state[k, OFFSET], state[k, ARRIVED] = t - arrival, arrival
        step = t - state[k, LAST]
        if step > 0:
            period = state[k, TOTAL] // max(1, state[k, STEPS])
            if state[k, STEPS] < ENOUGH or step <= max(horizon, PERIODS * period):
                state[k, STEPS] += 1
                state[k, TOTAL] += step
            else:
                state[k, GAP_FROM], state[k, GAP_TO] = state[k, LAST], t
            state[k, LAST] = t
        passed = min(max(arrival - state[k, ARRIVED], 0), SECOND)
        state[k, OFFSET] = max(t - arrival, state[k, OFFSET] - passed // RELAX)
        state[k, ARRIVED] = arrival
        if live:
            state[k, LIVE] = 1


@inlined
def row_of(kind, channel, sensors):
    """The row of the state for an event; -1 for those that always pass, and that the log refuses."""
    if kind == READING and 0 <= channel < sensors:
        return channel
    return sensors if kind == INPUT else sensors + 1 if kind == TRUTH else -1


@jit_brief
def _scan(state, t, raw, arrival, kind, channel, start, horizon):
    """Let in what fits, from `start` to the first event that does not, or whose channel holds some: its index."""
    sensors = state.shape[0] - 3
    for i in range(start, t.size):
        row = row_of(kind[i], channel[i], sensors)
        if row >= 0:
            live = raw[i] != arrival[i]
            if state[row, HOLDING] or _judge(state, row, t[i], arrival[i], live, horizon) != FITS:
                return i
            _note(state, row, t[i], arrival[i], live, horizon)
    return t.size


@lru_cache(maxsize=1)
def compiled() -> tuple[Any, Any, Any, Any]:
    """The functions, compiled for their one signature."""
    one = (I2, i64, i64, i64, types.boolean, i64)
    _reach.compile((I2, i64, i64, types.boolean))
    _judge.compile(one)
    _note.compile(one)
    _scan.compile((I2, I1, I1, I1, B1, types.int32[::1], i64, i64))
    return _reach, _judge, _note, _scan
