"""What the commands refuse: one line with the option or subject, its value and a remedy, before any long work."""

import shlex

import pytest

from app.extensions.lab.guard import suite
from tests.cases import cases


@cases(__file__, "bad_arguments.csv")
def test_a_wrong_argument_is_one_line(said, command, nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(suite, "guard_log", lambda *_: pytest.fail("it was folded"))
    assert said in nisus.refuses(*shlex.split(command))
    assert not list(tmp_path.iterdir())
