"""What is learned from windows: the rate that a model leaves out, and by how much the rest adds up."""

import sys

import numpy as np
import pytest

from app.extensions.learned.train import GP, NET, RIDGE, drift, train
from app.extensions.learned.windows import Windows, known_states, windows
from estimators.errors import EstimatorError
from estimators.log import Log
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from tests.models import first_state
from tests.support import folded as advanced


def f(x, u, p, dt, out):
    out[0] = x[0] + dt * p[0] * (u[0] - x[0])
    out[1] = x[1]


PHYSICS = StateSpaceModel(
    name="lag",
    title="A lag behind its input, and a level that stays",
    states=(State("lag", "m", 0.0, 1.0), State("level", "m", 0.0, 1.0)),
    inputs=(Input("drive", "m"),),
    parameters=(Parameter("speed", "1/s", 0.1),),
    noises=(Noise("lag", "m²/s", 0.01), Noise("level", "m²/s", 0.01)),
    sensors=(Sensor("gauge", (Row("gauge", "m", 1e-6),), h=first_state),),
    f=f,
    max_step=0.5,
)
LEFT_OUT = 0.03, -0.2
"""m/s: what the asset does beside the physics."""


def recorded(seconds=100.0, step=0.25, uneven=0.0):
    """A log of an asset that does more than its physics, with the truth of both states."""
    log = Log.of(PHYSICS)
    t = np.arange(0.0, seconds, step)
    drive = np.sign(np.sin(t / 6.0)) * (1.0 + t / 50.0)
    x = np.zeros((t.size, 2))
    for i in range(1, t.size):
        f(x[i - 1], drive[i - 1 : i], (0.1,), step, x[i])
        x[i] += step * np.array(LEFT_OUT) * (1.0 + uneven * (-1.0) ** i)
    log.add_inputs(t, drive=drive)
    log.add("gauge", t, x[:, 0])
    log.add_truth(t, lag=x[:, 0], level=x[:, 1])
    return log, t, x, drive


def cut(log, known, **changed):
    wanted = {"corrects": ("level", "lag"), "features": ("drive", "lag"), "seconds": 5.0, "stretches": 4} | changed
    held_out = np.arange(log.n) >= 0.76 * log.n
    return windows(PHYSICS, log, known, held_out, **wanted)


def folded(log):
    return advanced("ekf", PHYSICS, log)


def test_the_rate_of_a_window_is_what_the_physics_leaves_out():
    log, t, x, drive = recorded()
    given = cut(log, known_states(folded(log), PHYSICS))
    assert len(given.rates) == 18  # 19 windows of 5 s, of which one lies in both parts
    # Over a window a lag of 10 s forgets a fifth of what a rate adds: that is not taken for a smaller rate.
    np.testing.assert_allclose(given.rates, np.tile(LEFT_OUT[::-1], (18, 1)), rtol=0.0, atol=1e-9)


def test_a_rate_that_changes_within_a_window_counts_with_its_mean():
    log, t, x, drive = recorded(uneven=1.0)
    given = cut(log, known_states(folded(log), PHYSICS))
    np.testing.assert_allclose(given.rates[:, 0], LEFT_OUT[1], rtol=0.0, atol=1e-9)


def test_features_are_means_over_the_window():
    log, t, x, drive = recorded()
    given = cut(log, known_states(folded(log), PHYSICS))
    for start, end, features in zip(given.start, given.end, given.features, strict=True):
        rows = (t >= start - 1e-6) & (t < end - 1e-6)
        np.testing.assert_allclose(features, (drive[rows].mean(), x[rows, 0].mean()), rtol=0.0, atol=1e-12)
    assert sorted(set(given.block.tolist())) == [0, 1, 2, 3]
    np.testing.assert_array_equal(given.held_out, given.start >= 76.0)


def test_without_truth_the_smoothed_state_is_what_is_known():
    log, t, x, drive = recorded()
    bare = Log.of(PHYSICS)
    bare.add_inputs(t, drive=drive)
    bare.add("gauge", t, x[:, 0])
    given = cut(bare, known_states(folded(bare), PHYSICS), corrects=("lag",))
    truth = cut(log, known_states(folded(log), PHYSICS), corrects=("lag",))
    # The sensor is off by 1 mm at most, at both ends of 5 s, of which a lag forgets a fifth.
    np.testing.assert_allclose(given.rates, truth.rates, rtol=0.0, atol=2.5e-3 / 5.0)


