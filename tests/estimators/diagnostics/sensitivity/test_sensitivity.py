"""Nudges of models whose answers are known in closed form, or by Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import binom, norm

from estimators.diagnostics.detector_state import no_baseline
from estimators.diagnostics.detectors import RATIOS, TESTS
from estimators.diagnostics.sensitivity import bounds_of, sensitivities, sensitivity, worse_faults
from estimators.diagnostics.sensitivity.gramian import directions
from estimators.diagnostics.sensitivity.responses import CATALOGUE, DELAY, PRIOR, SCALE
from estimators.diagnostics.sensitivity.visibility import FaultTests, noncentrality, threshold
from estimators.fold import fold
from estimators.log import READING, Log
from estimators.models import MODELS
from estimators.track import GATED
from estimators.tuning import Tuning
from tests.models import level_model
from tests.support import folded

from .models import COUPLED, KEPT, TWICE, WALK, Q, R, S, simulate

N = 60
STEPS = np.arange(N)
SENSOR = KEPT**STEPS
"""dν of a bias of the sensor: each reading takes a share K of what it still differs by."""
DRIFT = -(1.0 - KEPT**STEPS) / (1.0 - KEPT)
"""dν of a drift: the prediction is off by one step's, and by what the readings left of the steps before."""
CENTRAL = 1e-5
"""Of a central difference with a step of 1e-3: its square, and a factor of ten for a curvature above one."""


def walk_log(seed=0, n=N):
    log = Log.of(WALK)
    log.add_inputs(np.arange(n), push=np.full(n, -1.0))
    log.add("level", np.arange(n), np.random.default_rng(seed).normal(size=n))
    return log


@pytest.fixture(scope="module")
def walk():
    return sensitivity("ekf", WALK, Tuning.of(WALK), walk_log(), seen_by="best")


def responses(found):
    return [fault.response for fault in found.faults]


def visible(found):
    return np.array([fault.visible for fault in found.faults])


def unseen(found):
    return np.array([(fault.low, fault.high) for fault in found.faults])


def readings(found, array):
    return array[np.isfinite(found.faults[0].response.innovation[:, 0])]


def test_responses_of_a_walk_in_closed_form(walk):
    sensor, push, slope, delay = responses(walk)
    assert [(n.kind, n.name) for n in walk.nudges] == [
        ("sensor", "level"),
        ("input", "push"),
        ("parameter", "slope"),
        ("parameter", "delay"),
    ]
    for response, dnu, tolerance in (
        (sensor, SENSOR, 1e-9),
        (push, DRIFT, 1e-9),
        (slope, DRIFT, 1e-9),
        (delay, -DRIFT, CENTRAL),
    ):
        scale = np.abs(dnu).max()
        np.testing.assert_allclose(readings(walk, response.innovation)[:, 0], dnu, atol=tolerance * scale)
        np.testing.assert_allclose(readings(walk, response.whitened)[:, 0], dnu / np.sqrt(S), atol=tolerance * scale)
    # The estimate follows a biased sensor in the end, and is behind the drift by what a reading leaves of it.
    np.testing.assert_allclose(readings(walk, sensor.states)[:, 0], 1.0 - KEPT ** (STEPS + 1), atol=1e-9)
    np.testing.assert_allclose(readings(walk, push.states)[:, 0], -KEPT * DRIFT, atol=1e-8)


def test_a_scale_and_a_wrong_prior_of_a_walk_in_closed_form():
    """Without noise a scale is an offset in proportion to the value, 5 throughout; the noise of a measurement stays."""
    model = replace(WALK, states=(replace(WALK.states[0], mean=5.0),))
    log = walk_log()
    log.value[: log.n][log.kind[: log.n] == READING, 0] = 5.0
    found = sensitivity("ekf", model, Tuning.of(model), log, kinds=CATALOGUE, begin=PRIOR)
    scale, prior = (found.faults[found.place(kind, name)] for kind, name in ((SCALE, "level"), (PRIOR, "x")))
    np.testing.assert_allclose(readings(found, scale.response.innovation)[:, 0], 5.0 * SENSOR, atol=1e-8)
    np.testing.assert_allclose(readings(found, prior.response.innovation)[:, 0], -SENSOR, atol=1e-9)
    np.testing.assert_allclose(readings(found, prior.response.states)[:, 0], KEPT ** (STEPS + 1), atol=1e-9)
    # Faults that begin later know no prior.
    later = sensitivity("ekf", model, Tuning.of(model), log, kinds=CATALOGUE)
    assert not {"prior", "Q", "R"} & {nudge.kind for nudge in later.nudges}


