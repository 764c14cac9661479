"""What may be chosen about a scene."""

import pytest

from app.views.viser.stage import NO_AXIS, Choice, Choices
from estimators.errors import ConfigError

STATES = ("a", "b", "c")


@pytest.fixture
def choices():
    return Choices([
        Choice("show", "Show", ("motor", "belief"), "motor"),
        Choice("x", "x", STATES, "a", "belief"), Choice("y", "y", STATES, "b", "belief"),
        Choice("z", "z", (*STATES, NO_AXIS), "none", "belief"),
        Choice("single", "Single", ("one",), "one"),
    ])  # fmt: skip


def test_only_what_there_is_to_choose_is_offered(choices):
    assert [item["key"] for item in choices.json()] == ["show"]
    choices.choose("show", "belief")
    assert [(item["key"], item["value"]) for item in choices.json()] == [
        ("show", "belief"), ("x", "a"), ("y", "b"), ("z", "none"),
    ]  # fmt: skip


def test_two_axes_never_have_the_same_state(choices):
    choices.choose("x", "b")
    assert [choices.values()[axis] for axis in "xyz"] == ["b", "a", "none"]
    choices.choose("z", "c")
    choices.choose("y", "c")
    assert [choices.values()[axis] for axis in "xyz"] == ["b", "c", "a"]
    # There is nothing that x could have instead.
    choices.choose("z", "none")
    with pytest.raises(ConfigError, match="b is on the x axis already"):
        choices.choose("z", "b")


@pytest.mark.parametrize(("key", "value", "said"), [("w", "a", "no choice 'w'"), ("x", "d", "x is 'd'; it must be")])
def test_what_there_is_not_is_refused(choices, key, value, said):
    before = choices.values()
    with pytest.raises(ConfigError, match=said):
        choices.choose(key, value)
    assert choices.values() == before
