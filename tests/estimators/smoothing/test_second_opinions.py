"""Smoothers by sigma points against FilterPy's on the same data."""

import numpy as np
from filterpy.kalman import JulierSigmaPoints, UnscentedKalmanFilter

from estimators import fold
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from tests.estimators.smoothing.test_dense import Q
from tests.support import measured


def swing(x, u, p, dt, out):
    out[0] = x[0] + dt * x[1]
    out[1] = x[1] - dt * 9.81 * np.sin(x[0])


def height(x, u, p, out):
    out[0] = np.sin(x[0])


PENDULUM = StateSpaceModel(
    name="swing",
    title="a pendulum whose height is read, as Särkkä has it",
    states=(State("angle", "rad", mean=1.5, std=np.sqrt(0.1)), State("rate", "rad/s", std=np.sqrt(0.1))),
    noises=(Noise("push", "rad²/s³", variance=0.01),),
    sensors=(Sensor("height", (Row("height", "m", variance=0.1),), h=height),),
    f=swing,
    Q=Q,
)


def test_filterpy_by_sigma_points():
    """Their cross-covariance is the sum over the points too; on a curved model the tangent's is another."""
    dt, n = 0.05, 120
    rng = np.random.default_rng(2)
    x, ys = np.array([1.5, 0.0]), []
    for _ in range(n):
        out = np.empty(2)
        swing(x, None, None, dt, out)
        x = out + rng.normal(0, [1e-3, 0.02])
        ys.append(np.sin(x[0]) + rng.normal(0, np.sqrt(0.1)))

    def fx(state, step):
        out = np.empty(2)
        swing(state, None, None, step, out)
        return out

    its = UnscentedKalmanFilter(2, 1, dt, lambda s: np.sin(s[:1]), fx, JulierSigmaPoints(2, kappa=1.0))
    its.x, its.P, its.R = np.array([1.5, 0.0]), 0.1 * np.eye(2), np.array([[0.1]])
    its.Q = 0.01 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    means, covs = [], []
    for k, y in enumerate(ys):
        if k:
            its.predict()
        # FilterPy would reuse the points of the prediction, without the noise that came since.
        its.sigmas_f = its.points_fn.sigma_points(its.x, its.P)
        its.update(np.array([y]))
        means.append(its.x.copy())
        covs.append(its.P.copy())
    expected, cov, _ = its.rts_smoother(np.array(means), np.array(covs))
    log = measured(PENDULUM, "height", dt * np.arange(n), np.array(ys))
    for estimator in ("ukf", "sr-ukf"):
        ours = fold(estimator, PENDULUM, log, covariance=True, smoothed=True, alpha=1.0, beta=0.0, kappa=1.0)
        np.testing.assert_allclose(ours.mean, expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.cov, cov, rtol=0, atol=1e-9)
