"""The Rao-Blackwellised particle filter: sample what is nonlinear, leave the rest to a Kalman filter a particle.

The model says which states it is linear in once the others are known (`conditionally_linear`), and may have a discrete
mode (`jump`). A particle carries a value of the others and of the mode, and mean and covariance of the linear states
given the whole past of these; a reading moves it as a Kalman filter and weighs it by N(y; h(x), H P Hᵀ + R). The
estimate is the mixture of these Gaussians. What is integrated exactly needs no particles: the variance is never larger
than that of `pf` with as many. With nothing to sample it is the Kalman filter.

The mode and the sampled states move as the model says, blind to the reading that comes.

Sources: Doucet, de Freitas, Murphy & Russell (2000), Rao-Blackwellised particle filtering for dynamic Bayesian
networks, UAI 2000, section 3; Schön, Gustafsson & Nordlund (2005), Marginalized particle filters for mixed
linear/nonlinear state-space models, doi:10.1109/TSP.2005.849151, algorithm 1.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_states, sensor_variances
from ..compiled.context import options as numbers
from ..estimator import Estimator, Option, Options
from ..gaussian.shared import admit
from ..model.state_space import StateSpaceModel
from ..numerics.jit import floats, jit, matrix
from ..numerics.peaks import Peak, peaks_of
from ..numerics.random import key_of, normal
from ..track import FAILED, MISSING, USED
from .cloud import (
    EQUAL,
    HEAD,
    MEMBERS,
    PROCESS,
    RECOVER,
    RECOVERIES,
    RESAMPLE,
    SETTLED,
    START,
    cloud_of,
    next_draw,
    own_covariance,
    sized,
    views,
    weigh_equally,
    weights_of,
    wrap_record,
)
from .cloud import OPTIONS as CLOUD_OPTIONS
from .describe import DRAWN, describe, moments, recoveries
from .innovation import finite_rows, score_rows
from .lineage import account, begin_lineage, score_cloud
from .mode_draws import any_mode, jump_key, nearest_mode
from .moments import cloud_moments
from .rbpf_condition import adopt_block, condition_block, mixture, refer
from .rbpf_predict import predict_block
from .rbpf_sampling import fix_mode, sample
from .rbpf_work import ADOPT, CONDITION, PREDICT, tune, work_size
from .steps import NO_KEY, add_up, sweep, work_of
from .weights import keep_or_resample, normalise, phases


@jit
def _spread(context, C, whole, key, member, mode, x, P, column, before):
    """Add a draw of N(0, C) to a particle: its sampled states move, its linear ones get what is left of C."""
    if context.mode >= 0:
        fix_mode(context, C, mode, x, column)
    sample(context, C, key, np.uint64(member * x.size), x, column, before)
    wrap_record(circular_states(context), x)
    for a in range(x.size):
        for b in range(x.size):
            P[a, b] = C[a, b] if whole else P[a, b] + C[a, b]


@jit
def _begin(context, mean, cov, index, stream, state):
    """The cloud that stands for N(mean, cov), of equal weights; the head's counters stay."""
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    records = cloud_of(state, nx, n).records
    key = key_of(context.seed, index, stream)
    C, column, before = np.empty((nx, nx)), np.empty(nx), np.empty(nx)
    mode = 0.0
    for i in range(n):
        x = records[i, :nx]
        for a in range(nx):
            x[a] = mean[a]
            for b in range(nx):
                C[a, b] = cov[a, b]
        if context.mode >= 0:
            j = context.mode
            std = np.sqrt(cov[j, j])
            mode = nearest_mode(context, mean[j] + std * normal(jump_key(key), np.uint64(i)), mean[j], std)
        _spread(context, C, True, key, i, mode, x, own_covariance(records[i], nx), column, before)
    weigh_equally(state, nx, n)
    begin_lineage(context, state)
    state[SETTLED] = 0.0


@jit
def start(context, mean, cov, state):
    """Sampled states and modes drawn from N(mean, cov), and the linear ones given them: Schön et al., step 1."""
    circular = circular_states(context)
    for i in range(HEAD):
        state[i] = 0.0
    cloud = cloud_of(state, mean.size, int(numbers(context)[MEMBERS]))
    for j in range(mean.size):
        cloud.circular[j] = circular[j]
    _begin(context, mean, cov, 0, START, state)


