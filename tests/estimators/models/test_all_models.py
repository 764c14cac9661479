"""The models that ship: derivatives, physics against closed forms, and what they make of the recordings."""

from collections.abc import Callable

import numpy as np
import pytest

from estimators.compiled.jacobians import ANALYTIC, COMPLEX_STEP
from estimators.compiled.model import compile_model
from estimators.errors import ModelError
from estimators.fold import fold
from estimators.log import INPUT, READING
from estimators.model.coloured import ColouredError, coloured
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.models.motor_drive import COPPER, MOTOR_DRIVE
from estimators.models.road_car import ROAD_CAR
from tests.models import complex_step, first_state, unchanged
from tests.skips import recorded

P = {item.name: k for k, item in enumerate(MOTOR_DRIVE.parameters)}

CAR = coloured(ROAD_CAR, errors={"gnss_position": ColouredError((1.0, 1.0), 100.0)})
"""As its twins have it: the error of a fix lasts."""


def defaults(model, **changed):
    return np.array([changed.get(item.name, item.value) for item in model.parameters], float)


def stepped(model, x, u, p, dt, steps):
    f = compile_model(model).f
    x, out = np.array(x, float), np.empty(model.nx)
    for _ in range(steps):
        f(x, u, p, dt, out)
        x = out.copy()
    return x


def drive(i_d=-80.0, i_q=150.0, speed=400.0):
    return np.array([i_d, i_q, speed, 60.0, 25.0])


# Derivatives


# The corridor's beams step at corners: test_corridor.py.
@pytest.mark.parametrize("name", [name for name in MODELS if name != "agv_corridor"])
def test_jacobians_match_central_differences_at_random_states(name):
    model = MODELS[name]
    compiled = compile_model(model)
    if model.shape is not None:
        pytest.skip("a field that only ensembles estimate: no filter asks for its derivatives")
    own = model.F is not None
    assert compiled.static["F_mode"] == (ANALYTIC if own else COMPLEX_STEP)
    given = [ANALYTIC if sensor.H is not None else COMPLEX_STEP for sensor in model.sensors]
    np.testing.assert_array_equal(compiled.static["H_mode"], given)
    rng = np.random.default_rng(1)
    std = np.array([state.std for state in model.states])
    mean = model.prior_mean
    p = defaults(model)
    dt = min(0.5, model.max_step)

    def of_h(k):
        return lambda x, u, out: compiled.h[k](x, u, p, out)

    calls: list[tuple[Callable, int]] = [(lambda x, u, out: compiled.f(x, u, p, dt, out), model.nx)]
    calls += [(of_h(k), len(sensor.rows)) for k, sensor in enumerate(model.sensors)]
    for _ in range(20):
        x = mean + std * rng.standard_normal(model.nx)
        u = model.default_inputs + rng.normal(0.0, 20.0, model.nu)
        for function, rows in calls:
            near = np.empty((rows, model.nx))
            for j in range(model.nx):
                step = 1e-4 * std[j]
                high, low = np.empty(rows), np.empty(rows)
                function(x + step * (np.arange(model.nx) == j), u, high)
                function(x - step * (np.arange(model.nx) == j), u, low)
                near[:, j] = (high - low) / (2.0 * step)
            # Rounding: 1e-16 of values up to 1e3 over a step of at least 1e-6; truncation: step² of third derivatives.
            exact = complex_step(lambda z, out, of=function, u=u: of(z, u, out), x, rows)
            np.testing.assert_allclose(exact, near, rtol=1e-6, atol=1e-6)


# The motor


def losses(x, u, p):
    """Copper and iron loss, W."""
    theta = 1.0 + COPPER * (x[0] - 20.0)
    ohmic = 1.5 * p[P["copper_resistance"]] * np.hypot(u[0], u[1]) ** 2
    copper = ohmic * theta + ohmic * p[P["copper_eddy"]] * u[2] ** 2 / theta
    return copper, p[P["iron_linear"]] * abs(u[2]) + p[P["iron_square"]] * u[2] ** 2


