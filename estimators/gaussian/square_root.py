"""What the square-root filters share: a mean and a factor of P as state, and conditioning by one triangularisation.

The state is x (nx,) followed by upper U (nx, nx) with P = Uᵀ U. P and S are never formed, so a spread of 1e-9 beside
one of 1 keeps half its digits, where P itself would hold none of 1e-18 beside 1. Behind U stands what an adaptation
remembers, as in shared.py.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import add_process_noise, circular_rows, options, shown_states
from ..estimator import Options
from ..numerics.jit import inlined, ints, jit, matrix
from ..numerics.linalg import EPSILON, remove, root, solve_transposed, triangularise, wrap
from ..track import FAILED, MISSING, USED
from . import robust
from .robust import ADAPT, NONE, OFF, ROBUST, ROBUST_AT, adapt, forget, reading_variances, rows, weight
from .shared import judge, wrap_mean


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (nx,) and covariance (nx, nx) of a state."""
    U = state[nx : nx + nx * nx].reshape(nx, nx)
    return state[:nx].copy(), U.T @ U


def condition_size(nx: int, ny: int, extra: int) -> int:
    """Scratch of `condition` for a spread with `extra` rows beyond nx."""
    return (nx + extra + ny) * (nx + ny) + 2 * nx + 3 * ny + ny * ny + robust.scratch_size(ny)


@jit
def start(context, mean, cov, state):
    """The state that stands for N(mean, cov); NaN if cov is indefinite."""
    n = mean.size
    U = matrix(state, n, n, n)
    good = root(cov, U, n)
    for i in range(n):
        state[i] = mean[i]
        for j in range(n):
            U[i, j] = U[i, j] if good else np.nan
    forget(context, state)


@jit
def describe(context, state, mean, std, cross):
    """Mean, standard deviation and the configured covariances."""
    n = context.nx
    U = matrix(state, n, n, n)
    shown = shown_states(context)
    for k in range(mean.size):
        i = shown[k]
        mean[k] = state[i]
        variance = 0.0
        for j in range(i + 1):
            variance += U[j, i] * U[j, i]
        std[k] = np.sqrt(variance)
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for c in range(cross.size):
        i = pairs[2 * c]
        j = pairs[2 * c + 1]
        cross[c] = 0.0
        for k in range(min(i, j) + 1):
            cross[c] += U[k, i] * U[k, j]


@inlined
def noise_root(context, x, u, dt, state, V, scratch):
    """Fill V (nx, nx) with a factor of Q, as scaled by an adaptation; False if Q is indefinite."""
    n = context.nx
    for i in range(n):
        for j in range(n):
            V[i, j] = 0.0
    add_process_noise(context, x, u, dt, V, scratch)
    if not root(V, V, n):
        return False
    scale = robust.noise_scale(context, state)
    if scale != 1.0:
        scale = np.sqrt(scale)
        for i in range(n):
            for j in range(i, n):
                V[i, j] *= scale
    return True


@inlined
def settle(context, forward, U, A, good, state):
    """Take the mean `forward` and the leading rows of A as the new state; NaN, which is seen, if there is none."""
    n = context.nx
    for i in range(n):
        state[i] = forward[i] if good else np.nan
        for j in range(n):
            U[i, j] = (A[i, j] if j >= i else 0.0) if good else np.nan
    wrap_mean(context, state[:n])


@jit
def triangularise_joint(y, r, m, Y, U, lost, A, scratch):
    """Fill A (k + m, m + n) with the factor of the joint covariance of reading and state; False if S has none.

        A ← [ Y  U ]          Aᵀ A = [ S  Cᵀ ]          [ S^½  W ]
            [ E  0 ]   with          [ C  P  ]   →  A = [ 0   U⁺ ]
            [ 0 √R ] (in the reading's columns)

    Y (k, ny) holds n rows that go with U's, then rows E of the reading alone; `lost` (m,) is a row whose square is
    taken off (a negative weight), or empty. W = S^-½ᵀ C, so x⁺ = x + Wᵀ S^-½ᵀ ν, and U⁺ᵀ U⁺ = P - C S⁻¹ Cᵀ.
    Rows of U come before those of √R: a tiny √R then keeps its digits.
    """
    n = U.shape[0]
    k = Y.shape[0]
    for i in range(k):
        for j in range(m):
            A[i, j] = Y[i, j]
        for j in range(n):
            A[i, m + j] = U[i, j] if i < n else 0.0
    for i in range(m):
        for j in range(m + n):
            A[k + i, j] = 0.0
    row = 0
    for i in range(r.size):
        if np.isfinite(y[i]):
            A[k + row, row] = np.sqrt(r[i])
            row += 1
    triangularise(A, scratch[: m + n])
    if lost.size > 0:
        v = scratch[m + n : 2 * (m + n)]
        for j in range(m + n):
            v[j] = lost[j] if j < m else 0.0
        if not remove(A, m + n, v):
            return False
    for j in range(m):
        whole = 0.0
        for i in range(j + 1):
            whole += A[i, j] * A[i, j]
        # Triangularising leaves errors of a few n ε of the column's length: a diagonal entry that small says nothing.
        if not (A[j, j] > 4.0 * (n + m) * EPSILON * np.sqrt(whole) and whole < np.inf):
            return False
    return True