def test_a_delay_of_the_only_sensor_is_undetectable_and_one_of_two_is_not():
    """Two sensors of one swinging quantity contradict each other if one is late; alone it is a later asset."""
    n = 400
    swing = 3.0 * np.sin(np.arange(n) / 8.0)
    for names in (("level",), ("level", "other")):
        model = level_model(dict.fromkeys(names, 0.01), 0.2, state="x")
        log = Log.of(model)
        rng = np.random.default_rng(4)
        for name in names:
            log.add(name, np.arange(n), swing + 0.1 * rng.normal(size=n))
        found = sensitivity("ekf", model, Tuning.of(model), log, kinds=(DELAY,), begin=PRIOR)
        fault = found.faults[0]
        assert fault.nudge.high == 10.0
        if len(names) == 1:
            assert (fault.low, fault.high, fault.visible) == (-10.0, 10.0, np.inf)
        else:
            # A delay of one period is at most 0.37 in 0.1 σ of noise: bisected to a thirtieth of ten seconds.
            assert fault.visible <= 2.0 and -2.0 < fault.low <= 0.0 <= fault.high < 2.0


def test_a_bias_from_the_prior_on_is_harder_to_detect_where_the_prior_is_wide():
    """The first innovations are larger, and so is their variance: a wide prior takes the bias for the state."""
    wide = replace(WALK, states=(replace(WALK.states[0], std=100.0),))
    present, *onsets = sensitivities("ekf", wide, Tuning.of(wide), walk_log(n=4 * N))
    at_start, later = (found.faults[found.place("sensor", "level")] for found in (present, onsets[0]))
    assert at_start.visible > 1.5 * later.visible
    worse = {(fault.nudge.kind, fault.nudge.name): one.begin for fault, one in worse_faults(present, *onsets)}
    assert worse["sensor", "level"] == PRIOR
    # R: each end of the range was folded without an alarm, and the next step beyond it with one.
    noise = present.faults[present.place("R", "level")]
    assert -1.0 < noise.low < 0.0 < noise.high and noise.visible >= 0.0
    level = bounds_of(wide, present, *onsets)["x"]
    assert level.bound == max(found.bounds.bound[-1, 0] for found in (present, *onsets))


def test_information_and_smallest_visible_faults_in_closed_form(walk):
    whitened = np.stack([SENSOR, DRIFT, DRIFT, -DRIFT]) / np.sqrt(S)
    expected = whitened @ whitened.T
    np.testing.assert_allclose(walk.fisher, expected, rtol=10 * CENTRAL)
    # (1 - ρ²ᴺ) / (1 - ρ²) is the sum of a geometric series.
    assert walk.fisher[0, 0] == pytest.approx((1 - KEPT ** (2 * N)) / (1 - KEPT**2) / S, rel=1e-9)
    # Readings in a day, one a second, times the tests of the one row.
    assert walk.h[0] == pytest.approx(np.log(86400.0 * TESTS), rel=1e-9)
    size = np.sqrt(walk.noncentrality / np.diag(expected))[:3]
    np.testing.assert_allclose(visible(walk)[:3], size, rtol=1e-6)
    np.testing.assert_allclose(unseen(walk)[:3], np.stack([-size, size], axis=1), rtol=1e-6)


