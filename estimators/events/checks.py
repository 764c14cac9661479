"""Checks of events when they enter a log.

Compiled code trusts every index in a log. A log with a model checks events against the model; the events of a log
without one are checked by the fold.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache

import numpy as np
from numba import types

from ..errors import LARGEST, EventError
from ..model.state_space import EventLayout
from ..numerics.jit import CPUDispatcher, i64, jit_brief
from .batch import BEFORE, COLUMN_TYPES, INPUT, KIND_NAMES, MAINTENANCE, MARK, READING, TRUTH, Events

FINE, TIME, KIND, CHANNEL, VALUES, STRAY, VARIANCE = range(7)  # Rules, by which `_look` names a violation
_ANY = np.zeros(0, np.int64)  # Rows of the sensors of an unknown model


def _read_only(element: types.Type, dimensions: int) -> types.Array:
    return types.Array(element, dimensions, "C", readonly=True)


_signature = types.UniTuple(i64, 3)(
    _read_only(types.int64, 1),
    _read_only(types.int8, 1),
    _read_only(types.int32, 1),
    _read_only(types.float64, 2),
    i64,
    _read_only(types.int64, 1),
    i64,
    i64,
)


@jit_brief
def _look(t, kind, channel, value, width, rows, nu, nx):
    """Return the first event that violates a rule, the rule (`FINE` if none), and the number of infinite values."""
    infinite = 0
    for i in range(t.size):
        if t[i] <= BEFORE or t[i] >= -BEFORE:
            return i, TIME, infinite
        if kind[i] < 0 or kind[i] >= len(KIND_NAMES):
            return i, KIND, infinite
        if channel[i] < 0:
            return i, CHANNEL, infinite
        # Values of a tick or a reset are ignored.
        places = width
        if rows.size > 0:
            if kind[i] == READING:
                if channel[i] >= rows.size:
                    return i, CHANNEL, infinite
                places = rows[channel[i]]
            elif kind[i] == TRUTH:
                if channel[i] >= nx:
                    return i, CHANNEL, infinite
                places = nx - channel[i]
            elif kind[i] == MAINTENANCE:
                if channel[i] >= nx:
                    return i, CHANNEL, infinite
            elif kind[i] == MARK:
                if channel[i] > rows.size + nu:
                    return i, CHANNEL, infinite
            else:
                if channel[i] > 0:
                    return i, CHANNEL, infinite
                if kind[i] == INPUT:
                    places = nu
        for k in range(min(width, value.shape[1])):
            if k >= places and np.isfinite(value[i, k]):
                return i, VALUES, infinite
            if np.isinf(value[i, k]):
                infinite += 1
        for k in range(width, value.shape[1]):
            own = value[i, k]
            if not np.isnan(own):
                if kind[i] != READING or k - width >= places:
                    return i, STRAY, infinite
                if not 0.0 < own <= LARGEST:
                    return i, VARIANCE, infinite
    return 0, FINE, infinite


@lru_cache(maxsize=1)
def _looking() -> CPUDispatcher:
    """Return `_look`, compiled for its only signature, which also accepts writable arrays."""
    with suppress(RuntimeError):  # Another thread was first, and has disabled it: the cache has no lock.
        _look.compile(_signature.args)
    _look.disable_compile()
    return _look


def admitted(batch: Events, width: int, layout: EventLayout | None) -> Events:
    """Return the batch, with infinite values replaced by NaN, if a log accepts it.

    Args:
        batch: Events of any kind.
        width: Value columns of the log; further ones hold variances.
        layout: Layout of the model, if the log has one.

    Raises:
        EventError: If an event violates a rule; then no event of the batch may be inserted.
    """
    batch = _plain(batch)
    t, _, kind, channel, value = batch
    rows, nu, nx = (_ANY, 0, 0) if layout is None else (layout.counts, layout.nu, layout.nx)
    at, rule, infinite = _looking()(t, kind, channel, value, width, rows, nu, nx)
    if rule != FINE:
        name = f"{KIND_NAMES[kind[at]]} " if rule != KIND else ""
        place = f"event {at + 1} of {t.size} ({name}at {t[at] * 1e-9:.9g} s)"
        raise EventError(f"{place}: {_broken(batch, at, rule, width, layout)}")
    if infinite:
        # What lies in the columns of variances is finite or NaN.
        batch = batch._replace(value=np.where(np.isinf(value), np.nan, value))
    return batch


def _plain(batch: Events) -> Events:
    """Return the batch with columns of one length and of the log's types.

    Raises:
        EventError: If a column cannot be that, with its name.
    """
    n = batch.t.size
    columns = [*batch]
    for j, (name, wanted) in enumerate(COLUMN_TYPES.items()):
        column = columns[j]
        if column.shape != (n,):
            raise EventError(f"{name} has shape {column.shape}; it must be ({n},), one for each event")
        if column.dtype != wanted:
            columns[j] = _integers(name, column, wanted)
        columns[j] = np.ascontiguousarray(columns[j])
    value = batch.value
    if value.ndim != 2 or value.shape[0] != n or value.dtype.kind not in "fiu":
        raise EventError(f"value has shape {value.shape} of {value.dtype}; it must be numbers of shape ({n}, width)")
    columns[4] = np.ascontiguousarray(value, float)
    return Events(*columns)


def _integers(name: str, column: np.ndarray, wanted: type) -> np.ndarray:
    """Convert integers to the log's type; reject floats, which would lose their decimals."""
    if column.dtype.kind not in "iu":
        unit = "whole nanoseconds: np.rint(1e9 * s).astype(np.int64)" if wanted is np.int64 else "integers"
        raise EventError(f"{name} holds {column.dtype} numbers; it must hold {unit}")
    bounds = np.iinfo(wanted)
    if column.size and (column.min() < bounds.min or column.max() > bounds.max):
        raise EventError(f"{name} holds {column.max()} and {column.min()}; it must fit in {bounds.dtype}")
    return column.astype(wanted)


