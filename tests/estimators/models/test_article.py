"""The article's worked example, every one of its 120 rows; and the chaotic models against their published equations.

The reference is the example itself, written out again in plain NumPy: other code, other algebra (inverses, full
matrices), the same draws of NumPy's seed 7.
"""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estimators.diagnostics.score import score
from estimators.log import READING, TICK, TRUTH, Events
from estimators.models import MODELS
from estimators.models.lorenz import LORENZ63, LORENZ96
from estimators.track import MISSING, USED
from tests.support import SECOND, as_log
from tests.support import folded as advanced


def example():
    """The example, literally; one row a step: truth, reading, lost, mean, covariance, NIS."""
    rng = np.random.default_rng(7)
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    H = np.array([[1.0, 0.0]])
    Q = np.array([[0.01, 0.0], [0.0, 0.001]])
    R = np.array([[4.0]])
    truth = np.array([40.0, 0.2])
    x = np.array([35.0, 0.0])
    P = np.diag([25.0, 1.0])
    rows = []
    for k in range(120):
        truth = F @ truth + rng.multivariate_normal([0, 0], Q)
        y = H @ truth + rng.normal(0, np.sqrt(R[0, 0]), size=1)
        lost = k % 15 == 14
        x = F @ x
        P = F @ P @ F.T + Q
        nis = np.nan
        if not lost:
            S = H @ P @ H.T + R
            K = P @ H.T @ np.linalg.inv(S)
            innovation = y - H @ x
            x = x + K @ innovation
            I_KH = np.eye(2) - K @ H
            P = I_KH @ P @ I_KH.T + K @ R @ K.T
            nis = float(innovation @ np.linalg.inv(S) @ innovation)
        rows.append((truth, y[0], lost, x, P, nis))
    return rows


def example_log(rows):
    """A tick at 0, where the prior holds; then per step the reading (NaN where lost) and the true states."""
    batch = [Events.one(0, 0, TICK, 0, (), 1)]
    for k, (truth, y, lost, *_) in enumerate(rows):
        t = (k + 1) * SECOND
        batch.append(Events.one(t, t, READING, 0, np.nan if lost else y, 2))
        batch.append(Events.one(t, t, TRUTH, 0, truth, 2))
    return as_log(Events.concat(batch, 2))


@pytest.fixture(scope="module")
def rows():
    return example()


@pytest.fixture(scope="module", params=["kf", "ekf", "ukf"])
def folded(request, rows):
    model = MODELS["motor_winding"]
    return advanced(request.param, model, example_log(rows), pairs=np.array([[0, 1]]))


def test_every_row(folded, rows):
    track, kinds = folded.track, folded.log.events.kind
    at = np.flatnonzero(kinds == READING)
    P = np.array([row[4] for row in rows])
    # Some thousand roundings, each 1e-16 of its size; the filter forgets the older ones.
    np.testing.assert_allclose(track.mean[at], [row[3] for row in rows], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(track.std[at] ** 2, P[:, [0, 1], [0, 1]], rtol=1e-12)
    np.testing.assert_allclose(track.cross[at, 0], P[:, 0, 1], rtol=1e-12, atol=1e-12)
    # ν is a difference of numbers of order 50, so it has lost two digits, and NIS squares it.
    np.testing.assert_allclose(track.nis[at], [row[5] for row in rows], rtol=1e-11, atol=1e-12)


def test_published_numbers(folded, rows):
    result = score(folded.track, folded.log.events, folded.model)
    assert round(result.states["temperature"].rmse, 4) == 1.0432
    assert round(result.nis, 4) == 0.8227
    mean, cov = folded.moments()
    assert round(cov[0, 0], 5) == 0.81306
    assert round(cov[1, 1], 6) == 0.012751
    assert result.readings == 120
    assert result.missing == 8


def test_lost_samples_are_missing_and_covariance_grows(folded, rows):
    at = np.flatnonzero(folded.log.events.kind == READING)
    verdict = folded.track.verdict[at]
    lost = np.array([row[2] for row in rows])
    assert np.all(verdict[lost] == MISSING)
    assert np.all(verdict[~lost] == USED)
    std = folded.track.std[at, 0]
    assert np.all(std[lost] > std[np.flatnonzero(lost) - 1])


def butterfly(t, s):
    x, y, z = s
    return [10.0 * (y - x), x * (28.0 - z) - y, x * y - 8.0 / 3.0 * z]


def circle(t, x):
    return (np.roll(x, -1) - np.roll(x, 2)) * np.roll(x, 1) - x + 8.0


@pytest.mark.parametrize(("model", "tendency", "dt"), [(LORENZ63, butterfly, 0.01), (LORENZ96, circle, 0.05)])
def test_a_step_is_right_to_fourth_order(model, tendency, dt):
    """One step is off by c dt⁵, so half the step leaves 1/32 of it, the reference is good to 1e-11."""
    rng = np.random.default_rng(0)
    p = model.default_parameters
    x = model.prior_mean + model.prior_std * rng.standard_normal(model.nx)
    off = []
    for step in (dt, dt / 2, dt / 4):
        exact = solve_ivp(tendency, (0.0, step), x, rtol=1e-13, atol=1e-13).y[:, -1]
        out = np.empty(model.nx)
        model.f(x, np.zeros(0), p, step, out)
        off.append(np.max(np.abs(out - exact)))
    assert off[0] < 0.02
    assert 24 < off[0] / off[1] < 42 and 24 < off[1] / off[2] < 42