def test_faults_at_once_add_up_or_cancel(walk):
    """A wrong input and a wrong slope of the walk have one effect."""
    _, push, slope, _ = visible(walk)
    assert push == pytest.approx(slope, rel=1e-6)
    one, both = ("input", "push", 0.5), [("input", "push", 0.5), ("parameter", "slope", 0.5)]
    assert walk.multiple([one]) == pytest.approx(push / 0.5, rel=1e-6)
    assert walk.multiple(both) == pytest.approx(push / 1.0, rel=1e-6)
    assert walk.multiple([one, ("parameter", "slope", -0.5)]) > 1e5 * push
    assert np.isnan(walk.multiple([one, ("sensor", "none of that name", 1.0)]))


def test_no_error_is_larger_than_a_state_can_be(walk):
    """Between limits 0.7 apart; the bound of the walk itself reaches from below to beyond that."""
    limited = replace(WALK, states=(replace(WALK.states[0], limits=(-0.3, 0.4)),))
    found = sensitivity("ekf", limited, Tuning.of(limited), walk_log(), seen_by="best")
    for own, free in zip(found.bounds[:2], walk.bounds[:2], strict=True):
        assert free.min() < 0.7 < free.max()
        np.testing.assert_array_equal(own, np.minimum(free, 0.7))


def test_what_the_readings_cannot_tell_apart(walk):
    # An input, and two parameters that do the same: the log tells their sum, and the sensor's bias beside it.
    assert np.isfinite(walk.among().deviation[0]) and np.all(np.isinf(walk.among().deviation[1:]))
    pair = walk.among([0, 1])
    cov = np.linalg.inv(np.stack([SENSOR, DRIFT]) @ np.stack([SENSOR, DRIFT]).T / S)
    np.testing.assert_allclose(pair.deviation, np.sqrt(np.diag(cov)), rtol=1e-6)
    np.testing.assert_allclose(walk.among().deviation[0], pair.deviation[0], rtol=1e-6)
    assert pair.correlation[0, 1] == pytest.approx(cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1]), abs=1e-6)
    # One at the other's cost: the sum stays when one rises and the other falls.
    assert walk.among([1, 2]).correlation[0, 1] == pytest.approx(-1.0, abs=1e-6)
    worst = directions(walk.fisher[1:3, 1:3], walk.nudges[1:3])[0]
    assert np.isinf(worst.deviation) and np.prod(worst.weights) < 0
    assert "slope" in worst.text and "input push" in worst.text


def test_a_fault_is_as_large_as_the_model_bends(walk):
    # The drift is 1/delay: a longer one changes it by 1 at most, a shorter one without limit.
    change = np.sqrt(walk.noncentrality / (DRIFT @ DRIFT / S))
    assert change < 0.95  # else a longer delay could never be seen, and this shows nothing
    k = walk.place("parameter", "delay")
    low, high = unseen(walk)[k]
    # Sizes are sought until √λ is within 5 % and then scaled: the change of the drift is, too, within its square.
    for size in (low, high):
        assert abs(1.0 / (1.0 + size) - 1.0) == pytest.approx(change, rel=0.06)
    assert high > 1.2 * -low
    assert visible(walk)[k] == pytest.approx(-low)
    assert walk.faults[k].nonlinearity > 0.1 > 1e-6 > walk.faults[0].nonlinearity
    # What it does to the state is what that change of the drift does, not what the derivative says.
    assert walk.bounds.bias[-1, 0] == pytest.approx(
        max(abs(responses(walk)[0].states[-1, 0] * unseen(walk)[0, 1]), abs(change * KEPT * DRIFT[-1])), rel=0.06
    )


def test_the_range_of_a_parameter_ends_its_faults():
    tuning = Tuning.of(WALK).set("p.slope", 4.99)
    found = sensitivity("ekf", WALK, tuning, walk_log(), kinds=("parameter",))
    assert unseen(found)[0, 1] == pytest.approx(0.01) and unseen(found)[0, 0] < -0.1
    assert visible(found)[0] == pytest.approx(-unseen(found)[0, 0])