def test_motor_keeps_energy_what_the_nodes_pass_on_to_each_other_cancels():
    rng = np.random.default_rng(2)
    capacity = defaults(MOTOR_DRIVE)[:4]
    for _ in range(20):
        x = rng.uniform(20.0, 140.0, 4)
        u = np.array([*rng.normal(0.0, 150.0, 2), rng.normal(0.0, 400.0), *rng.uniform(10.0, 80.0, 2)])
        p = defaults(MOTOR_DRIVE)
        out = (x[2] - u[3]) / p[P["yoke_coolant"]]
        out += (x[0] - u[4]) / p[P["winding_ambient"]] + (x[3] - u[4]) / p[P["magnet_ambient"]]
        dt = 1e-3
        stored = capacity @ (stepped(MOTOR_DRIVE, x, u, p, dt, 1) - x) / dt
        # The mean over dt differs from the start by λ dt / 2 with λ < 0.1/s, that is 5e-5 of the flows (up to 1e4 W);
        # subtracting temperatures of 100 °C costs 1e-14 · 1e3 J/K / 1e-3 s.
        assert stored == pytest.approx(sum(losses(x, u, p)) - out, abs=0.5)


def test_motor_comes_to_rest_where_a_linear_solve_says():
    p = defaults(MOTOR_DRIVE, copper_eddy=0.0)  # then the loss is linear in the winding's temperature
    u = drive()
    A, b = np.zeros((4, 4)), np.zeros(4)
    for i, j, name in ((0, 1, "winding_tooth"), (1, 2, "tooth_yoke"), (1, 3, "tooth_magnet"), (0, 3, "winding_magnet")):
        G = 1.0 / p[P[name]]
        A[i, i], A[j, j], A[i, j], A[j, i] = A[i, i] + G, A[j, j] + G, A[i, j] - G, A[j, i] - G
    for i, name, outside in ((2, "yoke_coolant", u[3]), (0, "winding_ambient", u[4]), (3, "magnet_ambient", u[4])):
        A[i, i] += 1.0 / p[P[name]]
        b[i] += outside / p[P[name]]
    ohmic = 1.5 * p[P["copper_resistance"]] * (u[0] ** 2 + u[1] ** 2)
    A[0, 0] -= ohmic * COPPER
    b[0] += ohmic * (1.0 - 20.0 * COPPER)
    _, iron = losses(np.zeros(4), u, p)
    tooth, magnet = p[P["iron_tooth"]], p[P["iron_magnet"]]
    b += iron * np.array([0.0, tooth, 1.0 - tooth - magnet, magnet])
    rest = np.linalg.solve(A, b)
    assert 60.0 < rest[3] < rest[0] < 200.0  # a motor, not an oven
    # Slowest time constant about 600 s: after 20,000 s nothing is left of the start.
    np.testing.assert_allclose(stepped(MOTOR_DRIVE, np.full(4, 20.0), u, p, 1.0, 20_000), rest, atol=1e-8)


def test_motor_copper_loss_follows_resistivity():
    p = defaults(MOTOR_DRIVE, copper_eddy=0.0)
    for T in (20.0, 120.0):  # everything as warm as its surroundings: the winding warms by its loss alone
        u = np.array([0.0, 100.0, 0.0, T, T])
        gained = stepped(MOTOR_DRIVE, np.full(4, T), u, p, 1e-3, 1) - T
        watts = gained[0] / 1e-3 * p[P["capacity_winding"]]
        assert watts == pytest.approx(1.5 * 0.01 * 100.0**2 * (1.0 + 0.00393 * (T - 20.0)), rel=1e-4)
    warm = np.array([80.0, 70.0, 60.0, 65.0])
    there, back = (stepped(MOTOR_DRIVE, warm, drive(speed=s), defaults(MOTOR_DRIVE), 1.0, 1) for s in (300.0, -300.0))
    np.testing.assert_array_equal(there, back)


def test_motor_integrates_to_fourth_order_and_one_second_is_enough():
    x, u = np.array([120.0, 80.0, 60.0, 40.0]), drive()
    p = defaults(MOTOR_DRIVE)
    fine = stepped(MOTOR_DRIVE, x, u, p, 0.1, 10)
    # λ < 0.1/s: (λ dt)^5 / 120 of a difference of 100 K.
    np.testing.assert_allclose(stepped(MOTOR_DRIVE, x, u, p, 1.0, 1), fine, atol=1e-5)
    small = p.copy()
    small[:4] = 500.0  # the smallest capacities that the sliders allow
    errors = [
        np.abs(stepped(MOTOR_DRIVE, x, u, small, 8.0 / n, n) - stepped(MOTOR_DRIVE, x, u, small, 0.01, 800)).max()
        for n in (8, 16)
    ]
    assert errors[0] > 1e-6 and 12.0 < errors[0] / errors[1] < 20.0  # 2^4, less what the next order adds


