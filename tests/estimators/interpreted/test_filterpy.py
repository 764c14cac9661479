"""FilterPy's filters as entries of the catalogue: ours to 1e-8 where FilterPy is right, and its faults avoided."""

import json
from dataclasses import replace

import numpy as np
import pytest

from estimators.fold import Fold, fold
from estimators.log import READING, TICK, Events, Log
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.track import FAILED, GATED, HELD_OUT, MISSING, USED
from estimators.tuning import Tuning
from tests.cases import cases
from tests.estimators.test_fold import MODEL, everything
from tests.models import constant_speed
from tests.support import SECOND, as_log, assert_same, folded, log_of

PAIRS = np.array([[0, 1], [0, 2], [1, 2]])


Q = np.array([0.02, 0.05, 0.01])
P0 = np.array([0.5, 0.8, 0.3])
X0 = np.array([0.6, -0.2, 1.1])


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * x[1]
    out[1] = x[1] - dt * (p[0] / x[2] * np.sin(x[0]) + 0.2 * x[1] * x[1] * x[1] - u[0])
    out[2] = x[2] + dt * 0.05 * np.cos(x[0])


def swing(x, u, p, out):
    out[0] = x[2] * np.sin(x[0])


def pair(x, u, p, out):
    out[0] = x[1] + 0.3 * x[0] * x[0]
    out[1] = np.exp(0.2 * x[1]) + x[2]


PENDULUM = StateSpaceModel(
    name="pendulum",
    title="pendulum of unknown length",
    states=tuple(
        State(name, "1", mean=m, std=s) for name, m, s in zip(("angle", "rate", "length"), X0, np.sqrt(P0), strict=True)
    ),
    inputs=(Input("torque", "1", default=0.3),),
    parameters=(Parameter("g", "m/s²", 9.81),),
    noises=tuple(Noise(name, "1", variance=q) for name, q in zip(("angle", "rate", "length"), Q, strict=True)),
    sensors=(
        Sensor("swing", (Row("swing", "m", variance=0.04),), h=swing),
        Sensor("pair", (Row("a", "1", variance=0.09), Row("b", "1", variance=0.25)), h=pair),
    ),
    f=f,
)


@pytest.fixture(scope="module")
def log():
    """200 readings of a simulated pendulum: irregular times, some equal, some rows and some readings missing."""
    rng = np.random.default_rng(11)
    x, t = np.array([0.9, 0.1, 1.2]), 17_000_003
    batch = [Events.one(0, 0, TICK, 0, (), 2)]
    for _ in range(200):
        step = int(rng.choice([0, 1, 2, 3], p=[0.2, 0.5, 0.2, 0.1])) * 17_000_003
        t += step
        ahead = np.empty(3)
        f(x, [0.3], [9.81], step / SECOND, ahead)
        x = ahead + rng.normal(0, 0.3, 3) * np.sqrt(Q * step / SECOND)
        sensor = PENDULUM.sensors[int(rng.random() < 0.4)]
        y = np.empty(len(sensor.rows))
        sensor.h(x, [0.3], [9.81], y)
        y += rng.normal(0, np.sqrt([row.variance for row in sensor.rows]))
        y[rng.random(y.size) < 0.15] = np.nan
        batch.append(Events.one(t, t, READING, PENDULUM.sensors.index(sensor), y, 2))
    return as_log(Events.concat(batch, 2))


def heading(x, u, p, out):
    out[0] = x[0] + 0.05 * x[1] * x[1]
    out[1] = x[1]


COMPASS = StateSpaceModel(
    name="compass",
    title="turning past ±π",
    states=(State("angle", "rad", 3.0, 0.3, circular=True), State("rate", "rad/s", 0.8, 0.3)),
    noises=(Noise("angle", "rad²/s", 0.01), Noise("rate", "rad²/s³", 0.02)),
    sensors=(Sensor("compass", (Row("heading", "rad", 0.02, circular=True), Row("rate", "rad/s", 0.1)), h=heading),),
    f=constant_speed,
)


def close(theirs, ours, what=("mean", "std", "cross", "innovation", "innovation_std", "nis", "log_likelihood")):
    """1e-8: a few hundred steps of a few hundred roundings, theirs with S inverted and K S Kᵀ subtracted."""
    np.testing.assert_array_equal(theirs.verdict, ours.verdict)
    np.testing.assert_array_equal(theirs.dof, ours.dof)
    for name in what:
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), rtol=1e-8, atol=1e-8, err_msg=name)


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf"])
def test_a_linear_model_with_gate_inputs_and_held_out_sensor(name):
    tuning = Tuning.of(MODEL).set("gate", 0.9).set("use.third", False)
    events = everything(np.random.default_rng(5), 300)
    ours, theirs = (fold(n, MODEL, tuning, as_log(events), pairs=PAIRS) for n in (name, f"filterpy-{name}"))
    close(theirs, ours)
    assert {USED, GATED, HELD_OUT, MISSING} <= set(theirs.verdict)


