"""Particle filters against a dense joint Gaussian, against themselves in other pieces, and where they must not fail."""

from dataclasses import replace
from functools import lru_cache

import numba
import numpy as np
import pytest

from estimators.fold import Fold, fold
from estimators.log import READING, TICK
from estimators.model.state_space import Noise, Row, Sensor, State
from estimators.particle.cloud import RECOVERIES, block, members
from estimators.track import FAILED, GATED, HELD_OUT, MISSING, USED
from estimators.tuning import Tuning
from tests.estimators.linear_models import JointGaussian, assert_mean, random_linear, random_log
from tests.models import first_state, first_state_squared, level_model
from tests.support import assert_same, folded, log_of

NAMES = ("pf", "pf-reg", "pf-ekf", "apf")
EXACT = ("pf", "pf-ekf", "apf")
"""Those whose limit is the posterior itself; the kernel of pf-reg smooths it."""

STILL = (Noise("s", "m²/s", 0.0),)


@lru_cache
def problem():
    """A linear model, a log of readings drawn from it, and the exact answer."""
    rng = np.random.default_rng(4)
    matrices = random_linear(rng, 2, 1)
    log = random_log(rng, matrices, 8)
    joint = JointGaussian(matrices, log)
    cov = joint.H @ joint.cov @ joint.H.T + joint.R
    y = iter(rng.multivariate_normal(joint.H @ joint.mean + joint.offset, cov))
    events = log.events
    for k in range(log.n):
        if events.kind[k] == READING:
            for row in np.flatnonzero(np.isfinite(events.value[k])):
                log.value[k, row] = next(y)
    return matrices, log, JointGaussian(matrices, log)


def tracks(name, n, seeds, **options):
    matrices, log, _ = problem()
    tuning = Tuning.of(matrices.model).with_options({"particles": n, **options})
    return [fold(name, matrices.model, replace(tuning, seed=seed), log) for seed in range(seeds)]


def scalar(**changes):
    return replace(level_model({"y": 0.04}, 0.3, state="s", mean=2.0, std=0.5), **changes)


def root(x, u, p, out):
    out[0] = np.sqrt(x[0])


def relative(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt * x[0] * x[0]


def within_half(y, x, u, p, r):
    return 0.0 if abs(y[0] - x[0]) < 0.5 else -np.inf


@pytest.mark.parametrize("name", EXACT)
def test_estimates_are_within_their_monte_carlo_error(name):
    _, log, joint = problem()
    used = np.ones(3, bool)
    runs = tracks(name, 1000, 40)
    for k in joint.events:
        mean, cov = joint.filtered(k, used)
        # A bias of 1/N of the posterior's spread.
        assert_mean([run.mean[k] for run in runs], mean, 20 / 1000 * np.sqrt(np.diag(cov)))
        spread = np.mean([run.std[k] ** 2 for run in runs], axis=0)
        assert np.all(np.abs(spread / np.diag(cov) - 1) < 0.1), k
        nu, S = joint.predictive(k, used)
        nis = nu @ np.linalg.solve(S, nu)
        assert abs(np.mean([run.nis[k] for run in runs]) - nis) < 0.05 * (nis + nu.size)


@pytest.mark.parametrize("name", EXACT)
def test_the_likelihood_is_unbiased(name):
    _, _, joint = problem()
    exact = joint.log_likelihood(np.ones(3, bool))
    ratio = np.array([np.exp(np.nansum(run.log_likelihood) - exact) for run in tracks(name, 300, 300)])
    assert ratio.std() / np.sqrt(len(ratio)) < 0.1
    assert_mean(ratio, 1.0)


@pytest.mark.parametrize("scheme", range(4))
def test_every_scheme_gives_the_posterior(scheme):
    _, _, joint = problem()
    last = joint.events[-1]
    mean, cov = joint.filtered(last, np.ones(3, bool))
    runs = tracks("pf", 1000, 40, resampling=scheme, fraction=1.0)
    assert_mean([run.mean[last] for run in runs], mean, 20 / 1000 * np.sqrt(np.diag(cov)))


def same_in_pieces_and_on_any_threads(name, model, tuning, log):
    """Fold at once, in pieces on one thread, and again on all threads; return the track, which is the same."""
    whole = fold(name, model, tuning, log)
    threads = numba.get_num_threads()
    pieces = Fold(name, model, tuning, log)
    try:
        numba.set_num_threads(1)
        while pieces.advance(3):
            pass
        assert_same(pieces.track, whole)
        numba.set_num_threads(threads)
        pieces.rewind(0)
        pieces.advance()
        assert_same(pieces.track, whole)
    finally:
        numba.set_num_threads(threads)
    return whole


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n", [500, 20_000])
def test_any_pieces_and_any_threads_give_the_same_bits(name, n):
    matrices, log, _ = problem()
    tuning = Tuning.of(matrices.model).with_options({"particles": n})
    whole = same_in_pieces_and_on_any_threads(name, matrices.model, tuning, log)
    other = fold(name, matrices.model, replace(tuning, seed=1), log)
    assert not np.array_equal(whole.mean, other.mean)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("changes", "variance"), [({}, 0.3), ({"max_step": 0.1}, 0.3), ({"Q": relative}, 0.3 * (2.0**2 + 0.25))]
)
def test_noise_is_of_each_substep_and_of_each_particle(name, changes, variance):
    """Ten steps of the same draws would make ten times the variance of independent ones; 0.3 x² is each particle's."""
    model = scalar(**changes)
    track = fold(name, model, Tuning.of(model).with_options({"particles": 1e5}), log_of(1, (0, TICK, 0), (1, TICK, 0)))
    # A variance of 10⁵ draws is right to √(2/10⁵); of a kurtosis below 4, as with 0.3 x², to √(3/10⁵).
    std = np.sqrt((3 if "Q" in changes else 2) / 1e5)
    assert abs(track.std[1, 0] ** 2 / (0.25 + variance) - 1) < 5 * std
    assert abs(track.mean[1, 0] - 2.0) < 5 * np.sqrt((0.25 + variance) / 1e5)


