"""FilterPy's filters behind one adapter: KF, EKF, UKF and EnKF as a second opinion, selectable like our own.

FilterPy's objects do the algebra of a step. The flat state is authoritative: an object is set from it before a step,
and its result is copied back only if the measurement is used, so that snapshots, gate and held-out sensors work as with
every filter. The adapter handles missing rows, sensors of several sizes and rates, offsets of a linear model, and
angles.

Where FilterPy 2.0 must be handled with care:
- `ExtendedKalmanFilter.predict_update` evaluates H before it predicts, so predict() and update() are called; its
  `predict_x` is F x even where f is curved, and is overridden with f.
- `UnscentedKalmanFilter.update` takes the sigma points of the last predict(), which are stale for a second reading at
  one time: they are drawn anew from x and P.
- `UnscentedKalmanFilter` takes sigma points from a P that is singular but for rounding and returns a wrong estimate
  without notice: such an update fails, as in our UKF (`only_rounding`).
- `EnsembleKalmanFilter.update` leaves a P = P - K S Kᵀ that is not its members' covariance: the members' is reported.
  Its perturbations do not have mean zero over the members. It has one Q for all members, here that of their mean.
- `EnsembleKalmanFilter` draws from NumPy's global generator: its methods run here with a generator of
  (seed, draw), which the state counts, and touch no other.

Source: Labbe, Kalman and Bayesian Filters in Python; FilterPy (MIT licence), https://github.com/rlabbe/filterpy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ..ensemble import shared as ensemble
from ..estimator import Estimator, Option
from ..gaussian import kf, ukf
from ..gaussian import shared as gaussian
from ..gaussian.ukf import only_rounding
from ..numerics.linalg import wrapped
from ..track import FAILED, MISSING, USED
from .view import View

if TYPE_CHECKING:
    from filterpy.kalman import EnsembleKalmanFilter, KalmanFilter, UnscentedKalmanFilter

    Filter: TypeAlias = "KalmanFilter | UnscentedKalmanFilter | EnsembleKalmanFilter"

PROCESS, START, PERTURB = range(3)
"""Streams of randomness."""


@lru_cache(maxsize=1)
def objects() -> Any:
    """Return FilterPy's classes, imported at first use: with their SciPy imports that takes as long as Numba."""
    from . import filterpy_objects

    return filterpy_objects


def in_turn(block: np.ndarray) -> Callable[..., np.ndarray]:
    """Return a function that yields the rows of a block in order, as FilterPy evaluates point by point."""
    rows = iter(block)
    return lambda *_: next(rows)


