"""The auxiliary particle filter: choose the particles by how well they foresee the reading, then let them move.

First stage: particle j is chosen in proportion to λ_j = w_j' p̂_j(y), the density of the reading under its predictive
Gaussian N(h(f(x_j)), H P H' + R). Second: x_i ~ p(x | x_j'), w_i ∝ p(y | x_i) / p̂_j(y). The likelihood
Σ_j λ_j · (1/N) Σ_i p(y | x_i) / p̂_j(y) is unbiased for the transition that proposals.py draws from: the model's own
where one step lies between readings, the EKF's Gaussian over several.

Pitt & Shephard score by p(y | f(x_j)) itself, whose tails are lighter than those of p(y | x), so that weights have no
bound; with the predictive spread they have one (Johansen & Doucet).

Sources: Pitt & Shephard (1999), doi:10.1080/01621459.1999.10474153; Johansen & Doucet (2008),
doi:10.1016/j.spl.2008.01.032.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..compiled.context import sensor_variances
from ..estimator import Estimator
from ..gaussian.shared import admit
from ..numerics.jit import ints, jit, matrix
from ..numerics.random import key_of
from ..track import FAILED, MISSING, USED
from .pf import finite_rows, predicted
from .proposals import EXPECT, PROPOSE_PRIOR, predict, predictive, tune, work_size
from .resampling import ancestors_of, take_ancestors
from .shared import (
    MEMBERS,
    OPTIONS,
    PROPOSE,
    RESAMPLE,
    RESAMPLED,
    SETTLED,
    describe,
    modes,
    moments,
    next_draw,
    points,
    records_of,
    recover,
    recoveries,
    sized,
    start,
    weigh_equally,
)
from .steps import children_of, keep, normalise, shared, sweep, total


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Choose by the predictive density, move, weigh by what it got wrong."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    if finite_rows(y, sensor_variances(context, sensor).size) == 0:
        return MISSING
    sums, _, _, S_flat, U_flat, nu, _ = shared(context, work, n)
    rows = sensor_variances(context, sensor).size
    S = matrix(S_flat, 0, rows, rows)
    settled = state[SETTLED]
    index = next_draw(state)
    sweep(EXPECT, context, u, 0.0, sensor, y, np.uint64(0), 0.0, state, work)
    total(context, work, sums)
    x = records_of(state, nx, n)[0, :nx]
    m = predicted(context, u, sensor, y, x, sums, S, nu, innovation, innovation_std)
    state[SETTLED] = settled
    verdict = admit(context, sensor, m, nu, S, matrix(U_flat, 0, rows, rows), score)
    log_sum = normalise(context, u, sensor, y, state, work, sums)
    if verdict == USED and log_sum > -np.inf:
        key = key_of(context.seed, index, RESAMPLE)
        children = children_of(context, u, sensor, y, key, sums, state, work)
        ancestors = ints(work.ctypes.data, n)
        ancestors_of(children, ancestors)
        take_ancestors(ancestors, records_of(state, nx, n))
        take_ancestors(ancestors, matrix(predictive(context, work, n), 0, n, 1))
        weigh_equally(state, nx, n)
        state[RESAMPLED] += 1.0
        key = key_of(context.seed, index, PROPOSE)
        sweep(PROPOSE_PRIOR, context, u, 0.0, sensor, y, key, 0.0, state, work)
        total(context, work, sums)
        second = normalise(context, u, sensor, y, state, work, sums)
        log_sum += second
        if log_sum > -np.inf:
            keep(context, u, sensor, y, second, sums, state, work)
    score[2] = log_sum if log_sum > -np.inf else np.nan
    if verdict == FAILED or (verdict == USED and not log_sum > -np.inf):
        verdict = FAILED
        recover(context, index, state)
    return verdict


APF = Estimator(
    name="apf",
    title="Auxiliary particle filter",
    family="particle",
    assumes="as pf; h differentiable, the noise of a step Gaussian",
    model_runs="2 N, and the derivatives of h (of f too between readings of several steps)",
    fails_when="the predictive density, linearised, misjudges which particles will explain the reading",
    source="Pitt & Shephard (1999), doi:10.1080/01621459.1999.10474153",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: 2 * options["particles"],
    state_size=sized(lambda nx: nx + nx * nx),
    work_size=work_size,
    moments=moments,
    points=points,
    modes=modes,
    recoveries=recoveries,
    options=tuple(option for option in OPTIONS if option.name != "fraction"),
    tune=tune,
)
