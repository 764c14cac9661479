"""What a step (predict and update) of each filter costs, beside FilterPy's, and how it grows with n."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from estimators.estimator import call_predict, call_update
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import StateSpaceModel
from estimators.models import MODELS
from estimators.numerics.jit import borrowed, floats, jit
from estimators.registry import ESTIMATORS
from estimators.tuning import Tuning

from ..support import SECOND
from . import ring
from .timing import compare, judged, medians

STEPS = 4096
THEIR_STEPS = 200
REPETITIONS = 15


def noisy_log(model: StateSpaceModel, events: int, *, step: float = 1.0) -> Log:
    """Events of the first sensor, `step` seconds apart: noise about what the model expects at its prior."""
    rng = np.random.default_rng(0)
    m = len(model.sensors[0].rows)
    x = np.array([state.mean for state in model.states])
    expected = np.empty(m)
    model.sensors[0].h(x, np.zeros(0), np.zeros(0), expected)
    t = np.arange(events, dtype=np.int64) * round(step * SECOND)
    value = expected + 0.3 * rng.standard_normal((events, m))
    log = Log(model.width, events)
    log.extend(Events(t, t, np.full(events, READING, np.int8), np.zeros(events, np.int32), np.ascontiguousarray(value)))
    return log


def folding(
    estimator: str, model: StateSpaceModel, log: Log, options: dict[str, float] | None = None
) -> Callable[[], None]:
    """A call that folds the whole log again: estimate, NIS, verdict and health of every event."""
    growing = Fold(estimator, model, Tuning.of(model).with_options(options or {}), log)
    growing.advance()

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


def beside_filterpy() -> None:
    """Each filter beside FilterPy's, in one run."""
    motor, ring24 = MODELS["motor_winding"], ring.ring(24, 8)
    small, large = noisy_log(motor, STEPS), noisy_log(ring24, STEPS // 16, step=0.1)
    x24 = np.array([state.mean for state in ring24.states])

    def f2(x, dt):
        return np.array([x[0] + dt * x[1], x[1]])

    rows = [
        ("KF   n=2  m=1", folding("kf", motor, small), theirs_kf(), STEPS, THEIR_STEPS, 15.0),
        ("EKF  n=2  m=1", folding("ekf", motor, small), theirs_ekf(), STEPS, THEIR_STEPS, None),
        (
            "UKF  n=2  m=1",
            folding("ukf", motor, small),
            theirs_ukf(
                2,
                1,
                np.array([35.0, 0.0]),
                np.diag([25.0, 1.0]),
                np.diag([0.01, 0.001]),
                np.eye(1) * 4,
                f2,
                lambda x: x[:1],
            ),
            STEPS,
            THEIR_STEPS,
            100.0,
        ),
        (
            "UKF  n=24 m=8",
            folding("ukf", ring24, large),
            theirs_ukf(
                24,
                8,
                x24,
                np.eye(24) * ring.STD**2,
                np.eye(24) * ring.Q * 0.1,
                np.eye(8) * ring.R,
                ring.f_numpy,
                ring.h_numpy,
            ),
            STEPS // 16,
            THEIR_STEPS // 4,
            15.0,
        ),
    ]
    print("A step: predict and update, with NIS, verdict and health on our side; processor time, medians, interleaved")
    print(f"  {'filter':15s} {'Nisus µs':>9s} {'FilterPy µs':>12s} {'ratio':>7s}   wanted")
    for name, ours, theirs, our_steps, their_steps, bound in rows:
        pair = compare(ours, theirs, steps=(our_steps, their_steps), repetitions=REPETITIONS)
        verdict = f">= {bound:3.0f}   {judged(pair.ratio, bound, at_least=True)}" if bound else "   -"
        print(f"  {name:15s} {pair.ours * 1e6:9.3f} {pair.theirs * 1e6:12.1f} {pair.ratio:7.1f}   {verdict}")


def alone(estimator: str, model: StateSpaceModel) -> Callable[[], None]:
    """Predictions and updates as the fold calls them, but nothing else: no estimate, health or log is written."""
    log = noisy_log(model, STEPS, step=0.1)
    fold = Fold(estimator, model, Tuning.of(model), log)
    fold.advance()
    machine, now = fold._machine, fold._now
    places = (now.u, now.state, machine.work, machine.score, log.value, *np.empty((2, model.width)))

    def steps() -> None:
        _steps(machine.code.predict, machine.code.update, machine.context, STEPS, *places)

    return steps


@jit
def _steps(predict, update, context, n, u, state, work, score, value, innovation, innovation_std):
    # What the fold does too: counted arrays cost more than the filter.
    u, state, work, score = borrowed(u), borrowed(state), borrowed(work), borrowed(score)
    innovation, innovation_std = borrowed(innovation), borrowed(innovation_std)
    for k in range(n):
        y = floats(value[k].ctypes.data, value.shape[1])
        call_predict(predict, context, u, 0.1, k, state, work)
        call_update(update, context, u, 0, y, k, state, work, innovation, innovation_std, score)


def step_alone() -> None:
    """A step of the unscented filter as the issue of speed is usually put: prediction and update alone."""
    calls = [
        alone("ukf", ring.ring(4, 2)),
        folding("ukf", ring.ring(4, 2), noisy_log(ring.ring(4, 2), STEPS, step=0.1)),
    ]
    step, whole = (value / STEPS * 1e6 for value in medians(calls, REPETITIONS))
    print(f"UKF n=4 m=2: predict and update {step:.2f} µs   <= 1   {judged(step, 1.0, at_least=False)}")
    print(f"             with estimate, NIS bounds, health and history {whole:.2f} µs")


def beside_stone_soup() -> None:
    """Kalman and unscented filters of Stone Soup on the motor: a prediction and an update of one state object."""
    try:
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
        from stonesoup.predictor.kalman import KalmanPredictor, UnscentedKalmanPredictor
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.state import GaussianState
        from stonesoup.updater.kalman import KalmanUpdater, UnscentedKalmanUpdater
    except ImportError:
        print("Stone Soup is not installed: pip install nisus[bench]")
        return
    moving = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.001)])
    reading = LinearGaussian(2, (0,), np.array([[4.0]]))
    begun = datetime(2026, 1, 1)
    detections = [Detection([[36.0]], timestamp=begun + timedelta(seconds=k + 1)) for k in range(THEIR_STEPS)]

    def theirs(predictor, updater):
        def steps() -> None:
            belief = GaussianState([[35.0], [0.0]], np.diag([25.0, 1.0]), timestamp=begun)
            for detection in detections:
                ahead = predictor.predict(belief, timestamp=detection.timestamp)
                belief = updater.update(SingleHypothesis(ahead, detection))

        return steps

    motor = MODELS["motor_winding"]
    print("A step beside Stone Soup's, n=2 m=1; processor time, medians, interleaved")
    for name, predictor, updater in (
        ("kf", KalmanPredictor(moving), KalmanUpdater(reading)),
        ("ukf", UnscentedKalmanPredictor(moving), UnscentedKalmanUpdater(reading)),
    ):
        ours = folding(name, motor, noisy_log(motor, STEPS))
        pair = compare(ours, theirs(predictor, updater), steps=(STEPS, THEIR_STEPS), repetitions=7)
        print(f"  {name:4s} {pair.ours * 1e6:7.3f} µs, theirs {pair.theirs * 1e6:7.0f} µs, ratio {pair.ratio:6.0f}")