def test_the_noncentrality_passes_the_threshold_with_its_probability():
    for readings, tests, probability in ((86400.0, 17, 0.95), (1e7, 51, 0.5), (100.0, 1, 0.99)):
        h = threshold(readings, tests)
        assert np.exp(-h) == pytest.approx(1.0 / (readings * tests))
        lam = noncentrality(h, norm.ppf(probability))
        assert norm.sf(h, loc=lam / 2.0, scale=np.sqrt(lam)) == pytest.approx(probability)


def test_a_fault_of_the_smallest_visible_size_is_seen():
    """A cumulative sum that knows the fault's shape finds it in 95 %, counted over simulated innovations."""
    found = sensitivity("ekf", WALK, Tuning.of(WALK), walk_log(), kinds=("sensor",), seen_by="best")
    shape = readings(found, responses(found)[0].whitened)[:, 0] * visible(found)[0]
    runs = 2000
    e = np.random.default_rng(3).normal(size=(runs, N)) + shape
    ratios = np.concatenate([np.zeros((runs, 1)), np.cumsum(shape * e - 0.5 * shape**2, axis=1)], axis=1)
    passed = (ratios - np.minimum.accumulate(ratios, axis=1)).max(axis=1) >= found.h[0]
    assert passed.sum() >= binom.ppf(1e-4, runs, 0.95)


def test_the_bank_sees_a_shift_of_a_white_row_with_the_probability_asked_for():
    """Its sums over simulated e, run here by themselves: log densities of the shifted and the white one."""
    n, runs, h, z = 4000, 1000, 16.0, norm.ppf(0.95)
    row = np.full((n, 1), 1.0)
    tests = FaultTests(np.array([h]), z, np.ones(n, bool), (np.arange(n),), (0,), no_baseline(WALK), True)
    size = tests.multiple(row, row)
    # The best test has no lower bound for how small a lasting shift may be; the bank's smallest is 0.2, half of it too.
    assert max(0.1, tests.optimal_multiple(row)) < size < 2.0 * tests.optimal_multiple(row)
    # Of a change that a float64 cannot square, as that of a diverged fold, any share is detected.
    assert tests.multiple(1e200 * row, 1e200 * row) == 0.0
    e = np.random.default_rng(29).normal(size=(runs, n)) + size
    seen = np.zeros(runs, bool)
    for shift in RATIOS[RATIOS[:, 3] != 0.0, 3]:
        ratios = norm.logpdf(e, loc=shift) - norm.logpdf(e)
        sums = np.concatenate([np.zeros((runs, 1)), np.cumsum(ratios, axis=1)], axis=1)
        seen |= (sums - np.minimum.accumulate(sums, axis=1)).max(axis=1) >= h
    assert seen.sum() >= binom.ppf(1e-4, runs, 0.95)


def test_deviations_agree_with_the_spread_of_fitted_parameters():
    """Maximum likelihood over simulated logs; the standard error of a deviation from n logs is 1/√(2n) = 4.6 %."""
    rng = np.random.default_rng(5)
    tuning = Tuning.of(COUPLED)
    true = tuning.p[:2].copy()
    fitted = []
    logs = [simulate(rng, 200)[0] for _ in range(240)]

    def misfit(scaled, log):
        p = tuning.p.copy()
        p[:2] = true * scaled
        track = fold("ekf", COUPLED, Tuning(COUPLED, tuning.q, tuning.r, p, tuning.used), log)
        return -np.nansum(track.log_likelihood)

    for log in logs:
        fitted.append(minimize(misfit, np.ones(2), args=(log,), method="BFGS", options={"gtol": 1e-2}).x * true)
    found = sensitivity("ekf", COUPLED, tuning, logs[0], kinds=("parameter",))
    told = found.among([found.place("parameter", "exchange"), found.place("parameter", "uptake")])
    # 20 % is four of its standard errors.
    np.testing.assert_allclose(np.std(fitted, axis=0), told.deviation, rtol=0.2)
    spread = np.corrcoef(np.array(fitted).T)[0, 1]
    # Fisher's z is normal with deviation 1/√(n - 3) = 0.065.
    assert np.arctanh(spread) == pytest.approx(np.arctanh(told.correlation[0, 1]), abs=4 * 0.065)
    # Each alone would be told better: they are told together.
    assert np.all(told.deviation > 1.05 * told.alone)


