"""Normal scores of particle filters against SciPy's mixture over the cloud, Kalman's innovations, and uniformity."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr, ndtri
from scipy.stats import kstest

from estimators.fold import Fold, fold
from estimators.log import INPUT, READING
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.particle.cloud import block, weights_of
from estimators.track import GATED, HELD_OUT, USED
from estimators.tuning import Tuning
from tests.estimators.linear_models import ROWS, random_linear
from tests.estimators.particle.test_particle_filters import scalar, within_half
from tests.estimators.particle.test_rbpf import R, biased, jump_model
from tests.models import first_state, first_state_squared, unchanged
from tests.support import folded, log_of

MATRICES = random_linear(np.random.default_rng(8), 3, 1)

CLOSE = {"pf": 1e-7, "pf-reg": 1e-7, "pf-ekf": 1e-10, "apf": 1e-10}
"""Error allowed: pf's tails are within 2e-8, which e passes on at less than 1.3 times; the others' are exact."""


def mixture_scores(w, expected, variances, y):
    """Φ⁻¹(Σ w Φ((y - h) / √s)) from the smaller tail; expected and variances (N, rows)."""
    z = (y - expected) / np.sqrt(variances)
    lower, upper = w @ ndtr(z), w @ ndtr(-z)
    return np.where(lower < upper, ndtri(lower), -ndtri(upper))


@pytest.mark.parametrize("name", list(CLOSE))
def test_scores_are_those_of_the_predicted_mixture(name):
    """An input at the time of each reading moves the cloud there first, so it can be looked at before the reading."""
    rng = np.random.default_rng(1)
    events = []
    for k in range(12):
        sensor = k % 3
        y = rng.normal(0, 3, ROWS[sensor])
        if k == 5:
            y[:2] = np.nan, 40.0
        events += [(5.0 + 0.2 * k, INPUT, rng.normal(0, 1, 1)), (5.0 + 0.2 * k, READING, y, sensor)]
    model = MATRICES.model
    tuning = Tuning.of(model).with_options({"particles": 60}).set("use.second", False)
    growing = Fold(name, model, tuning, log_of(model.width, *events))
    checked = 0
    for k in range(growing.log.n):
        if growing.log.kind[k] == READING:
            sensor = int(growing.log.channel[k])
            w, records = weights_of(growing.options, growing._now.state, model.nx)
            H, y = MATRICES.H[sensor], growing.log.value[k, : ROWS[sensor]]
            P = records[:, model.nx :].reshape(len(w), -1, model.nx) if records.shape[1] > model.nx else None
            variances = np.tile(MATRICES.R[sensor], (len(w), 1))
            if P is not None and P.size:
                variances = variances + np.einsum("ki,nij,kj->nk", H, P, H)
            expected = records[:, : model.nx] @ H.T + MATRICES.D[sensor] @ growing.u
            growing.advance(1)
            own = np.full(model.ny, np.nan)
            own[: y.size] = mixture_scores(w, expected, variances, y)
            own = np.clip(own, -8.0, 8.0)
            np.testing.assert_allclose(growing.track.whitened[k], own, rtol=0, atol=CLOSE[name])
            checked += int(np.isfinite(own).sum())
        else:
            growing.advance(1)
    assert checked > 20
    assert np.any(growing.track.verdict == HELD_OUT)


def test_scores_of_the_rao_blackwellised_filter():
    """Of two readings at one time the second finds the cloud as the first left it."""
    twice = tuple(Sensor(name, (Row("y", "m", R),), h=biased) for name in ("y", "again"))
    model = jump_model(sensors=twice)
    rng = np.random.default_rng(2)
    events = [(1.0 * k, READING, rng.normal(1.5 * k, 1.0), sensor) for k in range(1, 8) for sensor in (0, 1)]
    growing = Fold("rbpf", model, Tuning.of(model).with_options({"particles": 40}), log_of(model.width, *events))
    for k in range(growing.log.n):
        w, records = weights_of(growing.options, growing._now.state.copy(), model.nx)
        growing.advance(1)
        if k % 2:
            x, P = records[:, :3], records[:, 3:].reshape(-1, 3, 3)
            expected = x[:, :1] + 0.7 * x[:, 2:]
            own = mixture_scores(w, expected, P[:, :1, 0] + R, growing.log.value[k, :1])
            np.testing.assert_allclose(growing.track.whitened[k, :1], own, rtol=0, atol=1e-10)


def test_angles_count_the_shorter_way():
    """A cloud that lies across ±π, and the same turned to where nothing wraps: the same scores, to their 2e-8."""

    def scores(middle, y):
        turned = scalar(
            states=(State("s", "rad", middle, 0.3, circular=True),), noises=(Noise("s", "rad²/s", 0.01),),
            sensors=(Sensor("y", (Row("y", "rad", 0.01, circular=True),), h=first_state),),
        )  # fmt: skip
        track = fold("pf", turned, Tuning.of(turned), log_of(1, (0.0, READING, (y + np.pi) % (2 * np.pi) - np.pi)))
        return track.whitened[0, 0]

    for off in (-0.9, -0.2, 0.0, 0.4, 1.0):
        assert abs(scores(np.pi - 0.05, np.pi - 0.05 + off) - scores(0.0, off)) < 1e-6
        assert abs(scores(0.0, off) - off / np.sqrt(0.09 + 0.01)) < 0.15 * (1 + abs(off / 0.316))


@pytest.mark.parametrize("n", [200, 3200])
def test_a_large_clouds_score_is_kalmans_innovation(n):
    """First reading: e = ν/√S but for the cloud's chance, whose standard deviation is that of F over φ(e)."""
    model = MATRICES.model
    y = MATRICES.H[0] @ MATRICES.mean + MATRICES.D[0] @ MATRICES.u + 1.0
    log = log_of(model.width, (0.0, READING, y, 0))
    exact = fold("kf", model, Tuning.of(model), log)
    e = exact.innovation[0, 0] / exact.innovation_std[0, 0]
    assert abs(exact.whitened[0, 0] - e) < 1e-12
    tuning = Tuning.of(model).with_options({"particles": n})
    found = np.array([fold("pf", model, replace(tuning, seed=seed), log).whitened[0, 0] for seed in range(60)])
    s, r = np.sqrt(MATRICES.H[0] ** 2 @ MATRICES.std**2)[0], np.sqrt(MATRICES.R[0][0])
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    values = ndtr((exact.innovation[0, 0] - s * nodes) / r)
    weights = weights / weights.sum()
    std = np.sqrt((weights @ values**2 - (weights @ values) ** 2) / n) / (np.exp(-0.5 * e * e) / np.sqrt(2 * np.pi))
    # An RMS of 60 is right to 1/√120 = 9 %; four of these are allowed.
    assert 0.63 < np.sqrt(np.mean((found - e) ** 2)) / std < 1.37


