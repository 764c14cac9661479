"""What a step (predict and update) of each filter costs, beside FilterPy's, and how it grows with n."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime, timedelta

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from estimators.estimator import call_predict, call_update
from estimators.log import READING, Events, Log
from estimators.model.assemble import JointParameter, joint
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.numerics.jit import borrowed, floats, jit
from estimators.registry import ESTIMATORS
from tests.support import folded

from ..support import SECOND
from .timing import BenchmarkRow, Bound, compare, medians

STEPS = 4096
THEIR_STEPS = 200
REPETITIONS = 15

RING_STD, RING_Q, RING_R = 0.5, 0.01, 0.04


def ring_f(x, u, p, dt, out):
    n = x.size
    for i in range(n):
        flow = x[i - 1 if i > 0 else n - 1] - 2.0 * x[i] + x[i + 1 if i < n - 1 else 0]
        out[i] = x[i] + dt * (0.5 * flow - 0.1 * x[i] * x[i] * x[i])


def ring_f_linear(x, u, p, dt, out):
    n = x.size
    for i in range(n):
        flow = x[i - 1 if i > 0 else n - 1] - 2.0 * x[i] + x[i + 1 if i < n - 1 else 0]
        out[i] = x[i] + dt * 0.5 * flow


def ring_h(x, u, p, out):
    for j in range(out.size):
        out[j] = x[3 * j] + 0.1 * x[3 * j] * x[3 * j]


def ring_h_linear(x, u, p, out):
    for j in range(out.size):
        out[j] = x[3 * j]


def ring_f_numpy(x, dt):
    """The same for FilterPy, as a user of it would write it."""
    return x + dt * (0.5 * (np.roll(x, 1) - 2.0 * x + np.roll(x, -1)) - 0.1 * x**3)


def ring_h_numpy(x):
    every_third = x[::3]
    return every_third + 0.1 * every_third**2


def ring(n: int, m: int, *, linear: bool = False) -> StateSpaceModel:
    """Return a ring of n coupled masses of heat, of which every third is measured, m in all.

    x_i' = x_i + dt (0.5 (x_{i-1} - 2 x_i + x_{i+1}) - 0.1 x_i³),      y_j = x_{3j} + 0.1 x_{3j}²
    """
    h = ring_h_linear if linear else ring_h
    return StateSpaceModel(
        name=f"ring{n}",
        title=f"ring of {n}",
        states=tuple(State(f"x{i}", "K", mean=0.1 * (i % 5), std=RING_STD) for i in range(n)),
        noises=tuple(Noise(f"x{i}", "K²/s", RING_Q) for i in range(n)),
        sensors=(Sensor("y", tuple(Row(f"y{j}", "K", RING_R) for j in range(m)), h=h),),
        f=ring_f_linear if linear else ring_f,
        linear=linear,
    )


def noisy_log(model: StateSpaceModel, events: int, *, step: float = 1.0) -> Log:
    """Events of the first sensor, `step` seconds apart: noise about what the model expects at its prior."""
    rng = np.random.default_rng(0)
    m = len(model.sensors[0].rows)
    x = model.prior_mean
    expected = np.empty(m)
    model.sensors[0].h(x, model.default_inputs, model.default_parameters, expected)
    t = np.arange(events, dtype=np.int64) * round(step * SECOND)
    value = expected + 0.3 * rng.standard_normal((events, m))
    log = Log(model.width, events)
    log.extend(Events.alike(READING, t, np.ascontiguousarray(value)))
    return log


def folding(
    estimator: str, model: StateSpaceModel, log: Log, options: dict[str, float] | None = None
) -> Callable[[], None]:
    """A call that folds the whole log again: estimate, NIS, verdict and health of every event."""
    growing = folded(estimator, model, log, options=options or {})

    def again() -> None:
        growing.rewind(0)
        growing.advance()

    return again


def theirs_kf() -> Callable[[], None]:
    kf = KalmanFilter(dim_x=2, dim_z=1)
    kf.x, kf.P = np.array([35.0, 0.0]), np.diag([25.0, 1.0])
    kf.F, kf.H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    kf.Q, kf.R = np.diag([0.01, 0.001]), np.array([[4.0]])
    y = np.array([36.0])

    def steps() -> None:
        for _ in range(THEIR_STEPS):
            kf.predict()
            kf.update(y)

    return steps


def theirs_ekf() -> Callable[[], None]:
    H = np.array([[1.0, 0.0]])
    ekf = ExtendedKalmanFilter(dim_x=2, dim_z=1)
    ekf.x, ekf.P = np.array([35.0, 0.0]), np.diag([25.0, 1.0])
    ekf.Q, ekf.R = np.diag([0.01, 0.001]), np.array([[4.0]])
    y = np.array([36.0])

    def steps() -> None:
        for _ in range(THEIR_STEPS):
            ekf.F = np.array([[1.0, 1.0], [0.0, 1.0]])
            ekf.predict()
            ekf.update(y, lambda x: H, lambda x: x[:1])

    return steps


def theirs_ukf(n: int, m: int, x: np.ndarray, P: np.ndarray, Q: np.ndarray, R: np.ndarray, f, h) -> Callable[[], None]:
    points = MerweScaledSigmaPoints(n, alpha=1.0, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(n, m, 1.0, h, f, points)
    y = h(x)
    steps_each = THEIR_STEPS if n < 10 else THEIR_STEPS // 4

    def steps() -> None:
        ukf.x, ukf.P, ukf.Q, ukf.R = x.copy(), P.copy(), Q, R
        for _ in range(steps_each):
            ukf.predict(dt=0.1)
            ukf.update(y)

    return steps


def beside_filterpy() -> Iterator[BenchmarkRow]:
    """A step (predict, update, NIS, verdict, health) beside FilterPy's: processor time, medians, interleaved."""
    motor, ring24 = MODELS["motor_winding"], ring(24, 8)
    small, large = noisy_log(motor, STEPS), noisy_log(ring24, STEPS // 16, step=0.1)
    x24 = ring24.prior_mean
    x2, P2, Q2 = np.array([35.0, 0.0]), np.diag([25.0, 1.0]), np.diag([0.01, 0.001])
    I24, I8 = np.eye(24), np.eye(8)

    def f2(x, dt):
        return np.array([x[0] + dt * x[1], x[1]])

    ukf2 = theirs_ukf(2, 1, x2, P2, Q2, np.eye(1) * 4, f2, lambda x: x[:1])
    ukf24 = theirs_ukf(
        24, 8, x24, I24 * RING_STD**2, I24 * RING_Q * 0.1, I8 * RING_R, ring_f_numpy, ring_h_numpy
    )  # fmt: skip
    for name, ours, theirs, steps, bound in (
        ("KF n=2 m=1", folding("kf", motor, small), theirs_kf(), (STEPS, THEIR_STEPS), 25.0),
        ("EKF n=2 m=1", folding("ekf", motor, small), theirs_ekf(), (STEPS, THEIR_STEPS), None),
        ("UKF n=2 m=1", folding("ukf", motor, small), ukf2, (STEPS, THEIR_STEPS), 130.0),
        ("UKF n=24 m=8", folding("ukf", ring24, large), ukf24, (STEPS // 16, THEIR_STEPS // 4), 15.0),
    ):
        pair = compare(ours, theirs, steps=steps, repetitions=REPETITIONS)
        figures = {"Nisus [µs]": pair.ours * 1e6, "FilterPy [µs]": pair.theirs * 1e6, "ratio": pair.ratio}
        yield BenchmarkRow(name, figures, (Bound("ratio", bound, at_least=True),) if bound else ())


def alone(estimator: str, model: StateSpaceModel) -> Callable[[], None]:
    """Return a call of predictions and updates alone: no estimate, health or log is written."""
    log = noisy_log(model, STEPS, step=0.1)
    fold = folded(estimator, model, log)
    machine, now = fold.machine, fold._now
    places = (now.u, now.state, machine.work, machine.score, log.value, *np.empty((2, model.width)))

    def steps() -> None:
        _steps(machine.code.predict, machine.code.update, machine.context, STEPS, *places)

    return steps


@jit
def _steps(predict, update, context, n, u, state, work, score, value, innovation, innovation_std):
    # As in the fold: reference-counted arrays cost more than the filter.
    u, state, work, score = borrowed(u), borrowed(state), borrowed(work), borrowed(score)
    innovation, innovation_std = borrowed(innovation), borrowed(innovation_std)
    for k in range(n):
        y = floats(value[k].ctypes.data, value.shape[1])
        call_predict(predict, context, u, 0.1, k, state, work)
        call_update(update, context, u, 0, y, k, state, work, innovation, innovation_std, score)


def step_alone() -> Iterator[BenchmarkRow]:
    """A step of the unscented filter alone, and with estimate, NIS bounds, health and history: µs."""
    model = ring(4, 2)
    calls = [alone("ukf", model), folding("ukf", model, noisy_log(model, STEPS, step=0.1))]
    step, whole = (value / STEPS * 1e6 for value in medians(calls, REPETITIONS))
    figures = {"step [µs]": step, "with history [µs]": whole}
    yield BenchmarkRow("UKF n=4 m=2", figures, (Bound("step [µs]", 1.0),))


def chain_f(x, u, p, dt, out):
    out[0] = x[0] + dt * (u[0] * p[0] - p[1] * x[0] + p[2] * (x[1] - x[0]))
    out[1] = x[1] + dt * (p[3] * (x[0] - x[1]) - p[4] * (x[1] - x[2]))
    out[2] = x[2] + dt * (p[5] * (x[1] - x[2]) - p[6] * (x[2] - x[3]))
    out[3] = x[3] + dt * (p[7] * (x[2] - x[3]) - p[8] * x[3])


def chain_h(x, u, p, out):
    out[0] = x[0] + p[9] * u[0]


def chain() -> StateSpaceModel:
    """Return a chain of four masses of heat with ten parameters, heated and measured at one end."""
    return StateSpaceModel(
        name="chain",
        title="chain of four",
        states=tuple(State(f"x{i}", "K", mean=1.0, std=1.0) for i in range(4)),
        noises=tuple(Noise(f"x{i}", "K²/s", 0.01) for i in range(4)),
        sensors=(Sensor("y", (Row("y", "K", 0.04),), h=chain_h),),
        f=chain_f,
        inputs=(Input("power", "W", default=0.5),),
        parameters=tuple(Parameter(f"p{k}", "1", 0.1) for k in range(10)),
    )


def considered() -> Iterator[BenchmarkRow]:
    """A step of n=4 m=1 with ten considered parameters, beside the same with ten held ones."""
    model = chain()
    wide = joint(model, {item.name: JointParameter(0.01, considered=True) for item in model.parameters})
    for name in ("ekf", "sr-ekf", "ukf", "sr-ukf"):
        calls = [folding(name, each, noisy_log(each, STEPS, step=0.1)) for each in (model, wide)]
        pair = compare(calls[1], calls[0], steps=(STEPS, STEPS), repetitions=REPETITIONS)
        figures = {"held [µs]": pair.theirs * 1e6, "considered [µs]": pair.ours * 1e6, "times": 1.0 / pair.ratio}
        yield BenchmarkRow(name, figures, (Bound("times", 2.0),) if name.endswith("ekf") else ())


def beside_stone_soup() -> Iterator[BenchmarkRow]:
    """A step beside Stone Soup's, n=2 m=1: processor time, medians, interleaved."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor, UnscentedKalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater, UnscentedKalmanUpdater

    moving = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.001)])
    reading = LinearGaussian(2, (0,), np.array([[4.0]]))
    begun = datetime(2026, 1, 1)
    detections = [Detection([[36.0]], timestamp=begun + timedelta(seconds=k + 1)) for k in range(THEIR_STEPS)]

    def theirs(predictor, updater):
        def steps() -> None:
            estimate = GaussianState([[35.0], [0.0]], np.diag([25.0, 1.0]), timestamp=begun)
            for detection in detections:
                ahead = predictor.predict(estimate, timestamp=detection.timestamp)
                estimate = updater.update(SingleHypothesis(ahead, detection))

        return steps

    motor = MODELS["motor_winding"]
    for name, predictor, updater in (
        ("kf", KalmanPredictor(moving), KalmanUpdater(reading)),
        ("ukf", UnscentedKalmanPredictor(moving), UnscentedKalmanUpdater(reading)),
    ):
        ours = folding(name, motor, noisy_log(motor, STEPS))
        pair = compare(ours, theirs(predictor, updater), steps=(STEPS, THEIR_STEPS), repetitions=7)
        yield BenchmarkRow(
            name, {"Nisus [µs]": pair.ours * 1e6, "Stone Soup [µs]": pair.theirs * 1e6, "ratio": pair.ratio}
        )


def beside_fast_kalman() -> Iterator[BenchmarkRow]:
    """A Kalman filter step beside fast-kalman's (C++), n=2 m=1: processor time, medians, interleaved."""
    import kalman

    theirs = kalman.LinearKalmanFilter(
        2, 1, x=[35.0, 0.0], P=[25.0, 0.0, 0.0, 1.0], F=[1.0, 1.0, 0.0, 1.0], Q=[0.01, 0.0, 0.0, 0.001],
        H=[1.0, 0.0], R=[4.0],
    )  # fmt: skip
    y = np.full(STEPS, 36.0)

    def each() -> None:
        for _ in range(STEPS):
            theirs.update([36.0])

    motor = MODELS["motor_winding"]
    log = noisy_log(motor, STEPS)
    for name, ours, call, remark in (
        ("history, update", folding("kf", motor, log), each, "its innovation and NIS in each step, as here"),
        ("step alone, update_many", alone("kf", motor), lambda: theirs.update_many(y), "its last estimate only"),
    ):
        pair = compare(ours, call, steps=(STEPS, STEPS), repetitions=REPETITIONS)
        figures = {"Nisus [µs]": pair.ours * 1e6, "fast-kalman [µs]": pair.theirs * 1e6, "ratio": pair.ratio}
        yield BenchmarkRow(name, figures, (Bound("ratio", 1.0 / 1.5, at_least=True),), remark)


def growing_n() -> Iterator[BenchmarkRow]:
    """A step against n (ring of n states, every third measured): µs, which grow as n³ where matrices dominate."""
    for n in (2, 4, 8, 16, 24, 32, 48):
        m, steps = (n + 2) // 3, max(64, 60_000 // n**2)
        models = {name: ring(n, m, linear=name == "kf") for name in ("kf", "ekf", "ukf")}
        calls = [folding(name, model, noisy_log(model, steps, step=0.1)) for name, model in models.items()]
        each = [value / steps * 1e6 for value in medians(calls, 7)]
        yield BenchmarkRow(f"n={n} m={m}", dict(zip(models, each, strict=True)))


def growing_m() -> Iterator[BenchmarkRow]:
    """A step against m (ring of 24 states): µs, a constant part and one as n² m."""
    sizes = (1, 2, 4, 8)
    for name in ("kf", "ekf", "ukf"):
        models = [ring(24, m, linear=name == "kf") for m in sizes]
        each = medians([folding(name, model, noisy_log(model, 256, step=0.1)) for model in models], 7)
        yield BenchmarkRow(name, {f"m={m}": value / 256 * 1e6 for m, value in zip(sizes, each, strict=True)})


def gaussian_family() -> Iterator[BenchmarkRow]:
    """A step of each Gaussian filter and option (ring of n states, linear for the Kalman filters): µs."""
    variants: list[tuple[str, dict[str, float]]] = [
        *((name, {"period": 0.1} if name == "kf-steady" else {}) for name, entry in ESTIMATORS.items()
          if entry.family == "Gaussian"),
        ("ekf", {"joseph": 0}),
        *((name, option) for name in ("ekf", "ukf") for option in ({"robust": 1.0}, {"robust": 2.0}, {"adapt": 1.0})),
    ]  # fmt: skip
    columns = {}
    for n, m in ((2, 1), (4, 2), (8, 3), (24, 8)):
        steps = max(64, 20_000 // n**2)
        models = [ring(n, m, linear=name in ("kf", "kf-steady", "sr-kf")) for name, _ in variants]
        calls = [
            folding(name, model, noisy_log(model, steps, step=0.1), options)
            for (name, options), model in zip(variants, models, strict=True)
        ]
        columns[f"n={n} m={m}"] = [value / steps * 1e6 for value in medians(calls, 7)]
    for k, (name, options) in enumerate(variants):
        label = " ".join([name, *(f"{key}={value:g}" for key, value in options.items())])
        yield BenchmarkRow(label, {title: column[k] for title, column in columns.items()})
