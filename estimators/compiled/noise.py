"""Process noise as draws: w = L z with L Lᵀ = Q and z ~ N(0, I), for filters that carry members."""

from __future__ import annotations

import numpy as np

from ..numerics.jit import ints, jit
from .context import call_Q, parameters, process_variances

_SMALL = 1e-13
"""A pivot below this part of its diagonal is rounding: its direction has no noise of its own."""


@jit
def _not_semidefinite(L):
    """Make the failure visible in whatever uses L."""
    for i in range(L.shape[0]):
        for k in range(L.shape[1]):
            L[i, k] = np.nan
    return False


@jit
def semidefinite_root(A, L):
    """Lower L with L Lᵀ = A for a positive semidefinite A (n, n); False (and L of NaN) if A is not.

    Cholesky by columns; a pivot of zero leaves its column zero. Reads the lower triangle of A.

    Source: Higham (2002), Accuracy and Stability of Numerical Algorithms, 2nd edition, 10.3.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            L[i, j] = 0.0
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        # Written so that NaN fails too.
        if not pivot >= -1e-8 * abs(A[j, j]):
            return _not_semidefinite(L)
        if pivot <= _SMALL * n * A[j, j]:
            # No variance left in j, so no covariance with it either.
            for i in range(j + 1, n):
                s = A[i, j]
                for k in range(j):
                    s -= L[i, k] * L[j, k]
                # The roots apart: the product of two tiny variances would underflow.
                if not abs(s) <= 1e-6 * np.sqrt(A[i, i]) * np.sqrt(A[j, j]):
                    return _not_semidefinite(L)
            continue
        root = np.sqrt(pivot)
        L[j, j] = root
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / root
    return True


@jit
def belief_root(P, L):
    """Lower L with L Lᵀ = P for the covariance of a belief, or for its diagonal where rounding left it indefinite."""
    if not semidefinite_root(P, L):
        for i in range(L.shape[0]):
            for j in range(L.shape[1]):
                L[i, j] = np.sqrt(max(P[i, i], 0.0)) if i == j else 0.0


@jit
def noise_root(context, x, u, dt, L, scratch):
    """Fill L (nx, nx), lower, with L Lᵀ = Q(x, u, p, q, dt), or √(q·dt) on the diagonal where the model gives no Q.

    Where `context.Q_varies` is 0, the result does not depend on x, and one call serves all members of a step.
    """
    n = L.shape[0]
    if context.Q == 0:
        for i in range(n):
            for j in range(n):
                L[i, j] = 0.0
        q = process_variances(context)
        state = ints(context.noise_state, context.n_noises)
        for k in range(q.size):
            L[state[k], state[k]] = np.sqrt(q[k] * dt)
        return
    for i in range(n):
        for j in range(n):
            scratch[i, j] = 0.0
    call_Q(context.Q, x, u, parameters(context), process_variances(context), dt, scratch)
    semidefinite_root(scratch, L)


@jit
def add_noise(L, z, x):
    """x += L z, with lower L."""
    for i in range(x.size):
        s = 0.0
        for j in range(i + 1):
            s += L[i, j] * z[j]
        x[i] += s
