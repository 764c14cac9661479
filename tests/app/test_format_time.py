"""A time of a log in words: a date where its clock has one."""

import pytest

from app.format_time import format_time


@pytest.mark.parametrize(
    ("t", "said"),
    [(61 * 10**9, "61 s"), (1_795_358_420_700_000_000, "2026-11-22 14:40:20 UTC"), (10**18 - 10**9, "1e+09 s")],
)
def test_a_time_has_a_date_where_its_clock_counts_from_1970(t, said):
    assert format_time(t) == said
