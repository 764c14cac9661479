"""Noise that lasts: what filters make of it, beside joint Gaussians in closed form, statsmodels, and simulations."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from estimators.compiled.model import compile_model
from estimators.errors import ModelError
from estimators.fold import fold
from estimators.log import READING
from estimators.model.assemble import JointParameter, joint
from estimators.model.coloured import ColouredError, channels, coloured
from estimators.model.state_space import Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.tuning import Tuning
from tests.models import level_model
from tests.support import error_of, folded
from tests.support import log_of as log_of_rows

TAU, Q, R, STD, ERROR, ERROR_TIME = 7.0, 0.3, 0.04, 2.0, 0.6, 20.0

STEPS = np.array([0.0, 1e-3, 0.5, 2.0, 0.01, 9.0, 300.0, 0.25, 7.0, 40.0, 1e-2, 1.0, 1000.0])
"""Seconds between readings, from a small part of the correlation time to many of them; the prior holds at the first."""

EXACT = ("kf", "sr-kf", "ekf", "iekf", "ukf", "ckf", "sr-ekf", "sr-ukf", "filterpy-kf")


def slope_of_stay(x, u, p, dt, out):
    out[0, 0] = 1.0


def slope_of_told(x, u, p, out):
    out[0, 0] = 1.0


def density(y, x, u, p, r):
    return -0.5 * (y[0] - x[0]) ** 2 / r[0] - 0.5 * math.log(2.0 * math.pi * r[0])


WALK = level_model({"gauge": R}, Q, name="walk", mean=1.0, std=STD, linear=True)


BOTH = coloured(WALK, {"level": TAU}, {"gauge": ColouredError((ERROR**2,), ERROR_TIME)})
"""With a disturbance and an error of its sensor."""


def wandered(times, tau=TAU):
    """Covariance of ∫c dt from 0 to each of the times, c an OU process in its steady state.

    The double integral of q/(2τ) exp(-|s - t|/τ).
    """
    s, t = times[:, None], times[None, :]
    edge = 1.0 - np.exp(-s / tau) - np.exp(-t / tau) + np.exp(-np.abs(s - t) / tau)
    return Q * (np.minimum(s, t) - 0.5 * tau * edge)


def lasted(times, tau=ERROR_TIME):
    """Covariance of the error of a sensor."""
    return ERROR**2 * np.exp(-np.abs(times[:, None] - times[None, :]) / tau)


def log_of(times, y):
    return log_of_rows(1, *((t, READING, value) for t, value in zip(times, y, strict=True)))


def regression(level, readings):
    """Readings drawn; mean and std of the level after each, and the log density of each given those before.

    `level` and `readings` are covariances of the level at the readings, and of the readings (T, T); both have mean 1.
    """
    y = np.random.default_rng(3).multivariate_normal(np.ones(len(readings)), readings)
    means, stds, densities, before = [], [], [], 0.0
    for k in range(1, len(y) + 1):
        weights = np.linalg.solve(readings[:k, :k], level[:k, k - 1])
        means.append(1.0 + weights @ (y[:k] - 1.0))
        stds.append(np.sqrt(level[k - 1, k - 1] - weights @ level[:k, k - 1]))
        together = multivariate_normal(np.ones(k), readings[:k, :k]).logpdf(y[:k])
        densities.append(together - before)
        before = together
    return y, np.array(means), np.array(stds), np.array(densities)


def agree(estimator, model, level, readings, times):
    y, mean, std, log_density = regression(level, readings)
    track = folded(estimator, model, log_of(times, y)).track
    # Sigma points cancel numbers of order 1e6 (alpha 1e-3), which costs half of the digits of what is left.
    tolerance = 1e-8 if "ukf" in estimator else 1e-9
    np.testing.assert_allclose(track.mean[:, 0], mean, rtol=0, atol=100 * tolerance)
    np.testing.assert_allclose(track.std[:, 0], std, rtol=0, atol=tolerance)
    np.testing.assert_allclose(track.log_likelihood, log_density, rtol=0, atol=100 * tolerance)


@pytest.mark.parametrize("estimator", EXACT)
def test_both_kinds_of_lasting_error_are_the_regression_on_their_covariance(estimator):
    times = np.cumsum(STEPS)
    level = STD**2 + wandered(times)
    assert BOTH.linear and BOTH.state_names == ("level", "level_disturbance", "gauge_error")
    agree(estimator, BOTH, level, level + lasted(times) + R * np.eye(len(times)), times)


@pytest.mark.parametrize("estimator", ["kf", "ekf"])
def test_a_disturbance_alone_and_an_error_alone(estimator):
    times = np.cumsum(STEPS)
    level, noise = STD**2 + wandered(times), R * np.eye(len(times))
    agree(estimator, coloured(WALK, {"level": TAU}), level, level + noise, times)
    level = STD**2 + Q * np.minimum(times[:, None], times[None, :])
    error = {"gauge": ColouredError((ERROR**2,), ERROR_TIME)}
    agree(estimator, coloured(WALK, errors=error), level, level + lasted(times) + noise, times)


@pytest.mark.parametrize("estimator", ["kf", "ekf", "ukf"])
def test_derivatives_of_the_models_own_are_carried_along(estimator):
    times = np.cumsum(STEPS)
    level = STD**2 + wandered(times)
    own = replace(WALK, F=slope_of_stay, sensors=(replace(WALK.sensors[0], H=slope_of_told),))
    model = coloured(own, {"level": TAU}, {"gauge": ColouredError((ERROR**2,), ERROR_TIME)})
    assert model.F is not None and model.sensors[0].H is not None
    agree(estimator, model, level, level + lasted(times) + R * np.eye(len(times)), times)


def test_the_shorter_it_lasts_the_nearer_to_white_noise():
    times = np.cumsum(STEPS)
    white = STD**2 + Q * np.minimum(times[:, None], times[None, :])
    y, mean, std, _ = regression(white, white + R * np.eye(len(times)))
    worst = []
    for tau in (1e-4, 1e-6, 1e-8):
        model = coloured(WALK, {"level": tau})
        track = folded("kf", model, log_of(times, y)).track
        worst.append(max(np.abs(track.mean[:, 0] - mean).max(), np.abs(track.std[:, 0] - std).max()))
    # Of the first order in τ: what the integral over a step lacks of q dt is 1.5 q τ; the shortest step is 1 ms.
    assert worst[0] < 0.1 and worst[1] < 0.011 * worst[0] and worst[2] < 0.011 * worst[1]


def discrete(model, dt):
    """F and Q of a model over a step, from what is compiled."""
    compiled = compile_model(model)
    p = model.default_parameters
    q = np.array([item.variance for item in model.noises])
    F, Q = np.empty((model.nx, model.nx)), np.zeros((model.nx, model.nx))
    for j in range(model.nx):
        compiled.f(np.eye(model.nx)[j], np.zeros(model.nu), p, dt, F[j])
    compiled.Q(np.zeros(model.nx), np.zeros(model.nu), p, q, dt, Q)
    return F.T, Q


@pytest.mark.parametrize("a", [1e-7, 1e-4, 0.0499, 0.0501, 1.0, 3.0])
def test_a_step_is_that_of_the_exponential_of_a_matrix(a):
    dt = a * TAU
    A = np.array([[0.0, 1.0, 0.0], [0.0, -1.0 / TAU, 0.0], [0.0, 0.0, -1.0 / ERROR_TIME]])
    G = np.diag([0.0, Q / TAU**2, 2.0 * ERROR**2 / ERROR_TIME])
    # Van Loan (1978), doi:10.1109/TAC.1978.1101743.
    whole = expm(np.block([[-A, G], [np.zeros((3, 3)), A.T]]) * dt)
    F, noise = discrete(BOTH, dt)
    np.testing.assert_allclose(F, whole[3:, 3:].T, rtol=1e-12, atol=1e-15)
    # Rounding of entries of order e^a times those of order one.
    np.testing.assert_allclose(noise, whole[3:, 3:].T @ whole[:3, 3:], rtol=1e-9, atol=1e-15 * np.exp(a))


def test_a_steady_gain_is_that_of_the_kalman_filter_in_the_end():
    y = 1.0 + np.cumsum(np.random.default_rng(2).normal(0.0, 0.7, 600))
    log = log_of(np.arange(600.0), y)
    exact, steady = (folded(name, BOTH, log).track for name in ("kf", "kf-steady"))
    # The slowest mode of the error decays over some 20 s; after 300 s nothing of the start is left.
    np.testing.assert_allclose(steady.mean[300:], exact.mean[300:], rtol=0, atol=1e-6)
    np.testing.assert_allclose(steady.std[300:], exact.std[300:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("estimator", ["pf", "rbpf"])
def test_particles_agree_with_the_kalman_filter_within_chance(estimator):
    rng = np.random.default_rng(4)
    log = log_of(np.arange(40.0), 1.0 + np.cumsum(rng.normal(0.0, 0.5, 40)))
    exact = folded("kf", BOTH, log).track
    n = 20_000
    found = folded(estimator, BOTH, log, options={"particles": float(n)}).track
    # Of n independent particles a mean has the error σ/√n; resampling leaves some twentieth of them independent.
    error = np.abs(found.mean - exact.mean) / exact.std
    assert error.max() < 5.0 * np.sqrt(20.0 / n)
    assert np.abs(found.std / exact.std - 1.0).max() < 5.0 * np.sqrt(20.0 / n)


def test_a_sensors_own_likelihood_is_that_of_what_the_error_leaves():
    own = replace(WALK, sensors=(replace(WALK.sensors[0], log_likelihood=density),))
    plain, mine = (coloured(m, {"level": TAU}, {"gauge": ColouredError((ERROR**2,), ERROR_TIME)}) for m in (WALK, own))
    log = log_of(np.arange(30.0), 1.0 + 0.3 * np.arange(30.0))
    a, b = (folded("pf", model, log, options={"particles": 500.0}).track for model in (plain, mine))
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-9)


def coupled(x, u, p, dt, out):
    out[0] = x[0]
    out[1] = x[1]
    out[2] = x[2]


def three(x, u, p, q, dt, out):
    """One noise moves a and b against each other, one a and c alike, each for itself."""
    out[0, 0] = (q[0] + 4.0 * q[1]) * dt
    out[1, 1] = q[0] * dt
    out[0, 1] = -q[0] * dt
    out[1, 0] = -q[0] * dt
    out[2, 2] = 4.0 * q[1] * dt


THREE = StateSpaceModel(
    name="three",
    title="Three levels",
    states=(State("a", "m"), State("b", "m/s"), State("c", "°C")),
    noises=(Noise("slip", "m²/s", 0.2), Noise("walk", "m²/s", 0.05)),
    sensors=(Sensor("gauge", (Row("a", "m", R), Row("c", "°C", R)), h=lambda x, u, p, out: None),),
    f=coupled,
    Q=three,
)


def test_a_noise_on_several_states_lasts_in_each_channel():
    (slip,) = channels(THREE, "slip")
    assert slip[:2] == (0, 1.0) and slip[2].tolist() == [1.0, -1.0, 0.0]
    walk = channels(THREE, "walk")
    assert [j for j, _, _ in walk] == [0, 2] and [share for _, share, _ in walk] == pytest.approx([4.0, 4.0])
    assert [b.tolist() for _, _, b in walk] == [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    model = coloured(THREE, {"walk": 3.0, "slip": TAU}, {"gauge": ColouredError((0.01, 0.04), 5.0)})
    assert [(state.name, state.unit) for state in model.states[3:]] == [
        ("slip_disturbance", "m/s"),
        ("walk_a_disturbance", "m/s"),
        ("walk_c_disturbance", "°C/s"),
        ("gauge_a_error", "m"),
        ("gauge_c_error", "°C"),
    ]
    assert [(item.name, item.value, item.unit) for item in model.parameters] == [
        ("slip_disturbance_time", TAU, "s"),
        ("walk_disturbance_time", 3.0, "s"),
        ("gauge_error_time", 5.0, "s"),
    ]
    assert [(item.name, item.unit) for item in model.noises[2:]] == [("gauge_a_error", "m²"), ("gauge_c_error", "°C²")]
    # A long step has the variance of the white noise, a time on: q (dt - 1.5 τ), for all channels and between them.
    dt = 1e4
    mine = replace(model, sensors=(replace(model.sensors[0], h=two_rows),))
    F, noise = discrete(mine, dt)
    white = np.zeros((3, 3))
    three(None, None, None, np.array([0.2 * (dt - 1.5 * TAU), 0.05 * (dt - 4.5)]), 1.0, white)
    np.testing.assert_allclose(noise[:3, :3], white, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(F[:3, 3:6], [[TAU, 3.0, 0.0], [-TAU, 0.0, 0.0], [0.0, 0.0, 3.0]], rtol=1e-12)
    # Where q counts four times, the disturbance does too; and a step is as two halves of it.
    np.testing.assert_allclose(np.diag(noise)[3:6], [0.1 / TAU, 0.1 / 3.0, 0.1 / 3.0], rtol=1e-12)
    (F, noise), (G, half) = discrete(mine, 4.0), discrete(mine, 2.0)
    np.testing.assert_allclose(G @ half @ G.T + half, noise, rtol=1e-12, atol=1e-15)


def two_rows(x, u, p, out):
    out[0] = x[0] + x[6]
    out[1] = x[2] + x[7]


def test_correlation_times_and_variances_are_turned_while_it_runs():
    log = log_of(np.arange(50.0), np.sin(np.arange(50.0)))
    tuning = Tuning.of(BOTH).set("p.level_disturbance_time", 2.0).set("p.gauge_error_time", 3.0)
    turned = fold("kf", BOTH, tuning.set("Q.level", 0.1).set("Q.gauge_error", 0.5), log)
    walk = replace(WALK, noises=(replace(WALK.noises[0], variance=0.1),))
    declared = coloured(walk, {"level": 2.0}, {"gauge": ColouredError((0.5,), 3.0)})
    # The belief at the start is the model's, as ever; the rest is what it is turned to.
    declared = replace(declared, states=BOTH.states)
    np.testing.assert_allclose(folded("kf", declared, log).track.mean, turned.mean, rtol=1e-12)
    assert [item.key for item in tuning.items()] == [
        "Q.level", "Q.gauge_error", "R.gauge", "p.level_disturbance_time", "p.gauge_error_time"
    ]  # fmt: skip


def test_two_wrapped_models_are_told_apart_when_both_are_wrapped_again():
    """Wrappers of one layout differ by the model inside alone; machine code is kept by the names of functions."""
    log = log_of(np.arange(20.0), np.sin(np.arange(20.0)))
    base = replace(WALK, parameters=(Parameter("leak", "1/s", 0.1, 0.0, 1.0),), linear=False)
    ends = []
    for f in (leaking, growing):
        model = joint(coloured(replace(base, f=f), {"level": TAU}), {"leak": JointParameter(0.01)})
        ends.append(folded("ekf", model, log).track.mean[-1, 0])
    assert abs(ends[0] - ends[1]) > 1e-3


def leaking(x, u, p, dt, out):
    out[0] = x[0] * np.exp(-p[0] * dt)


def growing(x, u, p, dt, out):
    out[0] = x[0] * np.exp(p[0] * dt)


def test_linear_parts_and_modes_stay_what_they_are():
    model = coloured(MODELS["gripper_contact"], {"slip": 0.5}, {"force": ColouredError((0.01,), 10.0)})
    compiled = compile_model(model)  # the claims are checked on the way
    assert set(model.linear_states) > set(MODELS["gripper_contact"].linear_states)
    assert model.state_names[-2:] == ("slip_disturbance", "force_error")
    out = np.empty(model.nx)
    x = model.prior_mean.copy()
    x[-2] = 2.0
    compiled.f(x, np.zeros(model.nu), model.default_parameters, 1e-9, out)
    at = {name: k for k, name in enumerate(model.state_names)}
    assert (out[at["surface"]] - x[at["surface"]]) * (out[at["depth"]] - x[at["depth"]]) < 0.0


def warm(x, u, p, q, dt, out):
    three(x, u, p, q, dt, out)
    out[2, 2] = 4.0 * q[1] * dt * p[0]


REFUSED = [
    (WALK, {"levle": 1.0}, {}, "walk has no noise 'levle'; it has level"),
    (WALK, {}, {"gage": ColouredError((1.0,), 1.0)}, "walk has no sensor 'gage'; it has gauge"),
    (WALK, {"level": 0.0}, {}, "level has the correlation time 0 s; it must be positive"),
    (WALK, {"level": np.inf}, {}, "level has the correlation time inf s; it must be positive"),
    (
        WALK,
        {},
        {"gauge": ColouredError((1.0, 2.0), 1.0)},
        "the error of gauge has variance 1, 2; it must be positive, one for each of 1 rows",
    ),
    (replace(WALK, noises=(Noise("level", "m²/s", 0.0),)), {"level": 1.0}, {}, "noise level has variance 0"),
    (MODELS["thermal_field"], {"temperature": 9.0}, {}, "model thermal_field is a field, whose noise cannot"),
    (MODELS["uwb_rover"], {"bias": 9.0}, {}, "Q does not add bias as q·dt times a constant matrix"),
    (
        replace(THREE, Q=warm, parameters=(Parameter("warmth", "1", 1.0, 0.0, 9.0),)),
        {"walk": 1.0},
        {},
        "Q does not add walk as q·dt times a constant matrix",
    ),
    (
        replace(WALK, states=(*WALK.states, State("gauge_error", "m"))),
        {},
        {"gauge": ColouredError((1.0,), 1.0)},
        "states names 'gauge_error' twice",
    ),
]


@pytest.mark.parametrize(("model", "noises", "errors", "words"), REFUSED)
def test_what_cannot_last_is_refused(model, noises, errors, words):
    assert words in error_of(ModelError, coloured, model, noises, errors)
    assert coloured(WALK) is WALK
