"""Values that made simulated logs are found again, in their intervals: a few logs of what the benchmark does with many.

`python -m tests.benchmarks.recovery` does fifty of five twins.
"""

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
