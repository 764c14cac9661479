"""The steady-state Kalman filter: the limit of the Kalman filter's gain, computed once.

With measurements of one sensor, `period` seconds apart, P before a measurement tends to the solution of the discrete
algebraic Riccati equation, whatever it was at first:

    P = F (P - P Hᵀ (H P Hᵀ + R)⁻¹ H P) Fᵀ + Q,      K = P Hᵀ (H P Hᵀ + R)⁻¹

The gain is fixed from the first measurement on, so the start is slower than the Kalman filter's. P is the actual
covariance for this gain: it is computed by the Joseph form until it equals the steady one within rounding, and is then
copied, so that a step costs n m multiplications for the gain. After a late or lost measurement it grows accordingly.

Source: Anderson & Moore (1979), Optimal Filtering, chapter 4.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from ..compiled.context import options, sensor_rows, steps_of, transition
from ..errors import EstimatorError
from ..estimator import Estimator, Option, Options
from ..model.parts import covariance_of
from ..model.state_space import StateSpaceModel
from ..model.wrapping import noise_function
from ..numerics.jit import by_address, inlined, part, plain
from ..numerics.linalg import congruence, copy, unit_factor
from ..numerics.workspace import declare_layout, start_of
from ..track import USED
from ..tuning import Tuning
from . import kf, shared
from .ekf import linearise, predicting, updating
from .kf import constant_jacobian, kept_in
from .robust import INFLATION_OPTION, OWN, add_noise, reading_variances, shared_options
from .shared import admit, compare, describe, gain, joseph, moments_of, move_to, no_points, wrap_mean

STEP, WHOLE, STEADY = range(OWN, OWN + 3)
"""Positions in the context's options: a step of the period, whether it is the whole period, and the `Steady` arrays."""

NEAR = 0.01
"""Relative difference up to which a step counts, for P, as the step for which the gain was computed."""

MOVING, AFTER, BEFORE = range(3)
"""Phase of P: not steady, the steady one after a measurement, the steady one before a measurement."""


def state_size(values: Options, nx: int) -> int:
    """Return the size of the state: mean, covariance, and phase of the covariance."""
    return nx + nx * nx + 1


Steady, steady = declare_layout(
    "Steady",
    "n, m",
    K="n, m",  # gain
    after="n, n",  # P after a measurement
    before="n, n",  # P before a measurement
)


@inlined
def steady_of(context):
    """Return the steady gain and covariances from `tune`; the model has one sensor."""
    return steady(start_of(options(context)[STEADY:]), context.nx, sensor_rows(context, 0)[1])


@inlined
def phase_of(state):
    """Return the phase of P, (1,)."""
    return state[state.size - 1 :]


@by_address
def start(context, mean, cov, state):
    """Set the state to N(mean, cov)."""
    shared.start(context, mean, cov, state)
    phase_of(state)[0] = MOVING


@part
def settled(A, P):
    """Return whether P equals A within 1e-12, relative to the standard deviations."""
    n = P.shape[0]
    for i in range(n):
        for j in range(i + 1):
            error = P[i, j] - A[i, j]
            if not error * error <= 1e-24 * P[i, i] * P[j, j]:
                return False
    return True


@by_address
def predict(context, u, dt, index, state, work):
    """x ← f(x, u); P goes from the steady one to the steady one, or else as the Kalman filter's.

    Source: Anderson & Moore (1979), Optimal Filtering, chapter 4.
    """
    n = context.nx
    numbers = options(context)
    x, P = moments_of(state, n)
    phase = phase_of(state)
    own = predicting(start_of(work), n)
    transition(context, x, u, dt, own.forward)
    near = abs(dt - numbers[STEP]) <= NEAR * numbers[STEP]
    if near and phase[0] == AFTER and numbers[WHOLE] == 1.0:
        copy(steady_of(context).before, P)
        phase[0] = BEFORE
    else:
        constant = kept_in(work, n)
        counted = numbers[STEP] if near else dt
        constant_jacobian(context, u, counted, constant, own.jacobian)
        congruence(constant.F, n, P, own.products)
        add_noise(context, x, u, counted, state, P, own.Q)
        phase[0] = MOVING
    move_to(context, own.forward, x)


