"""What happens between readings, and around ±π: against numbers worked out by hand."""

import numpy as np
import pytest

from estimators.fold import Fold, fold
from estimators.interpreted.fold_loop import MAX_PREDICT_STEPS
from estimators.log import INPUT, READING, RESET, TICK, TRUTH, Events
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.registry import ESTIMATORS
from estimators.track import MISSING, USED
from estimators.tuning import Tuning
from tests.models import constant_speed, first_state, unchanged
from tests.support import SECOND, folded, log_of

# The gain of the first readings of kf-steady is another.
NAMES = [name for name, entry in ESTIMATORS.items() if entry.family == "Gaussian" and name != "kf-steady"]


def growth(x, u, p, dt, out):
    """Euler's step of x' = x."""
    out[0] = x[0] + dt * x[0]


def bearing(x, u, p, out):
    out[0] = np.arctan2(x[1], x[0])


def guarded(x, u, p, dt, out):
    """Linear, but the comparison keeps it from complex numbers: its Jacobian is by central differences."""
    out[0] = 0.9 ** (dt / 3.0) * x[0] if x[0] > -1e300 else 0.0


def model(f, h=first_state, *, states=1, std=0.5, mean=0.0, q=0.02, r=0.0025, circular=(), linear=True, **fields):
    return StateSpaceModel(
        name=f.__name__,
        title=f.__name__,
        states=tuple(
            State(f"x{i}", "rad", mean=np.broadcast_to(mean, states)[i], std=std, circular=f"x{i}" in circular)
            for i in range(states)
        ),
        noises=(Noise("x0", "rad²/s", variance=q),),
        sensors=(Sensor("y", (Row("y", "rad", variance=r, circular="y" in circular),), h=h),),
        f=f,
        linear=linear,
        **fields,
    )


def run(estimator, model, *events):
    return folded(estimator, model, log_of(1, *events))


@pytest.mark.parametrize("estimator", NAMES)
def test_covariance_grows_without_readings_as_the_sum_says(estimator):
    """P(k) = Fᵏ P₀ Fᵏᵀ + Σ Fⁱ Q Fⁱᵀ for F = [[1, 1], [0, 1]]: polynomials of k."""
    events = [(0, TICK, 0.0)] + [(k, READING, np.nan) for k in range(1, 41)]
    found = run(estimator, MODELS["motor_winding"], *events)
    k, (p1, p2), (q1, q2) = 40, (25.0, 1.0), (0.01, 0.001)
    expected = [
        [p1 + k**2 * p2 + k * q1 + q2 * (k - 1) * k * (2 * k - 1) / 6, k * p2 + q2 * k * (k - 1) / 2],
        [k * p2 + q2 * k * (k - 1) / 2, p2 + k * q2],
    ]
    # Forty steps, a few roundings each; the UKF takes P apart and puts it together again at every one.
    np.testing.assert_allclose(found.moments()[1], expected, rtol=1e-12)
    assert np.all(found.track.verdict[1:] == MISSING)
    assert np.all(np.diff(found.track.std, axis=0) > 0)


@pytest.mark.parametrize("estimator", NAMES)
@pytest.mark.parametrize(("dt", "steps"), [(0.5, 1), (2.0, 4), (1.1, 3), (0.2, 1)])
def test_long_steps_are_split(estimator, dt, steps):
    """x ← (1 + dt/k) x, k times, where a step may last 0.5 s; the noise adds up on the way."""
    found = run(estimator, model(growth, mean=2.0, max_step=0.5), (0, TICK, 0.0), (dt, READING, np.nan))
    a = 1.0 + dt / steps
    mean, cov = found.moments()
    np.testing.assert_allclose(mean[0], 2.0 * a**steps, rtol=1e-14)
    variance = 0.25
    for _ in range(steps):
        variance = a * a * variance + 0.02 * dt / steps
    np.testing.assert_allclose(cov[0, 0], variance, rtol=1e-13)


