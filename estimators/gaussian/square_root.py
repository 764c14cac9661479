"""Shared parts of the square-root filters: mean and a factor of P as state, conditioning by one triangularisation.

The state is x (nx,) followed by upper U (nx, nx) with P = Uᵀ U, and the memory of an adaptation as in shared.py. P and
S are never formed, so a standard deviation of 1e-9 beside one of 1 keeps half its digits, where P would lose 1e-18
beside 1.

With considered states the factor of the tangent filters is bordered: U = [U_e 0; U_ec U_c], U_e and U_c upper, the rows
of the estimated states first. U_c is a factor of the considered covariance, which never changes; so a step costs
little more than one of the estimated states alone.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import add_process_noise, circular_rows, estimated, options, shown_states
from ..compiled.noise import has_correlated_rows, independent_rows
from ..estimator import Options
from ..numerics.jit import by_address, embedded, inlined, ints, part
from ..numerics.linalg import (
    EPSILON,
    add_square,
    remove,
    root,
    solve_transposed,
    solve_unit,
    solve_upper,
    triangularise,
    wrap,
)
from ..numerics.workspace import declare_layout, start_of, take_matrix
from ..track import FAILED, MISSING, USED
from . import robust
from .robust import ROBUST, ROBUST_AT, adapt, forget, is_adaptive, is_robust, reading_variances, weight
from .shared import judge, moments_of, move_to, wrap_mean


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (nx,) and covariance (nx, nx) of a state."""
    U = state[nx : nx + nx * nx].reshape(nx, nx)
    return state[:nx].copy(), U.T @ U


Conditioning, conditioning = declare_layout(
    "Conditioning",
    "n, m, k",
    A="k + m, m + n",  # joint factor of measurement and state
    w="m + n",  # scratch of a triangularisation
    v="m + n",  # row that is taken off the joint factor
    r="m",  # variances of all rows, as they are in use
    d="m",  # variances of the finite rows, made independent
    raw="m",  # innovation, not whitened
    S="m, m",  # covariance of the innovation, for a weight
    L="m, m = S",  # unit lower, R = L diag(d) Lᵀ, where rows are correlated
    z="2 * m",  # scratch of a weight
    V="m, m",  # scratch of a weight
    K="n, m",  # gain, where the factor is bordered
    B="n + m, n",  # factor of the estimated states over K √R, where it is
)
"""Workspace of `condition` with m rows and n states whose spread has k rows."""


@part
def bordered_root(cov, U, first):
    """Fill U (n, n) with the bordered factor of a covariance of `first` estimated states; False if it is indefinite."""
    n = U.shape[0]
    # The considered states come first while it is factored.
    W = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            W[i, j] = cov[(i + first) % n, (j + first) % n]
    good = root(W, W, n)
    for i in range(n):
        for j in range(n):
            U[(i + first) % n, (j + first) % n] = W[i, j]
    return good


@by_address
def start(context, mean, cov, state):
    """Set the state to N(mean, cov); to NaN if cov is indefinite."""
    n = mean.size
    x, U = moments_of(state, n)
    good = bordered_root(cov, U, estimated(context)) if context.n_considered > 0 else root(cov, U, n)
    for i in range(n):
        x[i] = mean[i]
        for j in range(n):
            U[i, j] = U[i, j] if good else np.nan
    forget(context, state)


@by_address
def describe(context, state, mean, std, cross):
    """Fill mean, standard deviation and the configured covariances."""
    x, U = moments_of(state, context.nx)
    shown = shown_states(context)
    bordered = context.n_considered > 0
    for k in range(mean.size):
        i = shown[k]
        mean[k] = x[i]
        variance = 0.0
        for j in range(context.nx if bordered else i + 1):
            variance += U[j, i] * U[j, i]
        std[k] = np.sqrt(variance)
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for c in range(cross.size):
        i = pairs[2 * c]
        j = pairs[2 * c + 1]
        cross[c] = 0.0
        for k in range(context.nx if bordered else min(i, j) + 1):
            cross[c] += U[k, i] * U[k, j]


@embedded
def noise_root(context, x, u, dt, state, V, scratch):
    """Fill V (nx, nx) with a factor of Q, as scaled by an adaptation; False if Q is indefinite."""
    n = context.nx
    V[:] = 0.0
    add_process_noise(context, x, u, dt, V, scratch)
    # Considered states have no noise.
    if not root(V, V, estimated(context)):
        return False
    scale = robust.noise_scale(context, state)
    if scale != 1.0:
        scale = np.sqrt(scale)
        for i in range(n):
            for j in range(i, n):
                V[i, j] *= scale
    return True


