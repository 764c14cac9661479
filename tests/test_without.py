"""The core works without any extension, whether their entry points are left behind or not."""

from config.extensions import extensions
from tests.without import QUICK, problems, with_dependents


def test_the_core_works_without_any_extension():
    assert problems({*extensions()}, QUICK) == []


def test_who_needs_one_that_is_left_out_is_left_out_too():
    assert with_dependents(["mqtt"]) == {"mqtt", "fleet"}
