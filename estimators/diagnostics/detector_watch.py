"""Apply the detectors to new rows of a track, and fill their alarms, flags and the health of the twin."""

from __future__ import annotations

import numpy as np

from ..compiled.context import prior, sensor_rows, sensor_variances, shown_states
from ..log import INPUT, READING, RESET
from ..numerics.jit import borrowed, embedded, floats, ints, part
from ..track import (
    ADVISORY,
    DEGRADED,
    DIVERGED,
    DUPLICATE,
    FAILED,
    GATED,
    NO_VALUE,
    SCREENED,
    STALE,
    SUSPECT,
    TRACKING,
    USED,
    WAITING,
    borrowed_columns,
)
from .detector_state import (
    ACTED_ON,
    ADVISED,
    ADVISED_ROWS,
    BEGUN,
    DUE,
    GRADE,
    HEARD,
    JOINT_MASK,
    LOST_ROWS,
    MASK,
    NEXT_DUE,
    POOR,
    POOR_CLOUD,
    RESETTING,
    SILENT,
    SILENT_SENSORS,
    SUSPECT_ROWS,
    THRESHOLD,
    UNSETTLED,
    forget,
    row_part,
    sensor_part,
)
from .detector_tests import (
    add,
    alarm,
    find_dropouts,
    grade,
    note_coverage,
    note_time,
    repeat,
    resetting,
    weigh,
    weigh_joint,
)
from .detectors import (
    ADVISORY_ALARM,
    AGREEING,
    AT_REFUSALS,
    DISAGREEING,
    FAR_OUTSIDE,
    IMPOSSIBLE,
    IMPOVERISHED,
    LOST,
    OUTSIDE,
    REFUSED,
    SENSOR_FLAGS,
    SENSOR_MASK,
    STUCK,
    TESTS,
)
from .references import HALF_WIDTH

MIN_PARTICLES = 4.0
"""Effective sample size below which particles are poor; they also are if all descend from one particle, or agree."""

POOR_MEASUREMENTS = 60
"""Measurements more, poor than not, from which particles are impoverished; cleared at half as many. Three times the
number between two counts of ancestors: by chance one count may be 1, hardly three in succession."""


@embedded
def _has_news(i, y, count, track):
    """Return whether a measurement has a value in any row; a copy, as gateways make them, is no evidence."""
    for k in range(count):
        if np.isfinite(y[k]) and track.screened[i, k] & DUPLICATE == 0:
            return True
    return False


@embedded
def _test(i, now, y, s, context, policy, state, track):
    """Apply all tests to a measurement y of sensor s and the variances that may follow it."""
    width = track.alarms.shape[1]
    sensors = context.n_sensors
    chances = floats(context.chances, 2)
    variances = sensor_variances(context, s)
    first, count = sensor_rows(context, s)
    own = sensor_part(state, s)
    state[SILENT_SENSORS] -= own[SILENT]
    note_time(own, now, policy.false_alarm_every, context.n_tests, policy, ints(context.expected, sensors)[s])
    state[NEXT_DUE] = min(state[NEXT_DUE], own[DUE])
    h = own[THRESHOLD]
    verdict = track.verdict[i]
    judged = verdict == USED or verdict == GATED
    joint = 0
    base = floats(context.baseline + 8 * first * (3 + TESTS), 3)
    white = base[0] == 0.0 and base[1] == 1.0 and base[2] == 0.0
    unsettled = False
    if count > 1:
        for k in range(count):
            unsettled |= row_part(state, sensors, first + k)[RESETTING] > 0.0
    if judged and context.marginal == 0 and count > 1 and white and not unsettled:
        joint = weigh_joint(own, track.nis[i], track.dof[i], h, int(own[JOINT_MASK]))
        own[JOINT_MASK] = joint
    for k in range(count):
        if not np.isfinite(y[k]):
            continue
        row = first + k
        each = row_part(state, sensors, row)
        before = int(each[MASK])
        base = floats(context.baseline + 8 * row * (3 + TESTS), 3 + TESTS)
        r = variances[k]
        if width + k < y.size and np.isfinite(y[width + k]):
            r = y[width + k]
        innovation, std = track.innovation[i, k], track.innovation_std[i, k]
        begins = resetting(each, std)
        screened, mask = track.screened[i, k] != 0, before
        if track.screened[i, k] & NO_VALUE == 0:
            mask = before & ~STUCK | repeat(each, y[k], r, h, base, before, innovation, std, verdict == USED)
        if (judged or verdict == FAILED or screened) and not begins:
            ratio = chances[1] if verdict == USED and not screened else chances[0]
            level = add(each, AT_REFUSALS, ratio, h, base[3 + AT_REFUSALS])
            mask = mask & ~REFUSED | alarm(level, REFUSED, before)
        if judged and not screened and not begins:
            # NaN where the distribution function of a prediction that is not Gaussian is not known.
            e = track.whitened[i, k]
            if context.marginal == 0:
                e = innovation / std
            if np.isfinite(e):
                note_coverage(each, e, own)
                mask = mask & LOST | weigh(each, e, h, base, before)
        if k == 0:
            mask = mask & ~(DISAGREEING | AGREEING) | int(own[JOINT_MASK])
        each[MASK] = mask
        graded, graded_before = grade(each, mask, context.gated, r, base), each[GRADE]
        each[GRADE] = graded
        state[SUSPECT_ROWS] += (graded == ACTED_ON) - (graded_before == ACTED_ON)
        state[ADVISED_ROWS] += (graded == ADVISED) - (graded_before == ADVISED)
        state[LOST_ROWS] += (mask & LOST != 0) - (before & LOST != 0)