@pytest.mark.parametrize("estimator", NAMES)
def test_heading_takes_the_short_way_over_pi(estimator):
    """Prior 3.1 ± 0.1, reading -3.1 with R = 0.0025: gain 0.8, innovation 2π - 6.2, not -6.2."""
    compass = model(unchanged, mean=3.1, std=0.1, circular=("x0", "y"))
    found = run(estimator, compass, (0, READING, -3.1))
    innovation = 2 * np.pi - 6.2
    np.testing.assert_allclose(found.track.innovation[0, 0], innovation, rtol=1e-13)
    # 3.1 + 0.8 · 0.0832 = 3.1665 is beyond π, so it is told as 2π less.
    np.testing.assert_allclose(found.track.mean[0, 0], 3.1 + 0.8 * innovation - 2 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(found.track.std[0, 0] ** 2, 0.2 * 0.01, rtol=1e-13)
    np.testing.assert_allclose(found.track.nis[0], innovation**2 / 0.0125, rtol=1e-12)


@pytest.mark.parametrize("estimator", NAMES)
def test_turning_for_many_rounds(estimator):
    """A heading that turns 1 rad/s for a minute: wrapped all the way, the rate found, the error never a round."""
    turning = model(constant_speed, states=2, mean=0.0, std=1.0, q=1e-6, r=1e-4, circular=("x0", "y"))
    wrapped = lambda a: (a + np.pi) % (2 * np.pi) - np.pi  # noqa: E731
    found = run(estimator, turning, *[(0.2 * k, READING, wrapped(0.2 * k)) for k in range(300)])
    heading, rate = found.track.mean.T
    assert np.all((heading >= -np.pi) & (heading < np.pi))
    # The readings are exact and the prior is off by one sigma at most: within a few of the filter's own.
    error = np.abs(wrapped(heading - 0.2 * np.arange(300)))
    assert np.all(error[5:] < 3 * found.track.std[5:, 0])
    assert abs(rate[-1] - 1.0) < 3 * found.track.std[-1, 1]


@pytest.mark.parametrize("estimator", NAMES)
def test_a_state_that_is_not_circular_does_not_wrap(estimator):
    found = run(estimator, model(unchanged, mean=3.1, std=0.1), (0, READING, 3.3))
    np.testing.assert_allclose(found.track.mean[0, 0], 3.26, rtol=1e-14)


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
@pytest.mark.parametrize("side", [0.0, 1e-9, -1e-9])
def test_bearing_where_atan2_jumps(estimator, side):
    """A beacon due west: atan2 jumps from π to -π within the step of a central difference.

    At (-2, 0) the bearing's Jacobian is (0, -1/2): the reading -π + 0.1 has the innovation 0.1.
    """
    west = model(unchanged, bearing, states=2, mean=(-2.0, side), std=0.01, r=1e-6, circular=("y",), linear=False)
    found = run(estimator, west, (0, READING, -np.pi + 0.001))
    S = 0.25e-4 + 1e-6
    gain = -0.5e-4 / S
    # The UKF sees the curvature too: h'' σ² is 1e-4 of h' σ here. Central differences are good to 1e-9.
    tolerance = 1e-7 if estimator == "ekf" else 1e-3
    np.testing.assert_allclose(found.track.innovation_std[0, 0], np.sqrt(S), rtol=tolerance)
    np.testing.assert_allclose(found.track.mean[0, 1] - side, gain * (0.001 + side / 2), rtol=tolerance)
    assert found.track.verdict[0] == USED


@pytest.mark.parametrize("estimator", NAMES)
def test_purity_where_jacobians_are_differences(estimator):
    """What a filter keeps between steps (the KF its F) may not depend on where it was found."""
    rng = np.random.default_rng(2)
    guarded_model = model(guarded, mean=50.0)
    times = np.cumsum(rng.choice([0.1, 0.1, 0.1, 0.35], 400))
    events = [(t, READING, 50 * 0.965**t + rng.normal(0, 0.05)) for t in times]
    tuning = Tuning.of(guarded_model)
    whole = fold(estimator, guarded_model, tuning, log_of(1, *events))
    late = 300
    log = log_of(1, *events[:late], *events[late + 1 :])
    growing = folded(estimator, guarded_model, log, tuning)
    t, kind, value = events[late]
    changed, _ = log.extend(Events.one(round(t * SECOND), 0, kind, 0, value, 1))
    growing.rewind(changed)
    growing.advance()
    np.testing.assert_array_equal(growing.track.mean, whole.mean)
    np.testing.assert_array_equal(growing.track.std, whole.std)


@pytest.mark.parametrize("estimator", NAMES)
def test_a_reset_recovers_from_an_estimate_that_was_lost(estimator):
    """Events of 1e300 are believed, as Q is 1e300; after a reset nothing of that may remain."""
    events = [(0, TICK, 0.0), (0.5, READING, 1e300), (0.7, READING, -1e300), (0.9, READING, 1e300)]
    after = [(1, RESET, 0.0), (1.2, READING, 0.3), (1.4, READING, 0.4)]
    lost = run(estimator, model(constant_speed, states=2, q=1e300), *events, *after).track
    assert np.abs(lost.mean[:4]).max() > 1e200
    fresh = run(estimator, model(constant_speed, states=2, q=1e300), (1, TICK, 0.0), *after[1:]).track
    np.testing.assert_array_equal(lost.mean[-3:], fresh.mean)


def test_after_a_clock_jump_the_estimate_is_the_prior():
    model = MODELS["motor_drive"]
    just = model.max_step * MAX_PREDICT_STEPS
    later = [(just, TICK, []), (just + 1, TICK, []), (1_700_000_000, INPUT, [0, 0, 0, 40, 25])]
    log = log_of(model.width, (0, READING, 90.0), *later)
    track = fold("ekf", model, Tuning.of(model), log)
    prior = model.prior_mean
    assert np.all(np.abs(track.mean[1] - prior) > 1e-3)  # still predicted, towards its surroundings
    np.testing.assert_array_equal(track.mean[2:], [prior, prior])
    np.testing.assert_array_equal(track.std[3], [state.std for state in model.states])


def test_several_truths_at_one_time_are_one_query():
    model = MODELS["motor_drive"]
    later = ((TRUTH, 5), (TRUTH, 5), (TICK, 5), (TRUTH, 9), (INPUT, 12), (TRUTH, 12), (TRUTH, 12))
    log = log_of(model.width, (0, READING, 90.0), *((0.1 * t, kind, 50.0) for kind, t in later))
    whole = fold("ekf", model, Tuning.of(model), log)
    alone = Fold("ekf", model, Tuning.of(model), log)
    while alone.advance(1):
        pass
    np.testing.assert_array_equal(whole.mean, alone.track.mean)
    np.testing.assert_array_equal(whole.std, alone.track.std)
    np.testing.assert_array_equal(whole.mean[1], whole.mean[3])
    assert np.any(whole.mean[3] != whole.mean[4])
