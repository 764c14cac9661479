"""The Rao-Blackwellised filter against the Kalman filter, the exact mixture over all mode sequences, and pf."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from estimators.errors import EstimatorError, ModelError
from estimators.fold import Fold, fold
from estimators.log import READING, TICK, Events
from estimators.model.state_space import Jump, Noise, Row, Sensor, State, StateSpaceModel
from estimators.particle.cloud import RECOVERIES
from estimators.track import FAILED, USED
from estimators.tuning import Tuning
from tests.estimators.linear_models import assert_mean, random_linear, random_log
from tests.estimators.particle.test_particle_filters import same_in_pieces_and_on_any_threads
from tests.support import SECOND, folded, log_of

# A jump-Markov linear system: a walk that drifts in mode 1, seen by a sensor that is biased there.
STAY = ((0.9, 0.1), (0.2, 0.8))
DRIFT, BIAS, Q, R, DAMP = 1.5, 0.7, 0.05, 0.3, (0.95, 0.8)


def switched(x, u, p, dt, out):
    out[0] = (0.95 - 0.15 * x[2]) * x[0] + dt * x[1] + dt * 1.5 * x[2]
    out[1] = x[1]
    out[2] = x[2]


def chances(x, u, p, dt, out):
    if x[2] < 0.5:
        out[0], out[1] = 0.9, 0.1
    else:
        out[0], out[1] = 0.2, 0.8


def biased(x, u, p, out):
    out[0] = x[0] + 0.7 * x[2]


def jump_model(**changes):
    parts = dict(
        name="switched", title="",
        states=(State("s", "m", 0.0, 1.0), State("v", "m/s", 0.5, 0.4), State("m", "", 0.3, 0.46)),
        noises=(Noise("s", "m²/s", 0.05), Noise("v", "m²/s³", 0.02)), f=switched,
        sensors=(Sensor("y", (Row("y", "m", 0.3),), h=biased),),
        jump=Jump("m", ("rest", "drift"), chances), conditionally_linear=("s", "v"),
    )  # fmt: skip
    return StateSpaceModel(**(parts | changes))


READINGS = (0.4, 1.6, 3.1, 4.4, 3.9, 4.2)


def after_prior(*values, width=3, every=1.0):
    """A log of a tick at 0, where the prior holds, and then a reading `every` so many seconds."""
    return log_of(width, (0, TICK, ()), *(((k + 1) * every, READING, value) for k, value in enumerate(values)))


def exact_mixture():
    """Posterior after every reading and log-likelihood, by a Kalman filter for each of the 2⁷ mode sequences."""
    parts = []
    for first in (0, 1):
        parts.append(([first], np.log((0.7, 0.3)[first]), np.array([0.0, 0.5]), np.diag([1.0, 0.16])))
    answers, total = [], 0.0
    for y in READINGS:
        grown = []
        for (path, weight, mean, cov), mode in product(parts, (0, 1)):
            F = np.array([[DAMP[mode], 1.0], [0.0, 1.0]])
            m = F @ mean + np.array([DRIFT * mode, 0.0])
            P = F @ cov @ F.T + np.diag([Q, 0.02])
            H = np.array([1.0, 0.0])
            S = H @ P @ H + R
            nu = y - H @ m - BIAS * mode
            K = P @ H / S
            log_w = weight + np.log(STAY[path[-1]][mode]) - 0.5 * (nu * nu / S + np.log(2 * np.pi * S))
            grown.append(([*path, mode], log_w, m + K * nu, P - np.outer(K, K) * S))
        logs = np.array([part[1] for part in grown])
        norm = np.logaddexp.reduce(logs)
        total += norm
        parts = [(path, log_w - norm, m, P) for path, log_w, m, P in grown]
        w = np.exp(logs - norm)
        means = np.array([[*m, path[-1]] for path, _, m, _ in parts])
        mean = w @ means
        cov = np.einsum("k,ki,kj->ij", w, means - mean, means - mean)
        cov[:2, :2] += np.einsum("k,kij->ij", w, np.array([P for *_, P in parts]))
        answers.append((mean, cov))
    return answers, total


def runs(model, n, seeds, log, name="rbpf", **options):
    tuning = Tuning.of(model).with_options({"particles": n, **options})
    return [fold(name, model, replace(tuning, seed=seed), log) for seed in range(seeds)]


@pytest.mark.parametrize(("nx", "correlated"), [(1, False), (3, False), (3, True)])
def test_with_nothing_to_sample_it_is_the_kalman_filter(nx, correlated):
    rng = np.random.default_rng(nx)
    matrices = random_linear(rng, nx, 1, correlated=correlated)
    log = random_log(rng, matrices, 40)
    model = replace(matrices.model, conditionally_linear=matrices.model.state_names)
    exact = folded("kf", model, log)
    run = folded("rbpf", model, log, options={"particles": 7})
    for column in ("mean", "std", "innovation", "innovation_std", "nis", "log_likelihood"):
        a, b = getattr(exact.track, column), getattr(run.track, column)
        assert np.allclose(a, b, rtol=1e-9, atol=1e-9, equal_nan=True), column
    assert np.array_equal(exact.track.verdict, run.track.verdict)
    assert np.allclose(exact.moments()[1], run.moments()[1], rtol=1e-9, atol=1e-10)


def test_a_jump_markov_system_gives_the_mixture_over_all_mode_sequences():
    answers, total = exact_mixture()
    model, log = jump_model(), after_prior(*READINGS)
    few = runs(model, 400, 60, log)
    for k, (mean, cov) in enumerate(answers, start=1):
        # A bias of 1/N of the posterior's spread.
        assert_mean([run.mean[k] for run in few], mean, 5 / 400 * np.sqrt(np.diag(cov)))
        assert_mean([run.std[k] ** 2 for run in few], np.diag(cov), 5 / 400 * np.diag(cov))
    assert_mean([np.exp(np.nansum(run.log_likelihood) - total) for run in few], 1.0)

    def off(n):
        last = np.array([run.mean[-1] - answers[-1][0] for run in runs(model, n, 60, log)])
        return np.sqrt(np.mean(last**2 / np.diag(answers[-1][1])))

    # The error of an RMS over 60 runs of 3 dependent states is near 1/√(2·60) = 9 %, of a ratio of two 13 %.
    assert 4 / 1.6 < off(100) / off(1600) < 4 * 1.6


def test_the_innovation_is_that_of_the_mixture():
    """Of the first reading, by hand: two modes, each with a Gaussian."""
    run = fold(
        "rbpf", jump_model(), Tuning.of(jump_model()).with_options({"particles": 100_000}), after_prior(READINGS[0])
    )
    share = 0.7 * 0.1 + 0.3 * 0.8
    F = [np.array([[d, 1.0], [0.0, 1.0]]) for d in DAMP]
    P = [F[m] @ np.diag([1.0, 0.16]) @ F[m].T + np.diag([Q, 0.02]) for m in (0, 1)]
    means = np.array([(F[m] @ [0.0, 0.5])[0] + (DRIFT + BIAS) * m for m in (0, 1)])
    w = np.array([1 - share, share])
    S = w @ [P[0][0, 0] + R, P[1][0, 0] + R] + w @ means**2 - (w @ means) ** 2
    nu = READINGS[0] - w @ means
    # Only the share of the second mode is sampled, right to √(0.31·0.69/10⁵) = 0.0015.
    assert abs(run.innovation[1, 0] - nu) < 5 * 0.0015 * (means[1] - means[0])
    assert abs(run.innovation_std[1, 0] / np.sqrt(S) - 1) < 0.01
    assert abs(run.nis[1] - nu * nu / S) < 0.02


def turn(x, u, p, dt, out):
    out[0] = 0.6 * x[0] + 1.2 * np.sin(x[0]) + dt * x[1]
    out[1] = 0.9 * x[1] + 0.3 * np.cos(x[0])


def shared_noise(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt
    out[1, 1] = q[1] * dt
    out[0, 1] = 0.6 * np.sqrt(q[0] * q[1]) * dt
    out[1, 0] = out[0, 1]


def both(x, u, p, out):
    out[0] = x[0] * x[0] / 2 + x[1]


def test_what_the_sampled_state_did_tells_of_the_linear_one():
    """Schön's third step, with noise that both share: against pf, which needs none of it. Without it, v is not seen."""
    model = StateSpaceModel(
        name="mixed", title="", states=(State("a", "m", 0.3, 0.5), State("b", "m/s", 0.5, 1.0)), f=turn, Q=shared_noise,
        noises=(Noise("a", "m²/s", 0.05), Noise("b", "m²/s", 0.1)),
        sensors=(Sensor("y", (Row("y", "m", 0.2),), h=both),), conditionally_linear=("b",),
    )  # fmt: skip
    log = after_prior(0.9, 1.2, 0.4, 1.5, 2.2, 2.6, width=2)
    reference = runs(model, 300_000, 2, log, "pf")
    few = runs(model, 1000, 40, log)
    for k in range(1, 7):
        exact, spread = np.mean([run.mean[k] for run in reference], axis=0), reference[0].std[k]
        # pf's own error, of some √(10/300,000) of the spread, and a bias of 1/N.
        assert_mean([run.mean[k] for run in few], exact, 0.02 * spread)
        assert np.all(np.abs(np.mean([run.std[k] for run in few], axis=0) / spread - 1) < 0.03), k
    total = np.mean([np.nansum(run.log_likelihood) for run in reference])
    assert_mean([np.exp(np.nansum(run.log_likelihood) - total) for run in few], 1.0, 0.02)


