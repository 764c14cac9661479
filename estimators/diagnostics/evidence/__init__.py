"""Evidence against the filter: a bank of sequential tests on the standardised innovations of every sensor row."""

from .alarms import (
    AGREEING,
    CAUSES,
    DISAGREEING,
    HIGH,
    IMPOVERISHED,
    LOST,
    LOW,
    MISSED,
    NARROW,
    OUTSIDE,
    REFUSED,
    SENSORS,
    STUCK,
    TRUTH_MISSED,
)
from .bank import causes_now, chances_of, fresh, heard_last, no_baseline, threshold_of, watched
from .hypotheses import BITS, FURTHEST, RATIOS, SHIFTS, TESTS
from .row_tests import highest
from .watch import PATIENCE, watch_rows

__all__ = [
    "AGREEING",
    "BITS",
    "CAUSES",
    "DISAGREEING",
    "FURTHEST",
    "HIGH",
    "IMPOVERISHED",
    "LOST",
    "LOW",
    "MISSED",
    "NARROW",
    "OUTSIDE",
    "PATIENCE",
    "RATIOS",
    "REFUSED",
    "SENSORS",
    "SHIFTS",
    "STUCK",
    "TESTS",
    "TRUTH_MISSED",
    "causes_now",
    "chances_of",
    "fresh",
    "heard_last",
    "highest",
    "no_baseline",
    "threshold_of",
    "watch_rows",
    "watched",
]