def faulty(rng, n, nudge, size):
    """A log of an asset with a fault, and its true states at the readings."""
    p, sensor, given = Tuning.of(COUPLED).p.copy(), 0.0, [0.0, 0.0]
    if nudge.kind == "sensor":
        sensor = size
    elif nudge.kind == "input":
        given[COUPLED.input_names.index(nudge.name)] = size
    else:
        p[[item.name for item in COUPLED.parameters].index(nudge.name)] += size
    return simulate(rng, n, p, sensor, given)


@pytest.mark.parametrize("seen_by", ["bank", "best"])
def test_errors_under_unseen_faults_stay_below_the_bound(seen_by):
    rng = np.random.default_rng(7)
    n, runs, tuning = 150, 500, Tuning.of(COUPLED)
    log, _ = simulate(rng, n)
    found = sensitivity("ekf", COUPLED, tuning, log, seen_by=seen_by)
    assert np.all(np.isfinite(found.bounds.bound[-1]))
    np.testing.assert_array_equal(found.bounds.bound[-1], found.bounds.bias[-1] + norm.ppf(0.975) * found.std[-1])
    rows = np.flatnonzero(np.isfinite(responses(found)[0].innovation[:, 0]))
    inside = beyond = 0
    for _ in range(runs):
        k = rng.integers(len(found.nudges))
        log, xs = faulty(rng, n, found.nudges[k], rng.uniform(*unseen(found)[k]))
        track = fold("ekf", COUPLED, tuning, log)
        j, at = rng.integers(2), rng.integers(n)
        error = abs(track.mean[rows[at], j] - xs[at, j])
        inside += error <= found.bounds.bound[rows[at], j]
        beyond += error > norm.ppf(0.975) * track.std[rows[at], j]
    # Fewer would come about once in a thousand, if 95 % were inside.
    assert inside >= binom.ppf(1e-3, runs, 0.95)
    # The filter's own band does not hold them: the faults matter.
    assert beyond > binom.ppf(0.999, runs, 0.05)


def test_the_worst_fault_is_as_bad_as_the_bound_says():
    rng = np.random.default_rng(19)
    n, runs, tuning = 150, 100, Tuning.of(COUPLED)
    found = sensitivity("ekf", COUPLED, tuning, simulate(rng, n)[0])
    for j in range(2):
        k = found.bounds.cause[-1][j]
        # A bias of the sensor: what it does is linear in it, whatever the log.
        assert found.nudges[k].kind == "sensor"
        for end in unseen(found)[k]:
            errors = []
            for _ in range(runs):
                log, xs = faulty(rng, n, found.nudges[k], end)
                errors.append(fold("ekf", COUPLED, tuning, log).mean[-1, j] - xs[-1, j])
            assert abs(np.mean(errors)) == pytest.approx(
                found.bounds.bias[-1][j], abs=4.0 * found.std[-1, j] / np.sqrt(runs)
            )


def test_rows_that_share_an_uncertain_state_are_told_together():
    """Against F = BᵀC⁻¹B, C the covariance of all readings at once: their rows are far from independent."""
    n = 20
    log = Log.of(TWICE)
    log.add("level", np.arange(n), np.random.default_rng(23).normal(size=(n, 2)))
    found = sensitivity("ekf", TWICE, Tuning.of(TWICE), log)
    steps = np.arange(n)
    walk = 1.0 + Q * np.minimum(steps[:, None], steps)
    cov = np.kron(walk, np.ones((2, 2))) + np.kron(np.eye(n), np.diag([R, 0.5 * R]))
    biases = np.kron(np.ones((n, 1)), np.eye(2))
    np.testing.assert_allclose(found.fisher, biases.T @ np.linalg.solve(cov, biases), rtol=1e-8)


