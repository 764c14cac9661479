"""A discrete mode as filters see it that know means and covariances only: a continuous number.

It has the mean and the variance that a jump gives it (see jump.py). The estimate of it can leave its range, and one
Gaussian must stand for a mixture: that is where these filters fail.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..numerics.jit import jit
from .joint import as_inner
from .state_space import StateSpaceModel

LEAST = 1e-6
"""Variance that the mode keeps: a filter that was certain of it could never change its mind, and some need one."""


def indicator(model: StateSpaceModel) -> StateSpaceModel:
    """The model for filters that do not sample: the mode is continuous, with a jump's first two moments.

    m' = Σ k c_k and its noise has the variance Σ k² c_k - m'² (no less than `LEAST`), where c are the chances,
    interpolated between those of the two modes next to m. Between the modes f and h are the model's own.
    """
    return model if model.jump is None else _indicator(model)


@lru_cache(maxsize=32)
def _indicator(model: StateSpaceModel) -> StateSpaceModel:
    if model.jump is None:
        return model
    j, count = model.mode, len(model.jump.modes)
    acts_on = tuple((k, i) for k, noise in enumerate(model.noises) for i in model.acts_on(noise.name))
    return replace(
        model,
        f=_step(model.f, model.jump.chances, j, count),
        F=None,
        Q=_noise(model.Q, model.jump.chances, j, count, () if model.Q else acts_on),
        jump=None,
        conditionally_linear=(),
    )


@jit
def _between(m, count):
    """The modes next to m, held between the first and the last: the lower one, and how far m is on from there."""
    low = 0
    while low < count - 2 and m.real >= low + 1:
        low += 1
    if m.real <= low:
        return low, 0.0 * m
    if m.real >= low + 1:
        return low, 0.0 * m + 1.0
    return low, m - low


@jit
def _moments(c, part):
    """Mean and variance of the next mode, from the chances c (2, modes) of two modes, the second's part given."""
    mean = 0.0 * part
    square = 0.0 * part
    for i in range(c.shape[1]):
        share = (1.0 - part) * c[0, i] + part * c[1, i]
        mean += share * i
        square += share * i * i
    return mean, square - mean * mean


# Each of the two calls the chances itself: a compiled function that takes another as an argument is not cached.
def _step(function: Callable, chances: Callable, j: int, count: int) -> Callable:
    inner, jumping = as_inner(function), as_inner(chances)

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        z = x.copy()
        c = np.empty((2, count), x.dtype)
        low, part = _between(x[j], count)
        for k in range(2):
            z[j] = low + k
            jumping(z, u, p, dt, c[k])
        mean, _ = _moments(c, part)
        z[j] = mean
        inner(z, u, p, dt, out)
        out[j] = mean

    return f


def _noise(function: Callable | None, chances: Callable, j: int, count: int, acts_on: tuple) -> Callable:
    given = function is not None
    inner, jumping = as_inner(function or _nothing), as_inner(chances)
    pairs = np.array(acts_on, np.int64).reshape(-1, 2)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        z = x.copy()
        c = np.empty((2, count))
        low, part = _between(x[j], count)
        for k in range(2):
            z[j] = low + k
            jumping(z, u, p, dt, c[k])
        mean, variance = _moments(c, part)
        z[j] = mean
        inner(z, u, p, q, dt, out)
        if not given:
            for k in range(pairs.shape[0]):
                out[pairs[k, 1], pairs[k, 1]] += q[pairs[k, 0]] * dt
        out[j, j] = max(variance, LEAST)

    return Q


def _nothing(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
    """The Q of a model whose noises are added by name."""
