"""Where standard error is no terminal, work that takes long says now and then how far it has got."""

import io
import signal
import sys
import threading

import app.cli.prepare
from app.cli.prepare import attend, progress, progress_text
from tests.app.cli.test_prepare import MODEL
from tests.waiting import LIMIT_S


class Heard(io.StringIO):
    """A stream that knows when it was written to."""

    def __init__(self):
        super().__init__()
        self.written = threading.Event()

    def flush(self):
        self.written.set()


def test_lines_come_while_nothing_is_done_and_count_what_is(monkeypatch):
    now = 100.0
    heard = Heard()
    monkeypatch.setattr(sys, "stderr", heard)
    monkeypatch.setattr(app.cli.prepare, "LINE_PERIOD_S", 1e-3)
    with progress("pump", 12, "filters", clock=lambda: now) as advance:
        assert heard.written.wait(LIMIT_S)
        assert heard.getvalue().startswith("pump: 0 of 12 filters after 0 s\n")
        now = 130.0
        for _ in range(3):
            advance("best so far ekf")
        for _ in range(2):  # the first may have begun before they were done
            heard.written.clear()
            assert heard.written.wait(LIMIT_S)
    assert heard.getvalue().endswith("pump: 3 of 12 filters after 30 s, about 90 s left; best so far ekf\n")
    assert not any(thread.name == "progress" for thread in threading.enumerate())


def test_the_first_interrupt_ends_attended_work_with_its_best_result(monkeypatch):
    heard, stopped = Heard(), threading.Event()
    monkeypatch.setattr(sys, "stderr", heard)
    monkeypatch.setattr(app.cli.prepare, "LINE_PERIOD_S", 1e-3)
    monkeypatch.setattr(app.cli.prepare, "STATUS_DELAY_S", 0.0)

    def work():
        while "half done" not in heard.getvalue():
            heard.written.wait(LIMIT_S)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        return "best so far" if stopped.wait(LIMIT_S) else "not interrupted"

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # servers of other tests set their own
    try:
        assert attend(MODEL, work, "fitting", text=lambda: "half done", stop=stopped.set) == "best so far"
    finally:
        signal.signal(signal.SIGINT, before)
    assert "fitting: 0 s, half done\n" in heard.getvalue() and "interrupted; " in heard.getvalue()


def test_the_rest_takes_as_long_as_what_is_done():
    assert progress_text("pump", 12, 12, "filters", 40.0) == "pump: 12 of 12 filters after 40 s, about 0 s left"
    assert progress_text("pump", 8, 12, "filters", 40.0) == "pump: 8 of 12 filters after 40 s, about 20 s left"


def test_short_work_says_nothing_in_a_pipe(capsys):
    with progress("pump", 2, "filters") as advance:
        advance()
    assert capsys.readouterr() == ("", "")
