"""The choice of `make fast`."""

import pytest

from tests.conftest import within

TOOK = {"a": 3.0, "b": 0.5, "c": 1.0, "d": 0.25}


@pytest.mark.parametrize(
    ("budget", "chosen"),
    [(0.0, {"new"}), (0.74, {"new", "d"}), (1.75, {"new", "b", "c", "d"}), (100.0, {"new", "a", "b", "c", "d"})],
)
def test_the_quickest_tests_that_fit_and_all_new_ones_are_chosen(budget, chosen):
    assert within(budget, ["a", "b", "new", "c", "d"], TOOK) == chosen


def test_a_test_that_is_not_asked_for_takes_no_time_from_the_others():
    assert within(1.0, ["c"], TOOK) == {"c"}