@pytest.mark.parametrize("n", [300, 5000])
def test_any_pieces_and_any_threads_give_the_same_bits(n):
    model, log = jump_model(), after_prior(*READINGS, *READINGS)
    tuning = Tuning.of(model).with_options({"particles": n})
    same_in_pieces_and_on_any_threads("rbpf", model, tuning, log)


@pytest.mark.parametrize("name", ["pf", "pf-reg", "pf-ekf", "apf"])
def test_other_particle_filters_sample_the_mode(name):
    """Every particle is in one mode, and the mode's probability is the exact one, but for pf-reg's kernel."""
    answers, _ = exact_mixture()
    model, log = jump_model(), after_prior(*READINGS)
    run = folded(name, model, log, options={"particles": 20_000})
    assert set(np.unique(run.points()[:, 2])) == {0.0, 1.0}
    for k, (mean, _) in enumerate(answers, start=1):
        # One run: √(p(1-p)/N) from each of six updates, a few times more by resampling.
        assert abs(run.track.mean[k, 2] - mean[2]) < 0.03, k


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_filters_of_moments_see_the_mode_as_a_number_with_a_jumps_moments(name):
    # So narrow that no sigma point leaves the range, where the chances would be those of its ends.
    model = jump_model(states=(State("s", "m", 0.0, 1.0), State("v", "m/s", 0.5, 0.4), State("m", "", 0.3, 0.15)))
    track = fold(name, model, Tuning.of(model), after_prior(np.nan))
    p = 0.7 * 0.1 + 0.3 * 0.8
    # The mean of the chances; the jump's variance p(1-p), and the prior's, whose mode counts 0.8 - 0.1.
    assert abs(track.mean[1, 2] - p) < 1e-9
    assert abs(track.std[1, 2] ** 2 - (p * (1 - p) + (0.7 * 0.15) ** 2)) < 1e-9