@by_address
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + K ν with the steady gain, or with the gain of the finite rows if some are missing.

    Source: Anderson & Moore (1979), Optimal Filtering, chapter 4; P by the Joseph form, which holds for any gain.
    """
    n = context.nx
    ny = sensor_rows(context, sensor)[1]
    x, P = moments_of(state, n)
    phase = phase_of(state)
    own = updating(start_of(work), n, ny)
    reading = own.reading
    linearise(context, sensor, x, u, P, reading, own.H, own.jacobian)
    reading_variances(context, sensor, state, reading.r)
    m = compare(context, sensor, y, reading, own.H, P, innovation, innovation_std)
    verdict = admit(context, sensor, m, reading.nu, reading.S, reading.chol_S, score)
    if verdict != USED:
        return verdict
    found = steady_of(context)
    K = own.K
    if m == ny:
        K = found.K
    else:
        gain(m, reading.C, reading.chol_S, n, K, reading.W)
    for i in range(n):
        for k in range(m):
            x[i] += K[i, k] * reading.raw[k]
    wrap_mean(context, x)
    if m == ny and phase[0] == BEFORE:
        copy(found.after, P)
        phase[0] = AFTER
        return verdict
    joseph(m, reading.d, reading.C, own.H, K, P, own.N, reading.W, reading.B)
    phase[0] = MOVING
    if settled(found.after, P):
        copy(found.after, P)
        phase[0] = AFTER
    return verdict


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """Return the period, the steady gain, and the steady covariance after and before a measurement.

    Raises:
        EstimatorError: If the Riccati equation has no stabilising solution, with the reason.
    """
    from scipy.linalg import solve_discrete_are

    period, rate = values["period"], float(np.log(values["inflation"]))
    u = model.default_inputs
    steps = steps_of(period, float(model.max_step))
    F, Q, H = matrices(model, u, tuning.p, tuning.q, period, rate)
    R = covariance_of(model.sensors[0].correlation, np.asarray(tuning.r, float))
    if model.correlated:
        H, R = independent(H, R)
    if reason := undetectable(model, F, H):
        raise EstimatorError(f"estimator kf-steady does not apply: {reason}")
    if (mode := unseen(F.T, Q)) is not None:
        raise EstimatorError(
            f"estimator kf-steady: {model.name} has no steady gain, as {largest(model, mode)} neither decays nor gets "
            "process noise, so its variance tends to zero; raise its Q, or use kf"
        )
    try:
        before = solve_discrete_are(F.T, H.T, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise EstimatorError(
            f"estimator kf-steady: the Riccati equation of {model.name} cannot be solved for readings every "
            f"{period:g} s: {error}; use kf"
        ) from None
    before = 0.5 * (before + before.T)
    S = H @ before @ H.T + R
    K = np.linalg.solve(S, H @ before).T
    rest = np.eye(model.nx) - K @ H
    after = rest @ before @ rest.T + K @ R @ K.T
    return np.concatenate(
        (shared_options(values), [period / steps, steps == 1], K.ravel(), after.ravel(), before.ravel())
    )


def independent(H: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return H and R of the independent rows L⁻¹ y, on which `update` conditions."""
    L, d = R.copy(), np.diag(R).copy()
    unit_factor(L, d, d.size)
    return np.linalg.solve(np.tril(L, -1) + np.eye(d.size), H), np.diag(d)


