"""The steady-state filter against Riccati's recursion in NumPy, a long Kalman run, and what it must refuse."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.gaussian.kf_steady import AFTER
from estimators.log import READING, TICK, Events, Log
from estimators.model.state_space import Input, Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.registry import ESTIMATORS
from estimators.track import USED
from estimators.tuning import Tuning
from tests.estimators.interpreted.test_filterpy import PENDULUM
from tests.estimators.linear_models import random_linear
from tests.models import constant_speed, first_state, second_state
from tests.support import SECOND, log_of
from tests.support import folded as advanced

MOTOR = MODELS["motor_winding"]
F, H, R = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]]), 4.0
Q = np.diag([0.01, 0.001])


def readings(values, times=None):
    times = range(len(values)) if times is None else times
    return log_of(np.size(values[0]), *((t, READING, value) for t, value in zip(times, values, strict=True)))


def folded(estimator, log, tuning=None, model=MOTOR):
    return advanced(estimator, model, log, tuning)


def steady_gain():
    P = np.eye(2)
    for _ in range(5000):
        K = P @ H.T / (H @ P @ H.T + R)
        P = F @ (P - K @ H @ P) @ F.T + Q
    return P @ H.T / (H @ P @ H.T + R)


def test_the_gain_is_fixed_and_the_covariance_is_what_that_gain_has():
    """The whole run in NumPy: constant K, P ← (I - K H) P (I - K H)ᵀ + K R Kᵀ, from the first reading on."""
    rng = np.random.default_rng(0)
    y = 36.0 + rng.normal(0, 2.0, 400)
    track = folded("kf-steady", readings(y)).track
    K, x, P = steady_gain(), np.array([35.0, 0.0]), np.diag([25.0, 1.0])
    for k, value in enumerate(y):
        if k:
            x, P = F @ x, F @ P @ F.T + Q
        # The Riccati solver is good to some 1e-12 of K; it enters here 400 times, but each is forgotten again.
        S = (H @ P @ H.T + R).item()
        np.testing.assert_allclose(track.nis[k], (value - x[0]) ** 2 / S, rtol=1e-8, atol=1e-10)
        x = x + K[:, 0] * (value - x[0])
        A = np.eye(2) - K @ H
        P = A @ P @ A.T + K @ K.T * R
        np.testing.assert_allclose(track.mean[k], x, rtol=1e-9)
        np.testing.assert_allclose(track.std[k], np.sqrt(np.diag(P)), rtol=1e-9)


def test_a_long_kalman_run_ends_at_the_same_estimate():
    y = 36.0 + np.random.default_rng(1).normal(0, 2.0, 1500)
    steady, kalman = (folded(name, readings(y)) for name in ("kf-steady", "kf"))
    # The slower pole of F - F K H is 0.92 here: after 1500 readings nothing of the start is left.
    for a, b in zip(steady.moments(), kalman.moments(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    assert steady._now.state[-1] == AFTER
    # Of the first readings, whose gain should be large, it makes less; P knows.
    assert np.all(steady.track.std[5] > 1.5 * kalman.track.std[5])


def test_lost_readings_let_the_covariance_grow_and_it_settles_again():
    y = 36.0 + np.random.default_rng(2).normal(0, 2.0, 1200)
    times = [k if k < 600 else k + 20 for k in range(1200)]
    track = folded("kf-steady", readings(y, times)).track
    kalman = folded("kf", readings(y, times)).track
    settled = track.std[599]
    np.testing.assert_array_equal(track.std[598], settled)
    assert track.innovation_std[600, 0] > 1.5 * track.innovation_std[599, 0]
    np.testing.assert_allclose(track.innovation_std[600], kalman.innovation_std[600], rtol=1e-9)
    assert np.all(track.std[600] > kalman.std[600])
    np.testing.assert_array_equal(track.std[-1], settled)


def test_readings_a_little_late_are_steady_and_ticks_grow():
    log = readings(np.full(500, 36.0), [k + 0.004 * (-1) ** k for k in range(500)])
    at = 499 * SECOND
    log.extend(Events.one(at + 3 * SECOND, 0, TICK, 0, [], 1))
    track = folded("kf-steady", log).track
    np.testing.assert_array_equal(track.std[450], track.std[499])
    assert np.all(track.std[500] > track.std[499])


def decaying(x, u, p, dt, out):
    out[0] = x[0] + dt * (-0.5 * x[0] + x[1])
    out[1] = x[1] + dt * (u[0] - 0.1 * x[1])


def both(x, u, p, out):
    out[0] = x[0]
    out[1] = x[0] - 2.0 * x[1]


TWO_ROWS = StateSpaceModel(
    name="pair",
    title="pair",
    states=(State("a", "1"), State("b", "1")),
    inputs=(Input("push", "1", default=0.3),),
    noises=(Noise("a", "1", variance=0.1), Noise("b", "1", variance=0.2)),
    sensors=(Sensor("y", (Row("y1", "1", variance=0.5), Row("y2", "1", variance=0.8)), h=both),),
    f=decaying,
    linear=True,
    max_step=0.1,
)


@pytest.mark.parametrize("correlation", [None, ((1.0, 0.8), (0.8, 1.0))])
def test_two_rows_an_input_split_steps_and_a_row_that_is_missing(correlation):
    """The Kalman filter's estimate after 300 readings 0.25 s apart, which the model crosses in three steps."""
    model = replace(TWO_ROWS, sensors=(replace(TWO_ROWS.sensors[0], correlation=correlation),))
    rng = np.random.default_rng(3)
    values = rng.normal(0, 1, (300, 2))
    values[150, 1] = values[170, 0] = np.nan
    log = readings(values, 0.25 * np.arange(300))
    steady = folded("kf-steady", log, Tuning.of(model).with_options({"period": 0.25}), model)
    kalman = folded("kf", log, model=model)
    assert np.all(steady.track.verdict == USED)
    for a, b in zip(steady.moments(), kalman.moments(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_inflation_is_in_the_gain():
    """Riccati's recursion with √λ F, λ = 1.2 a second."""
    P = np.eye(2)
    for _ in range(5000):
        K = P @ H.T / (H @ P @ H.T + R)
        P = 1.2 * F @ (P - K @ H @ P) @ F.T + Q
    values = {"inflation": 1.2}
    y = 36.0 + np.random.default_rng(4).normal(0, 2.0, 600)
    steady = folded("kf-steady", readings(y), Tuning.of(MOTOR).with_options(values))
    kalman = folded("kf", readings(y), Tuning.of(MOTOR).with_options(values))
    np.testing.assert_allclose(steady.moments()[0], kalman.moments()[0], rtol=1e-9)
    np.testing.assert_allclose(steady.track.innovation_std[-1, 0] ** 2, (H @ P @ H.T + R)[0, 0], rtol=1e-9)


def geared(x, u, p, dt, out):
    out[0] = x[0] + dt * (1.0 + u[0]) * x[1]
    out[1] = x[1]


def linear(f, h=first_state, *, inputs=()):
    return StateSpaceModel(
        name=f.__name__,
        title=f.__name__,
        states=(State("place", "m"), State("speed", "m/s")),
        inputs=inputs,
        noises=(Noise("place", "1", variance=0.1), Noise("speed", "1", variance=0.1)),
        sensors=(Sensor("y", (Row("y", "1", variance=1.0),), h=h),),
        f=f,
        linear=True,
    )


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (PENDULUM, "pendulum is not linear"),
        (random_linear(np.random.default_rng(0), 2, 0).model, "linear has 3 sensors.*no one steady state"),
        (linear(geared, inputs=(Input("gear", "1"),)), "geared varies with its inputs"),
        (
            linear(constant_speed, second_state),
            "constant_speed is not detectable: y does not observe place, which",
        ),
    ],
)
def test_it_refuses_with_the_reason(model, reason):
    with pytest.raises(EstimatorError, match=f"kf-steady does not apply: {reason}"):
        Fold("kf-steady", model, Tuning.of(model), Log(model.width))


def test_it_refuses_a_state_that_is_known_ever_better():
    model = linear(constant_speed)
    tuning = Tuning.of(model).set("Q.place", 0.0).set("Q.speed", 0.0)
    with pytest.raises(EstimatorError, match="constant_speed has no steady gain, as speed neither decays.*raise its Q"):
        Fold("kf-steady", model, tuning.with_options({"period": 2.0}), Log(1))
    assert ESTIMATORS["kf-steady"].applies(model) is None
