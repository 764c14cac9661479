"""The soft gate: inflate the noise of a measurement beyond the gate until it lies on it.

    R ← w R,   w = 1 + (1/g - 1/NIS) νᵀ R⁻¹ ν,   NIS = νᵀ S⁻¹ ν > g

NIS(w) is g exactly for one row, or where ν is an eigenvector of S R⁻¹: 1/NIS is linear in w. With more rows 1/NIS is
concave in w, and its slope nowhere less than 1 / νᵀ R⁻¹ ν, so NIS(w) is at most g. A measurement moves the estimate
by about g/√NIS of the unsoftened update, the less the further off it is.

Sources: Huber (1964), doi:10.1214/aoms/1177703732, for weights that fall with the distance; Chang (2014),
doi:10.1007/s00190-013-0690-8, for a factor of R from the NIS.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import sensor_rows
from ..compiled.noise import independent_rows
from ..compiled.verdict import limit_of
from ..estimator import call_update
from ..numerics.jit import floats, linkable, part
from ..numerics.linalg import solve_unit
from ..track import GATED, LOG_LIKELIHOOD, USED

GATE_MARGIN = 1e-9
"""Relative margin of a softened NIS below the gate, against rounding."""


@linkable
def inflation(context, sensor, y, innovation, nis, m):
    """Return the factor w of R with which the NIS of a measurement is at most that of the gate.

    Args:
        context: The context, with the R by which the measurement was judged.
        sensor: Index of the sensor.
        y: The measurement (ny,), of which m rows are finite.
        innovation: ν (ny,).
        nis: Its NIS, beyond the gate.
        m: Finite rows.
    """
    first, rows = sensor_rows(context, sensor)
    r = floats(context.r, context.n_rows)[first : first + rows]
    L, d, e = np.zeros((rows, rows)), np.empty(rows), np.empty(rows)
    independent_rows(context, sensor, y, r, L, d)
    k = 0
    for i in range(rows):
        if np.isfinite(y[i]):
            e[k] = innovation[i]
            k += 1
    solve_unit(L, m, e)
    square = 0.0
    for i in range(m):
        square += e[i] * e[i] / d[i]
    limit = limit_of(context, sensor, m) * (1.0 - GATE_MARGIN)
    return 1.0 + (1.0 / limit - 1.0 / nis) * square


@part
def soften(code, context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Update on a measurement beyond the gate with inflated noise, and return the verdict.

    Innovation, standard deviation, NIS and whitened rows in the track stay those of the tuned noise; the log-likelihood
    is that of the inflated noise, and an adaptation does not learn from it. The measurement is rejected where R cannot
    be inflated, as for a row without noise or a sensor with a density of its own.
    """
    first, rows = sensor_rows(context, sensor)
    r = floats(context.r, context.n_rows)[first : first + rows]
    w = inflation(context, sensor, y, innovation, score[0], int(score[1]))
    if not w < np.inf:
        return GATED
    tuned, nu, std, scored = r.copy(), innovation.copy(), innovation_std.copy(), score.copy()
    adapted = state[state.size - context.n_memory :]
    learned = adapted.copy()
    for k in range(rows):
        r[k] *= w
    verdict = call_update(code.update, context, u, sensor, y, index, state, work, innovation, innovation_std, score)
    for k in range(rows):
        r[k] = tuned[k]
    for k in range(learned.size):
        adapted[k] = learned[k]
    for k in range(nu.size):
        innovation[k] = nu[k]
        innovation_std[k] = std[k]
    for k in range(score.size):
        if k != LOG_LIKELIHOOD or verdict != USED:
            score[k] = scored[k]
    return verdict
