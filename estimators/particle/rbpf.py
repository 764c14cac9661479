"""The Rao-Blackwellised particle filter: sample the nonlinear states, give each particle a Kalman filter for the rest.

The model lists the states in which it is linear once the others are known (`conditionally_linear`), and may have a
discrete mode (`jump`). A particle carries a value of the others and of the mode, and mean and covariance of the linear
states given their whole past; a measurement updates it like a Kalman filter and weighs it by N(y; h(x), H P Hᵀ + R).
The estimate is the mixture of these Gaussians. States that are integrated exactly need no particles: the variance is
never larger than that of `pf` with as many. With nothing to sample it is the Kalman filter.

The mode and the sampled states move as the model predicts, without regard to the next measurement. Considered states
are sampled, and have their prior again after each measurement, see `reconsider`.

Sources: Doucet, de Freitas, Murphy & Russell (2000), Rao-Blackwellised particle filtering for dynamic Bayesian
networks, UAI 2000, section 3; Schön, Gustafsson & Nordlund (2005), Marginalized particle filters for mixed
linear/nonlinear state-space models, doi:10.1109/TSP.2005.849151, algorithm 1.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_states, estimated, sensor_variances
from ..estimator import Estimator, Option, Options
from ..model.state_space import StateSpaceModel
from ..numerics.jit import floats, jit, matrix
from ..numerics.linalg import copy
from ..numerics.peaks import peaks_of
from ..numerics.random import key_of, normal
from ..track import FAILED, MISSING, USED
from .cloud import (
    MAX_POINTS,
    PROCESS,
    RECOVER,
    SETTLED,
    SHARED,
    START,
    begin_lineage,
    count_of,
    describe,
    next_draw,
    own_cloud,
    own_covariance,
    sized,
    views,
    weigh_equally,
    weights_of,
    wrap_record,
)
from .cloud import OPTIONS as CLOUD_OPTIONS
from .draws import any_mode, jump_key, lost_moments, nearest_mode, reset
from .innovation import expected_reading, finite_rows
from .pf import conclude
from .rbpf_blocks import (
    ADOPT,
    CONDITION,
    PREDICT,
    adopt_block,
    condition_block,
    drop,
    fix_mode,
    predict_block,
    sample,
    tune,
    work_size,
)
from .weights import NO_KEY, all_lost, phases, sweep


@jit
def _spread(context, C, whole, key, member, mode, x, P, column, before):
    """Add a draw of N(0, C) to a particle: its sampled states move, its linear ones get the rest of C."""
    if context.mode >= 0:
        fix_mode(context, C, mode, x, column)
    sample(context, C, key, np.uint64(member * x.size), x, column, before)
    wrap_record(circular_states(context), x)
    for a in range(x.size):
        for b in range(x.size):
            P[a, b] = C[a, b] if whole else P[a, b] + C[a, b]


@jit
def _begin(context, mean, cov, index, stream, state):
    """Draw a cloud of equal weights that stands for N(mean, cov); the head's counters stay."""
    nx, n = context.nx, count_of(context)
    records = own_cloud(context, state).records
    key = key_of(context.seed, index, stream)
    C, column, before = np.empty((nx, nx)), np.empty(nx), np.empty(nx)
    mode = 0.0
    for i in range(n):
        x = records[i, :nx]
        for a in range(nx):
            x[a] = mean[a]
        copy(cov, C)
        if context.mode >= 0:
            j = context.mode
            std = np.sqrt(cov[j, j])
            mode = nearest_mode(context, mean[j] + std * normal(jump_key(key), np.uint64(i)), mean[j], std)
        _spread(context, C, True, key, i, mode, x, own_covariance(records[i], nx), column, before)
    weigh_equally(context, state)
    begin_lineage(context, state)
    state[SETTLED] = 0.0


@jit
def start(context, mean, cov, state):
    """Draw sampled states and modes from N(mean, cov), and condition the linear ones on them: Schön et al., step 1."""
    reset(context, mean, state)
    _begin(context, mean, cov, 0, START, state)


