"""Window of the last judged measurements of an asset: a ring in its block, from which a measurement drops out in turn.

A single fold finds its window in the rows of its track (`diagnostics/health.py`). A fleet keeps no rows, and reading
the window again for each event takes longer than the event.
"""

from __future__ import annotations

import numpy as np

from ..diagnostics.health import (
    JUDGED_MEAN,
    MAX_ROWS_PER_READING,
    MEAN,
    NORMALS,
    VARIANCE,
    window_bounds,
    write_window,
)
from ..numerics.jit import embedded, part
from ..numerics.simd import total as sum_of
from ..track import USED
from .memory import DOF, IN_WINDOW, JUDGED, USED_IN_WINDOW

_ROW_BITS, _CHANNEL_BITS = 28, 14


@part
def has_no_baseline(normal):
    """Return whether the expected NIS of all sensors (sensors · NORMALS,) are those of white, normal innovations."""
    for k in range(0, normal.size, NORMALS):
        if normal[k + JUDGED_MEAN] != 1.0 or normal[k + MEAN] != 1.0 or normal[k + VARIANCE] != 2.0:
            return False
    return True


@embedded
def _dof(code):
    """Return the degrees of freedom of a measurement of the window, -1 if it was not used."""
    return (code & (1 << _CHANNEL_BITS) - 1) - 1


@embedded
def _count(head, dof, sign):
    """Add a measurement to the counts of the window, or take it out."""
    head[IN_WINDOW] += sign
    if dof >= 0:
        head[USED_IN_WINDOW] += sign
        head[DOF] += sign * dof


@embedded
def slide(i, event, channel, block, normal, white, policy, bounds, terms, track):
    """Put a judged measurement, row i of the track, into the window, and fill the columns of the window in row i.

    Args:
        i: Row of the track.
        event: Number of the event in its asset.
        channel: Its sensor.
        block: Block of the asset.
        normal: Expected NIS of each sensor, (sensors · NORMALS,).
        white: Whether these are as without a baseline, so that they follow from the degrees of freedom.
        policy: Limits of health.
        bounds: Quantiles of chi-square.
        terms: Scratch, (1 + NORMALS, window or more).
        track: The track.
    """
    head, codes, nis = block.head, block.codes, block.nis
    kept, window = codes.size, policy.window
    at = head[JUDGED] % kept
    used = track.verdict[i] == USED
    dof = np.int64(track.dof[i]) if used else -1
    codes[at] = event << _ROW_BITS | channel << _CHANNEL_BITS | (dof + 1)
    nis[at] = track.nis[i] if used else 0.0
    head[JUDGED] += 1
    _count(head, dof, 1)
    oldest = at - head[IN_WINDOW] + 1
    if oldest < 0:
        oldest += kept
    while head[IN_WINDOW] > 0 and (
        head[IN_WINDOW] > window or event - (codes[oldest] >> _ROW_BITS) >= MAX_ROWS_PER_READING * window
    ):
        _count(head, _dof(codes[oldest]), -1)
        oldest = oldest + 1 if oldest + 1 < kept else 0
    size = head[IN_WINDOW]
    before_end = min(size, kept - oldest)
    for k in range(before_end):
        terms[0, k] = nis[oldest + k]
    for k in range(before_end, size):
        terms[0, k] = nis[k - before_end]
    total = sum_of(size, terms[0])
    due = mean = float(head[DOF])
    variance = 2.0 * mean
    if not white:
        for k in range(size):
            code = codes[oldest + k if k < before_end else k - before_end]
            sensor = code >> _CHANNEL_BITS & (1 << _ROW_BITS - _CHANNEL_BITS) - 1
            for j in range(NORMALS):
                terms[1 + j, k] = max(_dof(code), 0) * normal[NORMALS * sensor + j]
        due = sum_of(size, terms[1 + JUDGED_MEAN])
        mean = sum_of(size, terms[1 + MEAN])
        variance = sum_of(size, terms[1 + VARIANCE])
    low = high = np.nan
    if head[USED_IN_WINDOW] > 0:
        low, high = window_bounds(mean, variance, head[DOF], head[USED_IN_WINDOW], bounds.low, bounds.high)
    track.age[i] = 0.0
    write_window(i, total, due, size, head[USED_IN_WINDOW], low, high, policy, track)


@part
def return_to(event, block, window):
    """Take measurements from event number `event` on out of the window; those before it return to it."""
    head, codes = block.head, block.codes
    while head[JUDGED] > 0 and codes[(head[JUDGED] - 1) % codes.size] >> _ROW_BITS >= event:
        head[JUDGED] -= 1
    head[IN_WINDOW] = head[USED_IN_WINDOW] = head[DOF] = 0
    for k in range(min(head[JUDGED], window)):
        _count(head, _dof(codes[(head[JUDGED] - 1 - k) % codes.size]), 1)
