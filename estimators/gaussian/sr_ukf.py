"""The square-root unscented Kalman filter: sigma points from a factor of P, which is never formed.

Sigma points and weights are those of ukf.py. A negative central weight is a rank-one downdate, which fails with NaN
if the result is not positive definite.

Source: van der Merwe & Wan (2001), doi:10.1109/ICASSP.2001.940586. Their m downdates by the columns of K S^½, which
break where P⁺ is nearly singular, are replaced by one triangularisation of reading and state together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..compiled.context import circular_rows, circular_states, estimated, expect_points, sensor_rows, transition_points
from ..estimator import FACTOR, POINTS, Options, SmoothingRule
from ..numerics.jit import by_address, inlined
from ..numerics.linalg import remove, triangularise
from ..numerics.simd_ir import padded
from ..numerics.simd_rows import spread_points
from ..numerics.workspace import declare_layout, start_of
from .robust import growth
from .shared import moments_of, work_of
from .square_root import condition, conditioning, describe, moments, noise_root, settle, start
from .ukf import UKF, deviations, weights, weights_of


def points(values: Options, state: np.ndarray, nx: int) -> np.ndarray:
    """Return the sigma points (2 nx + 1, nx) of a state."""
    U = state[nx : nx + nx * nx].reshape(nx, nx)
    spread = weights(values["alpha"], values["beta"], values["kappa"], nx).spread
    return np.vstack((state[:nx], state[:nx] + spread * U, state[:nx] - spread * U))


Predicting, predicting = declare_layout(
    "Predicting",
    "n",
    padded,
    sigma="2 * n + 1, padded(n)",  # sigma points
    moved="2 * n + 1, padded(n)",  # sigma points through f, then their deviations from the mean
    mean="padded(n)",  # mean of the sigma points through f
    lost="n",  # weighted deviation of the central point
    D="3 * n + 1, n",  # all weighted deviations over Q^½
    scratch="n, n",  # Q, then scratch of a triangularisation
)

Updating, updating = declare_layout(
    "Updating",
    "n, m",
    padded,
    conditioning,
    sigma="2 * n + 1, padded(n)",  # sigma points
    D="2 * n + 1, padded(m)",  # sigma points through h, then their deviations from the mean
    mean="padded(m)",  # mean of the sigma points through h
    expected="m = mean",  # mean without padding
    lost="m",  # weighted deviation of the central point
    Y="2 * n + 1, m",  # deviations, those of opposite points turned by 45°
    conditioning="Conditioning(at, n, m, 2 * n + 1)",
)


@inlined
def weigh_central(central, a, grown, deviation, lost, row):
    """Fill `lost` with the central point's row √|w| D₀, its `grown` entries times a; `row` too if w is positive."""
    bare = np.sqrt(abs(central))
    w = a * bare
    for j in range(lost.size):
        lost[j] = (w if j < grown else bare) * deviation[j]
        row[j] = lost[j] if central > 0.0 else 0.0


@by_address
def predict(context, u, dt, index, state, work):
    """x ← mean of the propagated sigma points;  U ← triangle of their weighted deviations over Q^½.

    If a negative central weight leaves a matrix that is not positive definite, the state becomes NaN and the twin
    reports divergence. Source: van der Merwe & Wan (2001), the time update.
    """
    n = context.nx
    x, U = moments_of(state, n)
    own = predicting(start_of(work), n)
    # One matrix from row 0: the central point, the 2n others, the factor of Q.
    D = own.D
    w = weights_of(context)
    spread_points(x, U, w.spread, own.sigma)
    transition_points(context, own.sigma, u, dt, own.moved)
    deviations(own.moved, w.outer, circular_states(context), own.mean)
    good = noise_root(context, x, u, dt, state, D[2 * n + 1 :], own.scratch)
    grown = np.sqrt(growth(context, dt))
    bare = np.sqrt(w.outer)
    outer = grown * bare
    for i in range(1, 2 * n + 1):
        for j in range(n):
            D[i, j] = (outer if j < estimated(context) else bare) * own.moved[i, j]
    weigh_central(w.central, grown, estimated(context), own.moved[0], own.lost, D[0])
    triangularise(D, own.scratch[0])
    if w.central < 0.0 and good:
        good = remove(D, n, own.lost)
    settle(context, own.mean, D, good, state)


@inlined
def turn_pairs(D, n, w, Y):
    """Rows of Y (2n, m) = √(w/2) (D₊ - D₋), then √(w/2) (D₊ + D₋), of opposite points' deviations."""
    a = np.sqrt(0.5 * w)
    for k in range(n):
        for j in range(Y.shape[1]):
            Y[k, j] = a * (D[1 + k, j] - D[1 + n + k, j])
            Y[n + k, j] = a * (D[1 + k, j] + D[1 + n + k, j])


@by_address
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """One triangularisation of sigma deviations and R^½, with fresh sigma points through h.

    With D± = h(x ± spread·U[k]) - ŷ and outer weight w, the pair of rows √w D₊, √w D₋ is turned by 45° into
    √(w/2) (D₊ - D₋), which goes with the row U[k] of the state's factor, and √(w/2) (D₊ + D₋), which goes with none.

    Source: van der Merwe & Wan (2001), the measurement update.
    """
    n = context.nx
    x, U = moments_of(state, n)
    own = updating(start_of(work), n, sensor_rows(context, sensor)[1])
    w = weights_of(context)
    spread_points(x, U, w.spread, own.sigma)
    expect_points(context, sensor, own.sigma, u, own.D)
    deviations(own.D, w.outer, circular_rows(context, sensor), own.mean)
    turn_pairs(own.D, n, w.outer, own.Y)
    lost = own.lost
    weigh_central(w.central, 1.0, 0, own.D[0], lost, own.Y[2 * n])
    if w.central >= 0.0:
        lost = lost[:0]
    return condition(
        context, sensor, y, state, own.expected, own.Y, lost, own.conditioning, innovation, innovation_std, score, False
    )


SR_UKF = replace(
    UKF,
    name="sr-ukf",
    title="Square-root unscented Kalman filter",
    assumes="f and h smooth within the spread; posterior well described by mean and covariance; any conditioning",
    fails_when="a negative central weight outweighs the others, or the posterior has several peaks",
    source="van der Merwe & Wan (2001), doi:10.1109/ICASSP.2001.940586",
    functions=(start, predict, update, describe),
    work_size=work_of(predicting, updating),
    moments=moments,
    points=points,
    smoothing=SmoothingRule(POINTS, FACTOR),
    needs_factor=False,
    singular=True,
)