@jit
def _recover(context, index, state):
    """Widen a cloud in which no particle explains the measurement, as `recover` does: any mode, twice the spread.

    The sampled states move by a draw from the cloud's covariance, which adds to that of the linear ones.
    """
    nx = context.nx
    mean, cov = np.empty(nx), np.empty((nx, nx))
    if not lost_moments(context, state, mean, cov):
        prior = matrix(floats(context.prior_cov, nx * nx), 0, nx, nx)
        _begin(context, floats(context.prior_mean, nx), prior, index, RECOVER, state)
        return
    records = own_cloud(context, state).records
    key = key_of(context.seed, index, RECOVER)
    C, column, before = np.empty((nx, nx)), np.empty(nx), np.empty(nx)
    mode = 0.0
    for i in range(records.shape[0]):
        copy(cov, C)
        if context.mode >= 0:
            drop(C, context.mode)
            mode = any_mode(context, jump_key(key), i)
        for j in range(estimated(context), nx):
            drop(C, j)
        _spread(context, C, False, key, i, mode, records[i, :nx], own_covariance(records[i], nx), column, before)
    begin_lineage(context, state)
    state[SETTLED] = 0.0


@jit
def predict(context, u, dt, index, state, work):
    """The mode jumps, the sampled states are drawn, the linear ones follow by a Kalman filter given the draw.

    Source: Schön, Gustafsson & Nordlund (2005), theorem 1 and algorithm 1, step 4.
    """
    index = next_draw(state)
    sweep(PREDICT, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    if all_lost(context, state, work):
        _recover(context, index, state)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Each particle a Kalman update; w ← w N(y; h(x), H P Hᵀ + R); resampling where few carry the weight.

    NIS is that of the mixture's mean and covariance, the log-likelihood the mixture's own, log Σ w N. If no particle
    explains the measurement the verdict is `FAILED`, the measurement is not used, and the cloud is widened. An infinite
    measurement fails without widening.
    """
    if finite_rows(y, sensor_variances(context, sensor).size) == 0:
        return MISSING
    # Each particle's Kalman update, aside, and log w_i + log N(y; h(x_i), H P_i Hᵀ + R)
    index, verdict = expected_reading(CONDITION, context, u, sensor, y, state, work, innovation, innovation_std, score)
    if verdict == USED:
        sweep(ADOPT, context, u, 0.0, sensor, y, NO_KEY, 0.0, state, work)
    verdict = conclude(context, index, verdict, state, work, score)
    if verdict == FAILED and not score[0] == np.inf:
        state[SETTLED] = 0.0
        _recover(context, index, state)
    return verdict


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return draws of the mixture (`MAX_POINTS`, nx): particles picked by weight at even steps, one draw from each."""
    w, records = weights_of(options, state, nx)
    picked = np.minimum(np.searchsorted(np.cumsum(w), (np.arange(MAX_POINTS) + 0.5) / MAX_POINTS), len(w) - 1)
    P = records[picked, nx:].reshape(MAX_POINTS, nx, nx)
    values, vectors = np.linalg.eigh(np.where(np.isfinite(P), P, 0.0))
    z = np.sqrt(np.maximum(values, 0.0)) * np.random.default_rng(0).standard_normal((MAX_POINTS, nx))
    return np.asarray(records[picked, :nx] + np.einsum("kij,kj->ki", vectors, z))


def applies(model: StateSpaceModel) -> str | None:
    """Return why a model without linear states or with a sensor's own likelihood does not fit; None if it does."""
    if not len(model.linear_states):
        return (
            f"rbpf needs states that are linear once the others are known; {model.name} names none in "
            "conditionally_linear; use pf"
        )
    own = [sensor.name for sensor in model.sensors if sensor.log_likelihood is not None]
    if own:
        return f"rbpf needs Gaussian sensors; {own[0]} of {model.name} has a log_likelihood of its own; use pf"
    return None


OPTIONS = (Option("particles", 500, 2, 1e6, "", "number of particles, each with a Kalman filter"), *CLOUD_OPTIONS[1:])


RBPF = Estimator(
    name="rbpf",
    title="Rao-Blackwellised particle filter",
    assumes="f and h linear in the states of conditionally_linear given the others and the mode; Gaussian noise",
    model_runs="2 N, and the derivatives of f and h",
    fails_when="a jump or a sampled state that the readings demand is so unlikely that no particle tries it",
    source="Schön, Gustafsson & Nordlund (2005), doi:10.1109/TSP.2005.849151",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["particles"] * (nx + 1),
    state_size=sized(lambda nx: nx + nx * nx),
    work_size=work_size,
    prepare=phases(predict_block, condition_block, adopt_block),
    applies=applies,
    considers=True,
    **(
        SHARED
        | {
            "points": points,
            "peaks": lambda options, state, nx: peaks_of(
                points(options, state, nx), views(options, state, nx).circular != 0.0
            ),
            "options": OPTIONS,
            "tune": tune,
        }
    ),
)