@embedded
def settle(context, forward, A, good, state):
    """Take the mean `forward` and the leading rows of A as the new state; NaN, which is seen, if there is none."""
    n = context.nx
    x, U = moments_of(state, n)
    for i in range(n):
        for j in range(n):
            U[i, j] = (A[i, j] if j >= i else 0.0) if good else np.nan
        if not good:
            forward[i] = np.nan
    move_to(context, forward, x)


@part
def triangularise_joint(d, m, Y, U, lost, A, w, v):
    """Fill A (k + m, m + n) with the factor of the joint covariance of reading and state; False if S has none.

        A ← [ Y  U ]          Aᵀ A = [ S  Cᵀ ]          [ S^½  W ]
            [ E  0 ]   with          [ C  P  ]   →  A = [ 0   U⁺ ]
            [ 0 √R ] (in the reading's columns)

    Y (k, ny) holds n rows that go with U's, then rows E of the reading alone; `lost` (m,) is a row whose square is
    taken off (a negative weight), or empty; R = diag(d). W = S^-½ᵀ C, so x⁺ = x + Wᵀ S^-½ᵀ ν, and
    U⁺ᵀ U⁺ = P - C S⁻¹ Cᵀ. Without U, A is the factor of S. Rows of U come before those of √R: a tiny √R then keeps its
    digits. w and v (m + n,) are scratch.
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
        A[k + i, i] = np.sqrt(d[i])
    triangularise(A, w)
    if lost.size > 0:
        for j in range(m + n):
            v[j] = lost[j] if j < m else 0.0
        if not remove(A, m + n, v):
            return False
    for j in range(m):
        whole = 0.0
        for i in range(j + 1):
            whole += A[i, j] * A[i, j]
        # Triangularising leaves errors of a few n ε of the column's length: a diagonal entry that small is no result.
        if not (A[j, j] > 4.0 * ((n if n > 0 else k) + m) * EPSILON * np.sqrt(whole) and whole < np.inf):
            return False
    return True


@inlined
def gather(context, sensor, y, own, expected, Y, lost, innovation):
    """Fill ν, in place of ŷ, and d; move the entries of finite rows to the front, and return their number."""
    circular = circular_rows(context, sensor)
    m = np.int64(0)  # a literal would be a second type, and compile every callee twice
    for i in range(expected.size):
        if np.isfinite(y[i]):
            residual = y[i] - expected[i]
            innovation[i] = wrap(residual) if circular[i] != 0 else residual
            expected[m] = innovation[i]
            own.d[m] = own.r[i]
            for j in range(Y.shape[0]):
                Y[j, m] = Y[j, i]
            if lost.size > 0:
                lost[m] = lost[i]
            m += 1
    return m


@part
def make_independent(m, L, nu, Y, lost):
    """ν ← L⁻¹ ν, Y ← Y L⁻ᵀ, lost ← L⁻¹ lost: see compiled/noise.py."""
    solve_unit(L, m, nu)
    for i in range(Y.shape[0]):
        solve_unit(L, m, Y[i])
    if lost.size > 0:
        solve_unit(L, m, lost)


@part
def dependent_variance(A, L, k):
    """S_kk of a reading's own rows, from the factor A of that of its independent ones: S = L Aᵀ A Lᵀ."""
    variance = 0.0
    for i in range(k + 1):
        a = A[i, k]
        for j in range(i, k):
            a += A[i, j] * L[k, j]
        variance += a * a
    return variance


