"""A model's functions with states appended that each keep themselves for a time: what coloured.py declares, computed.

The equations are those of coloured.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from .joint import as_inner
from .state_space import Sensor, StateSpaceModel


class Layout(NamedTuple):
    """Where things stand. The model within has n states, k parameters and m noises.

    State n + i keeps itself for the time p[time[i]]. The first `along.shape[1]` are disturbances: state n + i acts on
    the model's states along b = along[:, i] (n, disturbances), and `share[i]` of the noise q[noise[i]] drives it. The
    others are errors of sensors, with the variance q[noise[i]].
    """

    n: int
    k: int
    m: int
    time: tuple[int, ...]
    noise: tuple[int, ...]
    share: tuple[float, ...]
    along: tuple[tuple[float, ...], ...]


def functions(model: StateSpaceModel, layout: Layout, first: Mapping[str, int]) -> dict[str, Any]:
    """The fields of a model that are functions, or hold them, around those of `model`.

    `first` is where the errors of a sensor begin among the states, by sensor.
    """
    acts_on = () if model.Q else tuple(model.acts_on(noise.name).start for noise in model.noises)
    return {
        "f": _step(model.f, layout),
        "F": None if model.F is None else _slope(model.F, layout),
        "Q": _noise(model.Q, acts_on, layout),
        "sensors": tuple(_heard(sensor, first.get(sensor.name), layout) for sensor in model.sensors),
        "jump": None if model.jump is None else replace(model.jump, chances=_inside(model.jump.chances, layout)),
    }


def _integrated(a: float) -> float:
    """Variance of ∫c dt that a step of a = dt/τ adds, over q dt: 1 - (2 (1 - e⁻ᵃ) - (1 - e⁻²ᵃ)/2) / a."""
    if a < 0.05:
        # The terms above cancel to a²/3; of the series, the first that is left out is 3e-13 of that.
        c = (1 / 3, -1 / 4, 7 / 60, -1 / 24, 31 / 2520, -1 / 320, 127 / 181440)
        return a * a * (c[0] + a * (c[1] + a * (c[2] + a * (c[3] + a * (c[4] + a * (c[5] + a * c[6]))))))
    gone = -np.expm1(-a)
    return 1.0 - gone * (1.0 + 0.5 * gone) / a


@lru_cache(maxsize=64)
def _step(function: Callable, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, time = layout.n, layout.k, np.array(layout.time)
    along = np.array(layout.along).reshape(n, -1)

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], dt, out[:n])
        for i in range(time.size):
            a = dt / p[time[i]]
            if i < along.shape[1]:
                moved = -np.expm1(-a) * p[time[i]] * x[n + i]
                for j in range(n):
                    out[j] += along[j, i] * moved
            out[n + i] = np.exp(-a) * x[n + i]

    return f


@lru_cache(maxsize=64)
def _slope(function: Callable, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, time = layout.n, layout.k, np.array(layout.time)
    along = np.array(layout.along).reshape(n, -1)

    def F(x, u, p, dt, out):  # noqa: ANN001, ANN202
        out[:, :] = 0.0
        inner(x[:n], u, p[:k], dt, out[:n, :n])
        for i in range(time.size):
            a = dt / p[time[i]]
            if i < along.shape[1]:
                for j in range(n):
                    out[j, n + i] = -np.expm1(-a) * p[time[i]] * along[j, i]
            out[n + i, n + i] = np.exp(-a)

    return F


@lru_cache(maxsize=64)
def _noise(function: Callable | None, acts_on: tuple[int, ...], layout: Layout) -> Callable:
    given = function is not None
    inner = as_inner(function or _nothing)
    n, k, m = layout.n, layout.k, layout.m
    time, noise, share = np.array(layout.time), np.array(layout.noise), np.array(layout.share)
    along = np.array(layout.along).reshape(n, -1)
    states = np.array(acts_on, np.int64)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        white = q[:m].copy()
        for i in range(along.shape[1]):
            white[noise[i]] = q[noise[i]] * _integrated(dt / p[time[i]])
        if given:
            inner(x[:n], u, p[:k], white, dt, out[:n, :n])
        else:
            for i in range(states.size):
                out[states[i], states[i]] += white[i] * dt
        for i in range(time.size):
            a = dt / p[time[i]]
            variance = q[noise[i]]
            if i < along.shape[1]:
                variance = 0.5 * q[noise[i]] * share[i] / p[time[i]]
                for j in range(n):
                    both = variance * p[time[i]] * np.expm1(-a) ** 2 * along[j, i]
                    out[j, n + i] = both
                    out[n + i, j] = both
            out[n + i, n + i] = -variance * np.expm1(-2.0 * a)

    return Q


def _nothing(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
    """The Q of a model whose noises are added by name."""


def _heard(sensor: Sensor, first: int | None, layout: Layout) -> Sensor:
    """The sensor with the errors that begin at state `first`, or with none."""
    return replace(
        sensor,
        h=_sensor(sensor.h, first, layout),
        H=None if sensor.H is None else _sensor_slope(sensor.H, first, layout),
        log_likelihood=(None if sensor.log_likelihood is None else _likelihood(sensor.log_likelihood, first, layout)),
    )


@lru_cache(maxsize=256)
def _sensor(function: Callable, first: int | None, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, wrong, e = layout.n, layout.k, first is not None, first or 0

    def h(x, u, p, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], out)
        if wrong:
            for i in range(out.size):
                out[i] += x[e + i]

    return h


@lru_cache(maxsize=256)
def _sensor_slope(function: Callable, first: int | None, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, wrong, e = layout.n, layout.k, first is not None, first or 0

    def H(x, u, p, out):  # noqa: ANN001, ANN202
        out[:, :] = 0.0
        inner(x[:n], u, p[:k], out[:, :n])
        if wrong:
            for i in range(out.shape[0]):
                out[i, e + i] = 1.0

    return H


@lru_cache(maxsize=256)
def _likelihood(function: Callable, first: int | None, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k, wrong, e = layout.n, layout.k, first is not None, first or 0

    def log_likelihood(y, x, u, p, r):  # noqa: ANN001, ANN202
        told = y.copy()
        if wrong:
            for i in range(y.size):
                told[i] -= x[e + i]
        return inner(told, x[:n], u, p[:k], r)

    return log_likelihood


@lru_cache(maxsize=64)
def _inside(function: Callable, layout: Layout) -> Callable:
    inner = as_inner(function)
    n, k = layout.n, layout.k

    def chances(x, u, p, dt, out):  # noqa: ANN001, ANN202
        inner(x[:n], u, p[:k], dt, out)

    return chances
