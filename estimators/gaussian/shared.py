"""What the Gaussian filters share: a mean and a covariance as state, and conditioning on a reading.

The state is x (nx,) followed by P (nx, nx). The filters differ only in how mean and covariance pass through f and h;
gate, verdict, NIS and likelihood are here.

Behind P stands what an adaptation remembers (robust.py), if it is on.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, circular_states, shown_states
from ..compiled.verdict import verdict_of
from ..estimator import Options
from ..numerics.jit import floats, inlined, ints, jit, matrix
from ..numerics.linalg import EPSILON, cholesky, mirror, solve_transposed, solve_upper, wrap
from ..numerics.simd_ir import padded
from ..numerics.simd_rows import subtract_squares
from ..track import FAILED, MISSING
from . import robust
from .robust import forget


def state_size(options: Options, nx: int) -> int:
    """Numbers in the state."""
    return nx + nx * nx


def scratch_size(nx: int, ny: int) -> int:
    """Numbers in the views of `scratch`."""
    return 2 * ny + 2 * ny * ny + nx * ny + ny * padded(nx) + robust.scratch_size(ny)


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (nx,) and covariance (nx, nx) of a state."""
    return state[:nx].copy(), state[nx : nx + nx * nx].reshape(nx, nx).copy()


def no_points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """No points to draw."""
    return np.zeros((0, nx))


@jit
def start(context, mean, cov, state):
    """The state that stands for N(mean, cov)."""
    n = mean.size
    for i in range(n):
        state[i] = mean[i]
        for j in range(n):
            state[n + i * n + j] = cov[i, j]
    forget(context, state)


@jit
def describe(context, state, mean, std, cross):
    """Mean, standard deviation and the configured covariances."""
    n = context.nx
    shown = shown_states(context)
    for k in range(mean.size):
        i = shown[k]
        mean[k] = state[i]
        variance = state[n + i * n + i]
        std[k] = np.sqrt(variance) if variance >= 0.0 else np.nan
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for k in range(cross.size):
        cross[k] = state[n + pairs[2 * k] * n + pairs[2 * k + 1]]


@inlined
def wrap_mean(context, x):
    """Bring the circular states back to ±π."""
    circular = circular_states(context)
    for i in range(x.size):
        if circular[i] != 0:
            x[i] = wrap(x[i])


@inlined
def scratch(work, n, m):
    """What an update works in: ŷ or ν, r (m,), S and its factor (m, m), C (n, m), W, room for `reweigh`; where it ends.

    C is the covariance of state and predicted reading, W (m, padded n) is for `downdate`.
    """
    W = matrix(work, 0, m, padded(n))
    start = work.ctypes.data + 8 * W.size
    S = matrix(work, W.size + 2 * m, m, m)
    U = matrix(work, W.size + 2 * m + m * m, m, m)
    C = matrix(work, W.size + 2 * m + 2 * m * m, n, m)
    at = W.size + 2 * m + 2 * m * m + n * m
    room = m * m + 4 * m
    return floats(start, m), floats(start + 8 * m, m), S, U, C, W, work[at : at + room], at + room


@inlined
def compare(context, sensor, y, r, predicted, C, S, H, P, innovation, innovation_std):
    """The innovation and its covariance, over the rows of the reading that are finite.

    On entry S (ny, ny) holds the spread of the predicted reading, C (nx, ny) its covariance with the state and H
    (ny, nx) the Jacobian (or nothing). On return the leading rows and columns of all three, and of `predicted`, which
    then holds the innovation, belong to the finite rows, and S includes R. `innovation` and `innovation_std` keep the
    reading's own rows. An S that is nothing but the rounding of H P Hᵀ becomes NaN, so that the reading fails.

    Returns:
        The number of finite rows.
    """
    circular = circular_rows(context, sensor)
    m = 0
    for i in range(r.size):
        if not np.isfinite(y[i]):
            continue
        residual = y[i] - predicted[i]
        if circular[i] != 0:
            residual = wrap(residual)
        variance = S[i, i] + r[i]
        terms = 0.0
        for j in range(H.shape[1]):
            terms += H[i, j] * H[i, j] * P[j, j]
        if not variance > 4.0 * (H.shape[1] + r.size) * EPSILON * terms:
            variance = np.nan
        innovation[i] = residual
        innovation_std[i] = np.sqrt(variance) if variance >= 0.0 else np.nan
        predicted[m] = residual
        if m < i:
            # Row i moves up: what it overwrites has been read.
            column = 0
            for j in range(i):
                if np.isfinite(y[j]):
                    S[m, column] = S[i, j]
                    S[column, m] = S[i, j]
                    column += 1
            for j in range(C.shape[0]):
                C[j, m] = C[j, i]
            for j in range(H.shape[1]):
                H[m, j] = H[i, j]
        S[m, m] = variance
        m += 1
    return m


