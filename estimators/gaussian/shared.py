"""Shared parts of the Gaussian filters: mean and covariance as state, and conditioning on a measurement.

The state is x (nx,) followed by P (nx, nx), and the memory of an adaptation (robust.py) if one is on. The filters
differ only in how mean and covariance pass through f and h; gate, verdict, NIS and likelihood are here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..compiled.context import circular_rows, circular_states, shown_states
from ..compiled.noise import has_correlated_rows, independent_rows
from ..compiled.verdict import verdict_of
from ..estimator import Options
from ..numerics.jit import by_address, inlined, ints, linkable_embedded, part
from ..numerics.linalg import EPSILON, cholesky, mirror, solve_transposed, solve_unit, solve_upper, wrap
from ..numerics.simd import add_scaled, scaled
from ..numerics.simd_ir import LANES, padded
from ..numerics.simd_rows import multiply_rows, subtract_product, subtract_squares
from ..numerics.workspace import declare_layout, size_of, start_of, take_matrix, take_vector
from ..track import FAILED, MISSING, USED, WHITENED
from .robust import forget, is_robust, reweigh


def state_size(options: Options, nx: int) -> int:
    """Return the size of the state."""
    return nx + nx * nx


def work_of(predicting: Callable, updating: Callable) -> Callable[[Options, int, int], int]:
    """Return the function of the scratch of a prediction or an update, of their layouts."""
    return lambda options, nx, ny: max(size_of(predicting, nx), size_of(updating, nx, ny))


@inlined
def moments_of(state, n):
    """Return views of the mean x (n,) and the covariance P (n, n), or its factor, in a state."""
    x, at = take_vector(start_of(state), n)
    P, at = take_matrix(at, n, n)
    return x, P


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (nx,) and covariance (nx, nx) of a state."""
    return state[:nx].copy(), state[nx : nx + nx * nx].reshape(nx, nx).copy()


def no_points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return no points to draw."""
    return np.zeros((0, nx))


@by_address
def start(context, mean, cov, state):
    """Set the state to N(mean, cov)."""
    n = mean.size
    x, P = moments_of(state, n)
    for i in range(n):
        x[i] = mean[i]
        for j in range(n):
            P[i, j] = cov[i, j]
    forget(context, state)


@linkable_embedded
def tell(context, x, P, mean, std, cross):
    """Fill mean, standard deviation and the configured covariances of a row of the track."""
    shown = shown_states(context)
    for k in range(mean.size):
        i = shown[k]
        mean[k] = x[i]
        std[k] = np.sqrt(P[i, i]) if P[i, i] >= 0.0 else np.nan
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for k in range(cross.size):
        cross[k] = P[pairs[2 * k], pairs[2 * k + 1]]


@by_address
def describe(context, state, mean, std, cross):
    """Fill mean, standard deviation and the configured covariances."""
    x, P = moments_of(state, context.nx)
    tell(context, x, P, mean, std, cross)


@inlined
def wrap_mean(context, x):
    """Bring the circular states back to ±π."""
    circular = circular_states(context)
    for i in range(x.size):
        if circular[i] != 0:
            x[i] = wrap(x[i])


@inlined
def move_to(context, forward, x):
    """x ← forward, its angles within ±π."""
    for i in range(x.size):
        x[i] = forward[i]
    wrap_mean(context, x)


Reading, reading_of = declare_layout(
    "Reading",
    "n, m",
    padded,
    W="m, padded(n)",  # scratch of covariance and gain
    nu="m",  # predicted measurement, then innovation ν, then whitened, S^-½ ν
    r="m",  # variances of all rows, as they are in use
    S="m, m",  # covariance of the predicted measurement, then of the innovation
    chol_S="m, m",  # upper, chol_Sᵀ chol_S = S
    C="n, m",  # covariance of state and predicted measurement
    B="m, n = C",  # scratch of the Joseph form
    raw="m",  # innovation, not whitened
    d="m",  # variances of the finite rows, made independent
    z="2 * m",  # scratch of a weight
    V="m, m",  # scratch of a weight
)
"""Workspace of an update with m rows and n states.

