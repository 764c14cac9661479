"""What a command refuses: one line with the option or subject, its value and a remedy, before any long work."""

import shlex

import pytest

from estimators.registry import ESTIMATORS
from tests.cases import cases


@cases(__file__, "bad_arguments.csv")
def test_a_wrong_argument_is_one_line(said, command, nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said.replace("ESTIMATORS", ", ".join(ESTIMATORS)) in nisus.refuses(*shlex.split(command))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("more", ["", "--windows 60"])
def test_an_unknown_entry_is_refused_before_anything_is_compiled(more, nisus, monkeypatch):
    monkeypatch.setattr("app.cli.tune.prepare", lambda twin: pytest.fail("it was compiled"))
    assert "p.nosuch is no entry" in nisus.refuses("tune", "motor_bench", "--fit", "p.nosuch", *more.split())