def test_the_kernel_keeps_mean_and_covariance():
    """Within four deviations of the moments of 1e5 draws."""
    model = scalar(noises=STILL)
    log = log_of(1, (0, READING, 2.3), (1, TICK, 0))
    tuning = Tuning.of(model).with_options({"particles": 1e5, "fraction": 1.0, "bandwidth": 2.0})
    run = folded("pf-reg", model, log, tuning)
    mean, std = run.track.mean[:, 0], run.track.std[:, 0]
    assert abs(std[0] ** 2 / (0.25 * 0.04 / 0.29) - 1) < 0.05
    assert abs(std[1] ** 2 / std[0] ** 2 - 1) < 4 * np.sqrt(2 / 1e5)
    assert abs(mean[1] - mean[0]) < 4 * std[0] / np.sqrt(1e5)


@pytest.mark.parametrize("variance", [1e-14, 1e-17, 1e-40])
def test_a_sharp_reading_does_not_kill_the_proposals(variance):
    model = scalar(sensors=(Sensor("y", (Row("y", "m", variance),), h=first_state),))
    track = fold("pf-ekf", model, Tuning.of(model), log_of(1, (0, TICK, 0), (1, READING, 2.3)))
    assert track.verdict[1] == USED and track.mean[1, 0] == pytest.approx(2.3, abs=1e-7)


@pytest.mark.parametrize("name", NAMES)
def test_two_peaks_stay_alive_and_are_reported(name):
    """|x| is seen, its sign is not: both signs stay as likely as the prior made them."""
    rng = np.random.default_rng(0)
    model = scalar(
        states=(State("s", "m", 0.0, 2.0),), noises=(Noise("s", "m²/s", 1e-3),),
        sensors=(Sensor("y", (Row("y", "m²", 0.3),), h=first_state_squared),),
    )  # fmt: skip
    log = log_of(1, *((k, READING, 4.0 + 0.5 * rng.standard_normal()) for k in range(20)))
    run = folded(name, model, log, options={"particles": 20_000})
    first, second = run.peaks()
    assert abs(abs(first.mean[0]) - 2.0) < 0.15 and abs(first.mean[0] + second.mean[0]) < 0.1
    # Half each, but for what 20 resamplings of a cloud of 20,000 let the share wander.
    assert abs(first.weight - 0.5) < 5 * np.sqrt(20 * 0.25 / 20_000) + 0.02
    assert abs(run.track.mean[-1, 0]) < 0.3 and run.track.std[-1, 0] > 1.8