@embedded
def condition(context, sensor, y, state, expected, Y, lost, own, innovation, innovation_std, score, bordered):
    """Condition on a measurement whose prediction is `expected` (ny,), and return the verdict.

    Y (k, ny) and lost are those of `triangularise_joint`, for all rows; they and `expected` are overwritten. Where the
    factor is `bordered`, Y = U Hᵀ.

    Source: the array algorithm of Kailath, Sayed & Hassibi, Linear Estimation (2000), chapter 12; for sigma points,
    whose (D₊ - D₋) take the place of U Hᵀ, Arasaratnam, Haykin & Hurd (2010), doi:10.1109/TSP.2010.2056923.
    """
    n = context.nx
    x, U = moments_of(state, n)
    reading_variances(context, sensor, state, own.r)
    m = gather(context, sensor, y, own, expected, Y, lost, innovation)
    if m == 0:
        return MISSING
    score[1] = m
    nu = expected[:m]
    correlated = has_correlated_rows(context, sensor)
    if correlated:
        independent_rows(context, sensor, y, own.r, own.L, own.d)
        make_independent(m, own.L, nu, Y, lost)
    gone = lost[: min(m, lost.size)]
    # Rows that are missing make it smaller.
    spread, _ = take_matrix(start_of(U), 0 if bordered else n, 0 if bordered else n)
    A, _ = take_matrix(start_of(own.A), Y.shape[0] + m, m + spread.shape[0])
    if not triangularise_joint(own.d, m, Y, spread, gone, A, own.w, own.v):
        return FAILED
    row = 0
    for i in range(expected.size):
        if np.isfinite(y[i]):
            variance = 0.0
            if correlated:
                variance = dependent_variance(A, own.L, row)
            else:
                for j in range(row + 1):
                    variance += A[j, row] * A[j, row]
            innovation_std[i] = np.sqrt(variance)
            row += 1
    for i in range(m):
        own.raw[i] = nu[i]
    verdict = judge(context, sensor, m, nu, A, score)
    if verdict == USED and is_robust(context) and not reweigh_joint(context, m, nu, own, Y, spread, gone, A):
        verdict = FAILED
    if verdict == USED:
        if bordered:
            correct_bordered(m, nu, A, own.d, Y, estimated(context), x, U, own.K, own.B, own.w)
        else:
            take_over(m, nu, A, estimated(context), x, U)
        wrap_mean(context, x)
        if is_adaptive(context):
            adapt(context, sensor, y, state, innovation, innovation_std, score)
    return verdict


@inlined
def take_over(m, nu, A, estimated, x, U):
    """x ← x + Wᵀ ν̃ with the whitened ν̃, U ← U⁺, from the joint factor A, of which the rows of W are lost.

    Considered states stay, and so does their covariance: what U⁺ lacks of it, W_cᵀ W_c, is added again. Source:
    Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter 8.
    """
    n = x.size
    for i in range(m):
        a = nu[i]
        for j in range(estimated):
            x[j] += a * A[i, m + j]
    for i in range(n):
        for j in range(i, n):
            U[i, j] = A[m + i, m + j]
    if estimated < n:
        for i in range(m):
            lost = A[i, m:]
            lost[:estimated] = 0.0
            add_square(U, n, lost)


@part
def correct_bordered(m, nu, A, d, Y, first, x, U, K, B, w):
    """Correct the `first` estimated states with the gain K = C S⁻¹, S = Aᵀ A; the others stay, and so does their U_c.

        U_ec ← U_ec - Y_c Kᵀ,      U_e ← triangle of [U_e - Y_e Kᵀ; √R Kᵀ],      Y = U Hᵀ

    This is Joseph's form in factors: the columns of the estimated states become U ((I - K H)ᵀ), over the measurement's
    noise. `nu` (m,) is whitened. Sources: Schmidt (1966), Application of state-space methods to navigation problems;
    Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter 8.
    """
    n = U.shape[0]
    for j in range(first):
        for k in range(m):
            s = 0.0
            for i in range(j + 1):
                s += Y[i, k] * U[i, j]
            for i in range(first, n):
                s += Y[i, k] * U[i, j]
            K[j, k] = s
        solve_transposed(A, m, K[j])
        for k in range(m):
            x[j] += K[j, k] * nu[k]
        solve_upper(A, m, K[j])
    T, _ = take_matrix(start_of(B), first + m, first)
    for j in range(first):
        for i in range(n):
            s = U[i, j]
            for k in range(m):
                s -= Y[i, k] * K[j, k]
            if i < first:
                T[i, j] = s
            else:
                U[i, j] = s
        for k in range(m):
            T[first + k, j] = np.sqrt(d[k]) * K[j, k]
    triangularise(T, w)
    for i in range(first):
        for j in range(i, first):
            U[i, j] = T[i, j]


@part
def reweigh_joint(context, m, nu, own, Y, U, lost, A):
    """Weight the measurement's noise and triangularise again, for A and the whitened nu of the weighted noise.

    Only the weight is computed from S itself.
    """
    S = own.S
    for i in range(m):
        for j in range(m):
            S[i, j] = 0.0
            for k in range(min(i, j) + 1):
                S[i, j] += A[k, i] * A[k, j]
    w = weight(options(context)[ROBUST], options(context)[ROBUST_AT], m, own.raw, own.d, S, own.V, own.z)
    if not w > 0.0:
        return False
    for i in range(m):
        nu[i] = own.raw[i]
        own.d[i] /= w
    if not triangularise_joint(own.d, m, Y, U, lost, A, own.w, own.v):
        return False
    solve_transposed(A, m, nu)
    return True