`compare` moves the finite rows to the front and makes their noise independent; all arrays but `r` then describe these.
"""


@inlined
def compare(context, sensor, y, reading, H, P, innovation, innovation_std):
    """Compute the innovation ν = y - ŷ and its covariance S = S_ŷ + R over the finite rows of a measurement.

    On entry reading.nu holds ŷ, S (ny, ny) its covariance, C (nx, ny) the covariance with the state, r the variances of
    the rows, and H (ny, nx) is the Jacobian (or has no columns). On return the leading rows and columns of all but r
    belong to the finite rows, made independent. `innovation` and `innovation_std` keep the order of the sensor's rows.
    An S that consists of rounding errors of H P Hᵀ becomes NaN, so that the update fails.

    Returns:
        The number of finite rows.
    """
    m = gather(context, sensor, y, reading, H, P, innovation, innovation_std)
    if has_correlated_rows(context, sensor):
        # The factor of R shares memory with that of S, which is computed later.
        L = reading.chol_S
        independent_rows(context, sensor, y, reading.r, L, reading.d)
        make_independent(m, L, reading.nu, reading.S, reading.C, H)
    for i in range(m):
        reading.S[i, i] += reading.d[i]
        reading.raw[i] = reading.nu[i]
    return m


@inlined
def gather(context, sensor, y, reading, H, P, innovation, innovation_std):
    """Fill ν and d, move the entries of finite rows to the front, and return the number of finite rows."""
    nu, S, C = reading.nu, reading.S, reading.C
    circular = circular_rows(context, sensor)
    m = np.int64(0)  # a literal would be a second type, and compile every callee twice
    for i in range(reading.r.size):
        if not np.isfinite(y[i]):
            continue
        residual = y[i] - nu[i]
        if circular[i] != 0:
            residual = wrap(residual)
        own = S[i, i]
        variance = own + reading.r[i]
        terms = 0.0
        for j in range(H.shape[1]):
            terms += H[i, j] * H[i, j] * P[j, j]
        if not variance > 4.0 * (H.shape[1] + reading.r.size) * EPSILON * terms:
            own = np.nan
            variance = np.nan
        innovation[i] = residual
        innovation_std[i] = np.sqrt(variance) if variance >= 0.0 else np.nan
        nu[m] = residual
        reading.d[m] = reading.r[i]
        if m < i:
            # Row i moves up over a row that has been read.
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
        S[m, m] = own
        m += 1
    return m


@part
def make_independent(m, L, nu, S, C, H):
    """ν ← L⁻¹ ν, S ← L⁻¹ S L⁻ᵀ, C ← C L⁻ᵀ, H ← L⁻¹ H in the leading m rows: see compiled/noise.py."""
    solve_unit(L, m, nu)
    for i in range(m):
        solve_unit(L, m, S[i])
    for i in range(C.shape[0]):
        solve_unit(L, m, C[i])
    for i in range(m):
        for j in range(i):
            for k in range(m):
                S[i, k] -= L[i, j] * S[j, k]
            for k in range(H.shape[1]):
                H[i, k] -= L[i, j] * H[j, k]


@inlined
def factor(S, U, m, n):
    """Factor S (m, m) = Uᵀ U; return False if S is not positive definite beyond rounding.

    Forming S from n states leaves errors of a few n ε S_kk in each pivot. A gain from a pivot that small would be wrong
    without notice. The square-root filters do not form S.
    """
    if not cholesky(S, U, m):
        return False
    for i in range(m):
        if not U[i, i] * U[i, i] > 4.0 * (n + m) * EPSILON * S[i, i]:
            return False
    return True


@inlined
def judge(context, sensor, m, nu, U, score):
    """Return the verdict on an innovation with covariance Uᵀ U, and score it; nu (m,) becomes U⁻ᵀ nu.

    NIS = νᵀ S⁻¹ ν. Source: Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation
    (2001), 5.4.2.
    """
    solve_transposed(U, m, nu)
    nis = 0.0
    log_det = 0.0
    for i in range(m):
        nis += nu[i] * nu[i]
        log_det += 2.0 * np.log(U[i, i])
        score[WHITENED + i] = nu[i]
    return verdict_of(context, sensor, m, nis, log_det, score)


@inlined
def admit(context, sensor, m, nu, S, U, score):
    """Return the verdict on an innovation nu (m,) of covariance S; U gets the factor of S, nu becomes U⁻ᵀ ν."""
    if m == 0:
        return MISSING
    score[1] = m
    if not factor(S, U, m, context.nx):
        return FAILED
    return judge(context, sensor, m, nu, U, score)


@inlined
def admit_weighted(context, sensor, m, reading, score):
    """Return the verdict on the innovation of a measurement; weight the noise of one that is used."""
    verdict = admit(context, sensor, m, reading.nu, reading.S, reading.chol_S, score)
    if verdict == USED and is_robust(context):
        w = reweigh(context, m, reading.nu, reading.raw, reading.d, reading.S, reading.chol_S, reading.V, reading.z)
        for i in range(reading.r.size):
            reading.r[i] /= w
        if not w > 0.0:
            verdict = FAILED
    return verdict


@inlined
def gain(m, C, U, estimated, K, W):
    """K = C S⁻¹ for the leading m columns, with S = Uᵀ U; zero beyond the `estimated` rows; W as for `downdate`."""
    if C.shape[0] >= LANES:
        gain_rows(m, C, U, estimated, K, W)
    else:
        for i in range(C.shape[0]):
            for j in range(m):
                K[i, j] = C[i, j] if i < estimated else 0.0
            solve_transposed(U, m, K[i])
            solve_upper(U, m, K[i])


@part
def gain_rows(m, C, U, estimated, K, W):
    """As `gain`, in whole vectors."""
    n, width = C.shape[0], W.shape[1]
    whiten(m, C, U, estimated, W)
    for k in range(m - 1, -1, -1):
        for j in range(k + 1, m):
            add_scaled(width, -U[k, j], W[j], W[k])
        scaled(width, 1.0 / U[k, k], W[k], W[k])
    for i in range(n):
        for k in range(m):
            K[i, k] = W[k, i]


@part
def whiten(m, C, U, estimated, W):
    """W = U⁻ᵀ Cᵀ for the leading m columns of C; zero beyond its `estimated` rows."""
    width = W.shape[1]
    for k in range(m):
        for i in range(width):
            W[k, i] = C[i, k] if i < estimated else 0.0
        for j in range(k):
            add_scaled(width, -U[j, k], W[j], W[k])
        scaled(width, 1.0 / U[k, k], W[k], W[k])


@inlined
def move_mean(m, C, U, nu, estimated, x):
    """x += C U⁻¹ ν̃, where ν̃ = U⁻ᵀ ν is the whitened innovation; considered states stay."""
    solve_upper(U, m, nu)
    for i in range(estimated):
        for j in range(m):
            x[i] += C[i, j] * nu[j]


@part
def joseph(m, d, C, H, K, P, N, W, B):
    """P ← (I - K H) P (I - K H)ᵀ + K R Kᵀ, in O(n² m); C = P Hᵀ, R = diag(d).

    Symmetric and positive semidefinite whatever the gain. Scratch: N (nx, nx), W as for `downdate`, and B (m or more,
    nx), which may take the place of C. Source: Bucy & Joseph (1968), Filtering for Stochastic Processes with
    Applications to Guidance.
    """
    n = P.shape[0]
    if n >= LANES:
        # As N - K (N H - K R)ᵀ with N = (P - K Cᵀ)ᵀ.
        for k in range(m):
            for i in range(n):
                W[k, i] = K[i, k]
        subtract_product(P, C, n, m, W, 0, N)
        multiply_rows(H, m, n, N, 0, B)
        for k in range(m):
            add_scaled(n, -d[k], W[k], B[k])
        subtract_product(N, K, n, m, B, 1, P)
        mirror(P)
        return
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
    for k in range(m):
        for i in range(n):
            a = K[i, k] * d[k]
            for j in range(i + 1):
                P[i, j] += a * K[j, k]
    mirror(P)


@part
def downdate(m, C, U, estimated, P, W):
    """P ← P - K S Kᵀ, as P - Wᵀ W with W = U⁻ᵀ Cᵀ, in scratch of (m or more, nx in whole vectors).

    The covariance of the considered states stays. That of the estimated ones, and of both, is then that of Schmidt's
    filter: for a gain that is the optimal one in the estimated rows, P - K S Kᵀ is the optimal covariance there.
    Sources: Schmidt (1966), Application of state-space methods to navigation problems; Jazwinski (1970), Stochastic
    Processes and Filtering Theory, 8.4.
    """
    n = P.shape[0]
    if n >= LANES:
        whiten(m, C, U, n, W)
    else:
        for k in range(m):
            inverse = 1.0 / U[k, k]
            for i in range(n):
                s = C[i, k]
                for j in range(k):
                    s -= U[j, k] * W[j, i]
                W[k, i] = s * inverse
    subtract_squares(W, m, estimated, P)
    for i in range(estimated, n):
        for j in range(estimated):
            P[i, j] = P[j, i]
