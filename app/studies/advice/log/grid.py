"""Signals brought to common times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sources.inspect import Series

MOST = 4000
"""Times of a grid, at most."""

GAP = 5.0
"""Usual intervals, beyond which nothing is known between two values."""


def common(series: Sequence[Series]) -> tuple[np.ndarray, np.ndarray]:
    """Means of several signals over equal intervals: times (n,) in s from the first, and values (n, signals).

    Intervals are those of the slowest signal or longer, so that there are no more than 4000. What has no value of its
    own in one is taken from the line between its neighbours; NaN in a hole, and before and after it spoke.
    """
    begin = max(int(one.t[0]) for one in series)
    end = min(int(one.t[-1]) for one in series)
    if end <= begin:
        return np.zeros(0), np.zeros((0, len(series)))
    usual = [float(np.median(np.diff(one.t)[np.diff(one.t) > 0])) if one.t.size > 1 else 1e9 for one in series]
    step = max(max(usual), (end - begin) / MOST)
    edges = np.arange(begin, end + step, step)
    middles = 0.5 * (edges[1:] + edges[:-1])
    columns = [_mean(one, edges, middles, GAP * max(step, each)) for one, each in zip(series, usual, strict=True)]
    return (middles - begin) * 1e-9, np.column_stack(columns)


def _mean(series: Series, edges: np.ndarray, middles: np.ndarray, gap: float) -> np.ndarray:
    which = np.searchsorted(edges, series.t, side="right") - 1
    inside = (which >= 0) & (which < middles.size)
    count = np.bincount(which[inside], minlength=middles.size)
    with np.errstate(all="ignore"):
        mean = np.bincount(which[inside], weights=series.values[inside], minlength=middles.size) / count
    line = np.interp(middles, series.t, series.values)
    after = np.clip(np.searchsorted(series.t, middles), 1, series.t.size - 1)
    line[series.t[after] - series.t[after - 1] > gap] = np.nan
    return np.where(count > 0, mean, line)