@pytest.mark.parametrize("name", ["pf", "pf-reg", "apf"])
def test_a_sensor_may_have_a_likelihood_of_its_own(name):
    model = scalar(sensors=(Sensor("y", (Row("y", "m", 0.04),), h=first_state, log_likelihood=within_half),))
    track = fold(name, model, Tuning.of(model).with_options({"particles": 1e5}), log_of(1, (0, READING, 2.2)))
    from scipy.stats import norm, truncnorm

    a, b = (1.7 - 2.0) / 0.5, (2.7 - 2.0) / 0.5
    law = truncnorm(a, b, 2.0, 0.5)
    inside = norm.cdf(b) - norm.cdf(a)
    assert track.verdict[0] == USED
    assert abs(track.mean[0, 0] - law.mean()) < 5 * law.std() / np.sqrt(inside * 1e5)
    assert abs(track.std[0, 0] / law.std() - 1) < 5 / np.sqrt(2 * inside * 1e5)
    assert abs(np.exp(track.log_likelihood[0]) - inside) < 5 * np.sqrt(inside / 1e5)


@pytest.mark.parametrize("name", NAMES)
def test_a_cloud_that_explains_nothing_fails_visibly_and_recovers(name):
    model = scalar(sensors=(Sensor("y", (Row("y", "m", 0.04),), h=first_state, log_likelihood=within_half),))
    log = log_of(1, *((0.01 * k, READING, 30.0) for k in range(40)))
    run = folded(name, model, log, options={"particles": 2000})
    verdict = run.track.verdict
    assert verdict[0] == FAILED and verdict[-1] == USED
    assert run._now.state[RECOVERIES] == np.sum(verdict == FAILED)
    for column in (run.track.mean, run.track.std, run.moments()[0], run.points()):
        assert np.all(np.isfinite(column))
    assert abs(run.track.mean[-1, 0] - 30.0) < 1.0
    # A likelihood of zero has no logarithm that a sum of them could use.
    assert np.all(np.isnan(run.track.log_likelihood[verdict == FAILED]))
    assert np.all(np.isfinite(run.track.log_likelihood[verdict == USED]))


@pytest.mark.parametrize("name", NAMES)
def test_a_reading_without_a_value_and_a_question_change_nothing(name):
    """Nor how often the filter drew: what comes after it has its bits as before. It is the last of its time."""
    model = scalar()
    tuning = Tuning.of(model).with_options({"particles": 200})
    first, *others = (0, READING, 2.1), (1, READING, 2.4), (2, READING, 2.2)
    plain = fold(name, model, tuning, log_of(1, first, *others))
    missed = fold(name, model, tuning, log_of(1, first, (1, READING, np.nan), *others, (2, READING, np.nan)))
    assert list(missed.verdict) == [USED, USED, MISSING, USED, MISSING]
    assert np.array_equal(plain.mean[[0, 1, 1, 2, 2]], missed.mean)
    assert np.array_equal(plain.log_likelihood, missed.log_likelihood[[0, 1, 3]])
    asked = fold(name, model, tuning, log_of(1, first, (0.5, TICK, 0), (0.9, TICK, 0), *others))
    assert np.array_equal(plain.mean, asked.mean[[0, 3, 4]])


@pytest.mark.parametrize(("key", "value", "verdict"), [("gate", 0.999, GATED), ("use.y", False, HELD_OUT)])
@pytest.mark.parametrize("name", NAMES)
def test_a_reading_that_is_not_used_moves_no_particle(name, key, value, verdict):
    """The estimate is what a question at that time is answered with where no reading comes."""
    model = scalar()
    tuning = Tuning.of(model).with_options({"particles": 200}).set(key, value)
    asked = fold(name, model, tuning, log_of(1, (0, READING, 2.1), (1, TICK, 0)))
    track = fold(name, model, tuning, log_of(1, (0, READING, 2.1), (1, READING, 9.0)))
    assert track.verdict[1] == verdict
    # Moments may be added up in another order.
    np.testing.assert_allclose(track.mean[1], asked.mean[1], rtol=1e-12)
    np.testing.assert_allclose(track.std[1], asked.std[1], rtol=1e-9)


