"""Expected next time of each channel's clock, and whether a time fits it; compiled, as it runs for every event."""

from __future__ import annotations

from functools import lru_cache

from numba import types

from ..numerics.jit import I1, I2, CPUDispatcher, i64, inlined, jit_brief

SECOND_NS = 10**9

MIN_AGREEING_EVENTS = 3
"""Number of events that must agree on another time, and of steps after which the period of a channel is known."""

MAX_PERIODS_AHEAD, MAX_PERIODS_AHEAD_LIVE = 10, 3
"""Number of periods by which an event may be ahead of the newest, without and with known arrivals."""

MIN_OFFSET_TOLERANCE_NS = SECOND_NS
"""Smallest tolerance, ns, by which t - arrival may exceed its recent maximum; otherwise half the horizon."""

OFFSET_DECAY_TIME = 1000
"""The maximum of t - arrival decays by one part in so many of the elapsed time. No clock drifts faster, and after
minutes of long delays the offset of the clock is still known."""

FITS, AHEAD, BACK = range(3)

# Columns of the state, one row per channel and the last row for all of them together: whether it has reported; newest
# and first time; number of steps forward and their sum; recent maximum of t - arrival, last arrival; whether arrivals
# are known; whether events are held; the last gap.
SEEN, LAST, FIRST, STEPS, TOTAL, OFFSET, ARRIVED, LIVE, HOLDING, GAP_FROM, GAP_TO = range(11)


@inlined
def _reach(state, row, horizon, live):
    """Return how far ahead of the newest the next time of a channel may be, ns; -1 while its period is unknown."""
    last = state.shape[0] - 1
    if state[row, STEPS] < MIN_AGREEING_EVENTS:
        row = last
    if state[row, STEPS] < MIN_AGREEING_EVENTS:
        return -1
    period = state[row, TOTAL] // state[row, STEPS]
    # Half a horizon remains, so that slightly delayed events of other channels are not stale.
    return max(horizon // 2, MAX_PERIODS_AHEAD_LIVE * period) if live else max(horizon, MAX_PERIODS_AHEAD * period)


@inlined
def _judge(state, row, t, raw, arrival, live, horizon, utc):
    """Return whether a time fits its channel's clock, or is far ahead or back; `utc` as of the guard."""
    everything = state.shape[0] - 1
    if state[row, SEEN] and t < state[row, LAST] - horizon:
        return BACK
    if utc > 0:
        # What was buffered, or is history, comes late by any time, but a clock that is right is never ahead; and one
        # that was corrected is another if it is late.
        if t != raw and t - arrival < -utc:
            return BACK
        return FITS if t - arrival <= utc else AHEAD
    if not state[everything, SEEN]:
        return FITS
    live = live or state[row, LIVE] > 0
    reach = _reach(state, row, horizon, live)
    if reach < 0 or t <= state[everything, LAST] + reach:
        return FITS
    if live:
        offset = state[row if state[row, SEEN] else everything, OFFSET]
        if t - arrival <= offset + max(horizon // 2, MIN_OFFSET_TOLERANCE_NS):
            return FITS
        # Stamped by a correct clock: the other events were delayed longer, within the horizon.
        if -horizon <= offset and t <= arrival:
            return FITS
    return AHEAD


@inlined
def _note(state, row, t, arrival, live, horizon):
    """Update the expectation of a channel, and of all together, with an accepted time."""
    everything = state.shape[0] - 1
    for k in (row, everything):
        if live and not state[k, LIVE]:
            # Of what came before, such as the history in a file, no arrival is known.
            state[k, OFFSET], state[k, ARRIVED] = t - arrival, arrival
        if not state[k, SEEN]:
            state[k, SEEN], state[k, FIRST], state[k, LAST] = 1, t, t
            state[k, OFFSET], state[k, ARRIVED] = t - arrival, arrival
        step = t - state[k, LAST]
        if step > 0:
            period = state[k, TOTAL] // max(1, state[k, STEPS])
            if state[k, STEPS] < MIN_AGREEING_EVENTS or step <= max(horizon, MAX_PERIODS_AHEAD * period):
                state[k, STEPS] += 1
                state[k, TOTAL] += step
            else:
                state[k, GAP_FROM], state[k, GAP_TO] = state[k, LAST], t
            state[k, LAST] = t
        if live:
            passed = min(max(arrival - state[k, ARRIVED], 0), SECOND_NS)
            state[k, OFFSET] = max(t - arrival, state[k, OFFSET] - passed // OFFSET_DECAY_TIME)
            state[k, ARRIVED], state[k, LIVE] = arrival, 1


@jit_brief
def _scan(state, t, raw, arrival, rows, start, horizon, utc):
    """Accept events from `start` on; return the first that does not fit or whose channel has held events."""
    for i in range(start, t.size):
        row = rows[i]
        if row >= 0:
            live = utc > 0 or raw[i] != arrival[i]
            if state[row, HOLDING] or _judge(state, row, t[i], raw[i], arrival[i], live, horizon, utc) != FITS:
                return i
            _note(state, row, t[i], arrival[i], live, horizon)
    return t.size


@lru_cache(maxsize=1)
def compiled() -> tuple[CPUDispatcher, CPUDispatcher, CPUDispatcher, CPUDispatcher]:
    """Return the functions, compiled for their only signatures."""
    one = (I2, i64, i64, i64, types.boolean, i64)
    _reach.compile((I2, i64, i64, types.boolean))
    _judge.compile((*one[:2], *one[1:], i64))
    _note.compile(one)
    _scan.compile((I2, I1, I1, I1, I1, i64, i64, i64))
    return _reach, _judge, _note, _scan