def nan_slopes(x, u, p, out):
    out[0, 0] = np.nan if x[2] > 0.5 else 1.0
    out[0, 1] = 0.0
    out[0, 2] = 0.7


def test_readings_beyond_the_numbers_fail_alone():
    model = jump_model()
    tuning = replace(Tuning.of(model).with_options({"particles": 200}), gate=None)
    log = after_prior(*READINGS[:3], 1e300, *READINGS[3:])
    run = folded("rbpf", model, log, tuning)
    assert run.track.verdict[4] == FAILED and np.all(run.track.verdict[[1, 2, 3, 5, 6, 7]] == USED)
    assert run._now.state[RECOVERIES] == 0
    for column in (run.track.mean, run.track.std, run.points(), run.moments()[1]):
        assert np.all(np.isfinite(column))


def test_slopes_that_are_no_numbers_leave_their_particles_out():
    model = jump_model(sensors=(Sensor("y", (Row("y", "m", 0.3),), h=biased, H=nan_slopes),))
    run = folded("rbpf", model, after_prior(*READINGS), options={"particles": 200})
    assert np.all(run.track.verdict[1:] == USED) and np.all(np.isfinite(run.track.mean))
    assert np.all(run.track.mean[1:, 2] < 1e-12)


def far(x, u, p, dt, out):
    for j in range(3):
        out[j] = x[j]
    if u[0] > 0.5:
        out[0] = np.inf


