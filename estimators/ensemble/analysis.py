"""The analysis: whitened anomalies of the expected measurement, its normal scores, NIS, likelihood and verdict.

Z = (h(xᵢ) - ȳ) / √(r (N - 1)) and d = (y - ȳ) / √r, so that S = √R (I + Zᵀ Z) √R. Correlated rows are made independent
by the Cholesky factor of R over the finite rows; the rest is the same.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, estimated, expect, prior, sensor_rows, sensor_variances
from ..compiled.noise import has_correlated_rows, independent_rows, lost_root
from ..compiled.verdict import verdict_of
from ..estimator import Options
from ..model.state_space import LARGE
from ..numerics.jit import jit
from ..numerics.linalg import solve_transposed, solve_upper, wrap
from ..numerics.normal_score import student_score
from ..numerics.random import key_of, normal
from ..numerics.simd import WIDE, add_scaled, dot
from ..numerics.simd_ir import LANES
from ..numerics.symmetric import factor, gram
from ..numerics.workspace import after, declare_layout, size_of, start_of
from ..track import FAILED, MISSING, WHITENED
from .blocks import regression_at, transform_at
from .localisation import between_rows, crews, localised
from .shared import CONSIDER, THREADED_FROM, column_mean, count_ranks, covariance, ensemble, forecast_at, members

Analysis, analysis_at = declare_layout(
    "Analysis",
    "N, ny, side",
    ZT="ny, N",
    Z="N, ny",
    B="ny, N + 1",
    G="side, side",
    U="side, side",
    V="side, side",
    W="N, N + 1",
    T="N, N",
    d="ny",
    r="ny",
    rows="int ny",
    expected="ny",
    v="ny + N",
    places="int ny",
    values="side",
    small="3 * side",
)
"""Scratch of an analysis of N members and ny rows, with matrices of order `side`, the smaller of the two.