@inlined
def factor(S, U, m, n):
    """The Cholesky factor U of S (m, m); False if S is not positive definite, or only rounding makes it so.

    Forming S from n states leaves errors of a few n ε S_kk in each pivot: a pivot that small says nothing, and a gain
    from it would be wrong without a sign. The square-root filters do not form S.
    """
    if not cholesky(S, U, m):
        return False
    for i in range(m):
        if not U[i, i] * U[i, i] > 4.0 * (n + m) * EPSILON * S[i, i]:
            return False
    return True


@inlined
def judge(context, sensor, m, nu, U, score):
    """NIS, log-likelihood and verdict of an innovation with covariance Uᵀ U; nu (m,) becomes U⁻ᵀ nu.

    NIS = νᵀ S⁻¹ ν. Source: Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation
    (2001), 5.4.2.
    """
    solve_transposed(U, m, nu)
    nis = 0.0
    log_det = 0.0
    for i in range(m):
        nis += nu[i] * nu[i]
        log_det += 2.0 * np.log(U[i, i])
    return verdict_of(context, sensor, m, nis, log_det, score)


@inlined
def admit(context, sensor, m, nu, S, U, score):
    """Judge an innovation nu (m,) of covariance S: the verdict. U gets the factor of S, nu becomes U⁻ᵀ ν."""
    if m == 0:
        return MISSING
    score[1] = m
    if not factor(S, U, m, context.nx):
        return FAILED
    return judge(context, sensor, m, nu, U, score)


@inlined
def gain(m, C, U, K):
    """K = C S⁻¹ for the leading m columns, with S = Uᵀ U."""
    for i in range(C.shape[0]):
        for j in range(m):
            K[i, j] = C[i, j]
        solve_transposed(U, m, K[i])
        solve_upper(U, m, K[i])


@inlined
def move_mean(m, C, U, nu, x):
    """x += C U⁻¹ ν̃, where ν̃ = U⁻ᵀ ν is the whitened innovation."""
    solve_upper(U, m, nu)
    for i in range(x.size):
        for j in range(m):
            x[i] += C[i, j] * nu[j]


@inlined
def joseph(y, r, m, C, H, K, P, N):
    """P ← (I - K H) P (I - K H)ᵀ + K R Kᵀ, in O(n² m); C = P Hᵀ, N (nx, nx) is scratch.

    Symmetric and positive semidefinite whatever the gain. Source: Bucy & Joseph (1968), Filtering for Stochastic
    Processes with Applications to Guidance.
    """
    n = P.shape[0]
    for i in range(n):
        for j in range(n):
            N[i, j] = P[i, j]
        for k in range(m):
            a = K[i, k]
            for j in range(n):
                N[i, j] -= a * C[j, k]
    for i in range(n):
        for j in range(n):
            P[i, j] = N[i, j]
    for k in range(m):
        for i in range(n):
            s = 0.0
            for j in range(n):
                s += N[i, j] * H[k, j]
            C[i, k] = s
    for i in range(n):
        for k in range(m):
            a = C[i, k]
            for j in range(i + 1):
                P[i, j] -= a * K[j, k]
    k = 0
    for row in range(r.size):
        if np.isfinite(y[row]):
            variance = r[row]
            for i in range(n):
                a = K[i, k] * variance
                for j in range(i + 1):
                    P[i, j] += a * K[j, k]
            k += 1
    mirror(P)


@inlined
def downdate(m, C, U, P, W):
    """P ← P - K S Kᵀ, as P - Wᵀ W with W = U⁻ᵀ Cᵀ, in scratch of (m or more, nx in whole vectors)."""
    n = P.shape[0]
    for k in range(m):
        inverse = 1.0 / U[k, k]
        for i in range(n):
            s = C[i, k]
            for j in range(k):
                s -= U[j, k] * W[j, i]
            W[k, i] = s * inverse
    subtract_squares(n, m, W.ctypes.data, W.shape[1], P.ctypes.data)
