"""The limit of a wait, on clocks of the test's own."""

import pytest

import tests.waiting
from tests.waiting import BASE_S, wait_for


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass by sleeping alone."""
    now = [0.0]
    monkeypatch.setattr(tests.waiting.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(tests.waiting.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    return now


@pytest.mark.parametrize("slow", [1.0, 4.0])
def test_a_wait_has_a_limit_that_grows_with_the_slowness_of_the_machine(monkeypatch, clock, slow):
    monkeypatch.setattr(tests.waiting, "slowness", lambda: slow)
    with pytest.raises(AssertionError, match=f"did not hold within {BASE_S * slow + 1:.0f} s"):
        wait_for(lambda: False, every_s=1.0)
    assert clock[0] == BASE_S * slow + 1.0


def test_slowness_is_the_time_of_fixed_work_over_its_nominal_one(monkeypatch):
    seconds = iter([0.0, 3.0 * 10 * tests.waiting.NOMINAL_S])
    monkeypatch.setattr(tests.waiting.time, "perf_counter", lambda: next(seconds))
    assert tests.waiting.slowness() == pytest.approx(3.0, rel=1e-12)