ZT and Z are the whitened anomalies of the expected measurement, d the whitened innovation, r variances whose product is
det R; `rows` is the index of each finite row in the measurement, `places` the inverse. G and U are a Gram matrix and
the Cholesky factor of I + G. The others belong to the filter."""


def work_size(options: Options, nx: int, ny: int, task: int = 0) -> int:
    """Return the length of the scratch: the analysis, and for each crew its largest task, at least `task`."""
    N = members(options)
    crew = max(
        size_of(forecast_at, nx, nx if nx <= LARGE else 0),
        size_of(transform_at, N, WIDE),
        size_of(regression_at, N, WIDE),
        task,
    )
    # A crew's arrays may begin at its first whole cache line.
    crew += LANES
    side = ny if options.get("radius", 0.0) > 0 else min(ny, N)
    return size_of(analysis_at, N, ny, side) + crews(N * nx, THREADED_FROM) * crew


@jit
def find_places(m, rows, places):
    """Fill for each row of a measurement its index among the m finite ones, or -1."""
    places[:] = -1
    for k in range(m):
        places[rows[k]] = k


@jit
def score_of(residual, r, square, N):
    """Return the normal score e of a row: N(0, 1) if truth and members are drawn from one normal distribution.

    With s² = r `square` the variance of the N members' expectations, the residual from their mean has the variance s²
    (1 + 1/N) + r, since that mean is itself wrong by s/√N; and since s² is known from N members only, the residual in
    such units has Student's distribution, with the degrees of freedom of a sum of a variance that is estimated and r,
    which is known. ν/√S would be too wide (variance 1.4 with 10 members and little noise, 1.06 with 50), the mixture of
    the members, each with its sensor noise, wider still (2.1 with 10), as it has no tails beyond the outermost member
    but the noise's. This e has a variance within 2 % of 1 from 10 members on, whatever r.

    Sources: Satterthwaite (1946), doi:10.2307/3002019, for the degrees of freedom; Bröcker & Smith (2008),
    doi:10.1111/j.1600-0870.2007.00333.x, for the distribution that members alone leave.
    """
    spread = square * (1.0 + 1.0 / N)
    share = spread / (1.0 + spread)
    return student_score(residual / np.sqrt(r * (1.0 + spread)), (N - 1) / (share * share))


@jit
def decorrelate(context, sensor, y, m, a):
    """Make rows with the correlation c = F D Fᵀ independent: Z ← Z F⁻ᵀ D^(-1/2), d likewise."""
    ny, N = a.rows.size, a.ZT.shape[1]
    F, D = np.empty((ny, ny)), np.empty(ny)
    independent_rows(context, sensor, y, np.ones(ny), F, D)
    for k in range(m):
        for j in range(k):
            add_scaled(N, -F[k, j], a.ZT[j], a.ZT[k])
            a.d[k] -= F[k, j] * a.d[j]
    for k in range(m):
        scale = 1.0 / np.sqrt(D[k])
        for i in range(N):
            a.ZT[k, i] *= scale
        a.d[k] *= scale
        a.r[k] *= D[k]


@jit
def observe(context, sensor, u, y, state, a, innovation, innovation_std, score):
    """Fill the members' expectation of the finite rows of a measurement, whitened.

    Args:
        context: The context.
        sensor: Its index.
        u: Inputs (nu,).
        y: The measurement (ny,).
        state: The filter's state; its rank histogram counts the measurement.
        a: The analysis; gets Zᵀ, d, the index of each of the m rows in the measurement, and the variances r whose
            product is det R.
        innovation: Gets the innovation, by row of the measurement.
        innovation_std: Gets its standard deviation, by row of the measurement.
        score: Gets from `WHITENED` on the normal score of each row of the measurement, see `score_of`.

    Returns:
        The number m of finite rows.
    """
    X = ensemble(context, state)
    N = X.shape[0]
    ZT, d, rows, expected = a.ZT, a.d, a.rows, a.expected
    r = sensor_variances(context, sensor)
    circular = circular_rows(context, sensor)
    m = 0
    for k in range(r.size):
        if np.isfinite(y[k]):
            rows[m] = k
            m += 1
    for i in range(N):
        expect(context, sensor, X[i], u, expected)
        for k in range(m):
            ZT[k, i] = expected[rows[k]]
    for k in range(m):
        row = rows[k]
        z = ZT[k]
        first = z[0]
        total = 0.0
        for i in range(N):
            z[i] -= first
            if circular[row] != 0:
                z[i] = wrap(z[i])
            total += z[i]
        total /= N
        residual = y[row] - (first + total)
        if circular[row] != 0:
            residual = wrap(residual)
        scale = 1.0 / np.sqrt(r[row] * (N - 1))
        square = 0.0
        for i in range(N):
            z[i] = (z[i] - total) * scale
            square += z[i] * z[i]
        innovation[row] = residual
        innovation_std[row] = np.sqrt(r[row] * (1.0 + square))
        score[WHITENED + row] = score_of(residual, r[row], square, N)
        d[k] = residual / np.sqrt(r[row])
        a.r[k] = r[row]
    count_ranks(context, m, ZT, d, rows, state)
    if has_correlated_rows(context, sensor):
        decorrelate(context, sensor, y, m, a)
    return m


@jit
def judge_reading(context, sensor, m, a, score):
    """Return the verdict on a whitened innovation d (m,), and fill NIS and log-likelihood.

    NIS = dᵀ (I + C)⁻¹ d;  log-likelihood = -½ (NIS + log det S + m log 2π), with C = Zᵀ Z, tapered by the distance
    between the sensor's rows where the filter localises. With more rows than members, and no taper, the same from the
    matrix of the members: with v = (I + Z Zᵀ)⁻¹ Z d, NIS = |d - Zᵀ v|² + |v|² and det(I + Zᵀ Z) = det(I + Z Zᵀ).

    Args:
        context: The context.
        sensor: Its index.
        m: Finite rows of the measurement.
        a: The analysis, after `observe`; gets Z, in G C, or Z Zᵀ where m > N and nothing is tapered, and in U the
            Cholesky factor of I + G.
        score: Gets NIS, degrees of freedom and log-likelihood.
    """
    if m == 0:
        return MISSING
    ZT, Z, d, rows, G, U, v = a.ZT, a.Z, a.d, a.rows, a.G, a.U, a.v
    N = ZT.shape[1]
    score[1] = m
    for k in range(m):
        for i in range(N):
            Z[i, k] = ZT[k, i]
    taper = between_rows(context, sensor)
    in_rows = taper.size > 0 or m <= N
    nis = 0.0
    if in_rows:
        gram(Z, N, m, G)
        if taper.size > 0:
            for k in range(m):
                for j in range(m):
                    G[k, j] *= taper[rows[k], rows[j]]
        if not factor(G, m, U):
            return FAILED
        for k in range(m):
            v[k] = d[k]
        solve_transposed(U, m, v)
        for k in range(m):
            nis += v[k] * v[k]
    else:
        gram(ZT, m, N, G)
        if not factor(G, N, U):
            return FAILED
        v[:] = 0.0
        for k in range(m):
            add_scaled(N, d[k], ZT[k], v)
        solve_transposed(U, N, v)
        solve_upper(U, N, v)
        for k in range(m):
            rest = d[k]
            for i in range(N):
                rest -= ZT[k, i] * v[i]
            nis += rest * rest
        for i in range(N):
            nis += v[i] * v[i]
    log_det = 0.0
    for k in range(m if in_rows else N):
        log_det += 2.0 * np.log(U[k, k])
    for k in range(m):
        log_det += np.log(a.r[k])
    return verdict_of(context, sensor, m, nis, log_det, score)


@jit
def reconsider(context, index, X):
    """Give considered states c the moments of their prior again, after an analysis without perturbations moved them.

    c ← c - c̄ + c₀ + L z, z ~ N(0, I), with L Lᵀ = C - P_cc, as for particles (particle/draws.py): P - K S Kᵀ remains in
    the other states and their covariance with c, which is Schmidt's filter. The draws are made orthogonal to the
    anomalies, so that no covariance changes by chance, where there are members enough; otherwise only their mean is 0.
    An inflation does not act on c.
    """
    first = estimated(context)
    N, n = X.shape
    count = n - first
    if count == 0:
        return
    mean, C = prior(context)
    others = n if N > n + count else 0
    Z, P, root = np.empty((others + count, N)), np.empty((count, count)), np.zeros((count, count))
    for j in range(first, n):
        middle = column_mean(X, j)
        variance = covariance(X, j, middle, j, middle)
        shrunk = np.sqrt(C[j, j] / variance) if variance > C[j, j] else 1.0
        for i in range(N):
            X[i, j] = mean[j] + shrunk * (X[i, j] - middle)
    for j in range(count):
        for k in range(j + 1):
            P[j, k] = covariance(X, first + j, mean[first + j], first + k, mean[first + k])
            P[k, j] = P[j, k]
    if not lost_root(context, first, P, root):
        return
    key = key_of(context.seed, index, CONSIDER)
    for j in range(others + count):
        z = Z[j]
        total, size = 0.0, 0.0
        for i in range(N):
            z[i] = X[i, j] if j < others else normal(key, np.uint64(i * count + j - others))
            total += z[i]
        for i in range(N):
            z[i] -= total / N
            size += z[i] * z[i]
        # Twice: the second time takes away what rounding left.
        for _ in range(2):
            for k in range(j):
                add_scaled(N, -dot(N, z, Z[k]), Z[k], z)
        left = dot(N, z, z)
        # Anomalies that depend on those before them are rounding.
        scale = 1.0 / np.sqrt(left) if left > 1e-20 * size else 0.0
        for i in range(N):
            z[i] *= scale
    for j in range(count):
        for k in range(count):
            for i in range(N):
                X[i, first + j] += np.sqrt(N - 1.0) * root[j, k] * Z[others + k, i]


@jit
def begin_analysis(context, u, sensor, y, state, work, innovation, innovation_std, score):
    """Observe and judge a measurement; return members, analysis, the crews' scratch, number of finite rows, verdict."""
    X = ensemble(context, state)
    N = X.shape[0]
    _, ny = sensor_rows(context, sensor)
    a = analysis_at(start_of(work), N, ny, ny if localised(context) else min(ny, N))
    m = observe(context, sensor, u, y, state, a, innovation, innovation_std, score)
    return X, a, after(work, a.end), m, judge_reading(context, sensor, m, a, score)