@pytest.mark.parametrize("name", EXACT)
def test_the_likelihood_of_a_bent_sensor_is_that_of_quadrature(name):
    """y = 0 = x² of x ~ N(2, 0.25 + 0.3) after a step, where h is least straight: linearised, 29 % too likely.

    What apf's first stage foresees by that, its second must make up for. The mean of 100 clouds of 5000 is right to
    its standard error, under 1.5 %.
    """
    model = scalar(sensors=(Sensor("y", (Row("y", "m²", 0.3),), h=first_state_squared),))
    log = log_of(1, (0, TICK, 0), (1, READING, 0.0))
    tuning = Tuning.of(model).with_options({"particles": 5000})
    runs = [fold(name, model, replace(tuning, seed=seed), log) for seed in range(100)]
    x = np.linspace(-4.0, 8.0, 120_001)
    density = np.exp(-0.5 * (x - 2.0) ** 2 / 0.55 - 0.5 * x**4 / 0.3) / (2 * np.pi * np.sqrt(0.55 * 0.3))
    likelihood = np.array([np.exp(run.log_likelihood[1]) for run in runs]) / (np.sum(density) * (x[1] - x[0]))
    mean = np.average(x, weights=density)
    std = np.sqrt(np.average((x - mean) ** 2, weights=density))
    error = likelihood.std(ddof=1) / np.sqrt(len(runs))
    assert error < 0.015 and abs(likelihood.mean() - 1.0) < 5 * error
    means = np.array([run.mean[1, 0] for run in runs])
    # A bias of 1/N of the posterior's spread comes on top.
    assert abs(means.mean() - mean) < 5 * means.std(ddof=1) / np.sqrt(len(runs)) + 20 / 5000 * std


@pytest.mark.parametrize("name", NAMES)
def test_particles_where_the_sensor_says_no_number_are_out(name):
    """y = √x, of which a sixth of the prior has none: the posterior is that of the others, by quadrature."""
    model = scalar(states=(State("s", "m", 0.5, 0.5),), sensors=(Sensor("y", (Row("y", "m", 0.04),), h=root),))
    run = folded(name, model, log_of(1, (0, READING, 0.9)), options={"particles": 20_000})
    x = np.linspace(0.0, 4.0, 40_001)
    density = np.exp(-0.5 * ((x - 0.5) / 0.5) ** 2 - 0.5 * ((0.9 - np.sqrt(x)) / 0.2) ** 2)
    mean = np.average(x, weights=density)
    std = np.sqrt(np.average((x - mean) ** 2, weights=density))
    assert run.track.verdict[0] == USED
    # The effective sample is a third of the cloud.
    assert abs(run.track.mean[0, 0] - mean) < 5 * std / np.sqrt(20_000 / 3)
    assert abs(run.track.std[0, 0] / std - 1) < 5 / np.sqrt(2 * 20_000 / 3)
    assert np.all(np.isfinite(run.points()))


def test_copies_of_one_particle_widen_too():
    """No spread is left to double, nor process noise to bring it back; it takes the seed 23 doublings to reach 0.5."""
    sharp = Sensor("y", (Row("y", "m", 0.04),), h=first_state, log_likelihood=within_half)
    model = scalar(sensors=(sharp,), noises=STILL)
    log = log_of(1, *((0.01 * k, READING, 2.0 if k == 0 else 4.0) for k in range(60)))
    run = folded("pf", model, log, options={"particles": 20}, stop=1)
    block(run.options, run._now.state, 1)[:] = 2.0
    run.advance()
    failed = int((run.track.verdict == FAILED).sum())
    assert 10 < failed < 40 and np.all(run.track.verdict[1 + failed :] == USED)
    assert abs(run.track.mean[-1, 0] - 4.0) < 0.5


