"""The members between readings: each through the model with process noise of its own, and additive inflation.

Source: Evensen (2003), doi:10.1007/s10236-003-0036-9.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from ..compiled.context import (
    context_at,
    place_of,
    prior,
    process_variances,
    shaped,
    transition,
)
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, noise_root
from ..numerics.jit import ints, jit
from ..numerics.random import key_of, normal
from ..numerics.vectors import add_scaled
from ..numerics.workspace import layout, share, start_of, take_matrix, take_vector
from .shared import ADDITIVE, CREWS, PROCESS, SPREAD, ensemble, next_draw, settle


class Forecast(NamedTuple):
    """What a crew moves members in: the next state, normal numbers, shaped noise (nx,), a root of Q and room for it."""

    forward: Any
    z: Any
    w: Any
    L: Any
    spare: Any
    end: int


@layout
def forecast_at(at, n, side):
    """Lay it out; `side` is n where the noise has a covariance, or 0."""
    forward, at = take_vector(at, n)
    z, at = take_vector(at, n)
    w, at = take_vector(at, n)
    L, at = take_matrix(at, side, side)
    spare, at = take_matrix(at, side, side)
    return Forecast(forward, z, w, L, spare, at)


@jit
def forecast(context, u, dt, key, X, crew, crews, scratch):
    """One crew's share of the members through f, with process noise of their own."""
    N, n = X.shape
    q = process_variances(context)
    first = ints(context.noise_state, context.n_noises)
    count = ints(context.noise_states, context.n_noises)
    side = n if context.each_state == 0 else 0
    forward, z, w, L, spare, _ = forecast_at(start_of(scratch), n, side)
    if side > 0 and context.Q_varies == 0:
        noise_root(context, X[0], u, dt, L, spare)
    for i in range(crew * N // crews, (crew + 1) * N // crews):
        x = X[i]
        transition(context, x, u, dt, forward)
        base = i * n
        if side > 0:
            # Noise that depends on the state does so where the step began.
            if context.Q_varies != 0:
                noise_root(context, x, u, dt, L, spare)
            for j in range(n):
                z[j] = normal(key, np.uint64(base + j))
            add_noise(L, z, forward)
        elif context.shape != 0:
            for j in range(n):
                z[j] = normal(key, np.uint64(base + j))
            shaped(context, z, w)
            add_scaled(n, np.sqrt(q[0] * dt), w, forward)
        else:
            for k in range(q.size):
                std = np.sqrt(q[k] * dt)
                if std > 0.0:
                    for j in range(first[k], first[k] + count[k]):
                        forward[j] += std * normal(key, np.uint64(base + j))
        for j in range(n):
            x[j] = forward[j]


@jit(parallel=True)
def _forecast_on_threads(context, u, dt, key, X, crews, scratch):
    place = place_of(context)
    for crew in prange(crews):
        forecast(context_at(place), u, dt, key, X, crew, crews, share(scratch, crew, crews))


@jit
def predict(context, u, dt, index, state, work):
    """xᵢ ← f(xᵢ, u) + wᵢ, wᵢ ~ N(0, Q), for every member.

    Source: Evensen (2003), doi:10.1007/s10236-003-0036-9.
    """
    X = ensemble(context, state)
    key = key_of(context.seed, next_draw(context, state), PROCESS)
    crews = int(numbers(context)[CREWS])
    if crews > 1:
        _forecast_on_threads(context, u, dt, key, X, crews, work)
    else:
        forecast(context, u, dt, key, X, 0, 1, work)
    settle(context, X)


@jit
def add_spread(context, index, X, scratch):
    """Additive inflation: to each pair of members ±s z with z ~ N(0, 1), so that the mean stays.

    Source: Whitaker & Hamill (2012), doi:10.1175/MWR-D-11-00276.1, with noise in place of archived states.
    """
    share = numbers(context)[ADDITIVE]
    if share == 0.0:
        return
    N, n = X.shape
    _, cov = prior(context)
    key = key_of(context.seed, index, SPREAD)
    room = forecast_at(start_of(scratch), n, 0)
    z, w = room.z, room.w
    for i in range(N // 2):
        for j in range(n):
            z[j] = normal(key, np.uint64(i * n + j))
        drawn = z
        if context.shape != 0:
            shaped(context, z, w)
            drawn = w
        for j in range(n):
            a = share * drawn[j] * np.sqrt(cov[0, j] if cov.shape[0] < n else cov[j, j])
            X[2 * i, j] += a
            X[2 * i + 1, j] -= a
