"""What a signal of a recording is like: rate, holes, resolution, noise."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sources.inspect import RecordingContents, Series, holes

FEWEST = 20
"""Values needed to estimate a noise."""

SKIPPED = re.compile(
    r"time|epoch|date|count|check|crc|valid|status|mode|error|alive|_id$|^id$|parity|accuracy", re.IGNORECASE
)
"""Names of what is no measurement."""

DEGREES = ("deg", "°", "degree", "degrees")

STEPS = 8
"""Levels up to which a signal is a switch and no measurement."""


class Signal(NamedTuple):
    """A signal, and what its values say.

    `rate` is readings a second by the usual interval, NaN with none; `holes` how many gaps far longer than usual, and
    `longest` the longest, s. `resolution` is the smallest step between two values, `levels` how many values there are.
    `noise` is the standard deviation of what is not smooth in it, in its unit, never below that of its resolution.
    `kind` is "signal", "switch", "counter", "constant", or "short". `wraps`: an angle in degrees that jumps by a turn;
    its series is in radians, and goes on where the angle jumps.
    """

    name: str
    message: str | None
    series: Series
    rate: float
    holes: int
    longest: float
    resolution: float
    levels: int
    noise: float
    kind: str
    wraps: bool = False


def signals(found: RecordingContents) -> list[Signal]:
    """All signals with values, in the order of the recording."""
    offers: list[tuple[str | None, Series]] = [(m.name, series) for m in found.messages for series in m.signals]
    offers += [(None, series) for series in found.columns]
    return [signal(message, series) for message, series in offers if series.values.size]


def signal(message: str | None, series: Series) -> Signal:
    """What one series is like."""
    wraps = series.unit in DEGREES and bool(np.any(np.abs(np.diff(series.values)) > 300.0))
    if wraps:
        series = replace(series, unit="rad", values=np.unwrap(np.radians(series.values)))
    t, y = series.t, series.values
    apart = np.diff(t)[np.diff(t) > 0] * 1e-9
    rate = 1.0 / float(np.median(apart)) if apart.size else np.nan
    levels = np.unique(y)
    resolution = step_of(levels)
    noise = max(rough(t, y), resolution / np.sqrt(12.0))
    return Signal(
        series.name,
        message,
        series,
        rate,
        len(holes(t)),
        float(apart.max()) if apart.size else 0.0,
        resolution,
        int(levels.size),
        noise,
        _kind(series, levels),
        wraps,
    )


def _kind(series: Series, levels: np.ndarray) -> str:
    if series.values.size < FEWEST:
        return "short"
    if levels.size == 1:
        return "constant"
    if levels.size <= STEPS:
        return "switch"
    if SKIPPED.search(series.name):
        return "counter"
    return "signal"


def step_of(levels: np.ndarray) -> float:
    """The smallest step between sorted values, less than which is the rounding of their decoding; 0 without any."""
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * max(float(np.ptp(levels)), 1e-300)] if levels.size > 1 else steps
    return float(steps.min()) if steps.size else 0.0


def rough(t: np.ndarray, y: np.ndarray) -> float:
    """Standard deviation of the noise of a smooth curve that is sampled at t (ns), (n,), with any intervals.

    e_k = a y_(k-1) + b y_(k+1) - y_k is what the straight line between the neighbours leaves of a value, with
    a = (t_(k+1) - t_k) / (t_(k+1) - t_(k-1)) and b = 1 - a; σ² = mean of e_k² / (a² + b² + 1). What is not smooth over
    two intervals counts as noise, so this is an upper bound.

    Source: Gasser, Sroka & Jennen-Steinmetz (1986), doi:10.1093/biomet/73.3.625, equation 2.
    """
    keep = np.flatnonzero(np.diff(t, prepend=t[0] - 1) > 0)
    s, v = t[keep] * 1e-9, y[keep]
    if v.size < 3:
        return 0.0
    h = np.diff(s)
    usual = np.median(h)
    a = h[1:] / (h[1:] + h[:-1])
    b = 1.0 - a
    e = a * v[:-2] + b * v[2:] - v[1:-1]
    # Nothing is straight across a hole.
    near = (h[1:] < 3.0 * usual) & (h[:-1] < 3.0 * usual)
    square = e[near] ** 2 / (a[near] ** 2 + b[near] ** 2 + 1.0)
    return float(np.sqrt(np.mean(square))) if square.size else 0.0