def test_a_cloud_without_weight_recovers_visibly():
    from estimators.log import INPUT
    from estimators.model.state_space import Input

    model = jump_model(f=far, inputs=(Input("blow", "1"),), jump=Jump("m", ("a", "b"), chances))
    log = after_prior(0.1, 0.2)
    for t, on in ((3, 1.0), (4, 0.0)):
        log.extend(Events.one(t * SECOND, t * SECOND, INPUT, 0, np.array([on]), 3))
    log.extend(Events.one(5 * SECOND, 5 * SECOND, READING, 0, np.array([0.3]), 3))
    run = folded("rbpf", model, log, options={"particles": 100})
    assert run._now.state[RECOVERIES] == 1
    assert np.all(np.isfinite(run.track.mean)) and run.track.verdict[-1] == USED


def test_peaks_are_reported_with_their_weights():
    model, log = jump_model(), after_prior(3.0)
    run = folded("rbpf", model, log, options={"particles": 4000})
    first, second = run.peaks()
    p = run.track.mean[-1, 2]
    assert abs(first.weight - max(p, 1 - p)) < 0.05 and abs(first.weight + second.weight - 1) < 1e-9
    assert abs(first.mean[2] - second.mean[2]) > 0.9


def bent(x, u, p, dt, out):
    out[0] = x[0]
    out[1] = x[1] * x[1]
    out[2] = x[2]


def moved(x, u, p, dt, out):
    out[0] = x[0]
    out[1] = x[1]
    out[2] = 0.0 * x[2]


def lavish(x, u, p, dt, out):
    out[0], out[1] = 0.9, 0.9


def turning(x, u, p, dt, out):
    x[0] = -x[0]
    out[0], out[1] = 0.9, 0.1


def leaning(x, u, p, dt, out):
    out[1] = 1.0 / (1.0 + np.exp(-x[0]))
    out[0] = 1.0 - out[1]


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"f": bent}, "f is not linear in s, v"),
        ({"f": moved}, "f moves the mode m from 1 to 0"),
        ({"jump": Jump("m", ("a", "b"), lavish)}, "jump.chances gives .* which sum to 1"),
        ({"jump": Jump("m", ("a", "b"), turning)}, "jump.chances writes to its argument x"),
        ({"jump": Jump("m", ("a", "b"), leaning)}, "jump.chances depends on s, v"),
        ({"jump": Jump("k", ("a", "b"), chances)}, "jump names 'k', no state"),
        ({"conditionally_linear": ("s", "m")}, "names 'm', the mode"),
        ({"conditionally_linear": ("z",)}, "names 'z', no state"),
        ({"noises": (Noise("m", "1/s", 0.1),)}, "a noise acts on the mode m"),
    ],
)
def test_a_model_that_is_not_what_it_says_is_refused(changes, said):
    with pytest.raises(ModelError, match=said):
        Fold("rbpf", jump_model(**changes), Tuning.of(jump_model(**changes)), after_prior(0.0))


def test_models_that_declare_nothing_are_refused():
    model = jump_model(jump=None, conditionally_linear=())
    with pytest.raises(EstimatorError, match="rbpf needs states that are linear once the others are known"):
        fold("rbpf", model, Tuning.of(model), after_prior(0.0))
