"""Uncertainty of parameters after a fit: against the covariance of generalised least squares, and the prior."""

import numpy as np
import pytest

from estimators.fit.aims import WITNESSES, Aim
from estimators.fit.entries import Setting
from estimators.fit.recording import Recording
from estimators.fit.uncertainty import parameter_widths
from estimators.log import INPUT, READING, TRUTH, Events, Log
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning
from tests.support import SECOND

N, STD, PHI = 4000, 0.3, 0.9
PRIOR = {"gain": 10.0, "bias": 7.0, "unseen": 2.0}


def f(x, u, p, dt, out):
    out[0] = x[0]
    out[1] = p[1] * u[1]


def h(x, u, p, out):
    out[0] = x[0] + p[0] * u[0]


MODEL = StateSpaceModel(
    name="regression",
    title="one gain is measured, one acts on a hidden state only, one on nothing",
    states=(State("offset", "V", std=1e-6), State("hidden", "V", std=0.1)),
    noises=(Noise("hidden", "V²/s", variance=0.01),),
    sensors=(Sensor("y", (Row("y", "V", variance=STD**2),), h=h),),
    f=f,
    inputs=(Input("drive", "A"), Input("push", "A")),
    parameters=(Parameter("gain", "Ω", 2.0), Parameter("bias", "Ω", 1.0), Parameter("unseen", "1", 1.0)),
)


def recorded(phi, seed=0, hidden=False, drive=None, gain=2.0):
    """Return a log whose measurement errors have the lag-1 correlation phi, and the drive (N,)."""
    rng = np.random.default_rng(seed)
    error = np.empty(N)
    error[0] = rng.normal(0.0, STD)
    for k in range(1, N):
        error[k] = phi * error[k - 1] + rng.normal(0.0, STD * np.sqrt(1.0 - phi**2))
    u = np.sin(np.arange(N) / 60.0) + 0.3 if drive is None else drive
    y = gain * u + error
    true = 1.0 + rng.normal(0.0, 0.1, N)
    log = Log(MODEL.width)
    for k in range(N):
        t = np.array([k * SECOND] * (3 if hidden else 2))
        kind = np.array([INPUT, READING, TRUTH][: t.size], np.int8)
        value = np.full((t.size, MODEL.width), np.nan)
        value[0, :2], value[1, 0] = (u[k], 1.0), y[k]
        channel = np.zeros(t.size, np.int32)
        if hidden:
            value[2, 0], channel[2] = true[k], 1
        log.extend(Events(t, t.copy(), kind, channel, value))
    return log, u, y


def widths(logs, gain, aim=None):
    setting = Setting(Tuning.of(MODEL).set("p.gain", gain), None)
    return parameter_widths("ekf", setting, [Recording(log) for log in np.atleast_1d(logs)], PRIOR, aim=aim or Aim())


# The minimum has the variance (uᵀ u)⁻¹ uᵀ Σ u (uᵀ u)⁻¹. Its estimate is a quadratic form of 8 to 50 batches, of which
# the most inflated counts: in the mean it is that, or up to twice as much. White errors would give 1/19 at φ = 0.9.
@pytest.mark.parametrize("phi", [0.0, PHI])
def test_the_width_of_a_determined_parameter_is_that_of_correlated_errors(phi):
    found = []
    for seed in range(6):
        log, u, y = recorded(phi, seed)
        found.append(widths(log, float(u @ y / (u @ u))).std[0])
    lags = np.abs(np.subtract.outer(np.arange(N), np.arange(N)))
    expected = np.sqrt(u @ (STD**2 * float(phi) ** lags) @ u) / (u @ u)
    assert 0.9 * expected < np.sqrt(np.mean(np.square(found))) < 1.5 * expected


def test_what_the_data_do_not_determine_keeps_its_prior_and_a_truth_determines_more():
    log, u, y = recorded(0.0, hidden=True)
    gain = float(u @ y / (u @ u))
    by_sensors, by_truth = widths(log, gain), widths(log, gain, Aim(WITNESSES))
    np.testing.assert_allclose(by_sensors.std[1:], [7.0, 2.0], rtol=1e-6)
    # The truth scatters by 0.1 V, which 4,000 errors average; the value lies a draw of that from the minimum.
    assert 0.9 < by_truth.std[1] / (0.1 / np.sqrt(N)) < 3.0
    assert by_truth.std[2] == pytest.approx(2.0, rel=1e-6)
    assert by_truth.envelope["drive"] == pytest.approx((u.min(), u.max()))


def test_values_that_are_no_minimum_are_as_uncertain_as_their_distance_from_it():
    log, u, y = recorded(0.0)
    best = float(u @ y / (u @ u))
    found = widths(log, best + 0.5)
    assert found.std[0] == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize("gains", [(2.0,), (-3.0, 2.0, 4.0)])
def test_one_specimen_leaves_the_spread_between_specimens_and_several_are_weighed_with_it(gains):
    """By least squares of each, whose errors are small beside their distances; without data the prior stays."""
    logs, u, y = zip(*(recorded(0.0, k, gain=gain) for k, gain in enumerate(gains)), strict=True)
    best = np.array([drive @ reading / (drive @ drive) for drive, reading in zip(u, y, strict=True)])
    expected = np.sqrt((10.0**2 + np.sum((best - best.mean()) ** 2)) / len(gains))
    np.testing.assert_allclose(widths(logs, np.mean(gains)).spread, [expected, 7.0, 2.0], rtol=1e-3)