def test_snapshots_of_large_states_keep_to_their_memory(monkeypatch):
    model = scalar()
    log = log_of(1, *((0.01 * k, READING, 2.0) for k in range(3000)))
    tuning = Tuning.of(model).with_options({"particles": 500})
    plain = folded("pf", model, log, tuning)
    monkeypatch.setattr("estimators.snapshots.MAX_SNAPSHOT_BYTES", 10 * plain._now.state.nbytes)
    small = folded("pf", model, log, tuning)
    assert len(plain.snapshots._kept) > 20
    assert sum(kept.state.nbytes for kept in small.snapshots._kept.values()) <= 12 * plain._now.state.nbytes
    small.rewind(2000)
    assert small.n <= 2000
    small.advance()
    assert np.array_equal(small.track.mean, plain.track.mean)


def test_points_are_drawn_by_weight():
    model = scalar()
    run = folded("pf", model, log_of(1, (0, READING, 2.6)), options={"particles": 1e5, "fraction": 0})
    points, (mean, cov) = run.points(), run.moments()
    assert points.shape == (2000, 1) and members(run.options) == 100_000
    assert abs(points.mean() - mean[0]) < 5 * np.sqrt(cov[0, 0] / 2000)
    assert abs(points.var() / cov[0, 0] - 1) < 5 * np.sqrt(2 / 2000)


@pytest.mark.parametrize("name", ("pf", "pf-ekf", "apf"))
@pytest.mark.parametrize("scheme", range(4))
def test_siblings_stand_side_by_side(name, scheme):
    """Nothing moves but by resampling: each particle is a copy of one of the prior's, in the order of these."""
    model = scalar(noises=STILL)
    options = {"particles": 3000, "resampling": scheme} | ({} if name == "apf" else {"fraction": 1.0})
    run = folded(name, model, log_of(1, (0, TICK, 0), (1, READING, 2.3)), options=options, stop=1)
    before = block(run.options, run._now.state, 1)[:, 0].copy()
    run.advance()
    order = np.argsort(before)
    ancestors = order[np.searchsorted(before[order], block(run.options, run._now.state, 1)[:, 0])]
    assert np.array_equal(before[ancestors], block(run.options, run._now.state, 1)[:, 0])
    assert 100 < np.unique(ancestors).size < 2900
    assert np.all(np.diff(ancestors) >= 0)


def test_the_kernel_may_move_duplicates_only():
    """Without process noise a particle that has no sibling is a copy of one before; each of several is not."""
    model = scalar(noises=STILL)
    clouds = {}
    for name, options in (
        ("pf", {}), ("pf-reg", {"jitter": 1}), ("pf-reg", {"jitter": 0}), ("pf-reg", {"jitter": 1, "bandwidth": 0.0}),
    ):  # fmt: skip
        tuning = Tuning.of(model).with_options({"particles": 3000, "fraction": 1.0, **options})
        run = folded(name, model, log_of(1, (0, READING, 2.3)), tuning)
        clouds[name, *options.values()] = block(run.options, run._now.state, 1)[:, 0].copy()
    drawn, moved, all_moved = clouds["pf",], clouds["pf-reg", 1], clouds["pf-reg", 0]
    _, family, size = np.unique(drawn, return_inverse=True, return_counts=True)
    alone = size[family] == 1
    assert 300 < alone.sum() < 2700
    assert np.array_equal(moved[alone], drawn[alone])
    assert np.array_equal(clouds["pf-reg", 1, 0.0], drawn) and not np.any(all_moved == drawn)
    # Their kernel is that of all, h times the posterior's standard deviation, but they do not shrink to the mean.
    h = 0.5 * (4 / 3) ** 0.2 * 3000**-0.2
    mean = (all_moved - moved)[~alone] / (1.0 - np.sqrt(1.0 - h * h)) + drawn[~alone]
    assert np.ptp(mean) < 1e-9 and abs(mean[0] - drawn.mean()) < 5.0 * np.std(drawn) / 3000**0.5
    assert abs(np.std(moved[~alone] - drawn[~alone]) / (h * np.std(drawn)) - 1) < 0.1
