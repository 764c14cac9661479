"""Notices: the level of a line that a source reports."""

import pytest

from app.engine.notices import Notices
from sources.source import Condition


@pytest.mark.parametrize(
    ("key", "level"),
    [
        ("condition coolant", "info"),
        ("repeats coolant", "info"),
        ("short frame coolant", "warn"),
        ("undated row", "warn"),
    ],
)
def test_readings_that_the_yaml_leaves_out_are_no_warning(key, level):
    notices = Notices(lambda: 7)
    notices.report(key, "it is left out")
    [line] = notices.since(0)
    assert (line.level, line.text, line.t, notices.counts()) == (level, "it is left out", 7, {key: 1})
    notices.report("other", "text", "error")
    assert notices.since(1)[0].level == "error"


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (1.0, 2.5, "ok in 1 to 2.5"),
        (25.2, float("inf"), "ok of at least 25.2"),
        (float("-inf"), 2.0, "ok of at most 2"),
    ],
)
def test_a_condition_names_the_ends_that_it_has(low, high, text):
    assert str(Condition("ok", low, high)) == text
