"""Ensembles and trajectories of particles are smoothed within their Monte Carlo error of the dense solution."""

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import READING, RESET, Events, Log
from estimators.models import MODELS
from estimators.smoothing.smooth import smooth
from estimators.smoothing.trajectories_back import TRAJECTORIES
from estimators.tuning import Tuning
from tests.estimators.smoothing.test_dense import BODY, PLACES, START, TIMES, Chain, body_log, moved, query, reading
from tests.support import SECOND
from tests.support import folded as advanced

MEMBERS = 4000
READINGS = [reading(t, y) for t, y in zip(TIMES, PLACES, strict=True)]


def folded(estimator, log, model=BODY, **options):
    return advanced(estimator, model, log, Tuning.of(model).with_options(options))


@pytest.mark.parametrize(
    ("estimator", "options"),
    [
        *((name, {"members": MEMBERS}) for name in ("enkf", "etkf", "ensrf")),
        ("pf", {"particles": 20_000}),
        ("pf-reg", {"particles": 20_000, "bandwidth": 0.05}),
    ],
)
def test_a_linear_model(estimator, options):
    log = body_log([*READINGS, query(0.9), query(0.5), query(2.9)])
    chain, clock = Chain(*START), 0.0
    for i in range(log.n):
        t = log.t[i] * 1e-9
        chain.go_on(*moved(t - clock))
        clock = t
        if log.kind[i] == READING:
            chain.read(log.value[i, 0])
    mean, cov = (part[1:] for part in chain.solved())
    std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    fold = folded(estimator, log, **options)
    found = smooth(fold)
    # A sample's mean scatters by σ / √N, its deviation by σ / √(2 N); five of these. The σ of an ensemble is the
    # filter's, on which its gain works, over 14 steps that each draw.
    if "members" in options:
        scatter = np.stack([5.0 * fold.track.std / np.sqrt(MEMBERS)] * 2)
        assert np.all(found.std[0] < 0.8 * fold.track.std[0])
    else:
        scatter = 5.0 * std / np.sqrt([[[TRAJECTORIES]], [[2.0 * TRAJECTORIES]]])
    assert np.all(np.abs(found.mean - mean) < scatter[0])
    assert np.all(np.abs(found.std - std) < scatter[1])


def test_no_information_crosses_a_reset():
    log = body_log([reading(0.0, 0.7), Events.one(SECOND, 0, RESET, 0, [], 1), reading(2.0, 30.0), query(0.5)])
    fold = folded("pf", log, particles=20_000)
    found = smooth(fold)
    np.testing.assert_allclose(found.mean[:2], fold.track.mean[:2], rtol=0, atol=5.0 * 2.0 / np.sqrt(TRAJECTORIES))
    assert found.mean[2, 0] > 5.0


def test_the_same_draws_every_time():
    one, other = (smooth(folded("pf", body_log(READINGS), particles=500)) for _ in range(2))
    np.testing.assert_array_equal(one.mean, other.mean)


def test_estimates_that_cannot_be_smoothed_are_refused():
    """Too few members, a state without noise, a mode, a gain that is not optimal."""
    model = MODELS["lorenz96"]
    with pytest.raises(EstimatorError, match="etkf cannot be smoothed: the covariance of 40 members"):
        smooth(Fold("etkf", model, Tuning.of(model).with_options({"members": 40}), Log.of(model)))
    winding = MODELS["motor_winding"]
    log = body_log([Events.one(0, 0, READING, 0, [40.0], 1)])
    fold = advanced("pf", winding, log, Tuning.of(winding).set("Q.rate", 0.0))
    with pytest.raises(EstimatorError, match="pf cannot be smoothed: in motor_winding .* has no noise of its own"):
        smooth(fold)
    model = MODELS["gripper_contact"]
    with pytest.raises(EstimatorError, match="kf-steady cannot be smoothed, as its gain is not optimal.*; use kf"):
        smooth(advanced("kf-steady", winding, log))
    with pytest.raises(EstimatorError, match="rbpf cannot be smoothed; use kf"):
        smooth(Fold("rbpf", model, Tuning.of(model), body_log([])))