def test_motor_is_stable_at_the_worst_that_the_sliders_allow():
    low = np.array([item.low for item in MOTOR_DRIVE.parameters])
    u = np.array([0.0, 0.0, 0.0, 30.0, 30.0])
    x = np.array([200.0, 0.0, 200.0, 0.0])
    far = [np.abs(stepped(MOTOR_DRIVE, x, u, low, 1.0, n) - 30.0).max() for n in (0, 5, 50, 500)]
    assert far[0] > far[1] > far[2] and far[3] < 1e-6


# The car


def car(heading=0.0, speed=0.0, **other):
    values = {"heading": heading, "speed": speed, "wheel_scale": 1.0, **other}
    return np.array([values.get(name, 0.0) for name in CAR.state_names])


def test_car_drives_a_circle_to_the_left():
    speed, turn, dt = 15.0, 2.0 * np.pi / 60.0, 0.1
    p = defaults(CAR)
    u = np.array([0.3, turn + 0.02])  # the biases take off what is too much
    radius = speed / turn
    for steps in (150, 300, 600):  # a quarter, half, all of it
        x = stepped(CAR, car(speed=speed, accel_bias=0.3, yaw_rate_bias=0.02), u, p, dt, steps)
        angle = turn * dt * steps
        # Each step is a chord in the right direction, too long by (ω dt)² / 24.
        bound = 1.01 * speed * dt * steps * (turn * dt) ** 2 / 24.0
        assert np.hypot(x[0] - radius * np.sin(angle), x[1] - radius * (1.0 - np.cos(angle))) < bound
        assert x[2] == pytest.approx(angle, abs=1e-12) and x[3] == pytest.approx(speed, abs=1e-12)


def test_car_gains_speed_as_a_falling_stone_does():
    x = stepped(CAR, car(heading=np.pi / 2, speed=3.0), np.array([2.0, 0.0]), defaults(CAR), 0.1, 50)
    np.testing.assert_allclose(x[:4], [0.0, 3.0 * 5.0 + 0.5 * 2.0 * 5.0**2, np.pi / 2, 13.0], atol=1e-12)


def test_car_sensors_say_where_it_was():
    compiled = compile_model(CAR)
    p = defaults(CAR, gnss_delay=0.4)
    u = np.array([1.5, 0.0])
    before = car(
        heading=0.7, speed=12.0, wheel_scale=1.02, gnss_position_east_error=2.0, gnss_position_north_error=-1.0
    )
    now = stepped(CAR, before, np.array([0.0, 0.0]), p, 0.1, 4)
    readings = {}
    for h, sensor in zip(compiled.h, CAR.sensors, strict=True):
        readings[sensor.name] = np.empty(len(sensor.rows))
        h(now, u, p, readings[sensor.name])
    kept = np.exp(-0.4 / 100.0)
    np.testing.assert_allclose(readings["gnss_position"], [2.0 * kept, -1.0 * kept], atol=1e-12)
    np.testing.assert_allclose(readings["second_position"], 12.0 * 0.4 * np.array([np.cos(0.7), np.sin(0.7)]))
    np.testing.assert_allclose(readings["gnss_speed"], 12.0 - 0.4 * 1.5)
    np.testing.assert_allclose(readings["gnss_heading"], 0.7)
    np.testing.assert_allclose(readings["wheel_speed"], 12.0 * 1.02)


def test_car_noise_does_not_depend_on_how_time_is_cut():
    compiled = compile_model(CAR)
    p, u, x = defaults(CAR), np.zeros(2), car()
    q = np.array([noise.variance for noise in CAR.noises])

    def after(dt, steps):
        variance = np.zeros(CAR.nx)
        for _ in range(steps):
            Q = np.zeros((CAR.nx, CAR.nx))
            compiled.Q(x, u, p, q, dt, Q)
            kept = np.ones(CAR.nx)
            kept[-2:] = np.exp(-dt / 100.0)
            variance = kept**2 * variance + np.diag(Q)
        return variance

    np.testing.assert_allclose(after(0.1, 50), after(0.01, 500), rtol=1e-10)
    np.testing.assert_allclose(after(0.1, 20_000)[-2:], q[-2:], rtol=1e-9)