def test_windows_with_a_hole_are_left_out():
    log, t, x, drive = recorded()
    holed = Log.of(PHYSICS)
    kept = (t < 20.0) | (t > 33.0)
    holed.add_inputs(t[kept], drive=drive[kept])
    holed.add("gauge", t[kept], x[kept, 0])
    given = cut(holed, x[kept].repeat(2, axis=0))
    assert not np.any((given.start < 33.0) & (given.end > 20.0))


def made(rates, features, blocks, seconds=10.0):
    start = seconds * np.arange(len(rates))
    block = np.arange(len(rates)) * blocks // len(rates)
    return Windows(features, rates, start, start + seconds, block, np.zeros(len(rates), bool))


def test_the_drift_of_white_noise_is_its_variance_a_second():
    rng = np.random.default_rng(0)
    blocks, each, seconds, variance = 400, 12, 10.0, 0.09
    # A second's variance q is that of r T over T: r ~ N(0, q / T).
    rates = rng.normal(0.0, np.sqrt(variance / seconds), (blocks * each, 1))
    found = drift(made(rates, rates, blocks), rates)
    # Of each block the mean of n = 12 correlated χ²: at worst one draw a block, √(2/400) = 7 %; four of them.
    assert found == pytest.approx(variance, rel=0.28)


def test_the_drift_of_an_offset_grows_with_the_block():
    rates = np.full((24, 1), 0.02)
    # (n r T)² / (n T) = n r² T, its mean over n = 1 .. 12 is 6.5 r² T.
    assert drift(made(rates, rates, 2), rates) == pytest.approx(6.5 * 0.02**2 * 10.0)


def curved(z):
    return np.column_stack((0.3 * np.sin(z[:, 0]) + 0.05 * z[:, 1] ** 2,))


@pytest.mark.parametrize("kind", [GP, RIDGE])
def test_what_was_left_out_is_learned(kind):
    if kind == GP:
        pytest.importorskip("sklearn")
    rng = np.random.default_rng(1)
    z = rng.uniform(-1.5, 1.5, (60, 2))
    noise = 0.01
    found = train(kind, made(curved(z) + rng.normal(0.0, noise, (60, 1)), z, 6), names=("a", "b"), degree=2)
    apart = rng.uniform(-1.2, 1.2, (200, 2))
    off = np.sqrt(np.mean((found.correction.mean(apart) - curved(apart)) ** 2))
    # A process finds the curve to the noise of its windows, a parabola but for the cubic of the sine, 0.3 z³/6.
    assert off < (2.0 * noise if kind == GP else 0.06)
    assert found.drift < 0.1 * found.before


def test_of_noise_little_is_learned():
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(2)
    z, rates = rng.uniform(-1.5, 1.5, (60, 2)), rng.normal(0.0, 1.0, (60, 1))
    found = train(GP, made(rates, z, 6), names=("a", "b"))
    assert np.sqrt(np.mean(found.correction.mean(z) ** 2)) < 0.5
    assert found.drift > 0.7 * found.before


def test_a_net_is_only_asked_what_it_leaves():
    z = np.random.default_rng(3).uniform(-1.5, 1.5, (30, 2))
    found = train(NET, made(curved(z) + 0.1, z, 3), names=("a", "b"), net=curved)
    np.testing.assert_allclose(found.rest, 0.1, rtol=0.0, atol=1e-12)


def test_what_cannot_be_learned_from_is_refused():
    z = np.random.default_rng(4).uniform(-1.5, 1.5, (30, 2))
    given = made(curved(z), z, 3)
    with pytest.raises(EstimatorError, match="there are 7 windows to learn from; it takes 8 or more of two blocks"):
        train(RIDGE, given.of(np.arange(7)), names=("a", "b"))
    with pytest.raises(EstimatorError, match="b is 2 in every window, and explains nothing; leave it out"):
        train(RIDGE, replace_features(given, 2.0), names=("a", "b"))
    many = made(np.zeros((401, 1)), np.random.default_rng(5).uniform(0.0, 1.0, (401, 1)), 3)
    with pytest.raises(EstimatorError, match="401 windows, and a Gaussian process takes 400 at most; make them longer"):
        train(GP, many, names=("a",))


def replace_features(given, value):
    features = given.features.copy()
    features[:, 1] = value
    return given._replace(features=features)


def test_without_scikit_learn_a_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.gaussian_process", None)
    z = np.random.default_rng(6).uniform(-1.5, 1.5, (30, 2))
    with pytest.raises(EstimatorError, match=r"needs scikit-learn: pip install 'nisus\[learned\]'"):
        train(GP, made(curved(z), z, 3), names=("a", "b"))