def _broken(batch: Events, at: int, rule: int, width: int, layout: EventLayout | None) -> str:
    t, kind, channel = int(batch.t[at]), int(batch.kind[at]), int(batch.channel[at])
    value = batch.value[at]
    if rule == TIME:
        return f"t is {t} ns; it must lie within ±146 years of zero (±2**62 ns): mend the clock"
    if rule == KIND:
        return f"kind is {kind}; it must be 0 to {len(KIND_NAMES) - 1} ({', '.join(KIND_NAMES)})"
    if rule == CHANNEL and (channel < 0 or layout is None):
        return f"channel is {channel}; it is an index from 0 on"
    if rule == VARIANCE:
        wrong = next(own for own in value[width:] if not (np.isnan(own) or 0.0 < own <= LARGEST))
        return f"its variance is {wrong:g}; it must be positive and {LARGEST:g} at most, or NaN for the tuned one"
    if rule == STRAY and (kind != READING or layout is None):
        return f"it holds {_count(value)} values; the log has {width} column(s): make the log by Log.of(model)"
    assert layout is not None
    if rule == CHANNEL:
        if kind == READING:
            names = ", ".join(f"{k} {name}" for k, name in enumerate(layout.sensors[:8]))
            more = ", ..." if len(layout.sensors) > 8 else ""
            return f"channel is {channel}; {layout.name} has {len(layout.rows)} sensor(s): {names}{more}"
        if kind == MARK:
            return f"channel is {channel}; it must be {len(layout.rows) + layout.nu} (the whole twin) at most"
        states = f"{layout.name} has {layout.nx} states, counted from 0"
        return f"channel is {channel}; {states if kind in (TRUTH, MAINTENANCE) else 'for this kind it must be 0'}"
    if rule == STRAY:
        last = _count(value) - 1 - width
        return f"it gives a variance to row {last}; {layout.sensors[channel]} has {layout.rows[channel]} row(s)"
    if kind == READING:
        room = f"{layout.sensors[channel]} has {layout.rows[channel]} row(s)"
    elif kind == INPUT:
        room = f"{layout.name} has {layout.nu} input(s)"
    else:
        room = f"{layout.name} has {layout.nx - channel} state(s) from there on"
    return f"it holds {_count(value[:width])} values; {room}: leave the others NaN"


def _count(value: np.ndarray) -> int:
    """Return the number of columns up to the last known value."""
    return 1 + int(np.flatnonzero(~np.isnan(value))[-1])