def growing_n() -> None:
    """The cost of n: as n³ where the matrices rule, and what is left of that at small n."""
    sizes = (2, 4, 8, 16, 24, 32, 48)
    print("A step against n (ring of n states, every third read): µs, and ns / n³ in brackets")
    print(f"  {'n':>4s} {'m':>3s}" + "".join(f"{name:>20s}" for name in ("kf (linear)", "ekf", "ukf")))
    for n in sizes:
        m = (n + 2) // 3
        steps = max(64, 60_000 // n**2)
        calls = []
        for name in ("kf", "ekf", "ukf"):
            model = ring.ring(n, m, linear=name == "kf")
            calls.append(folding(name, model, noisy_log(model, steps, step=0.1)))
        each = [value / steps for value in medians(calls, 7)]
        print(f"  {n:4d} {m:3d}" + "".join(f"{s * 1e6:11.2f} [{s * 1e9 / n**3:6.2f}]" for s in each))


def growing_m() -> None:
    """The cost of m at n = 24: as n² m where the covariance's update rules, as m³ in the factor of S."""
    sizes = (1, 2, 4, 8)
    print("A step against m (ring of 24 states): µs; expected: a part that does not depend on m, and one as n² m")
    for name in ("kf", "ekf", "ukf"):
        models = [ring.ring(24, m, linear=name == "kf") for m in sizes]
        each = [
            value / 256 * 1e6 for value in medians([folding(name, a, noisy_log(a, 256, step=0.1)) for a in models], 7)
        ]
        print(f"  {name:4s} " + "   ".join(f"m = {m}: {value:6.2f}" for m, value in zip(sizes, each, strict=True)))


def gaussian_family() -> None:
    """Every Gaussian filter on the same rings, and what its options cost when they are on."""
    variants: list[tuple[str, dict[str, float]]] = [
        *((name, {"period": 0.1} if name == "kf-steady" else {}) for name, entry in ESTIMATORS.items()
          if entry.family == "Gaussian"),
        ("ekf", {"joseph": 0}),
        *((name, option) for name in ("ekf", "ukf") for option in ({"robust": 1.0}, {"robust": 2.0}, {"adapt": 1.0})),
    ]  # fmt: skip
    sizes = ((2, 1), (4, 2), (8, 3), (24, 8))
    print(
        "A step of each Gaussian filter (ring of n states, every third read; linear for the three Kalman filters): µs"
    )
    print(f"  {'filter':24s}" + "".join(f"{f'n={n} m={m}':>12s}" for n, m in sizes))
    columns = []
    for n, m in sizes:
        steps = max(64, 20_000 // n**2)
        calls = []
        for name, options in variants:
            model = ring.ring(n, m, linear=name in ("kf", "kf-steady", "sr-kf"))
            calls.append(folding(name, model, noisy_log(model, steps, step=0.1), options))
        columns.append([value / steps for value in medians(calls, 7)])
    for row, (name, options) in enumerate(variants):
        label = " ".join([name, *(f"{key}={value:g}" for key, value in options.items())])
        print(f"  {label:24s}" + "".join(f"{column[row] * 1e6:12.2f}" for column in columns))