def squared(seed, readings=2000, variance=0.04):
    """Scores of a walk of which only the square is seen: a cloud of two peaks, a prediction that is not Gaussian."""
    rng = np.random.default_rng(seed)
    model = scalar(
        sensors=(Sensor("y", (Row("y", "m", 0.04),), h=first_state_squared),),
        f=damped,
        states=(State("s", "m", 0.0, 1.0),),
    )
    x, events = rng.normal(0.0, 1.0), []
    for k in range(readings):
        if k:
            x = 0.9 * x + rng.normal(0, np.sqrt(0.3))
        events.append((1.0 * k, READING, x * x + rng.normal(0, 0.2)))
    tuning = Tuning.of(model).set("R.y", variance)
    return fold("pf", model, tuning, log_of(1, *events))


def damped(x, u, p, dt, out):
    out[0] = 0.9 * x[0]


def test_scores_are_normal_and_white_where_the_prediction_is_not():
    """2000 scores; a p-value under 1e-4 would be chance once in ten thousand seeds, and the seed is fixed."""
    track = squared(0)
    e = track.whitened[:, 0]
    assert kstest(e, "norm").pvalue > 1e-4
    assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 4 / np.sqrt(2000)
    # Which ν/√S is not: the prediction is skewed.
    assert kstest(track.innovation[:, 0] / track.innovation_std[:, 0], "norm").pvalue < 1e-4
    assert kstest(squared(0, variance=1.0).whitened[:, 0], "norm").pvalue < 1e-4
    assert not np.any(track.alarms)


def test_a_refused_reading_has_a_score():
    model = scalar()
    track = fold(
        "pf", model, replace(Tuning.of(model), gate=0.99), log_of(1, (0.0, READING, 2.1), (1.0, READING, 90.0))
    )
    assert list(track.verdict) == [USED, GATED]
    assert track.whitened[1, 0] == 8.0


