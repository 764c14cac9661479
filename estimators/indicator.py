"""A discrete mode as filters see it that know means and covariances only: a continuous number.

It has the mean and the variance that a jump gives it (see jump.py). The estimate of it can leave its range, and one
Gaussian must stand for a mixture: that is where these filters fail.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from .jit import jit
from .joint import as_inner
from .model import StateSpaceModel


def indicator(model: StateSpaceModel) -> StateSpaceModel:
    """The model for filters that do not sample: the mode is continuous, with a jump's first two moments.

    m' = Σ k c_k and its noise has the variance Σ k² c_k - m'², where c are the chances, interpolated between those of
    the two modes next to m. Between the modes f and h are the model's own.
    """
    return model if model.jump is None else _indicator(model)


@lru_cache(maxsize=32)
def _indicator(model: StateSpaceModel) -> StateSpaceModel:
    if model.jump is None:
        return model
    jump = as_inner(model.jump.chances)
    j, count = model.mode, len(model.jump.modes)
    acts_on = tuple((k, i) for k, noise in enumerate(model.noises) for i in model.acts_on(noise.name))
    return replace(
        model,
        f=_step(model.f, jump, j, count),
        F=None,
        Q=_noise(model.Q, jump, j, count, () if model.Q else acts_on),
        jump=None,
        conditionally_linear=(),
    )


@jit
def _moments(chances, x, u, p, dt, j, count):
    """Mean and variance of the next mode, for a mode x[j] between the whole numbers; x keeps what it is."""
    m = x[j]
    at = min(max(m.real, 0.0), count - 1.0)
    low = min(int(at), count - 2)
    part = m - low if m.real == at else m * 0.0 + (at - low)
    z = x.copy()
    c = np.empty(count, x.dtype)
    mean = part * 0.0
    square = part * 0.0
    for k in range(2):
        z[j] = low + k
        chances(z, u, p, dt, c)
        share = part if k == 1 else 1.0 - part
        for i in range(count):
            mean += share * i * c[i]
            square += share * i * i * c[i]
    return mean, square - mean * mean


def _step(function: Callable, chances: Any, j: int, count: int) -> Callable:
    inner = as_inner(function)

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        mean, _ = _moments(chances, x, u, p, dt, j, count)
        z = x.copy()
        z[j] = mean
        inner(z, u, p, dt, out)
        out[j] = mean

    return f


def _noise(function: Callable | None, chances: Any, j: int, count: int, acts_on: tuple) -> Callable:
    inner = _each if function is None else as_inner(function)
    given = function is not None
    pairs = np.array(acts_on, np.int64).reshape(-1, 2)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        mean, variance = _moments(chances, x, u, p, dt, j, count)
        z = x.copy()
        z[j] = mean
        if given:
            inner(z, u, p, q, dt, out)
        else:
            for k in range(pairs.shape[0]):
                out[pairs[k, 1], pairs[k, 1]] += q[pairs[k, 0]] * dt
        out[j, j] = max(variance, 0.0)

    return Q


@jit
def _each(x, u, p, q, dt, out):
    """Nothing: the noises of a model without Q are added by name."""
