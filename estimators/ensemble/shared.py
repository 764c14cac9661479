"""What the ensemble filters share: members as a flat state, forecasts, and what a reading says of them.

The state is the ensemble X (N, nx), member after member, and the number of times that something was drawn. The
covariance P = A Aᵀ / (N - 1) of its anomalies A is never formed: everything about a reading is said in whitened
anomalies of what the members expect, Z = (h(xᵢ) - ȳ) / √(r (N - 1)), so that S = √R (I + Zᵀ Z) √R.

Members of a circular state keep within half a turn of their mean, which keeps within ±π; plain sums are then right.

Randomness goes by (seed, event, member), and sums over members run in their order: the same bits on any number of
threads.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from ..compiled.context import (
    circular_rows,
    circular_states,
    context_at,
    expect,
    place_of,
    prior,
    process_variances,
    sensor_variances,
    shaped,
    shown_states,
    transition,
)
from ..compiled.context import options as numbers
from ..compiled.noise import add_noise, belief_root, noise_root
from ..estimator import Option, Options
from ..gaussian.shared import LOG_2PI
from ..model.state_space import LARGE, StateSpaceModel
from ..numerics.inverse_root import scratch_of
from ..numerics.jit import flags, floats, ints, jit, matrix
from ..numerics.linalg import solve_transposed, solve_upper, wrap
from ..numerics.random import key_of, normal
from ..numerics.simd import WIDE, add_scaled
from ..numerics.symmetric import factor, gram
from ..track import FAILED, GATED, HELD_OUT, MISSING, USED
from ..tuning import Tuning
from .localisation import between_rows, crews

INFLATION, ADDITIVE, CREWS, OWN = range(4)
"""Positions in the context's options; a filter's own number stands at the last."""

PROCESS, START, PERTURB, SPREAD, ROTATE = range(5)
"""Streams of randomness; see numerics/random.py."""

HEAD = 1
"""Numbers behind the members: how many predictions and analyses have drawn."""

THREADED_FROM = 65_536
"""Numbers in an ensemble from which threads gain more than they cost."""

MEMBERS = Option("members", 50, 2, 10_000, "", "number of members")
INFLATE = Option("inflation", 1.0, 1.0, 10.0, "", "factor on the anomalies after each reading that is used")
ADD = Option("additive", 0.0, 0.0, 10.0, "", "noise added after each reading, in standard deviations of the prior")
RADIUS = Option("radius", 0.0, 0.0, 1e9, "", "distance at which a reading's influence ends; 0: it has no end")


def members(options: Options) -> int:
    """Number of members."""
    return int(options["members"])


def tune(options: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The numbers that the compiled functions read."""
    own = options.get("rotation", 0.0)
    return np.array([options["inflation"], options["additive"], crews(members(options) * model.nx, THREADED_FROM), own])


def state_size(options: Options, nx: int) -> int:
    """Numbers in the state."""
    return members(options) * nx + HEAD


