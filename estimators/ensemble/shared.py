"""Parts that all ensemble filters share: state, start, forecast, additive inflation, rank histogram, row of the track.

The state is the ensemble X (N, nx), member after member, the number of draws, and the counts of the rank histogram. The
covariance P = Aᵀ A / (N - 1) of its anomalies A is never formed.

Members of a circular state keep within half a turn of their mean, which keeps within ±π; plain sums are then right.

Random numbers are keyed by (seed, event, member), and sums over members run in their order: the same bits on any number
of threads.

Sources: Evensen (2003), doi:10.1007/s10236-003-0036-9, for the forecast; Hamill (2001),
doi:10.1175/1520-0493(2001)129<0550:IORHFV>2.0.CO;2, for the ranks, with the sensor's noise on each member's expectation
as in section 3 there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from ..compiled.context import (
    circular_states,
    context_at,
    estimated,
    place_of,
    prior,
    process_variances,
    shaped,
    shown_states,
    transition,
)
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, belief_root, noise_root
from ..estimator import MEMBERS as HELD
from ..estimator import TANGENT, Estimator, Option, Options, SmoothingRule
from ..model.state_space import LARGE, StateSpaceModel
from ..numerics.jit import ints, jit
from ..numerics.linalg import copy_vector, wrap
from ..numerics.random import fill_normals, key_of, normal, unit, word
from ..numerics.simd import add_scaled
from ..numerics.workspace import declare_layout, share, size_of, start_of, view
from ..tuning import Tuning
from .localisation import crews

SIZE, INFLATION, ADDITIVE, CREWS, OWN = range(5)
"""Positions in the context's options; the last is the filter's own option."""


PROCESS, START, PERTURB, SPREAD, ROTATE, RANK, CONSIDER = range(7)
"""Streams of randomness; see numerics/random.py."""


BINS = 10
"""Bins of the rank histogram."""


THREADED_FROM = 65_536
"""Numbers in an ensemble from which threads gain more than they cost."""


MEMBERS = Option("members", 200, 2, 10_000, "", "number of members")
"""The chance spread of 50 members costs a tenth of the coverage of a band; a state of any size is cheap with 200."""


INFLATE = Option("inflation", 1.0, 1.0, 10.0, "", "factor on the anomalies after each reading that is used")


ADD = Option("additive", 0.0, 0.0, 10.0, "", "noise added after each reading, in standard deviations of the prior")


RADIUS = Option("radius", 0.0, 0.0, 1e9, "", "distance at which a reading's influence ends; 0: it has no end")


def members(options: Options) -> int:
    """Return the number of members."""
    return int(options["members"])


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """Return the numbers that the compiled functions read."""
    N, own = members(options), options.get("rotation", 0.0)
    return np.array([N, options["inflation"], options["additive"], crews(N * model.nx, THREADED_FROM), own])


Members, members_at = declare_layout("Members", "N, nx", X="N, nx", draws="1", ranks=f"{BINS}")
"""The state: members, number of predictions and analyses that have drawn, counts of the rank histogram."""


def state_size(options: Options, nx: int) -> int:
    """Return the length of the state."""
    return size_of(members_at, members(options), nx)


def block(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return a view of the members (N, nx) in a state."""
    return view(members_at(0, members(options), nx).X, state)


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (nx,) and covariance (nx, nx) of a state; beyond `LARGE` states the variances (1, nx)."""
    X = block(options, state, nx)
    N = len(X)
    mean = X[0] + np.mean(X - X[0], axis=0) if nx <= LARGE else X.mean(axis=0)
    if nx <= LARGE:
        A = X - mean
        return mean, A.T @ A / (N - 1)
    variances = np.zeros((1, nx))
    for member in X:
        variances[0] += (member - mean) ** 2
    return mean, variances / (N - 1)


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return the members (N, nx); none of a large state."""
    return block(options, state, nx).copy() if nx <= LARGE else np.zeros((0, nx))


def account(options: Options, state: np.ndarray, nx: int) -> dict[str, float | list[float]]:
    """Return the number of members, and the rank histogram since the filter started, in `BINS` bins.

    A U shape means that the spread is too small, a hump that it is too large, a slope that the model is biased.
    """
    ranks = view(members_at(0, members(options), nx).ranks, state)
    return {"members": float(members(options)), "ranks": [float(count) for count in ranks]}


