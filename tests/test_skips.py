"""Skips where something is missing, which are failures in CI."""

import pytest

from tests.skips import MISSING, recording, skip_without, summary, with_recording


def test_a_missing_recording_skips_the_test(monkeypatch, tmp_path):
    monkeypatch.delenv("CI", raising=False)
    monkeypatch.setenv("NISUS_DATA", str(tmp_path))
    for find in (lambda: recording("set", "file.csv"), lambda: with_recording("motor_bench")):
        with pytest.raises(pytest.skip.Exception, match=r"recordings are not here \(see docs/recordings.md\)"):
            find()
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "file.csv").touch()
    assert recording("set", "file.csv") == tmp_path / "set" / "file.csv"
    assert with_recording("motor_winding").name == "motor_winding"


@pytest.mark.parametrize("missing", MISSING)
@pytest.mark.parametrize("ci", ["true", "1"])
def test_in_ci_nothing_may_be_missing(monkeypatch, missing, ci):
    monkeypatch.setenv("CI", ci)
    with pytest.raises(pytest.fail.Exception, match="with CI=true that is a failure"):
        skip_without(missing)


def test_skips_are_counted_by_reason():
    assert summary(["no b", "no a", "no b"]) == ["2 tests skipped: no b", "1 test skipped: no a"]