def matrices(
    model: StateSpaceModel, u: np.ndarray, p: np.ndarray, q: np.ndarray, period: float, rate: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F and Q over a period, in steps of at most `max_step`, and H of the only sensor; F includes inflation."""
    n, m = model.nx, len(model.sensors[0].rows)
    steps = steps_of(period, float(model.max_step))
    dt = period / steps
    f, h = plain(model.f), plain(model.sensors[0].h)
    F = columns(lambda x, out: f(x, u, p, dt, out), n, n)
    H = columns(lambda x, out: h(x, u, p, out), n, m)
    Q = np.zeros((n, n))
    plain(noise_function(model))(model.prior_mean.copy(), u, p, q, dt, Q)
    F *= np.exp(0.5 * rate * dt)
    total_F, total_Q = np.eye(n), np.zeros((n, n))
    for _ in range(steps):
        total_F, total_Q = F @ total_F, F @ total_Q @ F.T + Q
    return total_F, total_Q, H


def columns(function: Callable, n: int, m: int) -> np.ndarray:
    """Return the matrix (m, n) of a linear function (of an affine one, without its constant)."""
    origin, out, J = np.empty(m), np.empty(m), np.empty((m, n))
    function(np.zeros(n), origin)
    for j in range(n):
        x = np.zeros(n)
        x[j] = 1.0
        function(x, out)
        J[:, j] = out - origin
    return J


def undetectable(model: StateSpaceModel, F: np.ndarray, H: np.ndarray) -> str | None:
    """Return why the model is not detectable, if it is not: a mode that neither decays nor is observed."""
    if (mode := unseen(F, H)) is None:
        return None
    sensor, state = model.sensor_names[0], largest(model, mode)
    return f"{model.name} is not detectable: {sensor} does not observe {state}, which does not decay"


def unseen(F: np.ndarray, H: np.ndarray) -> np.ndarray | None:
    """Return a mode of F that does not decay and that H does not observe, if there is one.

    Source: the Popov-Belevitch-Hautus test; Kailath, Sayed & Hassibi, Linear Estimation (2000), appendix C.
    """
    n = F.shape[0]
    scale = max(1.0, np.abs(F).max(), np.abs(H).max())
    # A double eigenvalue is accurate to the root of rounding only, 1e-8.
    for value, mode in zip(*(item.T for item in np.linalg.eig(F)), strict=True):
        if abs(value) >= 1.0 - 1e-7:
            seen = np.linalg.svd(np.vstack((F - value * np.eye(n), H)), compute_uv=False)[-1]
            if seen < 1e-7 * scale:
                return mode
    return None


def largest(model: StateSpaceModel, mode: np.ndarray) -> str:
    """Return the state with the largest entry in a mode."""
    return model.state_names[int(np.argmax(np.abs(mode)))]


@lru_cache(maxsize=64)
def applies(model: StateSpaceModel) -> str | None:
    """Return why the filter does not apply: only a linear model with one F, Q and sensor has a steady state."""
    if not model.linear:
        return f"{model.name} is not linear; its gain never settles; use an extended or unscented Kalman filter"
    if len(model.sensors) > 1:
        return (
            f"{model.name} has {len(model.sensors)} sensors, each at times of its own: no one steady state; make them "
            "rows of one sensor, or use kf"
        )
    p = model.default_parameters
    q = np.array([noise.variance for noise in model.noises], float)
    u = model.default_inputs
    period = min(1.0, model.max_step)
    here = matrices(model, u, p, q, period)
    for there in (matrices(model, u + shift, p, q, period) for shift in (1.0, -0.7) if u.size):
        if not all(np.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in zip(here, there, strict=True)):
            return f"{model.name} varies with its inputs: no one steady state; use kf"
    return undetectable(model, here[0], here[2])


KF_STEADY = Estimator(
    name="kf-steady",
    title="Steady-state Kalman filter",
    family="Gaussian",
    assumes="linear, constant f and h; one sensor that measures every `period` seconds",
    model_runs="1",
    fails_when="measurements are lost or late, or the prior is far off: the gain does not adapt",
    source="Anderson & Moore (1979), Optimal Filtering, chapter 4",
    functions=(start, predict, update, describe),
    state_size=state_size,
    work_size=kf.work_size,
    moments=shared.moments,
    points=no_points,
    options=(
        Option("period", 1.0, 1e-6, 1e6, "s", "time between measurements, for which the gain is computed"),
        INFLATION_OPTION,
    ),
    tune=tune,
    applies=applies,
    fixed_r=True,
)
