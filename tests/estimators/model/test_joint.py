"""Parameters moved into the state: the same as a model augmented by hand, and they find the truth."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.compiled.model import compile_model
from estimators.diagnostics.detectors import OUTSIDE
from estimators.errors import ModelError
from estimators.log import READING, Events, Log
from estimators.model.assemble import JointParameter, joint
from estimators.model.state_space import Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from tests.models import level_model
from tests.support import SECOND, folded


def fall(x, u, p, dt, out):
    out[0] = x[0] + dt * (p[1] - p[0] * x[0])


def level(x, u, p, out):
    out[0] = x[0] + p[2]


def spread(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt


def constant(x, u, p, dt, out):
    out[0] = x[0] + dt * (x[1] - p[0] * x[0])
    out[1] = x[1]


def shifted(x, u, p, out):
    out[0] = x[0] + p[1]


TANK = level_model(
    {"level": 0.04}, 0.01, name="tank", title="Tank with a leak and an inflow", mean=1.0, std=0.5, h=level, f=fall,
    parameters=(
        Parameter("leak", "1/s", 0.1, 0.0, 1.0),
        Parameter("inflow", "m/s", 0.3, -2.0, 2.0),
        Parameter("offset", "m", 0.25, -1.0, 1.0),
    ),
)  # fmt: skip
BY_HAND = StateSpaceModel(
    name="tank_by_hand",
    title="The same, its inflow a state",
    states=(State("level", "m", mean=1.0, std=0.5), State("inflow", "m/s", mean=0.3, std=0.2)),
    parameters=(Parameter("leak", "1/s", 0.1), Parameter("offset", "m", 0.25)),
    noises=(Noise("level", "m²/s", 0.01), Noise("inflow", "m²/s³", 0.03**2)),
    sensors=(Sensor("level", (Row("level", "m", 0.04),), h=shifted),),
    f=constant,
    linear=True,
)


def readings(n: int = 80) -> Log:
    rng = np.random.default_rng(5)
    x, log = 0.5, Log(1)
    for k in range(1, n + 1):
        x += 0.45 - 0.1 * x + rng.normal(0.0, 0.1)
        log.extend(Events.one(k * SECOND, 0, READING, 0, x + 0.25 + rng.normal(0.0, 0.2), 1))
    return log


@pytest.mark.parametrize("with_q", [False, True])
@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_an_unknown_inflow_is_estimated_as_by_a_kalman_filter_augmented_by_hand(estimator: str, with_q: bool) -> None:
    tank = replace(TANK, Q=spread) if with_q else TANK
    model = joint(tank, {"inflow": JointParameter(0.2, 0.03)})
    assert model.state_names == ("level", "inflow")
    assert [item.name for item in model.parameters] == ["leak", "offset"]
    log = readings()
    got = folded(estimator, model, log).track
    exact = folded("kf", BY_HAND, log).track
    # The model is linear in x and inflow, and complex step exact; the UKF cancels numbers of order 1 at alpha's scale.
    np.testing.assert_allclose(got.mean, exact.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.std, exact.std, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.log_likelihood, exact.log_likelihood, rtol=0, atol=1e-8)


@pytest.mark.parametrize("drift", [0.0, 1e-4])
def test_a_model_is_outside_its_range_where_an_estimated_constant_has_left_its_prior(drift: float) -> None:
    track = folded("ekf", joint(TANK, {"inflow": JointParameter(0.02, drift)}), readings(2000)).track
    far = np.abs(track.mean[:, 1] - 0.3) > 4.4 * 0.02
    assert far[-1] and not far[0]
    np.testing.assert_array_equal(track.flags & OUTSIDE != 0, far & (drift == 0.0))


MOVED = joint(TANK, {"offset": JointParameter(0.1), "leak": JointParameter(0.1)})


def test_parameters_keep_their_places_whichever_move() -> None:
    assert [(state.name, state.limits) for state in MOVED.states] == [
        ("level", None),
        ("leak", (0.0, 1.0)),
        ("offset", (-1.0, 1.0)),
    ]
    compiled = compile_model(MOVED)
    out, y = np.empty(3), np.empty(1)
    x, p = np.array([2.0, 0.2, -0.5]), np.array([0.7])
    compiled.f(x, np.zeros(0), p, 0.5, out)
    compiled.h[0](x, np.zeros(0), p, y)
    np.testing.assert_allclose(out, [2.0 + 0.5 * (0.7 - 0.2 * 2.0), 0.2, -0.5], rtol=1e-15)
    np.testing.assert_allclose(y, [1.5], rtol=1e-15)


def test_a_parameter_acts_within_its_range_only() -> None:
    for strayed, held in ((-3.0, 0.0), (5.0, 1.0)):
        out = np.empty(3)
        compile_model(MOVED).f(np.array([2.0, strayed, 0.0]), np.zeros(0), np.array([0.3]), 1.0, out)
        np.testing.assert_allclose(out, [2.0 + 0.3 - held * 2.0, strayed, 0.0], rtol=1e-15)


def test_what_cannot_move_is_refused() -> None:
    with pytest.raises(ModelError, match="tank has no parameter 'drain' to estimate; it has leak, inflow, offset"):
        joint(TANK, {"drain": JointParameter(1.0)})
    with pytest.raises(ModelError, match="prior of leak"):
        joint(TANK, {"leak": JointParameter(0.0)})
    assert joint(TANK, {}) is TANK


def test_the_motors_derivatives_reach_the_resistance() -> None:
    model = MODELS["motor_drive"]
    moved = joint(model, {"yoke_coolant": JointParameter(0.01)})
    compiled = compile_model(moved)
    x = np.array([80.0, 75.0, 70.0, 60.0, 0.03])
    u = np.array([-50.0, 120.0, 300.0, 40.0, 25.0])
    p = moved.default_parameters
    z, out = x.astype(complex), np.empty(5, complex)
    z[4] += 1e-20j
    compiled.f(z, u, p, 0.5, out)
    slopes = []
    for resistance in (0.03 - 1e-6, 0.03 + 1e-6):
        plain = np.empty(4)
        full = [resistance if item.name == "yoke_coolant" else item.value for item in model.parameters]
        compile_model(model).f(x[:4], u, np.array(full), 0.5, plain)
        slopes.append(plain)
    # Rounding 1e-14 over 2e-6; truncation 1e-12 times third derivatives of order 1e5.
    np.testing.assert_allclose(out.imag[:4] / 1e-20, (slopes[1] - slopes[0]) / 2e-6, rtol=1e-6, atol=1e-7)
    assert abs(out[2].imag / 1e-20) > 1.0  # the yoke feels it
