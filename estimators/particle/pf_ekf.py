"""The particle filter with an EKF proposal: each particle moves by its own EKF step into the reading.

x_i ~ q = N(x; EKF posterior of particle i),  w_i ∝ w_i' p(y | x_i) p(x_i | x_i') / q(x_i). With a linear sensor and one
step between readings q is the optimal proposal p(x | x', y), and the weight does not depend on the draw.

Sources: van der Merwe, Doucet, de Freitas & Wan (2000), The unscented particle filter, for the EKF as proposal; Doucet,
Godsill & Andrieu (2000), doi:10.1023/A:1008935410038, for the optimal proposal and its weight.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import options as numbers
from ..compiled.context import sensor_variances
from ..estimator import Estimator
from ..gaussian.shared import admit
from ..numerics.jit import jit, matrix
from ..numerics.random import key_of
from ..track import FAILED, MISSING, USED
from .pf import finite_rows, predicted
from .proposals import EXPECT, PROPOSE_EKF, predict, tune, work_size
from .shared import (
    MEMBERS,
    OPTIONS,
    PROPOSE,
    RESAMPLE,
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
)
from .steps import keep_or_resample, normalise, shared, sweep, total


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Draw each particle from its EKF posterior, weigh it, resample where few carry the weight.

    The log-likelihood of a reading that is not used is that of the particles' Gaussians, Σ w' N(y; h(x), S).
    """
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
    x = records_of(state, context.nx, n)[0, : context.nx]
    m = predicted(context, u, sensor, y, x, sums, S, nu, innovation, innovation_std)
    state[SETTLED] = settled
    verdict = admit(context, sensor, m, nu, S, matrix(U_flat, 0, rows, rows), score)
    if verdict == USED:
        key = key_of(context.seed, index, PROPOSE)
        sweep(PROPOSE_EKF, context, u, 0.0, sensor, y, key, 0.0, state, work)
        total(context, work, sums)
    log_sum = normalise(context, u, sensor, y, state, work, sums)
    score[2] = log_sum if log_sum > -np.inf else np.nan
    if verdict == USED and log_sum > -np.inf:
        key = key_of(context.seed, index, RESAMPLE)
        keep_or_resample(context, u, sensor, y, key, log_sum, sums, state, work)
    elif verdict == USED or verdict == FAILED:
        verdict = FAILED
        recover(context, index, state)
    return verdict


PF_EKF = Estimator(
    name="pf-ekf",
    title="Particle filter with EKF proposal",
    family="particle",
    assumes="as pf; f and h differentiable, the noise of a step Gaussian",
    model_runs="3 N, and the derivatives of h (of f too between readings of several steps)",
    fails_when="the EKF's posterior of a particle misses where the reading puts it",
    source="van der Merwe, Doucet, de Freitas & Wan (2000), The unscented particle filter",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: 3 * options["particles"],
    state_size=sized(lambda nx: nx + nx * nx),
    work_size=work_size,
    moments=moments,
    points=points,
    modes=modes,
    recoveries=recoveries,
    options=OPTIONS,
    tune=tune,
)
