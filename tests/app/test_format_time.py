"""Counts as text."""

import pytest

from app.format_time import counted


@pytest.mark.parametrize(
    "number, text", [(0, "0 readings"), (1, "1 reading"), (2, "2 readings"), (1200, "1,200 readings")]
)
def test_a_count_has_the_number_of_its_noun(number, text):
    assert counted(number, "reading") == text
