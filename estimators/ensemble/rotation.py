"""Members turned at random after an analysis: their mean and covariance stay.

A square root filter makes the same members of the same readings over and over; nonlinear models then leave one far off
and the others in a heap. All states are turned alike, so that what they have in common stays too.

Source: Sakov & Oke (2008), doi:10.1175/2007MWR2021.1.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..estimator import Option
from ..numerics.jit import jit
from ..numerics.random import key_of, normal
from ..numerics.vectors import add_scaled
from .blocks import transform_all
from .shared import CREWS, OWN, ROTATE

ROTATION = Option("rotation", 0, 0, 1, "", "1 turns the members at random after each reading; mean and spread stay")


@jit
def rotate_members(seed, index, T, W):
    """T ← Ω T with a random orthogonal Ω that leaves the mean: Ω 1 = Ωᵀ 1 = 1; W is scratch (N, N + 1).

    Ω = H diag(1, Q) H, where the reflection H turns the first unit vector into 1/√N and Q is a random rotation of the
    other N - 1 axes, from the orthogonalisation of normal numbers.

    Source: Sakov & Oke (2008), doi:10.1175/2007MWR2021.1.
    """
    N = T.shape[0]
    key = key_of(seed, index, ROTATE)
    Q = np.zeros((N, N))
    Q[0, 0] = 1.0
    for i in range(1, N):
        for j in range(1, N):
            Q[i, j] = normal(key, np.uint64(i * N + j))
        # Twice: the second time takes away what rounding left.
        for _ in range(2):
            for k in range(1, i):
                dot = 0.0
                for j in range(1, N):
                    dot += Q[i, j] * Q[k, j]
                add_scaled(N, -dot, Q[k], Q[i])
        norm = 0.0
        for j in range(1, N):
            norm += Q[i, j] * Q[i, j]
        for j in range(1, N):
            Q[i, j] /= np.sqrt(norm)
    h = np.full(N, 1.0 / np.sqrt(N))
    h[0] -= 1.0
    half = 1.0 - 1.0 / np.sqrt(N)
    for _ in range(2):
        for i in range(N):
            dot = 0.0
            for j in range(N):
                dot += Q[i, j] * h[j]
            add_scaled(N, -dot / half, h, Q[i])
        for i in range(N):
            for j in range(i):
                Q[i, j], Q[j, i] = Q[j, i], Q[i, j]
    for i in range(N):
        for j in range(N):
            W[i, j] = 0.0
        for k in range(N):
            add_scaled(N, Q[i, k], T[k], W[i])
    for i in range(N):
        for j in range(N):
            T[i, j] = W[i, j]


@jit
def rotate(context, index, X, a, rest):
    """Turn the members X (N, n), where the option says so; T (N, N) and W (N, N + 1) of the analysis are scratch."""
    given = numbers(context)
    if given[OWN] == 0.0:
        return
    N = X.shape[0]
    T, W = a.T, a.W
    for i in range(N):
        for j in range(N):
            T[i, j] = 1.0 if i == j else 0.0
    rotate_members(context.seed, index, T, W)
    for i in range(N):
        for j in range(N):
            W[i, j] = T[i, j]
        W[i, N] = 1.0
    transform_all(X, W, int(given[CREWS]), rest)
