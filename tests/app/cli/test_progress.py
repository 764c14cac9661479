"""Where standard error is no terminal, work that takes long says now and then how far it has got."""

import io
import threading

from app.cli.prepare import progress, progress_lines, progress_text


class Heard(io.StringIO):
    """A stream that knows when it was written to."""

    def __init__(self):
        super().__init__()
        self.written = threading.Event()

    def flush(self):
        self.written.set()


def test_lines_come_while_nothing_is_done_and_count_what_is():
    now = 100.0
    heard = Heard()
    with progress_lines("pump", 12, "filters", every=1e-3, clock=lambda: now, file=heard) as advance:
        assert heard.written.wait(10.0)
        assert heard.getvalue().startswith("pump: 0 of 12 filters after 0 s\n")
        now = 130.0
        for _ in range(3):
            advance()
        for _ in range(2):  # the first may have begun before they were done
            heard.written.clear()
            assert heard.written.wait(10.0)
    assert heard.getvalue().endswith("pump: 3 of 12 filters after 30 s, about 90 s left\n")
    assert not any(thread.name == "progress" for thread in threading.enumerate())


def test_the_rest_takes_as_long_as_what_is_done():
    assert progress_text("pump", 12, 12, "filters", 40.0) == "pump: 12 of 12 filters after 40 s, about 0 s left"
    assert progress_text("pump", 8, 12, "filters", 40.0) == "pump: 8 of 12 filters after 40 s, about 20 s left"


def test_short_work_says_nothing_in_a_pipe(capsys):
    with progress("pump", 2, "filters") as advance:
        advance()
    assert capsys.readouterr() == ("", "")