def block(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """A view of the members (N, nx) in a state."""
    return state[: members(options) * nx].reshape(-1, nx)


def side_of(options: Options, ny: int) -> int:
    """Rows of the largest matrix that an analysis factors."""
    return ny if options.get("radius", 0.0) > 0 else min(ny, members(options))


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: what `workspace` hands out, and each crew's own."""
    N, side = members(options), side_of(options, ny)
    analysis = ny * (3 * N + 6) + side * (3 * side + 4) + 2 * N * (N + 1) + N
    crew = max(
        3 * nx + (2 * nx * nx if nx <= LARGE else 0),
        2 * (N + 2) * WIDE + ny * (N + 4) + side * side + scratch_of(side) + 5 * (side + N),
    )
    return analysis + crews(N * nx, THREADED_FROM) * crew


def moments(options: Options, state: np.ndarray, nx: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (nx,) and covariance (nx, nx) of a state; beyond `LARGE` states the variances (1, nx)."""
    N = members(options)
    X = state[: N * nx].reshape(N, nx)
    mean = X[0] + np.mean(X - X[0], axis=0) if nx <= LARGE else X.mean(axis=0)
    if nx <= LARGE:
        A = X - mean
        return mean, A.T @ A / (N - 1)
    variances = np.zeros((1, nx))
    for member in X:
        variances[0] += (member - mean) ** 2
    return mean, variances / (N - 1)


def points(options: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """The members (N, nx); none of a large state."""
    N = members(options)
    return state[: N * nx].reshape(N, nx).copy() if nx <= LARGE else np.zeros((0, nx))


@jit
def ensemble(context, state):
    """The members X (N, nx) of a state."""
    n = context.nx
    return matrix(state, 0, (state.size - HEAD) // n, n)


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
    X = ensemble(context, state)
    N, n = X.shape
    state[N * n] = 0.0
    key = key_of(context.seed, 0, START)
    z = np.empty(n)
    total = np.zeros(n)
    diagonal = cov.shape[0] < n
    side = 1 if diagonal else n
    L = np.empty((side, side))
    if not diagonal:
        belief_root(cov, L)
    for i in range(N):
        for j in range(n):
            z[j] = normal(key, np.uint64(i * n + j))
            X[i, j] = 0.0
        if diagonal:
            if context.shape != 0:
                shaped(context, z, X[i])
            else:
                add_scaled(n, 1.0, z.ctypes.data, X[i].ctypes.data)
            for j in range(n):
                X[i, j] *= np.sqrt(cov[0, j])
        else:
            add_noise(L, z, X[i])
        add_scaled(n, 1.0 / N, X[i].ctypes.data, total.ctypes.data)
    for i in range(N):
        for j in range(n):
            X[i, j] += mean[j] - total[j]
    settle(context, X)


@jit
def describe(context, state, mean, std, cross):
    """Mean and standard deviation of the states that the track keeps, and the configured covariances."""
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
    """Mean of a state over the members."""
    N = X.shape[0]
    total = 0.0
    for i in range(N):
        total += X[i, j] - X[0, j]
    return X[0, j] + total / N


@jit
def covariance(X, j, mean_j, k, mean_k):
    """Covariance of two states over the members."""
    N = X.shape[0]
    total = 0.0
    for i in range(N):
        total += (X[i, j] - mean_j) * (X[i, k] - mean_k)
    return total / (N - 1)


@jit
def forecast(context, u, dt, key, X, crew, crews, scratch):
    """One crew's share of the members through f, with process noise of their own."""
    N, n = X.shape
    forward = scratch[:n]
    z = scratch[n : 2 * n]
    w = scratch[2 * n : 3 * n]
    q = process_variances(context)
    first = ints(context.noise_state, context.n_noises)
    count = ints(context.noise_states, context.n_noises)
    side = n if context.each_state == 0 else 0
    L = matrix(scratch, 3 * n, side, side)
    spare = matrix(scratch, 3 * n + side * side, side, side)
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
            for j in range(n):
                z[j] = normal(key, np.uint64(base + j))
            add_noise(L, z, forward)
        elif context.shape != 0:
            for j in range(n):
                z[j] = normal(key, np.uint64(base + j))
            shaped(context, z, w)
            add_scaled(n, np.sqrt(q[0] * dt), w.ctypes.data, forward.ctypes.data)
        else:
            for k in range(q.size):
                std = np.sqrt(q[k] * dt)
                if std > 0.0:
                    for j in range(first[k], first[k] + count[k]):
                        forward[j] += std * normal(key, np.uint64(base + j))
        for j in range(n):
            x[j] = forward[j]


@jit(parallel=True)
def _forecast_on_threads(context, u, dt, key, X, crews, scratch, each):
    place = place_of(context)
    for crew in prange(crews):
        forecast(context_at(place), u, dt, key, X, crew, crews, scratch[crew * each : (crew + 1) * each])


@jit
def next_draw(X, state):
    """Number this prediction or analysis among all of the state's: the place of its draws; see estimator.py."""
    state[X.size] += 1.0
    return int(state[X.size])


@jit
def predict(context, u, dt, index, state, work):
    """xᵢ ← f(xᵢ, u) + wᵢ, wᵢ ~ N(0, Q), for every member.

    Source: Evensen (2003), doi:10.1007/s10236-003-0036-9.
    """
    X = ensemble(context, state)
    key = key_of(context.seed, next_draw(X, state), PROCESS)
    crews = int(numbers(context)[CREWS])
    if crews > 1:
        _forecast_on_threads(context, u, dt, key, X, crews, work, work.size // crews)
    else:
        forecast(context, u, dt, key, X, 0, 1, work)
    settle(context, X)


@jit
def observe(context, sensor, u, y, X, ZT, d, rows, expected, innovation, innovation_std):
    """What the members expect of the finite rows of a reading, whitened.

    Args:
        context: The context.
        sensor: Its index.
        u: Inputs (nu,).
        y: The reading (ny,).
        X: Members (N, nx).
        ZT: Gets √(1 / (r (N - 1))) times the anomalies of h(xᵢ), (m, N).
        d: Gets the innovation y - ȳ over √r, (m,).
        rows: Gets the row of the reading that each of the m is (as numbers).
        expected: Scratch (ny,).
        innovation: Gets the innovation itself, by row of the reading.
        innovation_std: Gets the square root of its variance, by row of the reading.

    Returns:
        The number m of finite rows.
    """
    N = X.shape[0]
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
            ZT[k, i] = expected[int(rows[k])]
    for k in range(m):
        row = int(rows[k])
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
        d[k] = residual / np.sqrt(r[row])
    return m


@jit
def judge(context, sensor, m, ZT, Z, d, rows, G, U, v, score):
    """NIS, log-likelihood and verdict of a whitened innovation d (m,).

    NIS = dᵀ (I + C)⁻¹ d;  log-likelihood = -½ (NIS + log det S + m log 2π), with C = Zᵀ Z, tapered by the distance
    between the sensor's rows where the filter localises. With more rows than members, and no taper, the same from the
    matrix of the members: with v = (I + Z Zᵀ)⁻¹ Z d, NIS = |d - Zᵀ v|² + |v|² and det(I + Zᵀ Z) = det(I + Z Zᵀ).

    Args:
        context: The context.
        sensor: Its index.
        m: Finite rows of the reading.
        ZT: From `observe`, (m, N).
        Z: Gets its transpose (N, m).
        d: From `observe`, (m,).
        rows: From `observe`.
        G: Gets C (m, m), or Z Zᵀ (N, N) where m > N and nothing is tapered.
        U: Gets the Cholesky factor of I + G.
        v: Scratch (max(m, N),).
        score: Gets NIS, degrees of freedom and log-likelihood.

    Returns:
        The verdict.
    """
    if m == 0:
        return MISSING
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
                    G[k, j] *= taper[int(rows[k]), int(rows[j])]
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
            add_scaled(N, d[k], ZT[k].ctypes.data, v.ctypes.data)
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
    r = sensor_variances(context, sensor)
    for k in range(m):
        log_det += np.log(r[int(rows[k])])
    score[0] = nis
    score[2] = -0.5 * (nis + log_det + m * LOG_2PI)
    if flags(context.used, context.n_sensors)[sensor] == 0:
        return HELD_OUT
    limit = floats(context.gate, context.width + 1)[m]
    if nis <= limit:
        # As in gaussian/shared.py: a reading that far off would leave members that are no numbers.
        return USED if nis < np.inf else FAILED
    return GATED if limit < nis else FAILED


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
    z = scratch[:n]
    w = scratch[n : 2 * n]
    for i in range(N // 2):
        for j in range(n):
            z[j] = normal(key, np.uint64(i * n + j))
        drawn = z
        if context.shape != 0:
            shaped(context, z, w)
            drawn = w
        for j in range(n):
            a = share * drawn[j] * np.sqrt(cov[0, j] if cov.shape[0] < n else cov[j, j])
            X[2 * i, j] += a
            X[2 * i + 1, j] -= a


@jit
def workspace(N, ny, side, work):
    """The parts of `work` that an analysis uses, and the rest, which is the crews'.

    Returns:
        ZT (ny, N), Z (N, ny), B (ny, N + 1), G, U and V (side, side), W (N, N + 1), T (N, N), d, rows, expected (ny,
        each), v (ny + N,), where (ny int64s), values (side,), small (3 side,), rest.
    """
    ZT = matrix(work, 0, ny, N)
    Z = matrix(work, ny * N, N, ny)
    B = matrix(work, 2 * ny * N, ny, N + 1)
    at = ny * (3 * N + 1)
    G = matrix(work, at, side, side)
    U = matrix(work, at + side * side, side, side)
    V = matrix(work, at + 2 * side * side, side, side)
    at += 3 * side * side
    W = matrix(work, at, N, N + 1)
    T = matrix(work, at + N * (N + 1), N, N)
    at += 2 * N * (N + 1)
    d = work[at : at + ny]
    rows = work[at + ny : at + 2 * ny]
    expected = work[at + 2 * ny : at + 3 * ny]
    v = work[at + 3 * ny : at + 4 * ny + N]
    where = ints(work.ctypes.data + 8 * (at + 4 * ny + N), ny)
    at += 5 * ny + N
    values = work[at : at + side]
    small = work[at + side : at + 4 * side]
    return ZT, Z, B, G, U, V, W, T, d, rows, expected, v, where, values, small, work[at + 4 * side :]


@jit
def find_rows(m, rows, where):
    """For each row of a reading which of the m finite ones it is, or -1."""
    for k in range(where.size):
        where[k] = -1
    for k in range(m):
        where[int(rows[k])] = k