def test_the_bank_sees_faults_of_the_smallest_visible_size():
    rng = np.random.default_rng(17)
    n, runs, tuning = 150, 60, Tuning.of(COUPLED)
    found = sensitivity("ekf", COUPLED, tuning, simulate(rng, n)[0])
    best = sensitivity("ekf", COUPLED, tuning, simulate(rng, n)[0], seen_by="best")
    assert np.all(visible(found) >= visible(best) * 0.9)
    for k, nudge in enumerate(found.nudges):
        low, high = unseen(found)[k]
        size = high if high == visible(found)[k] else low
        assert abs(size) == visible(found)[k]
        said = {
            factor: sum(
                bool(np.any(fold("ekf", COUPLED, tuning, faulty(rng, n, nudge, factor * size)[0]).alarms))
                for _ in range(runs)
            )
            for factor in (0.25, 1.0)
        }
        assert said[1.0] >= binom.ppf(1e-3, runs, 0.95), nudge.name
        # A quarter of it has a sixteenth of the noncentrality: it should hardly ever be seen.
        assert said[0.25] <= 0.1 * runs, nudge.name


def test_what_was_refused_stays_refused():
    log = walk_log()
    value = log.value[: log.n]
    spike = np.flatnonzero(log.kind[: log.n] == READING)[30]
    value[spike, 0] += 10.0
    tuning = Tuning.of(WALK).set("gate", 1.0 - 1e-9)
    assert np.flatnonzero(fold("ekf", WALK, tuning, log).verdict == GATED).tolist() == [spike]
    found = sensitivity("ekf", WALK, tuning, log)
    value[spike, 0] = np.nan
    without = sensitivity("ekf", WALK, Tuning.of(WALK), log)
    np.testing.assert_array_equal(found.fisher, without.fisher)
    np.testing.assert_array_equal(found.bounds.bound[-1], without.bounds.bound[-1])
    assert np.isnan(responses(found)[0].innovation[spike, 0])


def test_the_last_part_of_a_log_is_that_log_from_a_base():
    log, _ = simulate(np.random.default_rng(11), 1500)
    tuning = Tuning.of(COUPLED)
    found = sensitivity("ekf", COUPLED, tuning, log, most=1000)
    whole = folded("ekf", COUPLED, log, tuning)
    at, base = whole.base_at(log.n - 1000)
    assert (found.first, len(found.t)) == (at, log.n - at) and at > 0
    rest = log.copy()
    rest.drop_front(at)
    again = sensitivity("ekf", COUPLED, tuning, rest, base=base, executor=None)
    np.testing.assert_array_equal(found.fisher, again.fisher)
    np.testing.assert_array_equal(found.bounds.bound, again.bounds.bound)


def test_a_sensor_held_out_is_neither_nudged_nor_a_witness():
    log = walk_log()
    found = sensitivity("ekf", WALK, Tuning.of(WALK).set("use.level", False), log)
    assert found.nudges[0].kind == "input"
    # Nobody sees it, and the drift carries the state away without limit.
    assert np.all(found.fisher == 0.0) and np.isinf(visible(found)[0])
    assert np.isinf(found.bounds.bound[-1][0]) and found.bounds.cause[-1][0] == 0


def test_particles_are_replaced():
    log, _ = simulate(np.random.default_rng(13), 60)
    tuning = Tuning.of(COUPLED)
    found = sensitivity("pf", COUPLED, tuning, log)
    assert found.estimator == "ekf" and "pf is a Monte Carlo filter" in found.note
    np.testing.assert_array_equal(found.fisher, sensitivity("ekf", COUPLED, tuning, log).fisher)


def test_what_is_too_large_or_silent_is_refused_with_a_reason():
    model = MODELS["thermal_field"]
    found = sensitivity("enkf", model, Tuning.of(model), Log.of(model))
    assert "states; sensitivities are computed up to 64" in found.reason and not found.faults
    assert "no measurement" in sensitivity("ekf", WALK, Tuning.of(WALK), Log.of(WALK)).reason