@jit
def _recover(context, index, state):
    """Widen a cloud in which no particle explains the reading, as `recover` does: any mode, twice the spread.

    The sampled states move by a draw from the cloud's covariance, the linear ones get it added to theirs.
    """
    nx = context.nx
    n = int(numbers(context)[MEMBERS])
    state[RECOVERIES] += 1.0
    mean, cov = np.empty(nx), np.empty((nx, nx))
    cloud_moments(state, nx, n, mean, cov)
    finite = True
    for i in range(nx):
        finite = finite and np.isfinite(mean[i]) and np.isfinite(cov[i, i])
    if not finite:
        prior = matrix(floats(context.prior_cov, nx * nx), 0, nx, nx)
        _begin(context, floats(context.prior_mean, nx), prior, index, RECOVER, state)
        return
    records = cloud_of(state, nx, n).records
    key = key_of(context.seed, index, RECOVER)
    C, column, before = np.empty((nx, nx)), np.empty(nx), np.empty(nx)
    mode = 0.0
    for i in range(n):
        for a in range(nx):
            for b in range(nx):
                C[a, b] = cov[a, b]
        if context.mode >= 0:
            for a in range(nx):
                C[a, context.mode] = 0.0
                C[context.mode, a] = 0.0
            mode = any_mode(context, jump_key(key), i)
        _spread(context, C, False, key, i, mode, records[i, :nx], own_covariance(records[i], nx), column, before)
    begin_lineage(context, state)
    state[SETTLED] = 0.0


@jit
def predict(context, u, dt, index, state, work):
    """The mode jumps, the sampled states are drawn, the linear ones follow by a Kalman filter given the draw.

    Source: Schön, Gustafsson & Nordlund (2005), theorem 1 and algorithm 1, step 4.
    """
    n = int(numbers(context)[MEMBERS])
    index = next_draw(state)
    sweep(PREDICT, context, u, dt, 0, u, key_of(context.seed, index, PROCESS), 0.0, state, work)
    lost = add_up(context, work)[0]
    if lost > 0.0:
        state[EQUAL] = 0.0
        if lost >= n:
            _recover(context, index, state)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """Each particle a Kalman update; w ← w N(y; h(x), H P Hᵀ + R); resampling where few carry the weight.

    NIS is that of the mixture's mean and covariance, the log-likelihood the mixture's own, log Σ w N. When no particle
    explains the reading the verdict is `FAILED`, the reading is not used, and the cloud is widened. A reading that
    is infinite fails alone.
    """
    rows = sensor_variances(context, sensor).size
    if finite_rows(y, rows) == 0:
        return MISSING
    shared = work_of(context, work)
    settled = state[SETTLED]
    index = next_draw(state)
    refer(context, sensor, u, state, shared.nu[:rows])
    # Each particle's Kalman update, aside, and log w_i + log N(y; h(x_i), H P_i Hᵀ + R)
    sweep(CONDITION, context, u, 0.0, sensor, y, NO_KEY, 0.0, state, work)
    add_up(context, work)
    m = mixture(context, sensor, y, shared, innovation, innovation_std)
    verdict = admit(context, sensor, m, shared.nu, shared.S, shared.U, score)
    score_rows(context, sensor, y, shared, score)
    state[SETTLED] = settled
    score[2] = np.nan
    if verdict == USED:
        sweep(ADOPT, context, u, 0.0, sensor, y, NO_KEY, 0.0, state, work)
    log_sum = normalise(context, state, work)
    if log_sum > -np.inf:
        score[2] = log_sum
    if verdict == USED and log_sum > -np.inf:
        keep_or_resample(context, key_of(context.seed, index, RESAMPLE), log_sum, state, work)
        score_cloud(state, score)
    elif verdict == USED or (verdict == FAILED and not score[0] == np.inf):
        verdict = FAILED
        state[SETTLED] = 0.0
        _recover(context, index, state)
    return verdict


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Draws of the mixture (`DRAWN`, nx): particles picked by weight at even steps, and one of each's Gaussian."""
    w, records = weights_of(options, state, nx)
    picked = np.minimum(np.searchsorted(np.cumsum(w), (np.arange(DRAWN) + 0.5) / DRAWN), len(w) - 1)
    P = records[picked, nx:].reshape(DRAWN, nx, nx)
    values, vectors = np.linalg.eigh(np.where(np.isfinite(P), P, 0.0))
    z = np.sqrt(np.maximum(values, 0.0)) * np.random.default_rng(0).standard_normal((DRAWN, nx))
    return np.asarray(records[picked, :nx] + np.einsum("kij,kj->ki", vectors, z))


def peaks(options: Options, state: np.ndarray, nx: int) -> list[Peak]:
    """The peaks of the mixture."""
    return peaks_of(points(options, state, nx), views(options, state, nx).circular != 0.0)


def applies(model: StateSpaceModel) -> str | None:
    """Only a model that says what is linear, or has a mode, leaves something to a Kalman filter a particle."""
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
    family="particle",
    assumes="f and h linear in the states of conditionally_linear given the others and the mode; Gaussian noise",
    model_runs="2 N, and the derivatives of f and h",
    fails_when="a jump or a sampled state that the readings demand is so unlikely that no particle tries it",
    source="Schön, Gustafsson & Nordlund (2005), doi:10.1109/TSP.2005.849151",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: options["particles"] * (nx + 1),
    state_size=sized(lambda nx: nx + nx * nx),
    work_size=work_size,
    moments=moments,
    points=points,
    peaks=peaks,
    recoveries=recoveries,
    account=account,
    options=OPTIONS,
    tune=tune,
    prepare=phases(predict_block, condition_block, adopt_block),
    applies=applies,
)
