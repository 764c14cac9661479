"""Draws of the sampled states and of the mode, and what they say of the linear ones.

Source: Schön, Gustafsson & Nordlund (2005), doi:10.1109/TSP.2005.849151, theorem 1.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import sampled_states
from ..numerics.jit import jit
from ..numerics.random import ONE, normal

_ROUNDING = 1e-13
"""A variance below this part of what it was made from is rounding."""


@jit
def _given(C, j, step, x, column):
    """Condition N(x, C) on state j, which turns out `step` standard deviations above its mean: x_j moves there too."""
    nx = x.size
    scale = 1.0 / np.sqrt(C[j, j])
    for i in range(nx):
        column[i] = C[i, j] * scale
        x[i] += column[i] * step
    for i in range(nx):
        a = column[i]
        for k in range(nx):
            C[i, k] -= a * column[k]


@jit
def drop(C, j):
    """Nothing is uncertain about state j any more."""
    for i in range(C.shape[0]):
        C[i, j] = 0.0
        C[j, i] = 0.0


@jit
def fix_mode(context, C, mode, x, column):
    """Condition N(x, C), whose mode is a number with mean and variance, on the mode that was drawn."""
    j = context.mode
    if C[j, j] > 0.0:
        _given(C, j, (mode - x[j]) / np.sqrt(C[j, j]), x, column)
    drop(C, j)
    x[j] = mode


@jit
def sample(context, C, key, place, x, column, before):
    """Draw the sampled states of N(x, C), one after another; each draw conditions what is left.

    x becomes the drawn values and the mean of the linear states given them, C their covariance. For the prediction
    N(f, F P Fᵀ + Q) of a particle this is the time update of Schön, Gustafsson & Nordlund (2005), theorem 1: what the
    sampled states did says something of the linear states that drove them (their "third step"), noise that both share
    included. A state without variance moves without a draw.
    """
    drawn = sampled_states(context)
    for k in range(drawn.size):
        before[k] = C[drawn[k], drawn[k]]
    for k in range(drawn.size):
        j = drawn[k]
        if C[j, j] > _ROUNDING * before[k]:
            _given(C, j, normal(key, place), x, column)
        place += ONE
        drop(C, j)
