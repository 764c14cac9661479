"""The steady-state Kalman filter: the gain that the Kalman filter settles to, found once.

With readings of one sensor, `period` seconds apart, P before a reading tends to the solution of the discrete algebraic
Riccati equation, whatever it was at first:

    P = F (P - P Hᵀ (H P Hᵀ + R)⁻¹ H P) Fᵀ + Q,      K = P Hᵀ (H P Hᵀ + R)⁻¹

The gain is fixed from the first reading on, so the start is slower than the Kalman filter's. P is the covariance that
this gain really has: it is carried by the Joseph form until it is within rounding of the steady one, and from then on
copied, so that a step costs n m multiplications for the gain; a late or lost reading makes it grow as it should.

Source: Anderson & Moore (1979), Optimal Filtering, chapter 4.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from ..compiled.context import options, row_count, steps_of, transition
from ..errors import EstimatorError
from ..estimator import Estimator, Option, Options
from ..model.sensor import covariance_of
from ..model.state_space import StateSpaceModel
from ..numerics.jit import by_address, inlined, part
from ..numerics.linalg import congruence, unit_factor
from ..numerics.workspace import declare_layout, start_of
from ..track import USED
from ..tuning import Tuning
from . import kf, shared
from .ekf import linearise, predicting, updating
from .kf import constant_jacobian, kept_in
from .robust import INFLATION_OPTION, OWN, add_noise, reading_variances, shared_options
from .shared import admit, compare, describe, gain, joseph, moments_of, move_to, no_points, wrap_mean

STEP, WHOLE, STEADY = range(OWN, OWN + 3)
"""Positions in the context's options: a step of the period, whether that is all of it, and what `Steady` lists."""

NEAR = 0.01
"""Share of a step by which it may be shorter or longer and count, for P, as the one that the gain was found for."""

MOVING, AFTER, BEFORE = range(3)
"""What P is: on its way, the steady one after a reading, the steady one before a reading."""


def state_size(values: Options, nx: int) -> int:
    """Numbers in the state: mean, covariance, and what the covariance is."""
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
    """What `tune` found; the model has one sensor."""
    return steady(start_of(options(context)[STEADY:]), context.nx, row_count(context, 0))


@inlined
def phase_of(state):
    """(1,): what P is."""
    return state[state.size - 1 :]


@by_address
def start(context, mean, cov, state):
    """The state that stands for N(mean, cov)."""
    shared.start(context, mean, cov, state)
    phase_of(state)[0] = MOVING


@part
def copy(A, P):
    """P ← A."""
    n = P.shape[0]
    for i in range(n):
        for j in range(n):
            P[i, j] = A[i, j]


@part
def settled(A, P):
    """Whether P is A within 1e-12, relative to the deviations."""
    n = P.shape[0]
    for i in range(n):
        for j in range(i + 1):
            error = P[i, j] - A[i, j]
            if not error * error <= 1e-24 * P[i, i] * P[j, j]:
                return False
    return True


@by_address
def predict(context, u, dt, index, state, work):
    """x ← f(x, u); P steps from the steady one to the steady one, or else as the Kalman filter's.

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
        congruence(constant.F, P, own.products)
        add_noise(context, x, u, counted, state, P, own.Q)
        phase[0] = MOVING
    move_to(context, own.forward, x)


@by_address
def update(context, u, sensor, y, index, state, work, innovation, innovation_std, score):
    """x ← x + K ν with the steady gain, or where rows of the reading are missing with the gain of the others.

    Source: Anderson & Moore (1979), Optimal Filtering, chapter 4; P by the Joseph form, which holds for any gain.
    """
    n = context.nx
    ny = row_count(context, sensor)
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
        gain(m, reading.C, reading.chol_S, K)
    for i in range(n):
        for k in range(m):
            x[i] += K[i, k] * reading.raw[k]
    wrap_mean(context, x)
    if m == ny and phase[0] == BEFORE:
        copy(found.after, P)
        phase[0] = AFTER
        return verdict
    joseph(m, reading.d, reading.C, own.H, K, P, own.N)
    phase[0] = MOVING
    if settled(found.after, P):
        copy(found.after, P)
        phase[0] = AFTER
    return verdict


def tune(values: Options, model: StateSpaceModel, tuning: Tuning) -> np.ndarray:
    """The period, the steady gain, and the steady covariance after and before a reading.

    Raises:
        EstimatorError: If the Riccati equation has no stabilising solution, with the reason.
    """
    from scipy.linalg import solve_discrete_are

    period, rate = values["period"], float(np.log(values["inflation"]))
    u = np.array([item.default for item in model.inputs], float)
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
            "process noise, so it is known ever better; raise its Q, or use kf"
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
    """H and R of the rows L⁻¹ y, which are independent: those that `update` conditions on, as `compare` leaves them."""
    L, d = R.copy(), np.diag(R).copy()
    unit_factor(L, d, d.size)
    return np.linalg.solve(np.tril(L, -1) + np.eye(d.size), H), np.diag(d)


def matrices(
    model: StateSpaceModel, u: np.ndarray, p: np.ndarray, q: np.ndarray, period: float, rate: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F and Q over a period, in steps that the model allows, and H of the only sensor; F includes the inflation."""
    n, m = model.nx, len(model.sensors[0].rows)
    steps = steps_of(period, float(model.max_step))
    dt = period / steps
    f, h = _plain(model.f), _plain(model.sensors[0].h)
    F = columns(lambda x, out: f(x, u, p, dt, out), n, n)
    H = columns(lambda x, out: h(x, u, p, out), n, m)
    Q = np.zeros((n, n))
    if model.Q is None:
        for noise, variance in zip(model.noises, q, strict=True):
            j = model.state_names.index(noise.name)
            Q[j, j] += variance * dt
    else:
        _plain(model.Q)(np.array([state.mean for state in model.states], float), u, p, q, dt, Q)
    F *= np.exp(0.5 * rate * dt)
    total_F, total_Q = np.eye(n), np.zeros((n, n))
    for _ in range(steps):
        total_F, total_Q = F @ total_F, F @ total_Q @ F.T + Q
    return total_F, total_Q, H


