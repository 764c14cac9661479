"""Models made from other models: their functions called by compiled wrappers, noise, and modes as numbers.

A mode as a continuous number, for filters that use means and covariances only, has the mean and the variance that a
jump gives it (see `Jump`). Its estimate can leave its range, and one Gaussian stands for a mixture: these filters fail
where that is a poor approximation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..numerics.helpers import compiled
from ..numerics.jit import Inner, inner, named, plain
from .state_space import StateSpaceModel


@lru_cache(maxsize=256)
def as_inner(function: Callable) -> Inner:
    """Compile a model's function for a wrapper to call, whose code LLVM copies into that of the wrapper."""
    return compiled(plain(function), {}, forceinline=True)


def derived(function: Callable) -> Callable:
    """Mark a Jacobian by complex step: where f or h is not analytic, differences take its place."""
    function.derived = True  # type: ignore[attr-defined]
    return function


def is_derived(function: Callable | None) -> bool:
    """Return whether a Jacobian is marked by `derived`."""
    return getattr(plain(function), "derived", False)


def noise_function(model: StateSpaceModel) -> Callable:
    """Return the model's Q, or one that adds each noise to the states of its name."""
    if model.Q is not None:
        return model.Q
    return _white_noise(tuple((k, j) for k, item in enumerate(model.noises) for j in model.acts_on(item.name)))


@lru_cache(maxsize=64)
def _white_noise(acts_on: tuple[tuple[int, int], ...]) -> Callable:
    pairs = np.array(acts_on, np.int64).reshape(-1, 2)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        for i in range(pairs.shape[0]):
            out[pairs[i, 1], pairs[i, 1]] += q[pairs[i, 0]] * dt

    return Q


MIN_MODE_VARIANCE = 1e-6
"""Variance that the mode keeps: with none, its estimate could never change, and some filters need a positive one."""


def indicator(model: StateSpaceModel) -> StateSpaceModel:
    """Return the model for filters that do not sample: the mode is continuous, with a jump's first two moments.

    m' = Σ k c_k, and its noise has the variance Σ k² c_k - m'² (at least `MIN_MODE_VARIANCE`); c are the chances,
    interpolated between those of the two modes next to m. Between the modes f and h are the model's own.
    """
    return model if model.jump is None else _indicator(model)


@lru_cache(maxsize=32)
def _indicator(model: StateSpaceModel) -> StateSpaceModel:
    assert model.jump is not None
    j, count = model.mode, len(model.jump.modes)
    return replace(
        model,
        f=_step(model.f, model.jump.chances, j, count),
        F=None,
        Q=_noise(noise_function(model), model.jump.chances, j, count),
        jump=None,
        conditionally_linear=(),
    )


@named
@inner
def _between(m, count):
    """Return the lower of the two modes next to m, and the fraction of the way to the upper one."""
    low = 0
    while low < count - 2 and m.real >= low + 1:
        low += 1
    if m.real <= low:
        return low, 0.0 * m
    if m.real >= low + 1:
        return low, 0.0 * m + 1.0
    return low, m - low


@named
@inner
def _moments(c, part):
    """Return mean and variance of the next mode, from the chances c (2, modes) of two modes and the second's weight."""
    mean = 0.0 * part
    square = 0.0 * part
    for i in range(c.shape[1]):
        share = (1.0 - part) * c[0, i] + part * c[1, i]
        mean += share * i
        square += share * i * i
    return mean, square - mean * mean


# Each wrapper has a function around the chances: a compiled function that takes another as an argument is not cached.
def _next_mode(chances: Callable, j: int, count: int) -> Callable:
    """Return a function that sets the mode in z, which it works in, to the mean of the next; return its variance."""
    jumping = as_inner(chances)

    def settle(z, u, p, dt):  # noqa: ANN001, ANN202
        c = np.empty((2, count), z.dtype)
        low, part = _between(z[j], count)
        for k in range(2):
            z[j] = low + k
            jumping(z, u, p, dt, c[k])
        z[j], variance = _moments(c, part)
        return variance

    return as_inner(settle)


def _step(function: Callable, chances: Callable, j: int, count: int) -> Callable:
    inner, settle = as_inner(function), _next_mode(chances, j, count)

    def f(x, u, p, dt, out):  # noqa: ANN001, ANN202
        z = x.copy()
        settle(z, u, p, dt)
        inner(z, u, p, dt, out)
        out[j] = z[j]

    return f


def _noise(function: Callable, chances: Callable, j: int, count: int) -> Callable:
    inner, settle = as_inner(function), _next_mode(chances, j, count)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        z = x.copy()
        variance = settle(z, u, p, dt)
        inner(z, u, p, q, dt, out)
        out[j, j] = max(variance, MIN_MODE_VARIANCE)

    return Q
