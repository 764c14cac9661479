"""What the members say of a reading, in whitened anomalies, and the judgement of it.

Z = (h(xᵢ) - ȳ) / √(r (N - 1)) and d = (y - ȳ) / √r, so that S = √R (I + Zᵀ Z) √R. Where the rows are correlated, they
are made independent by the Cholesky factor of R over those that are there; whatever follows is the same.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import (
    circular_rows,
    expect,
    sensor_variances,
)
from ..compiled.noise import has_correlated_rows, independent_rows
from ..compiled.verdict import verdict_of
from ..numerics.jit import jit
from ..numerics.linalg import solve_transposed, solve_upper, wrap
from ..numerics.normal_score import student_score
from ..numerics.symmetric import factor, gram
from ..numerics.vectors import add_scaled
from ..track import FAILED, MISSING, WHITENED
from .localisation import between_rows
from .ranks import count_ranks
from .shared import ensemble


@jit
def observe(context, sensor, u, y, state, a, innovation, innovation_std, score):
    """What the members expect of the finite rows of a reading, whitened.

    Args:
        context: The context.
        sensor: Its index.
        u: Inputs (nu,).
        y: The reading (ny,).
        state: The filter's state; its rank histogram counts the reading.
        a: The analysis; gets Zᵀ, d, the row of the reading that each of the m is, and the variances r whose product is
            det R.
        innovation: Gets the innovation itself, by row of the reading.
        innovation_std: Gets the square root of its variance, by row of the reading.
        score: Gets from `WHITENED` on the normal score of each row of the reading, see `score_of`.

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
def score_of(residual, r, square, N):
    """The normal score e of a row: N(0, 1) where truth and members are drawn alike from a normal distribution.

    With s² = r `square` the variance of the N members' expectations, the residual from their mean has the variance
    s² (1 + 1/N) + r, since that mean is itself off by s/√N; and since s² is known from N members only, the residual in
    such units has Student's distribution, with the degrees of freedom of a sum of a variance that is estimated and r,
    which is known. ν/√S would be too wide (variance 1.4 with 10 members and little noise, 1.06 with 50), the mixture of
    the members, each with its sensor noise, wider still (2.1 with 10), as it has no tails beyond the outermost member
    but the noise's. This e has a variance within 2 % of 1 from 10 members on, whatever r.

    Sources: Satterthwaite (1946), doi:10.2307/3002019, for the degrees of freedom; Bröcker & Smith (2008),
    doi:10.1111/j.1600-0870.2007.00333.x, for what members alone leave of a distribution.
    """
    spread = square * (1.0 + 1.0 / N)
    share = spread / (1.0 + spread)
    return student_score(residual / np.sqrt(r * (1.0 + spread)), (N - 1) / (share * share))


@jit
def decorrelate(context, sensor, y, m, a):
    """Make rows independent that are whitened but for their correlation c = F D Fᵀ: Z ← Z F⁻ᵀ D^(-1/2), d likewise."""
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
def judge_reading(context, sensor, m, a, score):
    """NIS, log-likelihood and verdict of a whitened innovation d (m,).

    NIS = dᵀ (I + C)⁻¹ d;  log-likelihood = -½ (NIS + log det S + m log 2π), with C = Zᵀ Z, tapered by the distance
    between the sensor's rows where the filter localises. With more rows than members, and no taper, the same from the
    matrix of the members: with v = (I + Z Zᵀ)⁻¹ Z d, NIS = |d - Zᵀ v|² + |v|² and det(I + Zᵀ Z) = det(I + Z Zᵀ).

    Args:
        context: The context.
        sensor: Its index.
        m: Finite rows of the reading.
        a: The analysis, after `observe`; gets Z, in G C, or Z Zᵀ where m > N and nothing is tapered, and in U the
            Cholesky factor of I + G.
        score: Gets NIS, degrees of freedom and log-likelihood.

    Returns:
        The verdict.
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
        for i in range(N):
            v[i] = 0.0
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
