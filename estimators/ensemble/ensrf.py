"""The serial ensemble square root filter: the rows of a reading one after the other, without perturbations.

For one row with variance r, s = C_yy + r and gain K = ρ C_xy / s:

    x̄ ← x̄ + K (y - ȳ),   aᵢ ← aᵢ - α K (h(xᵢ) - ȳ),   α = 1 / (1 + √(r / s))

The rows to come are corrected like states, tapered by their distance from the row at hand. So the sequence of rows is
found first, among the rows alone; then every state goes through it by itself.

Source: Whitaker & Hamill (2002), doi:10.1175/1520-0493(2002)130<1913:EDAWPO>2.0.CO;2, equation 13 for α; the rows
first, then the states: Anderson & Collins (2007), doi:10.1175/JTECH2049.1.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..compiled.context import sensor_rows
from ..estimator import Estimator
from ..numerics.jit import jit
from ..numerics.simd import add_scaled
from ..track import USED
from .blocks import sweep_all
from .localisation import between_rows, localised, prepare
from .rotation import ROTATION, rotate
from .shared import (
    ADD,
    CREWS,
    INFLATE,
    INFLATION,
    MEMBERS,
    RADIUS,
    add_spread,
    block,
    describe,
    ensemble,
    find_rows,
    judge,
    moments,
    next_draw,
    observe,
    points,
    predict,
    settle,
    start,
    state_size,
    tune,
    work_size,
    workspace,
)


@jit
def row_by_row(context, sensor, m, ZT, d, rows, B):
    """Assimilate the rows among themselves, in whitened anomalies: s = 1 + |zₖ|².

    On return ZT[k] and B[k] hold what row k is when its turn comes: zₖ, and what a regression coefficient on it does to
    the anomalies, -α zₖ / s, and to the mean, dₖ / (s √(N - 1)).
    """
    N = ZT.shape[1]
    taper = between_rows(context, sensor)
    for k in range(m):
        z = ZT[k]
        s = 1.0
        for i in range(N):
            s += z[i] * z[i]
        alpha = 1.0 / (1.0 + np.sqrt(1.0 / s))
        for i in range(N):
            B[k, i] = -alpha * z[i] / s
        B[k, N] = d[k] / (s * np.sqrt(N - 1.0))
        for j in range(k + 1, m):
            dot = 0.0
            for i in range(N):
                dot += ZT[j, i] * z[i]
            if taper.size > 0:
                dot *= taper[int(rows[j]), int(rows[k])]
            d[j] -= dot * d[k] / s
            add_scaled(N, -alpha * dot / s, z.ctypes.data, ZT[j].ctypes.data)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a reading; see the module's equations.

    Without localisation the moments become those of the Kalman update of the ensemble's own moments, exactly, where h
    is linear. With it, and many rows, they depend a little on the order of the rows.
    """
    X = ensemble(context, state)
    N = X.shape[0]
    _, ny = sensor_rows(context, sensor)
    parts = workspace(N, ny, ny if localised(context) else min(ny, N), work)
    ZT, Z, B, G, U, _, W, T, d, rows, expected, v, where, _, _, rest = parts
    m = observe(context, sensor, u, y, X, ZT, d, rows, expected, innovation, innovation_std)
    verdict = judge(context, sensor, m, ZT, Z, d, rows, G, U, v, score)
    if verdict != USED:
        return verdict
    index = next_draw(X, state)
    given = numbers(context)
    row_by_row(context, sensor, m, ZT, d, rows, B)
    find_rows(m, rows, where)
    sweep_all(context, sensor, X, where, ZT, B, True, given[INFLATION], int(given[CREWS]), rest)
    rotate(context, index, X, T, W, rest)
    add_spread(context, index, X, rest)
    settle(context, X)
    return USED


ENSRF = Estimator(
    name="ensrf",
    title="Serial ensemble square root filter",
    family="ensemble",
    assumes="posterior near Gaussian, its spread within the span of the members; noise of rows independent",
    model_runs="members",
    fails_when="few members of many states without a radius: chance covariances; the spread collapses",
    source="Whitaker & Hamill (2002), doi:10.1175/1520-0493(2002)130<1913:EDAWPO>2.0.CO;2",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["members"],
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    blocks=block,
    points=points,
    options=(MEMBERS, INFLATE, ADD, RADIUS, ROTATION),
    tune=tune,
    prepare=prepare,
)
