"""Filter and smoother agree where the model is that of the data, and not where its noise is another."""

import numpy as np
import pytest

from estimators import fold
from estimators.smoothing.smooth import consistency
from estimators.smoothing.walk import Smoothed
from tests.estimators.smoothing.test_textbook import CAR, car


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 0.9, 1.1), (0.01, 2.0, np.inf), (100.0, 0.0, 0.85)])
def test_a_noise_that_is_right_too_small_or_too_large(factor, low, high):
    found = []
    for seed in range(40):
        _, _, log = car(seed)
        filtered, smoothed = (fold("kf", CAR, log, Q={"push": factor}, smoothed=each) for each in (False, True))
        each = Smoothed(smoothed.mean, smoothed.std, smoothed.track.cross)
        found.append(list(consistency(filtered.track, each, CAR).values()))
    # 40 runs of some 20 independent stretches: the mean of as many squares scatters by √(2/800) = 0.05.
    place = np.mean(found, axis=0)[:2]
    assert np.all((low < place) & (place < high)), place
