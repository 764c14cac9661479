"""Ensembles are smoothed within their Monte Carlo error of the dense solution, and not where that cannot be told."""

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.models import MODELS
from estimators.smoothing.smooth import smooth
from estimators.tuning import Tuning
from tests.estimators.smoothing.test_dense import BODY, PLACES, START, TIMES, Chain, body_log, moved, query, reading

MEMBERS = 4000


@pytest.mark.parametrize("estimator", ["enkf", "etkf", "ensrf"])
def test_a_linear_model(estimator):
    events = [reading(t, y) for t, y in zip(TIMES, PLACES, strict=True)] + [query(0.9), query(2.9)]
    log = body_log(events)
    fold = Fold(estimator, BODY, Tuning.of(BODY).with_options({"members": MEMBERS}), log)
    fold.advance()
    chain, clock = Chain(*START), 0.0
    for i in range(log.n):
        t = log.t[i] * 1e-9
        chain.go_on(*moved(t - clock))
        clock = t
        if log.kind[i] == READING:
            chain.read(log.value[i, 0])
    mean, cov = (part[1:] for part in chain.solved())
    std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    found = smooth(fold)
    # A sample's mean scatters by σ / √N, its deviation by σ / √(2 N); σ here is the filter's, which the gain works on.
    # Over 14 steps that each draw, five of these deviations.
    scatter = 5.0 * fold.track.std / np.sqrt(MEMBERS)
    assert np.all(np.abs(found.mean - mean) < scatter)
    assert np.all(np.abs(found.std - std) < scatter)
    assert np.all(found.std[0] < 0.8 * fold.track.std[0])


def test_too_few_members_are_refused():
    model = MODELS["lorenz96"]
    with pytest.raises(EstimatorError, match="etkf cannot be smoothed: the covariance of 40 members"):
        smooth(Fold("etkf", model, Tuning.of(model).with_options({"members": 40}), Log.of(model)))
