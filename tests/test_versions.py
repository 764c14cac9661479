"""What `make versions` tries is there, and says so when it is not."""

import sys

import pytest

from tests import versions


def test_every_module_that_is_tried_is_there():
    assert len(versions.chosen()) == len(versions.FOLDERS) + len(versions.MODULES)


@pytest.mark.parametrize(("name", "says"), [("FOLDERS", "no folder .*nothing"), ("MODULES", "no file .*nothing")])
def test_a_module_that_was_renamed_is_not_left_out_quietly(name, says, monkeypatch):
    monkeypatch.setattr(versions, name, (*getattr(versions, name), "nothing"))
    with pytest.raises(SystemExit, match=says):
        versions.chosen()


def test_this_interpreter_is_among_those_found():
    assert sys.version_info[:2] in versions.interpreters()
