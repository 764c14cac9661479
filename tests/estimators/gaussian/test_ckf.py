"""The cubature filter against its equations in NumPy, on a curved model: a linear one cannot tell the weights."""

import numpy as np
import pytest

from estimators.log import INPUT, READING, TICK
from tests.estimators.interpreted.test_filterpy import P0, PENDULUM, X0, Q, R, hx
from tests.support import folded, log_of

DT = 0.4


def on_the_sphere(x, P):
    """The points x ± √n Lᵢ of equal weight: Arasaratnam & Haykin (2009)."""
    L = np.sqrt(x.size) * np.linalg.cholesky(P)
    return np.vstack((x + L.T, x - L.T))


def moved(x, u):
    out = np.empty(3)
    PENDULUM.f(x, np.array([u]), np.array([9.81]), DT, out)
    return out


@pytest.mark.parametrize(("sensor", "y"), [(0, [1.2]), (1, [-1.0, 2.9]), (1, [np.nan, 2.0])])
def test_a_step_and_a_reading_are_the_published_sums(sensor, y):
    rows = (DT, TICK, []), (DT, READING, y, sensor)
    before, fold = (folded("ckf", PENDULUM, log_of(2, (0, INPUT, 0.7), row)) for row in rows)

    X = np.array([moved(x, 0.7) for x in on_the_sphere(X0, np.diag(P0))])
    x = X.mean(0)
    P = (X - x).T @ (X - x) / 6 + DT * np.diag(Q)
    # Sums of a dozen numbers of order 1, and a solve with a condition of about 10.
    np.testing.assert_allclose(before.track.mean[1], x, rtol=0, atol=1e-13)
    np.testing.assert_allclose(before.track.std[1], np.sqrt(np.diag(P)), rtol=0, atol=1e-13)

    finite = np.isfinite(y)
    X = on_the_sphere(x, P)
    Y = np.array([hx(sensor, point) for point in X])[:, finite]
    D = Y - Y.mean(0)
    S = D.T @ D / 6 + np.diag(R[sensor][finite])
    K = np.linalg.solve(S, D.T @ (X - x) / 6).T
    mean, cov = fold.moments()
    np.testing.assert_allclose(mean, x + K @ (np.array(y)[finite] - Y.mean(0)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(cov, P - K @ S @ K.T, rtol=0, atol=1e-12)
    points = fold.points()
    np.testing.assert_allclose(points.mean(0), mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.cov(points.T, bias=True), cov, rtol=0, atol=1e-12)
