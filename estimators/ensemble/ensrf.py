"""The serial ensemble square root filter: the rows of a measurement one after the other, without perturbations.

For one row with variance r, s = C_yy + r and gain K = ρ C_xy / s:

    x̄ ← x̄ + K (y - ȳ),   aᵢ ← aᵢ - α K (h(xᵢ) - ȳ),   α = 1 / (1 + √(r / s))

Later rows are corrected like states, tapered by their distance from the current row. So the rows are assimilated among
themselves first; then every state goes through the sequence by itself. Without a taper all states go through the same
sequence of combinations of members, so that one combination stands for many rows.

Source: Whitaker & Hamill (2002), doi:10.1175/1520-0493(2002)130<1913:EDAWPO>2.0.CO;2, equation 13 for α; the rows
first, then the states: Anderson & Collins (2007), doi:10.1175/JTECH2049.1.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..numerics.jit import jit
from ..numerics.simd import add_scaled, combine, dot
from ..track import USED
from .analysis import begin_analysis, find_places, reconsider, work_size
from .blocks import ROTATION, identity, regress_all, rotate, transform_members
from .localisation import between_rows, localised, prepare
from .shared import CREWS, INFLATION, RADIUS, describe, ensemble_filter, finish, next_draw, predict, start


@jit
def row_by_row(context, sensor, m, a):
    """Assimilate the rows among themselves, in whitened anomalies: s = 1 + |zₖ|².

    On return ZT[k] is zₖ when row k is assimilated, and B[k] the factors of a regression coefficient on it: -α zₖ / s
    on the anomalies, and dₖ / (s √(N - 1)) on the mean.
    """
    ZT, d, rows, B = a.ZT, a.d, a.rows, a.B
    N = ZT.shape[1]
    taper = between_rows(context, sensor)
    for k in range(m):
        z = ZT[k]
        s = 1.0 + dot(N, z, z)
        alpha = 1.0 / (1.0 + np.sqrt(1.0 / s))
        for i in range(N):
            B[k, i] = -alpha * z[i] / s
        B[k, N] = d[k] / (s * np.sqrt(N - 1.0))
        for j in range(k + 1, m):
            near = taper[rows[j], rows[k]] if taper.size > 0 else 1.0
            if near > 0.0:
                coefficient = near * dot(N, ZT[j], z) / s
                d[j] -= coefficient * d[k]
                add_scaled(N, -alpha * coefficient, z, ZT[j])


@jit
def row_transform(m, a):
    """Fill T and v = √(N - 1) w: after all rows, in their order and without taper, x̄ + (T + 1 wᵀ) A are the members.

    A row changes the anomalies of states and later rows alike, A ← (I - α z zᵀ / s) A; hence, from its forecast z⁰, d⁰,

        z = T z⁰,  d = d⁰ - vᵀ z⁰,  v ← v + Tᵀ z d / s,  T ← T - α z (Tᵀ z)ᵀ / s
    """
    ZT, T, v = a.ZT, a.T, a.v
    N = ZT.shape[1]
    z, back = a.W[0], a.W[1]
    identity(T, v)
    for k in range(m):
        for i in range(N):
            z[i] = dot(N, T[i], ZT[k])
        combine(N, z, 1, T[0], N, N, back, 0)
        s = 1.0 + dot(N, z, z)
        add_scaled(N, (a.d[k] - dot(N, v, ZT[k])) / s, back, v)
        alpha = 1.0 / (1.0 + np.sqrt(1.0 / s))
        for i in range(N):
            add_scaled(N, -alpha * z[i] / s, back, T[i])


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a measurement; see the module's equations.

    Without localisation the moments become those of the Kalman update of the ensemble's own moments, exactly, where h
    is linear. With it, and many rows, they depend a little on the order of the rows.
    """
    X, a, rest, m, verdict = begin_analysis(context, u, sensor, y, state, work, innovation, innovation_std, score)
    if verdict != USED:
        return verdict
    index = next_draw(context, state)
    given = numbers(context)
    # A row takes 2 N operations per state, a transform N².
    if localised(context) or 2 * m < X.shape[0]:
        # First the rows among themselves, for zₖ and dₖ; then every state: aᵢ ← aᵢ - α K zₖᵢ, x̄ ← x̄ + K dₖ.
        row_by_row(context, sensor, m, a)
        find_places(m, a.rows, a.places)
        regress_all(context, sensor, X, a.places, a.ZT, a.B, True, given[INFLATION], int(given[CREWS]), rest)
        rotate(context, index, X, a, rest)
    else:
        row_transform(m, a)
        transform_members(context, index, a, X, given[INFLATION], rest)
    reconsider(context, index, X)
    finish(context, index, X, rest)
    return USED


ENSRF = ensemble_filter(
    RADIUS,
    ROTATION,
    name="ensrf",
    title="Serial ensemble square root filter",
    assumes="posterior near Gaussian, its spread within the span of the members",
    fails_when="few members of many states without a radius: chance covariances; the spread collapses",
    source="Whitaker & Hamill (2002), doi:10.1175/1520-0493(2002)130<1913:EDAWPO>2.0.CO;2",
    functions=(start, predict, update, describe),
    considers=True,
    work_size=work_size,
    prepare=prepare,
)
