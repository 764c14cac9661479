"""Trajectories of particles are draws from the smoothing distribution: against the dense solution, and two peaks."""

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import READING, RESET, Events
from estimators.models import MODELS
from estimators.smoothing.smooth import smooth
from estimators.smoothing.trajectories_back import TRAJECTORIES
from estimators.tuning import Tuning
from tests.estimators.smoothing.test_dense import BODY, PLACES, START, TIMES, Chain, body_log, moved, query, reading
from tests.support import SECOND


def folded(estimator, log, model=BODY, **options):
    fold = Fold(estimator, model, Tuning.of(model).with_options(options), log)
    fold.advance()
    return fold


@pytest.mark.parametrize(("estimator", "options"), [("pf", {}), ("pf-reg", {"bandwidth": 0.05})])
def test_a_linear_model(estimator, options):
    events = [reading(t, y) for t, y in zip(TIMES, PLACES, strict=True)] + [query(0.9), query(0.5), query(2.9)]
    log = body_log(events)
    chain, clock = Chain(*START), 0.0
    for i in range(log.n):
        t = log.t[i] * 1e-9
        chain.go_on(*moved(t - clock))
        clock = t
        if log.kind[i] == READING:
            chain.read(log.value[i, 0])
    mean, cov = (part[1:] for part in chain.solved())
    std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    found = smooth(folded(estimator, log, particles=20_000, **options))
    # The mean of K draws scatters by σ / √K, their deviation by σ / √(2 K); five of these.
    assert np.all(np.abs(found.mean - mean) < 5.0 * std / np.sqrt(TRAJECTORIES))
    assert np.all(np.abs(found.std - std) < 5.0 * std / np.sqrt(2.0 * TRAJECTORIES))


def test_nothing_is_told_across_a_reset():
    log = body_log([reading(0.0, 0.7), Events.one(SECOND, 0, RESET, 0, [], 1), reading(2.0, 30.0), query(0.5)])
    fold = folded("pf", log, particles=20_000)
    found = smooth(fold)
    np.testing.assert_allclose(found.mean[:2], fold.track.mean[:2], rtol=0, atol=5.0 * 2.0 / np.sqrt(TRAJECTORIES))
    assert found.mean[2, 0] > 5.0


def test_the_same_draws_every_time():
    log = body_log([reading(t, y) for t, y in zip(TIMES, PLACES, strict=True)])
    one, other = (smooth(folded("pf", log, particles=500)) for _ in range(2))
    np.testing.assert_array_equal(one.mean, other.mean)


def test_a_state_without_noise_and_a_mode_are_refused():
    bare = Tuning.of(MODELS["motor_winding"]).set("Q.rate", 0.0)
    fold = Fold("pf", MODELS["motor_winding"], bare, body_log([]))
    fold.log.extend(Events.one(0, 0, READING, 0, [40.0], 1))
    fold.advance()
    with pytest.raises(EstimatorError, match="pf cannot be smoothed: in motor_winding .* has no noise of its own"):
        smooth(fold)
    model = MODELS["gripper_contact"]
    with pytest.raises(EstimatorError, match="rbpf cannot be smoothed; use kf"):
        smooth(Fold("rbpf", model, Tuning.of(model), body_log([])))