@embedded
def _agree(std, context):
    """Return whether all particles have one value of a state that is uncertain, as its prior was; modes may."""
    _, P = prior(context)
    shown = shown_states(context)
    for k in range(std.size):
        j = shown[k]
        if not std[k] > 0.0 and P[j % P.shape[0], j] > 0.0 and j != context.mode:
            return True
    return False


@embedded
def _count_particles(i, context, state, track):
    """Update whether particles are impoverished after another measurement that was used."""
    if track.effective[i] < MIN_PARTICLES or track.ancestors[i] < 2.0 or _agree(track.std[i], context):
        state[POOR] = min(state[POOR] + 1.0, float(POOR_MEASUREMENTS))
    else:
        state[POOR] = max(state[POOR] - 1.0, 0.0)
    if state[POOR] == POOR_MEASUREMENTS:
        state[POOR_CLOUD] = 1.0
    elif state[POOR] <= POOR_MEASUREMENTS // 2:
        state[POOR_CLOUD] = 0.0


@embedded
def _range(i, u, context, track):
    """Return the flags of states and inputs outside the range in which the model was fitted, or beyond all limits."""
    states = track.mean.shape[1]
    ranges = floats(context.ranges, 6 * (states + u.size))
    found = 0
    for k in range(states + u.size):
        value = track.mean[i, k] if k < states else u[k - states]
        own = ranges[6 * k : 6 * k + 6]
        if value < own[0] or value > own[1]:
            found |= OUTSIDE
        if value < own[2] or value > own[3]:
            found |= FAR_OUTSIDE
        half = HALF_WIDTH * track.std[i, k] if k < states else 0.0
        if value + half < own[4] or value - half > own[5]:
            found |= IMPOSSIBLE
    return found


@embedded
def _health(i, now, silent, flags, state, policy, track):
    """Return the health of the twin after an event."""
    finite = True
    for j in range(track.mean.shape[1]):
        finite &= np.isfinite(track.mean[i, j]) & np.isfinite(track.std[i, j])
    if not finite:
        return DIVERGED
    if state[HEARD] == 0.0:
        return STALE if now - state[BEGUN] > policy.stale_after else WAITING
    if track.age[i] > policy.stale_after:
        return STALE
    if track.consistency[i] == DIVERGED and state[UNSETTLED] == 0.0:
        return DIVERGED
    if track.age[i] > policy.degraded_after or silent != 0 or state[LOST_ROWS] > 0.0:
        return DEGRADED
    if state[SUSPECT_ROWS] > 0.0 or flags != 0:
        return SUSPECT
    return ADVISORY if state[ADVISED_ROWS] > 0.0 else TRACKING


@embedded
def watch_row(i, t, kind, channel, value, context, policy, state, track):
    """Fill alarms, flags (beside those of the memory) and health of row i of a track; `state` evolves."""
    sensors, rows, nu = context.n_sensors, context.n_rows, context.nu
    width = track.alarms.shape[1]
    expected = ints(context.expected, sensors)
    u = floats(row_part(state, sensors, rows).ctypes.data, nu)
    now = t[i] * 1e-9
    if not np.isfinite(state[BEGUN]):
        state[BEGUN] = now
        for s in range(sensors):
            if expected[s] > 0:
                sensor_part(state, s)[DUE] = now + policy.stale_after
        state[NEXT_DUE] = now + policy.stale_after
    for k in range(width):
        track.alarms[i, k] = 0
    if kind[i] == READING:
        y = floats(value[i:].ctypes.data, value.shape[1])
        first, count = sensor_rows(context, channel[i])
        # A sensor that reports no value has dropped out all the same.
        if _has_news(i, y, count, track):
            if track.verdict[i] != SCREENED:
                state[HEARD] = 1.0
                state[UNSETTLED] = max(state[UNSETTLED] - 1.0, 0.0)
            _test(i, now, y, channel[i], context, policy, state, track)
        # Neither a missing value nor a copy ends an alarm.
        for k in range(count):
            own = row_part(state, sensors, first + k)
            track.alarms[i, k] = int(own[MASK]) | (ADVISORY_ALARM if own[GRADE] == ADVISED else 0)
        if np.isfinite(track.effective[i]):
            _count_particles(i, context, state, track)
    elif kind[i] == INPUT:
        for k in range(nu):
            if np.isfinite(value[i, k]):
                u[k] = value[i, k]
    elif kind[i] == RESET:
        forget(state, sensors, rows, policy.window)
    if now > state[NEXT_DUE]:
        find_dropouts(state, sensors, now)
    flags = track.flags[i]
    for s in range(sensors if state[SILENT_SENSORS] > 0.0 else 0):
        if sensor_part(state, s)[SILENT] != 0.0:
            flags |= 1 << min(s, SENSOR_FLAGS - 1)
    silent = flags & SENSOR_MASK
    if context.fitted != 0:
        flags |= _range(i, u, context, track)
    if state[POOR_CLOUD] != 0.0:
        flags |= IMPOVERISHED
    track.flags[i] = flags
    track.health[i] = _health(i, now, silent, flags & ~context.unwatched, state, policy, track)


@part
def watch_rows(first, last, t, kind, channel, value, context, policy, state, track):
    """Fill alarms, flags and health of rows `first` to `last` of a track whose other columns are known.

    `state` evolves with the rows, so the result does not depend on the pieces of a fold.
    """
    t, kind, channel, value = borrowed(t), borrowed(kind), borrowed(channel), borrowed(value)
    state, track = borrowed(state), borrowed_columns(track)
    for i in range(first, last):
        watch_row(i, t, kind, channel, value, context, policy, state, track)
