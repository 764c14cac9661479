"""The noise of a signal and of what moves it, from the differences of its values."""

from __future__ import annotations

import numpy as np

from sources.inspect import Series

from .signals import rough, step_of

SURE = 3.0
"""Standard errors of a variance of differences, √(8 / n) of it for white noise, below which it tells nothing."""

FAR = 20
"""Intervals over which a slow walk is looked for."""


def noise_of(series: Series) -> tuple[bool, float, float]:
    """Whether a signal moves smoothly, its process noise in one second, and the variance of its readings.

    Of a random walk with noisy readings, y = x + v, the differences d have E d² = q dt + 2 r and E d_k d_(k+1) = -r. Of
    one whose speed is a random walk, the second differences e have E e² = ⅔ q dt³ + 6 r and
    E e_k e_(k+1) = q dt³/6 - 4 r. It moves smoothly if its differences follow one another, with a correlation above ½,
    which noise alone makes negative. A variance r is at least that of the resolution, step²/12.

    Source: the covariances of the differences, from the definitions; e is the integral of the noise of the speed
    with a triangle of width 2 dt and height dt.
    """
    y, t = series.values, series.t * 1e-9
    dt = float(np.median(np.diff(t)[np.diff(t) > 0])) if np.any(np.diff(t) > 0) else 1.0
    steady = np.flatnonzero(np.abs(np.diff(t) - dt) < 0.5 * dt)
    d = np.diff(y)
    floor = max(step_of(np.unique(y)) ** 2 / 12, 1e-12 * float(np.mean(d**2))) or 1e-12
    both = steady[:-1][np.diff(steady) == 1] if steady.size > 1 else steady[:0]
    power = float(np.mean(d[steady] ** 2)) if steady.size else float(np.mean(d**2))
    follow = float(np.mean(d[both] * d[both + 1])) if both.size else 0.0
    power = max(power, floor)
    if follow <= 0.5 * power:
        r = max(min(-follow, 0.5 * power), floor)
        q = max(power - 2 * r, 0.01 * power) / dt
        if q * dt < SURE * power * np.sqrt(8.0 / max(1, both.size)):
            # Hardly told from none by one interval; after many the walk stands out from the noise, if there is one.
            far = y[FAR:] - y[:-FAR]
            whole = (t[FAR:] - t[:-FAR]) < 1.5 * FAR * dt
            grown = float(np.mean(far[whole] ** 2)) if whole.any() else 0.0
            q = max(grown - 2 * r, 1e-4 * FAR * power) / (FAR * dt)
        return False, q, r
    e = d[both + 1] - d[both]
    second = max(float(np.mean(e**2)), floor)
    next_to = np.flatnonzero(np.diff(both) == 1)
    lagged = float(np.mean(e[next_to] * e[next_to + 1])) if next_to.size else 0.0
    r = max(min((second / 4 - lagged) / 5.5, second / 6), floor)
    return True, max(second - 6 * r, 0.01 * second) / (2 / 3 * dt**3), r


def walk_of(series: Series) -> float:
    """Variance that a random walk with noisy readings adds in one second, whether it moves smoothly or not.

    E d² = q dt + 2 r of its differences, r by what is rough in it (`signals.rough`).
    """
    d, dt = np.diff(series.values), np.diff(series.t) * 1e-9
    later = dt > 0.0
    if not later.any():
        return 1.0
    power = float(np.mean(d[later] ** 2))
    r = min(rough(series.t, series.values) ** 2, 0.495 * power)
    return max(power - 2.0 * r, 1e-12) / float(np.mean(dt[later]))
