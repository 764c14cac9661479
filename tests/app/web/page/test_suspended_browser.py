"""A real browser that is suspended in the midst of drawing: it costs neither readings nor recorded rows."""

import os
import signal
import subprocess

import numpy as np
import pytest

from app.engine.commands import Record
from app.record.reader import read_recording
from estimators.log import READING
from tests.app.web.page.browsed import running
from tests.chromium import FLAGS
from tests.waiting import LIMIT_S, wait_for

pytestmark = pytest.mark.browser

LIVED = 300
"""Events, one a second of the twin, that come while the browser is suspended."""


@pytest.fixture
def suspendable(chromium, tmp_path):
    """A Chromium in a process group of its own, and the port that controls it."""
    profile = tmp_path / "profile"
    process = subprocess.Popen(
        [chromium, *FLAGS, "--remote-debugging-port=0", f"--user-data-dir={profile}", "about:blank"],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    port = profile / "DevToolsActivePort"
    wait_for(lambda: port.is_file() and port.read_text().count("\n") > 0)
    yield process, int(port.read_text().split()[0])
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="this system cannot suspend a process")
def test_a_suspended_browser_costs_nothing(suspendable, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api")
    process, port = suspendable
    path = tmp_path / "suspended.rrd"
    with running("motor_winding", 60.0, **{"source.duration": "1000000"}) as session:
        session.engine.submit(Record(path))
        with sync_api.sync_playwright() as playwright:
            page = playwright.chromium.connect_over_cdp(f"http://127.0.0.1:{port}").contexts[0].new_page()
            page.goto(session.url, timeout=LIMIT_S * 1000)
            wait_for(lambda: page.evaluate("window.nisus?.drawn > 0"))
            before = session.engine.status().counts["readings"]
            os.killpg(process.pid, signal.SIGSTOP)
            wait_for(lambda: session.engine.status().counts["readings"] > before + LIVED)
            during = session.engine.status().counts["readings"]
            os.killpg(process.pid, signal.SIGCONT)
            drawn = page.evaluate("window.nisus.drawn")
            # It goes on where it is now, without anybody's help.
            wait_for(lambda: page.evaluate("window.nisus.drawn") > drawn)
        session.engine.submit(Record(None))
        wait_for(lambda: session.recorder.finished)
    recorded = read_recording(path)
    rows = recorded.events.t[recorded.events.kind == READING]
    assert rows.size > during
    np.testing.assert_array_equal(np.diff(rows), 1_000_000_000)