# The recordings


class Run:
    """A filter over the recording of a bundled twin."""

    def __init__(self, name, estimator):
        twin, log = recorded(name)
        self.model, self.events = twin.model, log.events
        self.track = fold(estimator, twin.model, twin.tuning, log)

    def of(self, sensor):
        """Rows of the readings of a sensor that hold a value."""
        rows = (self.events.kind == READING) & (self.events.channel == self.model.sensor_names.index(sensor))
        return np.flatnonzero(rows & np.isfinite(self.events.value[:, 0]))

    def final(self, state):
        return float(self.track.mean[-1, self.model.state_names.index(state)])


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_car_finds_the_scale_of_its_wheels_and_its_heading(estimator):
    result = Run("road_car", estimator)
    # The scale of the wheels is what comparing both sensors directly gives.
    t = result.events.t
    wheels, gnss = result.of("wheel_speed"), result.of("gnss_speed")
    by_wheels = np.interp(t[gnss] - 300_000_000, t[wheels], result.events.value[wheels, 0])
    by_gnss = result.events.value[gnss, 0]
    assert result.final("wheel_scale") == pytest.approx(by_wheels @ by_gnss / (by_gnss @ by_gnss), abs=0.004)
    # Heading: settled, it agrees with the receiver's to its resolution and delay, for 95 % of the readings.
    heading = result.of("gnss_heading")
    heading = heading[heading.size // 10 :]
    assert np.quantile(np.abs(result.track.innovation[heading, 0]), 0.95) < np.radians(1.5)


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_rav4_finds_the_error_of_its_gyroscope(estimator):
    result = Run("road_car_rav4", estimator)
    # The gyroscope's error is the rate it shows on average, less the little that the course turned.
    inputs = (result.events.kind == INPUT) & np.isfinite(result.events.value[:, 1])
    heading = result.of("gnss_heading")
    span = (result.events.t[heading[-1]] - result.events.t[heading[0]]) * 1e-9
    turned = np.mean(result.events.value[heading[-50:], 0]) - np.mean(result.events.value[heading[:50], 0])
    rate = np.mean(result.events.value[inputs, 1]) - turned / span
    assert abs(rate) > np.radians(0.3)
    assert result.final("yaw_rate_bias") == pytest.approx(rate, abs=np.radians(0.05))


def test_drive_s_own_jacobian_is_the_complex_step_of_its_step():
    model = MODELS["motor_drive"]
    rng = np.random.default_rng(4)
    p = defaults(model)
    for _ in range(100):
        x, dt = rng.uniform(0.0, 150.0, 4), rng.uniform(0.01, 1.0)
        u = drive(*(rng.uniform(-1.0, 1.0, 3) * [100.0, 250.0, 500.0]))
        own = np.empty((4, 4))
        model.F(x, u, p, dt, own)
        exact = complex_step(lambda z, out, u=u, dt=dt: model.f(z, u, p, dt, out), x, 4)
        # Both are exact but for rounding of a few dozen operations on numbers of about one.
        np.testing.assert_allclose(own, exact, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("reads", "row_circular", "fine"), [
    ("angle", False, False), ("angle", True, True), ("sine", False, True), ("twice", True, True), ("half", True, False),
])  # fmt: skip
def test_an_angle_read_by_a_row_that_does_not_wrap_is_refused(reads, row_circular, fine):
    """What a full turn changes, no filter can compare: the state is within ±π whenever h sees it."""

    h = {"angle": first_state, "sine": sine_of_angle, "twice": twice_the_angle, "half": half_the_angle}[reads]
    model = StateSpaceModel(
        name="vane", title="", f=unchanged, states=(State("angle", "rad", 0.0, 0.5, circular=True),),
        noises=(Noise("angle", "rad²/s", 0.1),),
        sensors=(Sensor("y", (Row("y", "rad", 0.1, circular=row_circular),), h),),
    )  # fmt: skip
    if fine:
        compile_model(model)
    else:
        with pytest.raises(ModelError, match="with a full turn of angle, which is circular; declare the row circular"):
            compile_model(model)


def sine_of_angle(x, u, p, out):
    out[0] = np.sin(x[0])


def twice_the_angle(x, u, p, out):
    out[0] = 2.0 * x[0]


def half_the_angle(x, u, p, out):
    out[0] = 0.5 * x[0]
