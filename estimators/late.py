"""Readings that come late: what a rewind for one costs, and the cheap way, a reading that is used now with a larger R.

The exact way is the log's: the reading is put where it was measured and the fold goes back. The cheap way stamps it
with the newest time and adds to the noise of each row what the predicted reading has moved by since,

    R + (delay · dh/dt)² + H Q(delay) Hᵀ,    dh/dt ≈ (h(f(x, u, p, dt)) - h(x)) / dt

at the present estimate. It treats a known shift as noise with that mean square, and leaves out that the error of the
reading is correlated with the state's history. So it is for readings that are late now and then: where all of a sensor
are late by the same, the shift is a bias, which no R tells the filter of, and its bands become too narrow.

Sources: Larsen, Andersen, Ravn & Poulsen (1998), doi:10.1109/CDC.1998.758571, and Alexander (1991),
doi:10.1117/12.44531, for updates that carry the correlation along and would cost a filter of their own each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .events.batch import MARK, READING, TICK, Events

if TYPE_CHECKING:
    from .fold import Fold

NUMBER = 50e-9
"""Seconds that one number of a filter's state takes in an event: 3 s for 50 members of a million cells each."""

MOST = 256
"""States beyond which H Q Hᵀ is left out: an ensemble so large is what the cheap way is for."""

_STEP = 6e-6


def rewind_seconds(numbers: int, events: int) -> float:
    """What going back over so many events costs a filter whose state has so many numbers."""
    return events * numbers * NUMBER


def moved_variance(fold: Fold, sensor: int, delay: float) -> np.ndarray:
    """The mean square by which each row (ny,) of a sensor's prediction moves in `delay` seconds, as the model says.

    Zero where the model has no number for it.
    """
    made, model = fold.compiled, fold.model
    x, _ = fold.moments()
    u, p = fold.u, np.asarray(fold.tuning.p, float)
    dt = min(delay, model.max_step)
    X = np.ascontiguousarray(x)[None, :]
    now = made.h_block(sensor, X, u, p)[0]
    circular = np.array([row.circular for row in model.sensors[sensor].rows])
    then = made.h_block(sensor, made.f_block(X, u, p, dt), u, p)[0]
    shift = _apart(then, now, circular)
    moved = (shift * (delay / dt)) ** 2
    if model.nx <= MOST and made.box is None:
        Q = np.zeros((model.nx, model.nx))
        made.Q(X[0], u, p, np.asarray(fold.tuning.q, float), dt, Q)
        h = _STEP * np.maximum(1.0, np.abs(x))
        ends = made.h_block(sensor, X + np.diag(h), u, p), made.h_block(sensor, X - np.diag(h), u, p)
        H = ((ends[0] - ends[1]) / (2.0 * h[:, None])).T
        moved = moved + np.einsum("ij,jk,ik->i", H, Q, H) * (delay / dt)
    return np.where(np.isfinite(moved), np.maximum(moved, 0.0), 0.0)


def inflated(events: Events, fold: Fold, newest: int, horizon: int) -> tuple[Events, int]:
    """The events with their late readings stamped with the newest time before them, and with the R that this costs.

    Inputs and true states that are late stay where they are, and what is later than the horizon is left to the log.

    Args:
        events: In the order of arrival.
        fold: Its estimate says how fast the readings move.
        newest: Newest time of the log, ns.
        horizon: Lateness allowed, ns.

    Returns:
        The events, and how many of them were late.
    """
    asks = (events.kind == TICK) | (events.kind == MARK)
    said = np.where(asks, newest, events.t)
    before = np.concatenate(([newest], np.maximum(np.maximum.accumulate(said), newest)[:-1]))
    if not np.any((events.kind == READING) & (events.t < before) & (events.t >= before - horizon)):
        return events, 0
    model, width = fold.model, fold.log.width
    wide = events.widened(width + model.width)
    value, t = wide.value.copy(), wide.t.copy()
    count = 0
    for i in range(len(events)):
        if events.kind[i] == READING and newest - horizon <= t[i] < newest:
            sensor = int(events.channel[i])
            rows = len(model.sensors[sensor].rows)
            start = model.row_start[sensor]
            own = value[i, width : width + rows]
            base = np.where(np.isnan(own), fold.tuning.r[start : start + rows], own)
            value[i, width : width + rows] = base + moved_variance(fold, sensor, float(newest - t[i]) * 1e-9)
            # After all that is there: at the newest time itself it could come before another, and take the fold back.
            t[i] = newest + 1
            count += 1
        if not asks[i]:
            newest = max(newest, int(t[i]))
    return wide._replace(t=t, value=value), count


def _apart(a: np.ndarray, b: np.ndarray, circular: np.ndarray) -> np.ndarray:
    """a - b, of angles the shorter way round."""
    apart = a - b
    return np.where(circular, (apart + np.pi) % (2.0 * np.pi) - np.pi, apart)