@inlined
def condition(context, sensor, y, state, expected, Y, lost, work, innovation, innovation_std, score):
    """Condition on a reading whose prediction is `expected` (ny,), and return the verdict.

    Y (k, ny) and lost are those of `triangularise_joint`, for all rows of the reading; they and `expected` are lost.

    Source: the array algorithm of Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12; for sigma points,
    whose (D₊ - D₋) take the place of U Hᵀ, Arasaratnam, Haykin & Hurd (2010), doi:10.1109/TSP.2010.2056923.
    """
    n = context.nx
    x = state[:n]
    U = matrix(state, n, n, n)
    circular = circular_rows(context, sensor)
    ny = expected.size
    k = Y.shape[0]
    at = (k + ny) * (ny + n)
    scratch = work[at : at + 2 * (ny + n)]
    at += 2 * (ny + n)
    r = work[at : at + ny]
    at += ny
    reading_variances(context, sensor, state, r)
    m = 0
    for i in range(ny):
        if np.isfinite(y[i]):
            residual = y[i] - expected[i]
            innovation[i] = wrap(residual) if circular[i] != 0 else residual
            expected[m] = innovation[i]
            for j in range(k):
                Y[j, m] = Y[j, i]
            if lost.size > 0:
                lost[m] = lost[i]
            m += 1
    if m == 0:
        return MISSING
    score[1] = m
    nu = expected[:m]
    gone = lost[: min(m, lost.size)]
    A = matrix(work, 0, k + m, m + n)
    if not triangularise_joint(y, r, m, Y, U, gone, A, scratch):
        return FAILED
    row = 0
    for i in range(ny):
        if np.isfinite(y[i]):
            variance = 0.0
            for j in range(row + 1):
                variance += A[j, row] * A[j, row]
            innovation_std[i] = np.sqrt(variance)
            row += 1
    verdict = judge(context, sensor, m, nu, A, score)
    if verdict != USED:
        return verdict
    if options(context)[ROBUST] != NONE:
        S = matrix(work, at, m, m)
        if not reweigh_joint(context, y, r, m, innovation, Y, U, gone, A, S, nu, scratch, work[at + m * m :]):
            return FAILED
    for i in range(m):
        a = nu[i]
        for j in range(n):
            x[j] += a * A[i, m + j]
    for i in range(n):
        for j in range(i, n):
            U[i, j] = A[m + i, m + j]
    wrap_mean(context, x)
    if options(context)[ADAPT] != OFF:
        adapt(context, sensor, y, state, innovation, innovation_std, score)
    return verdict


@jit
def reweigh_joint(context, y, r, m, innovation, Y, U, lost, A, S, nu, scratch, room):
    """Weight the reading's noise and triangularise again; A and the whitened nu then belong to the weighted noise.

    The weight alone is found from S itself.
    """
    for i in range(m):
        for j in range(m):
            S[i, j] = 0.0
            for k in range(min(i, j) + 1):
                S[i, j] += A[k, i] * A[k, j]
    raw = room[:m]
    variance = room[m : 2 * m]
    rows(y, innovation, raw)
    rows(y, r, variance)
    V = matrix(room, 4 * m, m, m)
    w = weight(options(context)[ROBUST], options(context)[ROBUST_AT], m, raw, variance, S, V, room[2 * m : 4 * m])
    if not w > 0.0:
        return False
    for i in range(m):
        nu[i] = raw[i]
    for i in range(r.size):
        r[i] /= w
    if not triangularise_joint(y, r, m, Y, U, lost, A, scratch):
        return False
    solve_transposed(A, m, nu)
    return True
