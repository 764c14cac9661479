"""How large innovations are, and the noise of a sensor by them: against chi-square draws and sums by hand."""

import numpy as np
import pytest

from estimators.diagnostics.innovations import mean_nis, sensor_noise
from estimators.fold import fold
from estimators.log import READING, Events
from estimators.models import MODELS
from estimators.numerics.quantiles import chi_square_quantile
from estimators.track import GATED, USED, Track
from estimators.tuning import Tuning
from tests.support import SECOND, as_log

MODEL = MODELS["motor_winding"]


def track_of(nis, dof, gate):
    """A track whose readings have these NIS, judged by a gate."""
    track = Track.allocate(nis.size, 1, 0, 2)
    track.nis[:], track.dof[:] = nis, dof
    track.verdict[:] = np.where(nis <= chi_square_quantile(gate, dof), USED, GATED) if gate else USED
    return track


@pytest.mark.parametrize("gate", [None, 0.9, 0.99])
@pytest.mark.parametrize("dof", [1, 2])
def test_a_consistent_filter_has_one_whatever_its_gate(gate, dof):
    n = 200_000
    nis = np.random.default_rng(dof).chisquare(dof, n)
    # Standard deviation of a mean of n of at most sqrt(2 m) / m each, four times.
    assert mean_nis(track_of(nis, dof, gate), gate) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / dof / n) / 0.8)


def test_what_the_gate_refuses_still_counts():
    draws, g = np.random.default_rng(5).chisquare(1, 50_000), chi_square_quantile(0.9, 1)
    expected = np.minimum(4.0 * draws, g).mean() / np.minimum(draws, g).mean()
    assert mean_nis(track_of(4.0 * draws, 1, 0.9), 0.9) == pytest.approx(expected, rel=0.03) and expected > 1.8
    assert np.isnan(mean_nis(track_of(np.zeros(0), 1, None), None))


def walked(n, r, seed):
    """Readings of a state of the model's own dynamics, simulated by its matrices, with noise of variance r."""
    rng = np.random.default_rng(seed)
    dt, q = 0.1, np.array([noise.variance for noise in MODEL.noises])
    x, values = np.array([state.mean for state in MODEL.states], float), []
    F = np.array([[1.0, dt], [0.0, 1.0]])
    for _ in range(n):
        x = F @ x + rng.normal(size=q.size) * np.sqrt(q * dt)
        values.append(x[0] + rng.normal() * np.sqrt(r))
    t = np.round(np.arange(1, n + 1) * dt * SECOND).astype(np.int64)
    kinds = np.full(n, READING, np.int8)
    return Events(t, t.copy(), kinds, np.zeros(n, np.int32), np.array(values).reshape(n, 1))


@pytest.mark.parametrize("start, r", [(1.0, 1.0), (0.2, 1.0), (5.0, 1.0)])
def test_taken_again_and_again_it_comes_to_the_true_noise(start, r):
    log = as_log(walked(8000, r, seed=11))
    tuning = Tuning.of(MODEL).set("R.winding", start)
    for _ in range(8):
        found = sensor_noise(fold("kf", MODEL, tuning, log), log.events, tuning)["winding"]
        tuning = tuning.set("R.winding", max(found.variance, 1e-3))
    assert found.n == 8000
    assert abs(found.variance - r) < 4.0 * found.std
    # Of n white innovations of variance S, R and a little more, it is S times the root of 2 / n.
    assert found.std == pytest.approx(r * np.sqrt(2.0 / 8000), rel=0.3)


def test_by_hand_on_a_scalar_filter():
    rng = np.random.default_rng(2)
    n = 400
    track = Track.allocate(n, 2, 0, 1)
    S = rng.uniform(1.0, 3.0, n)
    nu = rng.normal(size=n)
    track.innovation[:, 0], track.innovation_std[:, 0] = nu, np.sqrt(S)
    track.dof[:], track.verdict[:], track.nis[:] = 1, USED, nu**2 / S
    t = np.arange(n, dtype=np.int64)
    events = Events(t, t, np.full(n, READING, np.int8), np.zeros(n, np.int32), np.zeros((n, 1)))
    tuning = Tuning.of(MODEL).set("R.winding", 0.7)
    found = sensor_noise(track, events, tuning)["winding"]
    top = bottom = 0.0
    for k in range(n):
        top += (nu[k] ** 2 - (S[k] - 0.7)) / S[k] ** 2
        bottom += 1.0 / S[k] ** 2
    assert found.variance == pytest.approx(top / bottom, rel=1e-12)
    assert found.std == pytest.approx((2.0 / bottom) ** 0.5, rel=1e-12)


def test_few_readings_say_nothing():
    log = as_log(walked(40, 1.0, seed=1))
    tuning = Tuning.of(MODEL)
    assert sensor_noise(fold("kf", MODEL, tuning, log), log.events, tuning) == {}


def test_innovations_of_a_right_filter_are_as_white_as_chance_has_it_and_of_a_wrong_one_are_not():
    """Of ten right filters the chances are spread over 0 to 1; with Q a hundred times too small none has any."""
    right, wrong = [], []
    for seed in range(10):
        log = as_log(walked(2000, 1.0, seed=100 + seed))
        for tuning, chances in (
            (Tuning.of(MODEL).set("R.winding", 1.0), right),
            (Tuning.of(MODEL).set("R.winding", 1.0).set("Q.temperature", 5e-5).set("Q.rate", 5e-6), wrong),
        ):
            chances.append(sensor_noise(fold("kf", MODEL, tuning, log), log.events, tuning)["winding"])
    # Ten uniform draws lie all above 1e-3 with 99 %, and not all above a half with 99.9 %.
    assert min(noise.chance for noise in right) > 1e-3 and min(noise.chance for noise in right) < 0.5
    assert max(noise.chance for noise in wrong) < 1e-6 and min(noise.correlation for noise in wrong) > 0.1
