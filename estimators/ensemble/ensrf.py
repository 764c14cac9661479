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
from ..estimator import Estimator
from ..numerics.jit import jit
from ..numerics.vectors import add_scaled
from ..track import USED
from .analysis import begin_analysis, find_places, work_size
from .blocks import regress_all
from .forecast import add_spread, predict
from .innovation import judge_reading, observe
from .localisation import between_rows, prepare
from .ranks import account
from .rotation import ROTATION, rotate
from .shared import (
    ADD,
    CREWS,
    INFLATE,
    INFLATION,
    MEMBERS,
    RADIUS,
    block,
    describe,
    ensemble,
    moments,
    next_draw,
    points,
    settle,
    start,
    state_size,
    tune,
)


@jit
def row_by_row(context, sensor, m, a):
    """Assimilate the rows among themselves, in whitened anomalies: s = 1 + |zₖ|².

    On return ZT[k] and B[k] hold what row k is when its turn comes: zₖ, and what a regression coefficient on it does to
    the anomalies, -α zₖ / s, and to the mean, dₖ / (s √(N - 1)).
    """
    ZT, d, rows, B = a.ZT, a.d, a.rows, a.B
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
                dot *= taper[rows[j], rows[k]]
            d[j] -= dot * d[k] / s
            add_scaled(N, -alpha * dot / s, z, ZT[j])


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Condition the ensemble on a reading; see the module's equations.

    Without localisation the moments become those of the Kalman update of the ensemble's own moments, exactly, where h
    is linear. With it, and many rows, they depend a little on the order of the rows.
    """
    X = ensemble(context, state)
    a, rest = begin_analysis(context, sensor, X.shape[0], work)
    m = observe(context, sensor, u, y, state, a, innovation, innovation_std, score)
    verdict = judge_reading(context, sensor, m, a, score)
    if verdict != USED:
        return verdict
    index = next_draw(context, state)
    given = numbers(context)
    # The rows among themselves: zₖ and dₖ as row k finds them; then every state: aᵢ ← aᵢ - α K zₖᵢ, x̄ ← x̄ + K dₖ.
    row_by_row(context, sensor, m, a)
    find_places(m, a.rows, a.places)
    regress_all(context, sensor, X, a.places, a.ZT, a.B, True, given[INFLATION], int(given[CREWS]), rest)
    rotate(context, index, X, a, rest)
    add_spread(context, index, X, rest)
    settle(context, X)
    return USED


ENSRF = Estimator(
    name="ensrf",
    title="Serial ensemble square root filter",
    family="ensemble",
    assumes="posterior near Gaussian, its spread within the span of the members",
    model_runs="members",
    fails_when="few members of many states without a radius: chance covariances; the spread collapses",
    source="Whitaker & Hamill (2002), doi:10.1175/1520-0493(2002)130<1913:EDAWPO>2.0.CO;2",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["members"],
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    blocks=block,
    account=account,
    points=points,
    options=(MEMBERS, INFLATE, ADD, RADIUS, ROTATION),
    tune=tune,
    prepare=prepare,
)
