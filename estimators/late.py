"""Late measurements: the cost of a rewind, and the cheap alternative, an update now with an inflated R.

The exact way is to insert the measurement at its time and rewind the fold. The cheap way stamps it with the newest time
and adds to the variance of each row the mean square by which the predicted measurement has moved since,

    R + (delay · dh/dt)² + H Q(delay) Hᵀ,    dh/dt ≈ (h(f(x, u, p, dt)) - h(x)) / dt

at the present estimate. It treats a known shift as noise, and neglects that the error of the measurement is correlated
with the history of the state. It suits measurements that are late now and then. If all measurements of a sensor have
the same delay, the shift is a bias, which no R describes, and the confidence bands become too narrow.

Sources: Larsen, Andersen, Ravn & Poulsen (1998), doi:10.1109/CDC.1998.758571, and Alexander (1991),
doi:10.1117/12.44531, for updates that carry the correlation; each would need a filter of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .compiled.jacobians import CENTRAL_STEP
from .events.batch import MARK, READING, TICK, Events
from .numerics.linalg import wrapped

if TYPE_CHECKING:
    from .fold import Fold

EVENT_S_PER_NUMBER = 50e-9
"""Seconds per event and number of a filter's state: 3 s for 50 members of a million cells each."""

MAX_NOISE_STATES = 256
"""States beyond which H Q Hᵀ is neglected: larger ones are ensembles, whose Q is too large to form."""


def rewind_seconds(numbers: int, events: int) -> float:
    """Return the expected time, s, to fold so many events again with a filter whose state has so many numbers."""
    return events * numbers * EVENT_S_PER_NUMBER


def moved_variance(fold: Fold, sensor: int, delay: float) -> np.ndarray:
    """Return the mean square by which each row (ny,) of a predicted measurement moves in `delay` seconds.

    Zero where the model returns no finite number.
    """
    made, model = fold.compiled, fold.model
    x, _ = fold.moments()
    u, p = fold.u, np.asarray(fold.tuning.p, float)
    dt = min(delay, model.max_step)
    X = np.ascontiguousarray(x)[None, :]
    now = made.h_block(sensor, X, u, p)[0]
    circular = np.array([row.circular for row in model.sensors[sensor].rows])
    then = made.h_block(sensor, made.f_block(X, u, p, dt), u, p)[0]
    moved = (wrapped(then - now, circular) * (delay / dt)) ** 2
    if model.nx <= MAX_NOISE_STATES and made.box is None:
        Q = np.zeros((model.nx, model.nx))
        made.Q(X[0], u, p, np.asarray(fold.tuning.q, float), dt, Q)
        h = CENTRAL_STEP * np.maximum(1.0, np.abs(x))
        ends = made.h_block(sensor, X + np.diag(h), u, p), made.h_block(sensor, X - np.diag(h), u, p)
        H = ((ends[0] - ends[1]) / (2.0 * h[:, None])).T
        moved = moved + np.einsum("ij,jk,ik->i", H, Q, H) * (delay / dt)
    return np.where(np.isfinite(moved), np.maximum(moved, 0.0), 0.0)


def inflated(events: Events, fold: Fold, newest: int, horizon: int) -> tuple[Events, int]:
    """Stamp late measurements with the newest time before them, and inflate their R.

    Late inputs and true states are unchanged. Measurements later than the horizon are left for the log to drop.

    Args:
        events: Events in the order of arrival.
        fold: Fold whose estimate gives the rate of change of the measurements.
        newest: Newest time of the log, ns.
        horizon: Allowed delay, ns.

    Returns:
        The events, and the number of late measurements.
    """
    queries = (events.kind == TICK) | (events.kind == MARK)
    times = np.where(queries, newest, events.t)
    before = np.concatenate(([newest], np.maximum(np.maximum.accumulate(times), newest)[:-1]))
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
            # One nanosecond after the newest: at the same time it could precede another event and rewind the fold.
            t[i] = newest + 1
            count += 1
        if not queries[i]:
            newest = max(newest, int(t[i]))
    return wide._replace(t=t, value=value), count
