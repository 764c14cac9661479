"""The square-root unscented Kalman filter: sigma points from a factor of P that is never multiplied out.

Sigma points and weights as in ukf.py. A negative central weight takes a square off the others: that is a rank-one
downdate, which fails visibly where nothing positive definite is left.

Source: van der Merwe & Wan (2001), doi:10.1109/ICASSP.2001.940586. Their m downdates by the columns of K S^½, which
break where P⁺ is nearly singular, are replaced by one triangularisation of reading and state together.
"""

from __future__ import annotations

import numpy as np

from ..compiled.context import circular_rows, circular_states, expect_rows, options, sensor_rows, transition_rows
from ..estimator import Estimator, Options
from ..numerics.jit import jit, matrix
from ..numerics.linalg import remove, triangularise
from ..numerics.simd_ir import padded
from .robust import growth, memory
from .shared import state_size
from .sigma_points import deviations, spread_points
from .square_root import condition, condition_size, describe, moments, noise_root, settle, start
from .ukf import CENTRAL_COV, OUTER, SPREAD, UKF, tune, weights


def points(values: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """The sigma points (2 nx + 1, nx) of a state."""
    U = state[nx : nx + nx * nx].reshape(nx, nx)
    spread = weights(values["alpha"], values["beta"], values["kappa"], nx)[2]
    return np.vstack((state[:nx], state[:nx] + spread * U, state[:nx] - spread * U))


def work_size(options: Options, nx: int, ny: int) -> int:
    """Scratch: sigma points; and the same through f, Q^½ and a square; or ŷ, points through h, conditioning."""
    n, m, points = padded(nx), padded(ny), 2 * nx + 1
    predicting = points * n + n + nx + (3 * nx + 1) * nx + nx * nx
    return points * n + max(predicting, points * m + m + ny + points * ny + condition_size(nx, ny, nx + 1))


@jit
def predict(context, u, dt, index, state, work):
    """x ← mean of the propagated sigma points;  U ← triangle of their weighted deviations over Q^½.

    Where a negative central weight leaves nothing positive definite, the state becomes NaN and the twin reports
    divergence. Source: van der Merwe & Wan (2001), the time update.
    """
    n = context.nx
    U = matrix(state, n, n, n)
    sigma = matrix(work, 0, 2 * n + 1, padded(n))
    at = sigma.size
    moved = matrix(work, at, 2 * n + 1, padded(n))
    at += moved.size
    forward = work[at : at + padded(n)]
    at += forward.size
    row = work[at : at + n]
    at += n
    # From row 0: the central point, the 2n others, the factor of Q; one after the other, so that all are one matrix.
    D = matrix(work, at, 3 * n + 1, n)
    scratch = matrix(work, at + (3 * n + 1) * n, n, n)
    numbers = options(context)
    spread_points(state[:n], U, numbers[SPREAD], sigma)
    transition_rows(context, sigma.ctypes.data, sigma.shape[1], 2 * n + 1, u, dt, moved)
    deviations(moved, numbers[OUTER], circular_states(context), forward)
    good = noise_root(context, state[:n], u, dt, state, D[2 * n + 1 :], scratch)
    grown = np.sqrt(growth(context, dt))
    w = grown * np.sqrt(numbers[OUTER])
    for i in range(1, 2 * n + 1):
        for j in range(n):
            D[i, j] = w * moved[i, j]
    central = numbers[CENTRAL_COV]
    w = grown * np.sqrt(abs(central))
    for j in range(n):
        row[j] = w * moved[0, j]
        D[0, j] = row[j] if central > 0.0 else 0.0
    triangularise(D, scratch[0])
    if central < 0.0 and good:
        good = remove(D, n, row)
    settle(context, forward, U, D, good, state)


@jit
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """One triangularisation of sigma deviations and R^½, with fresh sigma points through h.

    With D± = h(x ± spread·U[k]) - ŷ and outer weight w, the pair of rows √w D₊, √w D₋ is turned by 45° into
    √(w/2) (D₊ - D₋), which goes with the row U[k] of the state's factor, and √(w/2) (D₊ + D₋), which goes with none.

    Source: van der Merwe & Wan (2001), the measurement update.
    """
    n = context.nx
    _, m = sensor_rows(context, sensor)
    U = matrix(state, n, n, n)
    sigma = matrix(work, 0, 2 * n + 1, padded(n))
    at = sigma.size
    D = matrix(work, at, 2 * n + 1, padded(m))
    at += D.size
    expected = work[at : at + padded(m)]
    at += expected.size
    lost = work[at : at + m]
    at += m
    Y = matrix(work, at, 2 * n + 1, m)
    at += Y.size
    numbers = options(context)
    spread_points(state[:n], U, numbers[SPREAD], sigma)
    expect_rows(context, sensor, sigma.ctypes.data, sigma.shape[1], 2 * n + 1, u, D)
    deviations(D, numbers[OUTER], circular_rows(context, sensor), expected)
    w = np.sqrt(0.5 * numbers[OUTER])
    for k in range(n):
        for j in range(m):
            Y[k, j] = w * (D[1 + k, j] - D[1 + n + k, j])
            Y[n + k, j] = w * (D[1 + k, j] + D[1 + n + k, j])
    central = numbers[CENTRAL_COV]
    w = np.sqrt(abs(central))
    for j in range(m):
        lost[j] = w * D[0, j]
        Y[2 * n, j] = lost[j] if central > 0.0 else 0.0
    if central >= 0.0:
        lost = lost[:0]
    return condition(context, sensor, y, state, expected[:m], Y, lost, work[at:], innovation, innovation_std, score)


SR_UKF = Estimator(
    name="sr-ukf",
    title="Square-root unscented Kalman filter",
    family="Gaussian",
    assumes="f and h smooth within the spread; posterior well described by mean and covariance; any conditioning",
    model_runs="2 nx + 1",
    fails_when="a negative central weight outweighs the others, or the posterior has several peaks",
    source="van der Merwe & Wan (2001), doi:10.1109/ICASSP.2001.940586",
    functions=(start, predict, update, describe),
    runs=lambda options, nx: 2 * nx + 1,
    state_size=state_size,
    work_size=work_size,
    moments=moments,
    points=points,
    options=UKF.options,
    tune=tune,
    memory=memory,
    refuses=UKF.refuses,
)