@jit
def parts(context, state):
    """Return the parts of a state."""
    return members_at(start_of(state), int(numbers(context)[SIZE]), context.nx)


@jit
def ensemble(context, state):
    """Return the members X (N, nx) of a state."""
    return parts(context, state).X


@jit
def next_draw(context, state):
    """Count this prediction or analysis, and return the count, which keys its random numbers; see estimator.py."""
    draws = parts(context, state).draws
    draws[0] += 1.0
    return int(draws[0])


@jit
def settle(context, X):
    """Bring the circular states of the members within half a turn of their mean, and that within ±π."""
    circular = circular_states(context)
    N = X.shape[0]
    for j in range(circular.size):
        if circular[j] != 0:
            first = X[0, j]
            total = 0.0
            for i in range(N):
                X[i, j] = wrap(X[i, j] - first)
                total += X[i, j]
            shift = wrap(first + total / N) - total / N
            for i in range(N):
                X[i, j] += shift


@jit
def start(context, mean, cov, state):
    """Draw the members from N(mean, cov), cov (nx, nx) or, diagonal, (1, nx); their mean is then made exact."""
    X, draws, ranks, _ = parts(context, state)
    N, n = X.shape
    draws[0] = 0.0
    ranks[:] = 0.0
    key = key_of(context.seed, 0, START)
    z = np.empty(n)
    total = np.zeros(n)
    diagonal = cov.shape[0] < n
    side = 1 if diagonal else n
    L = np.empty((side, side))
    if not diagonal:
        belief_root(cov, L)
    X[:] = 0.0
    for i in range(N):
        fill_normals(key, np.uint64(i * n), n, z)
        if diagonal:
            if context.shape != 0:
                shaped(context, z, X[i])
            else:
                add_scaled(n, 1.0, z, X[i])
            for j in range(n):
                X[i, j] *= np.sqrt(cov[0, j])
        else:
            add_noise(L, z, X[i])
        add_scaled(n, 1.0 / N, X[i], total)
    for i in range(N):
        for j in range(n):
            X[i, j] += mean[j] - total[j]
    settle(context, X)


@jit
def describe(context, state, mean, std, cross):
    """Fill mean and standard deviation of the states in the track, and the configured covariances."""
    X = ensemble(context, state)
    shown = shown_states(context)
    for k in range(mean.size):
        j = shown[k]
        mean[k] = column_mean(X, j)
        std[k] = np.sqrt(covariance(X, j, mean[k], j, mean[k]))
    pairs = ints(context.pairs, 2 * context.n_pairs)
    for k in range(cross.size):
        i, j = pairs[2 * k], pairs[2 * k + 1]
        cross[k] = covariance(X, i, column_mean(X, i), j, column_mean(X, j))


@jit
def column_mean(X, j):
    """Return the mean of a state over the members."""
    N = X.shape[0]
    total = 0.0
    for i in range(N):
        total += X[i, j] - X[0, j]
    return X[0, j] + total / N


@jit
def covariance(X, j, mean_j, k, mean_k):
    """Return the covariance of two states over the members."""
    N = X.shape[0]
    total = 0.0
    for i in range(N):
        total += (X[i, j] - mean_j) * (X[i, k] - mean_k)
    return total / (N - 1)


ForecastScratch, forecast_at = declare_layout(
    "ForecastScratch", "n, side", forward="n", z="n", w="n", L="side, side", spare="side, side"
)
"""Scratch of a crew: next state, normal numbers, shaped noise; where the noise has a covariance (`side` is n, otherwise
0) a root of Q and room for it."""