def columns(function: Callable, n: int, m: int) -> np.ndarray:
    """The matrix (m, n) of a linear function (of an affine one, without its constant)."""
    origin, out, J = np.empty(m), np.empty(m), np.empty((m, n))
    function(np.zeros(n), origin)
    for j in range(n):
        x = np.zeros(n)
        x[j] = 1.0
        function(x, out)
        J[:, j] = out - origin
    return J


def undetectable(model: StateSpaceModel, F: np.ndarray, H: np.ndarray) -> str | None:
    """The reason why no gain tames the model: something that does not decay and that the sensor does not see."""
    if (mode := unseen(F, H)) is None:
        return None
    sensor, state = model.sensor_names[0], largest(model, mode)
    return f"{model.name} is not detectable: {sensor} does not see {state}, which does not decay"


def unseen(F: np.ndarray, H: np.ndarray) -> np.ndarray | None:
    """A mode of F that does not decay and that H does not see, if there is one.

    Source: the Popov-Belevitch-Hautus test; Kailath, Sayed & Hassibi, Linear Estimation (2000), appendix C.
    """
    n = F.shape[0]
    scale = max(1.0, np.abs(F).max(), np.abs(H).max())
    # An eigenvalue that is there twice is good to the root of rounding only, 1e-8.
    for value, mode in zip(*(item.T for item in np.linalg.eig(F)), strict=True):
        if abs(value) >= 1.0 - 1e-7:
            seen = np.linalg.svd(np.vstack((F - value * np.eye(n), H)), compute_uv=False)[-1]
            if seen < 1e-7 * scale:
                return mode
    return None


def largest(model: StateSpaceModel, mode: np.ndarray) -> str:
    """The state that a mode moves most."""
    return model.state_names[int(np.argmax(np.abs(mode)))]


@lru_cache(maxsize=64)
def applies(model: StateSpaceModel) -> str | None:
    """Only a linear model with one F, one Q and one sensor has a steady state."""
    if not model.linear:
        return f"{model.name} is not linear; its gain never settles; use an extended or unscented Kalman filter"
    if len(model.sensors) > 1:
        return (
            f"{model.name} has {len(model.sensors)} sensors, each at times of its own: no one steady state; make them "
            "rows of one sensor, or use kf"
        )
    p = np.array([item.value for item in model.parameters], float)
    q = np.array([noise.variance for noise in model.noises], float)
    u = np.array([item.default for item in model.inputs], float)
    period = min(1.0, model.max_step)
    here = matrices(model, u, p, q, period)
    for there in (matrices(model, u + shift, p, q, period) for shift in (1.0, -0.7) if u.size):
        if not all(np.allclose(a, b, rtol=1e-9, atol=1e-12) for a, b in zip(here, there, strict=True)):
            return f"{model.name} varies with its inputs: no one steady state; use kf"
    return undetectable(model, here[0], here[2])


def _plain(function: Callable) -> Callable:
    return getattr(function, "py_func", function)


KF_STEADY = Estimator(
    name="kf-steady",
    title="Steady-state Kalman filter",
    family="Gaussian",
    assumes="linear, constant f and h; one sensor that reads every `period` seconds",
    model_runs="1",
    fails_when="readings are lost, late, or start far off: the gain stays what it is",
    source="Anderson & Moore (1979), Optimal Filtering, chapter 4",
    functions=(start, predict, update, describe),
    state_size=state_size,
    work_size=kf.work_size,
    moments=shared.moments,
    points=no_points,
    options=(
        Option("period", 1.0, 1e-6, 1e6, "s", "time between readings, for which the gain is found"),
        INFLATION_OPTION,
    ),
    tune=tune,
    applies=applies,
    fixed_r=True,
)