def moments_of(view: View, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return views of mean (nx,) and covariance (nx, nx) in a state."""
    n = view.nx
    return state[:n], state[n:].reshape(n, n)


def _at(filter_: Filter, view: View, state: np.ndarray) -> tuple[Filter, np.ndarray, np.ndarray]:
    """Return a filter that was given the mean and covariance of a state, and these."""
    filter_.x, filter_.P = x, P = moments_of(view, state.copy())
    return filter_, x, P


def start(view: View, mean: np.ndarray, cov: np.ndarray, state: np.ndarray) -> None:
    """Set the state to N(mean, cov), with angles within ±π and a covariance that is symmetric to the last bit."""
    state[: view.nx] = wrapped(mean, view.circular)
    state[view.nx :] = (0.5 * (cov + cov.T)).ravel()


def describe(view: View, state: np.ndarray, mean: np.ndarray, std: np.ndarray, cross: np.ndarray) -> None:
    """Fill mean, standard deviation and the configured covariances."""
    x, P = moments_of(view, state)
    mean[:] = x[view.shown]
    std[:] = np.sqrt(np.diag(P)[view.shown])
    cross[:] = P[view.pairs[:, 0], view.pairs[:, 1]]


def predict_kf(view: View, u: np.ndarray, dt: float, index: int, state: np.ndarray, work: np.ndarray) -> None:
    """x ← F x + c, P ← F P Fᵀ + Q, with c what f adds to F x: inputs, offsets."""
    filter_, x, _ = _at(objects().KalmanFilter(dim_x=view.nx, dim_z=1, dim_u=1), view, state)
    F = view.F(view.prior[0], u, dt)
    offset = view.f(x[None], u, dt)[0] - F @ x
    filter_.predict(u=np.ones(1), B=offset[:, None], F=F, Q=view.Q(x, u, dt))
    start(view, filter_.x, filter_.P, state)


def update_kf(view: View, u: np.ndarray, sensor: int, y: np.ndarray, *rest: Any) -> int:
    """Condition on z = y - h(x) + H x, which removes inputs, offsets and turns of angles."""

    def step(state: np.ndarray, rows: np.ndarray, R: np.ndarray) -> Filter:
        filter_, x, _ = _at(objects().KalmanFilter(dim_x=view.nx, dim_z=rows.size), view, state)
        H = view.H(sensor, x, u)[rows]
        nu = wrapped(y[rows] - view.h(sensor, x[None], u)[0, rows], view.angles[sensor][rows])
        filter_.update(H @ x + nu, R=R, H=H)
        return filter_

    return _update(view, sensor, y, step, *rest)


def predict_ekf(view: View, u: np.ndarray, dt: float, index: int, state: np.ndarray, work: np.ndarray) -> None:
    """x ← f(x, u), P ← F P Fᵀ + Q."""
    filter_, x, _ = _at(objects().Extended(dim_x=view.nx, dim_z=1), view, state)
    filter_.F, filter_.Q = view.F(x, u, dt), view.Q(x, u, dt)
    filter_.forward = view.f(x[None], u, dt)[0]
    filter_.predict()
    start(view, filter_.x, filter_.P, state)


def update_ekf(view: View, u: np.ndarray, sensor: int, y: np.ndarray, *rest: Any) -> int:
    """Condition on a measurement, linearised at the prediction."""

    def step(state: np.ndarray, rows: np.ndarray, R: np.ndarray) -> Filter:
        filter_, *_ = _at(objects().Extended(dim_x=view.nx, dim_z=rows.size), view, state)
        angles = view.angles[sensor][rows]
        filter_.update(
            y[rows],
            lambda x: view.H(sensor, x, u)[rows],
            lambda x: view.h(sensor, x[None], u)[0, rows],
            R=R,
            residual=lambda a, b: wrapped(a - b, angles),
        )
        return filter_

    return _update(view, sensor, y, step, *rest)


def _mean_of(angles: np.ndarray) -> Callable[..., np.ndarray] | None:
    """Return a weighted mean of points with angles, summed relative to the central point."""
    if not np.any(angles):
        return None
    return lambda points, weights: points[0] + weights @ wrapped(points - points[0], angles)


def _residual_of(angles: np.ndarray) -> Callable[..., np.ndarray] | None:
    return (lambda a, b: wrapped(a - b, angles)) if np.any(angles) else None


def _unscented(view: View, angles: np.ndarray) -> UnscentedKalmanFilter:
    values = view.options
    points = objects().MerweScaledSigmaPoints(view.nx, values["alpha"], values["beta"], values["kappa"])
    return objects().UnscentedKalmanFilter(
        view.nx,
        max(1, angles.size),
        0.0,
        hx=None,
        fx=None,
        points=points,
        x_mean_fn=_mean_of(view.circular),
        residual_x=_residual_of(view.circular),
        z_mean_fn=_mean_of(angles),
        residual_z=_residual_of(angles),
    )


def predict_ukf(view: View, u: np.ndarray, dt: float, index: int, state: np.ndarray, work: np.ndarray) -> None:
    """x, P ← mean and covariance of the propagated sigma points, plus Q; NaN where P has no factor."""
    filter_, x, P = _at(_unscented(view, np.zeros(0, bool)), view, state)
    filter_.Q = view.Q(x, u, dt)
    try:
        block = view.f(filter_.points_fn.sigma_points(x, P), u, dt)
        filter_.predict(dt=dt, fx=in_turn(block))
    except ValueError:  # no Cholesky factor: LinAlgError is one
        state[:] = np.nan
        return
    start(view, filter_.x, filter_.P, state)


def update_ukf(view: View, u: np.ndarray, sensor: int, y: np.ndarray, *rest: Any) -> int:
    """Condition on a measurement, with sigma points drawn again from the prediction."""

    def step(state: np.ndarray, rows: np.ndarray, R: np.ndarray) -> Filter:
        filter_, x, P = _at(_unscented(view, view.angles[sensor][rows]), view, state)
        filter_.sigmas_f = filter_.points_fn.sigma_points(x, P)
        block = np.ascontiguousarray(view.h(sensor, filter_.sigmas_f, u)[:, rows])
        filter_.update(y[rows], R=R, hx=in_turn(block))
        U = np.ascontiguousarray(np.linalg.cholesky(P).T)
        w = float(filter_.points_fn.Wm[1])
        across = block[1 : x.size + 1] - block[x.size + 1 :]
        if only_rounding(U, P, across, filter_.S - R, np.diag(R).copy(), w, y[rows]):
            raise ValueError("the sigma points rest on rounding")
        return filter_

    return _update(view, sensor, y, step, *rest)


def _update(
    view: View,
    sensor: int,
    y: np.ndarray,
    step: Callable[..., Filter],
    index: int,
    state: np.ndarray,
    work: np.ndarray,
    innovation: np.ndarray,
    innovation_std: np.ndarray,
    score: np.ndarray,
    *,
    adopt: Callable[..., None] = lambda view, filter_, state: start(view, filter_.x, filter_.P, state),
) -> int:
    """Update a copy with FilterPy by the finite rows, judge its innovation, and `adopt` the copy if it is used."""
    R = view.R[sensor]
    rows = np.flatnonzero(np.isfinite(y[: len(R)]))
    if not rows.size:
        return MISSING
    try:
        filter_ = step(state, rows, R[np.ix_(rows, rows)])
    except ValueError:  # S or P is singular or not finite
        score[1] = rows.size
        return FAILED
    verdict = view.admit(sensor, y, filter_.y, filter_.S, innovation, innovation_std, score)
    if verdict == USED:
        adopt(view, filter_, state)
    return verdict


def _enkf(view: View) -> EnsembleKalmanFilter:
    if "enkf" not in view.kept:
        view.kept["enkf"] = objects().Ensemble(view.nx, ensemble.members(view.options))
    return view.kept["enkf"]


def _members(view: View, state: np.ndarray) -> np.ndarray:
    return ensemble.block(view.options, state, view.nx)


def _settle(view: View, X: np.ndarray) -> None:
    """Bring the angles of the members within half a turn of their mean, and that within ±π."""
    if np.any(view.circular):
        near = wrapped(X - X[0], view.circular)
        shift = near.mean(axis=0)
        X[:] = np.where(view.circular, wrapped(X[0] + shift, view.circular) + near - shift, X)


def start_enkf(view: View, mean: np.ndarray, cov: np.ndarray, state: np.ndarray) -> None:
    """Draw the members from N(mean, cov)."""
    filter_ = _enkf(view)
    filter_.seed(view.seed, 0, START)
    filter_.initialize(np.array(mean), cov)
    X = _members(view, state)
    X[:] = filter_.sigmas
    _settle(view, X)
    state[-1] = 0.0


def predict_enkf(view: View, u: np.ndarray, dt: float, index: int, state: np.ndarray, work: np.ndarray) -> None:
    """xᵢ ← f(xᵢ, u) + wᵢ, wᵢ ~ N(0, Q)."""
    X, filter_ = _members(view, state), _enkf(view)
    forward = view.f(X, u, dt)  # before anything changes: it may fail
    filter_.seed(view.seed, int(state[-1]), PROCESS)
    state[-1] += 1.0
    filter_.sigmas, filter_.dt = X.copy(), dt
    filter_.fx = in_turn(forward)
    filter_.Q = view.Q(X.mean(axis=0), u, dt)
    try:
        filter_.predict()
    except ValueError:  # Q is not finite
        state[:] = np.nan
        return
    X[:] = filter_.sigmas
    _settle(view, X)


def update_enkf(view: View, u: np.ndarray, sensor: int, y: np.ndarray, *rest: Any) -> int:
    """xᵢ ← xᵢ + K (y + vᵢ - h(xᵢ)), vᵢ ~ N(0, R), with the covariances of the members."""

    def step(state: np.ndarray, rows: np.ndarray, R: np.ndarray) -> Filter:
        X, filter_ = _members(view, state), _enkf(view)
        angles = view.angles[sensor][rows]
        expected = view.h(sensor, X, u)[:, rows]
        # FilterPy does not wrap differences, so angles are given within half a turn of one another.
        expected = expected[0] + wrapped(expected - expected[0], angles)
        centre = expected.mean(axis=0)
        nu = wrapped(y[rows] - centre, angles)
        filter_.seed(view.seed, int(state[-1]), PERTURB)
        filter_.sigmas, filter_.x, filter_.P = X.copy(), X.mean(axis=0), np.zeros((view.nx, view.nx))
        filter_.hx, filter_._mean_z = in_turn(expected), np.zeros(rows.size)
        filter_.update(centre + nu, R=R)
        filter_.y = nu
        return filter_

    def adopt(view: View, filter_: EnsembleKalmanFilter, state: np.ndarray) -> None:
        X = _members(view, state)
        X[:] = filter_.sigmas
        state[-1] += 1.0
        _settle(view, X)

    return _update(view, sensor, y, step, *rest, adopt=adopt)


def describe_enkf(view: View, state: np.ndarray, mean: np.ndarray, std: np.ndarray, cross: np.ndarray) -> None:
    """Mean, standard deviation and the configured covariances of the members."""
    x, P = ensemble.moments(view.options, state, view.nx)
    mean[:] = wrapped(x, view.circular)[view.shown]
    std[:] = np.sqrt(np.diag(P)[view.shown])
    cross[:] = P[view.pairs[:, 0], view.pairs[:, 1]]


def _entry(name: str, functions: tuple[Callable, Callable, Callable, Callable], **other: Any) -> Estimator:
    return Estimator(
        name=f"filterpy-{name}",
        title=f"FilterPy's {name.upper()}",
        family="reference",
        functions=functions,
        interpreted=True,
        state_size=other.pop("state_size", gaussian.state_size),
        work_size=lambda options, nx, ny: 0,
        moments=other.pop("moments", gaussian.moments),
        points=other.pop("points", gaussian.no_points),
        source="Labbe (2014), FilterPy 2.0, https://github.com/rlabbe/filterpy",
        **other,
    )


FILTERPY_KF = _entry(
    "kf",
    (start, predict_kf, update_kf, describe),
    assumes="linear f and h, Gaussian noise",
    model_runs="1",
    fails_when="as kf; in Python, a hundred times slower",
    applies=kf.applies,
)
FILTERPY_EKF = _entry(
    "ekf",
    (start, predict_ekf, update_ekf, describe),
    assumes="differentiable f and h, nearly straight within the spread of the estimate",
    model_runs="1 and its derivatives",
    fails_when="as ekf; in Python, a hundred times slower",
    linearises=True,
    runs=lambda options, nx: nx + 1,
)
FILTERPY_UKF = _entry(
    "ukf",
    (start, predict_ukf, update_ukf, describe),
    assumes="f and h smooth within the spread; posterior well described by mean and covariance",
    model_runs="2 nx + 1",
    fails_when="as ukf, and sooner: it subtracts K S Kᵀ and inverts S",
    runs=lambda options, nx: 2 * nx + 1,
    points=ukf.points,
    needs_factor=True,
    options=tuple(option for option in ukf.UKF.options if option.name in ("alpha", "beta", "kappa")),
    refuses=ukf.refuses,
)
FILTERPY_ENKF = _entry(
    "enkf",
    (start_enkf, predict_enkf, update_enkf, describe_enkf),
    assumes="posterior near Gaussian, its spread within the span of the members",
    model_runs="members",
    fails_when="few members: chance covariances, perturbations that shift the mean; the spread collapses",
    runs=lambda options, nx: options["members"],
    state_size=ensemble.state_size,
    moments=ensemble.moments,
    points=ensemble.points,
    samples=True,
    options=(Option("members", 50, 2, 10_000, "", "number of members"),),
)