def test_a_likelihood_of_its_own_has_no_score_and_raises_no_alarm():
    model = scalar(sensors=(Sensor("y", (Row("y", "m", 1e-4),), h=first_state, log_likelihood=within_half),))
    rng = np.random.default_rng(0)
    readings = [(0.1 * k, READING, 2.0 + 0.3 * rng.random()) for k in range(300)]
    track = fold("pf", model, replace(Tuning.of(model), gate=None), log_of(1, *readings))
    assert np.all(track.verdict == USED)
    # ν/√S would be an alarm: the standard deviation that is written down is not the likelihood's.
    assert np.std(track.innovation[:, 0] / track.innovation_std[:, 0]) != pytest.approx(1.0, abs=0.3)
    assert np.all(np.isnan(track.whitened)) and not np.any(track.alarms)


def walk_and_constant():
    """A walk that is seen, and a constant that is not: its values tell from which particle one descends."""
    return StateSpaceModel(
        name="traced", title="", states=(State("s", "m", 0.0, 1.0), State("c", "m", 0.0, 1.0)),
        noises=(Noise("s", "m²/s", 0.3),), f=unchanged, sensors=(Sensor("y", (Row("y", "m", 2.0),), h=first_state),),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["pf", "pf-ekf", "apf"])
def test_ancestors_are_those_that_a_constant_tells(name):
    model = walk_and_constant()
    rng = np.random.default_rng(3)
    log = log_of(1, *((0.2 * k, READING, rng.normal()) for k in range(25)))
    growing = folded(name, model, log, options={"particles": 300}, stop=20 if name == "apf" else 19)
    constants = len(np.unique(weights_of(growing.options, growing._now.state, 2)[1][:, 1]))
    growing.advance()
    assert 1 < constants < 300
    assert np.all(growing.track.ancestors[:19] == 300) and np.all(growing.track.ancestors[19:] == constants)
    assert growing.account()["ancestors"] == constants


def test_effective_sample_size_before_resampling():
    """1 / Σ w² of w p(y | x), the particles from before the second of two readings at one time."""
    pair = tuple(Sensor(name, (Row("y", "m", 0.04),), h=first_state) for name in ("y", "z"))
    model = scalar(sensors=pair)
    growing = folded(
        "pf", model, log_of(1, (0.0, READING, 2.2, 0), (0.0, READING, 2.4, 1)), options={"particles": 300}, stop=1
    )
    w, records = weights_of(growing.options, growing._now.state.copy(), 1)
    growing.advance()
    w = w * np.exp(-0.5 * (growing.log.value[1, 0] - records[:, 0]) ** 2 / 0.04)
    assert growing.track.effective[1] == pytest.approx(w.sum() ** 2 / np.sum(w**2), rel=1e-10)
    assert growing.account()["effective"] == growing.track.effective[1]


def test_a_poor_cloud_is_told():
    """A sensor a thousand times sharper than the cloud leaves a particle or two each time; a blunt one does not.

    Copies of one particle, which no process noise moves apart, stay so, all of equal weight.
    """
    from estimators.diagnostics.detector_watch import POOR_MEASUREMENTS
    from estimators.diagnostics.detectors import IMPOVERISHED
    from estimators.diagnostics.episodes import episodes
    from estimators.track import SUSPECT

    rng = np.random.default_rng(5)
    for variance, q, poor in ((1e-6, 0.3, True), (0.3, 0.3, False), (0.3, 0.0, True)):
        sensors, noises = (Sensor("y", (Row("y", "m", variance),), h=first_state),), (Noise("s", "m²/s", q),)
        model = scalar(sensors=sensors, noises=noises, f=unchanged)
        values = 2.0 + np.cumsum(rng.normal(0, np.sqrt(q), 100)) + rng.normal(0, np.sqrt(variance), 100)
        tuning = replace(Tuning.of(model).with_options({"particles": 300}), gate=None)
        log = log_of(1, *((1.0 * k, READING, value) for k, value in enumerate(values)))
        growing = folded("pf", model, log, tuning, stop=1)
        if q == 0.0:
            block(growing.options, growing._now.state, 1)[:] = 2.0
        growing.advance()
        told = np.flatnonzero(growing.track.flags & IMPOVERISHED)
        assert bool(told.size) == poor
        causes = [episode.cause for episode in episodes(growing)]
        assert ("impoverished" in causes) == poor
        if poor:
            assert told[0] >= POOR_MEASUREMENTS - 1
            assert growing.track.health[told[0]] >= SUSPECT
