"""Values that made simulated logs are found again, in their intervals: a few logs of what the benchmark does with many.

`python -m tests.benchmarks.recovery` does fifty of five twins.
"""

import numpy as np
from scipy.stats import binom

from tests.benchmarks.recovery import CASES, recover

LOGS = 6


def test_true_noises_lie_in_their_intervals():
    found = recover(next(case for case in CASES if case.twin == "motor_winding"), LOGS)
    told = sum(found.told.values())
    # All three are told by 1500 readings. Fewer inside than this would come by chance once in a thousand.
    assert told == 3 * LOGS
    assert sum(found.inside.values()) >= binom.ppf(1e-3, told, 0.95)
    # NIS on a log that was not fitted: 99 % bounds.
    assert found.consistent >= LOGS - 1


def test_a_fit_makes_the_nis_of_another_log_as_uncertain_as_its_readings_do():
    """With the information I of a fit, ∂(mean NIS)/∂θ is -(2 / N) I e along the scale e of all noises, so gᵀ I⁻¹ g is
    2 / N: the variance of a chi-square's mean once more, whatever the model, if all Q and R are fitted."""
    case = next(case for case in CASES if case.twin == "motor_winding")
    found = recover(case, 3)
    # The belief takes from it, the sandwich adds, by a few percent each.
    np.testing.assert_allclose(found.wider, np.sqrt(2.0), rtol=0.15)
