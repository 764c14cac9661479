"""The browser is opened at a file of this user's, and never learns the token from its command line."""

import os
import re
import signal
import stat
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from app.web import session as opening_module
from app.web.session import BrowserPage
from tests.app.scripted import wait_for

pytestmark = pytest.mark.skipif(os.name != "posix", reason="permissions and command lines as on POSIX")
URL = 'http://127.0.0.1:9900/?token=a"b&c'


@pytest.fixture(autouse=True)
def runtime(tmp_path, monkeypatch):
    folder = tmp_path / "runtime"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def test_only_this_user_can_read_the_file_and_it_leads_to_the_page(runtime, monkeypatch):
    before = os.umask(0)
    try:
        opening = BrowserPage(URL)
    finally:
        os.umask(before)
    assert stat.S_IMODE(opening.path.stat().st_mode) == 0o600
    assert opening.path.parent == runtime
    text = opening.path.read_text()
    assert 'content="0;url=http://127.0.0.1:9900/?token=a&quot;b&amp;c"' in text
    shown = []
    monkeypatch.setattr(opening_module.webbrowser, "open", shown.append)
    opening.show()
    wait_for(lambda: shown)
    assert Path(unquote(urlsplit(shown[0]).path)) == opening.path and "token" not in shown[0]
    opening.close()
    opening.close()
    assert not list(runtime.iterdir())


def test_without_a_runtime_folder_it_is_among_the_temporary_ones(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "absent"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    opening = BrowserPage(URL)
    assert opening.path.parent == tmp_path
    opening.close()


BROWSER = """#!/bin/sh
tr '\\0' ' ' < /proc/$$/cmdline > "$SEEN.part"
cat "${1#file://}" >> "$SEEN.part"
mv "$SEEN.part" "$SEEN"
"""


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="reads command lines from /proc")
def test_two_runs_have_two_tokens_and_show_neither(tmp_path, runtime):
    from http.client import HTTPConnection

    browser = tmp_path / "browser"
    browser.write_text(BROWSER)
    browser.chmod(0o755)
    tokens = []
    for k in range(2):
        seen = tmp_path / f"seen{k}"
        settings = {**os.environ, "BROWSER": f"{browser} %s", "SEEN": str(seen)}
        code = "import sys; from app.cli.main import main; sys.exit(main(['run', 'motor_winding', '--port', '0']))"
        run = subprocess.Popen([sys.executable, "-c", code], env=settings, stdout=subprocess.PIPE, text=True)
        try:
            printed = next(found for line in run.stdout if (found := re.search(r"http://127\.0\.0\.1:(\d+)/\S+", line)))
            wait_for(seen.exists)
            port, target = int(printed[1]), "/" + printed[0].partition("/?")[1][1:] + printed[0].partition("/?")[2]
            token = target.partition("token=")[2]
            said = seen.read_text().splitlines()
            assert said[0].startswith("/bin/sh") and token not in said[0]
            assert f'url={printed[0]}"' in "\n".join(said)
            assert len(list(runtime.iterdir())) == 1
            # The printed address still works, and the file goes once a browser has come.
            connection = HTTPConnection("127.0.0.1", port)
            connection.request("GET", target)
            assert connection.getresponse().status == 303
            wait_for(lambda: not list(runtime.iterdir()))
            tokens.append(token)
        finally:
            run.send_signal(signal.SIGTERM)
            run.wait()
    assert tokens[0] != tokens[1]


def test_the_file_goes_with_the_session_that_nobody_looked_at(tmp_path, runtime):
    settings = {**os.environ, "BROWSER": "true %s"}
    words = ["run", "motor_winding", "--port", "0", "--duration", "1"]
    code = f"import sys; from app.cli.main import main; sys.exit(main({words!r}))"
    subprocess.run([sys.executable, "-c", code], env=settings, check=True, stdout=subprocess.DEVNULL)
    assert not list(runtime.iterdir())