@cases(__file__, "curved.csv")
def test_a_curved_model(name, values, log):
    tuning = Tuning.of(PENDULUM).with_options(json.loads(values))
    ours, theirs = (fold(n, PENDULUM, tuning, log, pairs=PAIRS) for n in (name, f"filterpy-{name}"))
    close(theirs, ours)


def test_cubature_points_are_those_of_a_centre_without_weight(log):
    """Arasaratnam & Haykin (2009): x ± √n Lᵢ of equal weight, which FilterPy's UKF has with α = 1 and β = κ = 0."""
    theirs = folded("filterpy-ukf", PENDULUM, log, options=dict(alpha=1, beta=0, kappa=0)).track
    ours = folded("ckf", PENDULUM, log)
    close(theirs, ours.track)
    mean, cov = ours.moments()
    points = ours.points()
    np.testing.assert_allclose(points.mean(axis=0), mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.cov(points.T, bias=True), cov, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_angles_turn_past_pi(name):
    rng = np.random.default_rng(2)
    events = Log(2)
    for k in range(1, 150):
        y = [3.0 + 0.08 * k + rng.normal(0, 0.1), 0.8 + rng.normal(0, 0.3)]
        y[0] = (y[0] + np.pi) % (2 * np.pi) - np.pi
        if rng.random() < 0.2:
            y[int(rng.integers(2))] = np.nan
        events.extend(Events.one(k * SECOND // 10, 0, READING, 0, y, 2))
    ours, theirs = (folded(n, COMPASS, events, pairs=PAIRS[:1]).track for n in (name, f"filterpy-{name}"))
    close(theirs, ours)
    assert np.sum(np.abs(np.diff(theirs.mean[:, 0])) > np.pi) >= 1  # it did pass
    assert np.nanmax(np.abs(theirs.innovation[:, 0])) < 1.0
    ensemble = folded("filterpy-enkf", COMPASS, events, options={"members": 400}).track
    off = (ensemble.mean[:, 0] - ours.mean[:, 0] + np.pi) % (2 * np.pi) - np.pi
    # Chance of 400 members, gathered over the few readings that the filter remembers: half a sigma is ten times that.
    assert np.max(np.abs(off) / ours.std[:, 0]) < 0.5
    assert np.all(np.abs(ensemble.mean[:, 0]) <= np.pi)


def one_reading(members):
    events = log_of(3, (0, TICK, ()), (1, READING, [0.4, -0.7], 1))
    return folded("filterpy-enkf", MODEL, events, options={"members": members})


def test_enkf_is_within_monte_carlo_error_of_the_exact_answer():
    """After a prediction and a reading: a member's mean and variance scatter by σ/√N and σ²√(2/N)."""
    N = 10_000
    theirs = one_reading(N)
    exact = folded("kf", MODEL, theirs.log).track
    # The gain is the members' too and the perturbations add theirs: twice the scatter of plain draws, at 4 sigma.
    assert np.all(np.abs(theirs.track.mean - exact.mean) < 8 * exact.std / np.sqrt(N))
    assert np.all(np.abs(theirs.track.std**2 / exact.std**2 - 1) < 8 * np.sqrt(2 / N))
    np.testing.assert_allclose(theirs.track.nis[1], exact.nis[1], rtol=0.1)
    # What it reports is the spread of its members.
    X = theirs.points()
    mean, cov = theirs.moments()
    np.testing.assert_allclose(mean, X.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(cov, np.cov(X.T), rtol=1e-10)
    np.testing.assert_allclose(theirs.track.std[1], X.std(axis=0, ddof=1), rtol=1e-10)


def test_enkf_draws_by_seed_and_leaves_the_global_generator_alone():
    events = everything(np.random.default_rng(6), 120)
    np.random.seed(7)  # noqa: NPY002  the global one is what must stay
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    tuning = Tuning.of(MODEL)
    one = fold("filterpy-enkf", MODEL, tuning, as_log(events))
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(8)  # noqa: NPY002
    growing = Log(MODEL.width, capacity=1)
    pieces = Fold("filterpy-enkf", MODEL, tuning, growing)
    for k in range(0, len(events), 7):
        growing.extend(events.select(slice(k, k + 7)))
        pieces.advance()
    pieces.rewind(60)
    pieces.advance()
    assert_same(pieces.track, one)
    other = fold("filterpy-enkf", MODEL, replace(tuning, seed=1), as_log(events))
    assert np.mean(other.mean != one.mean) > 0.9  # all but the resets, which give the prior's draw


def test_a_covariance_without_a_factor_fails_and_is_no_exception():
    fold_ = folded("filterpy-ukf", PENDULUM, log_of(2, (0, TICK, ()), (1, READING, 0.5)), stop=1)
    fold_._now.state[3:] = -np.eye(3).ravel()
    fold_.advance()
    assert np.all(np.isnan(fold_.track.mean[1]))
    assert fold_.track.verdict[1] == FAILED