@jit
def forecast(context, u, dt, key, X, crew, crews, scratch):
    """Move one crew's share of the members through f, each with its own process noise."""
    N, n = X.shape
    q = process_variances(context)
    first = ints(context.noise_state, context.n_noises)
    count = ints(context.noise_states, context.n_noises)
    side = n if context.each_state == 0 else 0
    forward, z, w, L, spare, _ = forecast_at(start_of(scratch), n, side)
    if side > 0 and context.Q_varies == 0:
        noise_root(context, X[0], u, dt, L, spare)
    for i in range(crew * N // crews, (crew + 1) * N // crews):
        x = X[i]
        transition(context, x, u, dt, forward)
        base = i * n
        if side > 0:
            # Noise that depends on the state does so where the step began.
            if context.Q_varies != 0:
                noise_root(context, x, u, dt, L, spare)
            fill_normals(key, np.uint64(base), n, z)
            add_noise(L, z, forward)
        elif context.shape != 0:
            fill_normals(key, np.uint64(base), n, z)
            shaped(context, z, w)
            add_scaled(n, np.sqrt(q[0] * dt), w, forward)
        else:
            for k in range(q.size):
                std = np.sqrt(q[k] * dt)
                if std > 0.0:
                    for j in range(first[k], first[k] + count[k]):
                        forward[j] += std * normal(key, np.uint64(base + j))
        copy_vector(forward, x)


@jit(parallel=True)
def _forecast_on_threads(context, u, dt, key, X, crews, scratch):
    place = place_of(context)
    for crew in prange(crews):
        forecast(context_at(place), u, dt, key, X, crew, crews, share(scratch, crew, crews))


@jit
def predict(context, u, dt, index, state, work):
    """xᵢ ← f(xᵢ, u) + wᵢ, wᵢ ~ N(0, Q), for every member.

    Source: Evensen (2003), doi:10.1007/s10236-003-0036-9.
    """
    X = ensemble(context, state)
    key = key_of(context.seed, next_draw(context, state), PROCESS)
    crews = int(numbers(context)[CREWS])
    if crews > 1:
        _forecast_on_threads(context, u, dt, key, X, crews, work)
    else:
        forecast(context, u, dt, key, X, 0, 1, work)
    settle(context, X)


@jit
def add_spread(context, index, X, scratch):
    """Additive inflation: to each pair of members ±s z with z ~ N(0, 1), so that the mean stays.

    Source: Whitaker & Hamill (2012), doi:10.1175/MWR-D-11-00276.1, with noise in place of archived states.
    """
    share = numbers(context)[ADDITIVE]
    if share == 0.0:
        return
    N, n = X.shape
    _, cov = prior(context)
    key = key_of(context.seed, index, SPREAD)
    room = forecast_at(start_of(scratch), n, 0)
    z, w = room.z, room.w
    for i in range(N // 2):
        fill_normals(key, np.uint64(i * n), n, z)
        drawn = z
        if context.shape != 0:
            shaped(context, z, w)
            drawn = w
        for j in range(estimated(context)):
            a = share * drawn[j] * np.sqrt(cov[0, j] if cov.shape[0] < n else cov[j, j])
            X[2 * i, j] += a
            X[2 * i + 1, j] -= a


@jit
def finish(context, index, X, scratch):
    """Add the additive inflation to an analysis, and wrap its angles."""
    add_spread(context, index, X, scratch)
    settle(context, X)


@jit
def count_ranks(context, m, ZT, d, rows, state):
    """Count for every finite row in which tenth of the members' expectations, with noise added, the measurement lies.

    Args:
        context: The context.
        m: Finite rows.
        ZT: (m, N): (h(xᵢ) - ȳ) / √(r (N - 1)).
        d: (m,): (y - ȳ) / √r.
        rows: (m,): index of each in the measurement.
        state: The filter's state; only its counts change.
    """
    N = ZT.shape[1]
    own = parts(context, state)
    key = key_of(context.seed, int(own.draws[0]), RANK)
    scale = np.sqrt(N - 1.0)
    for k in range(m):
        place = rows[k] * (N + 1)
        rank = unit(word(key, np.uint64(place + N)))
        for i in range(N):
            if scale * ZT[k, i] + normal(key, np.uint64(place + i)) < d[k]:
                rank += 1.0
        own.ranks[min(int(BINS * rank / (N + 1.0)), BINS - 1)] += 1.0


def ensemble_filter(*own: Option, **fields: Any) -> Estimator:
    """Return an `Estimator` with the parts that all ensemble filters share, and options of its own."""
    return Estimator(
        family="ensemble",
        samples=True,
        smoothing=SmoothingRule(TANGENT, HELD),
        model_runs="members",
        runs=lambda options, nx: options["members"],
        state_size=state_size,
        moments=moments,
        points=points,
        blocks=block,
        account=account,
        options=(MEMBERS, INFLATE, ADD, *own),
        tune=tune,
        **fields,
    )
