"""A function of a model that does not return is named; one that does is not, however often it is called."""

import io
import sys
import threading

import pytest

import app.cli.prepare
from app.cli.prepare import attend
from app.engine.watchdog import CALL_TIMEOUT_S, CallWatch
from tests.models import level_model
from tests.waiting import LIMIT_S, wait_for

ENTERED, LEAVE = threading.Event(), threading.Event()


def waits(x, u, p, dt, out):
    LEAVE.wait(ENTERED.set())  # seen in this line from the moment that it is entered


MODEL = level_model({"s": {"r": 1.0}}, 1.0, state="x", name="slow", f=waits)


def call():
    """A call of f that has begun, and its thread."""
    ENTERED.clear()
    LEAVE.clear()
    thread = threading.Thread(target=waits, args=(None,) * 5, daemon=True)
    thread.start()
    assert ENTERED.wait(LIMIT_S)
    return thread


def test_a_call_that_does_not_return_is_named_once():
    now = 0.0
    watch = CallWatch(MODEL, clock=lambda: now)
    thread = call()
    try:
        assert watch.check() is None
        now = CALL_TIMEOUT_S - 0.1
        assert watch.check() is None
        now = CALL_TIMEOUT_S
        line = watch.check()
        assert line is not None and "\n" not in line
        place, rest = line.split(": ", 1)
        assert place.endswith(f"test_prepare.py:{waits.__code__.co_firstlineno + 1}")  # where it waits
        assert rest.startswith("f of the model slow has not returned for 10 s; ") and "Ctrl-C" in rest
        now = 100.0
        assert watch.check() is None
    finally:
        LEAVE.set()
        thread.join(LIMIT_S)


def test_calls_that_return_are_not():
    now = 0.0
    watch = CallWatch(MODEL, clock=lambda: now)
    for _ in range(3):  # each of them looked at twice, and longer than the patience in sum
        thread = call()
        assert watch.check() is None
        now += 0.6 * CALL_TIMEOUT_S
        assert watch.check() is None
        LEAVE.set()
        thread.join(LIMIT_S)
    assert watch.check() is None


def test_attended_work_gives_what_it_gives():
    assert attend(MODEL, lambda: 3, "doing") == 3
    with pytest.raises(ZeroDivisionError):
        attend(MODEL, lambda: 1 / 0, "doing")


class Pipe(io.StringIO):
    """Output that somebody reads at the other end, as far as it was flushed."""

    read = ""

    def flush(self):
        self.read = self.getvalue()


def test_where_output_is_redirected_it_says_what_it_does_before_it_is_done(monkeypatch):
    pipe = Pipe()
    monkeypatch.setattr(sys, "stderr", pipe)
    monkeypatch.setattr(app.cli.prepare, "STATUS_DELAY_S", 0.0)

    def work():
        return wait_for(lambda: pipe.read)

    assert attend(MODEL, work, "compiling filters, once", "compiled filters, once") == "compiling filters, once ...\n"
    before, after = pipe.read.splitlines()
    assert after.startswith("compiled filters, once: ")
