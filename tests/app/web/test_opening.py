"""Opening the page: a port that is taken is reported first, and no command line shows the token."""

import os
import re
import signal
import socket
import stat
import subprocess
import sys
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import app.cli.open_twin
import app.cli.run
from app.cli.main import main
from app.engine.engine import Engine
from app.web import session as session_module
from app.web.http_server import FormerSessions, check_port
from app.web.server import PageServer
from app.web.session import BrowserPage
from estimators.errors import ConfigError
from tests.app.scripted import Scripted, twin
from tests.app.served import SECRET
from tests.app.web.page.browsed import DRAWN, until
from tests.support import free_port
from tests.waiting import wait_for

posix = pytest.mark.skipif(os.name != "posix", reason="permissions and command lines as on POSIX")
URL = 'http://127.0.0.1:9900/?token=a"b&c'


@pytest.fixture
def port():
    return free_port()


@pytest.fixture
def taken():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other.getsockname()[1]


@pytest.mark.parametrize("command", ["run", "review"])
def test_a_port_in_use_is_reported_before_anything_is_compiled(command, taken, monkeypatch, capsys):
    for place in ("app.cli.open_twin.begin_to_compile", "app.record.reader.read_recording"):
        monkeypatch.setattr(place, lambda *_: pytest.fail("it went on"))
    assert main([command, "motor_winding", "--port", str(taken), "--no-browser"]) == 2
    assert re.fullmatch(rf"nisus: port {taken}: .* in use; .*--port\n", capsys.readouterr().err)


def test_without_a_page_the_port_does_not_matter(taken, monkeypatch):
    reached = []
    monkeypatch.setattr(app.cli.run, "prepare", reached.append)
    monkeypatch.setattr(app.cli.run, "open_session", lambda *_, **__: (_ for _ in ()).throw(ConfigError("enough")))
    assert main(["run", "motor_winding", "--port", str(taken), "--headless"]) == 2
    assert len(reached) == 1


def test_a_port_that_was_checked_is_free_again(port):
    for wanted in (port, port, 0):
        check_port(wanted)
    for wrong in (-1, 70000):
        with pytest.raises(ConfigError, match=f"port {wrong}: is not a port; choose another with --port"):
            check_port(wrong)


# The file that leads a browser to the page


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    folder = tmp_path / "runtime"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


@posix
@pytest.mark.parametrize("usable", [True, False])
def test_only_this_user_can_read_the_file_and_it_leads_to_the_page(runtime, tmp_path, monkeypatch, usable):
    folder = runtime if usable else tmp_path / "temporary"
    if not usable:
        folder.mkdir()
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "absent"))
        monkeypatch.setattr("tempfile.tempdir", str(folder))
    before = os.umask(0)
    try:
        opening = BrowserPage(URL)
    finally:
        os.umask(before)
    assert opening.path.parent == folder and stat.S_IMODE(opening.path.stat().st_mode) == 0o600
    assert 'content="0;url=http://127.0.0.1:9900/?token=a&quot;b&amp;c"' in opening.path.read_text()
    shown = []
    monkeypatch.setattr(session_module.webbrowser, "open", shown.append)
    opening.show()
    wait_for(lambda: shown)
    assert Path(unquote(urlsplit(shown[0]).path)) == opening.path and "token" not in shown[0]
    opening.close()
    opening.close()
    assert not list(folder.iterdir())


BROWSER = """#!/bin/sh
tr '\\0' ' ' < /proc/$$/cmdline > "$SEEN.part"
cat "${1#file://}" >> "$SEEN.part"
mv "$SEEN.part" "$SEEN"
"""


def program(*words):
    return [sys.executable, "-c", f"import sys; from app.cli.main import main; sys.exit(main({list(words)!r}))"]


def printed_address(run):
    return next(found[0] for line in run.stdout if (found := re.search(r"http://127\.0\.0\.1:\d+/\S+", line)))


@posix
@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="reads command lines from /proc")
def test_two_runs_have_two_tokens_and_show_neither(tmp_path, runtime):
    browser = tmp_path / "browser"
    browser.write_text(BROWSER)
    browser.chmod(0o755)
    tokens = set()
    for k in range(2):
        seen = tmp_path / f"seen{k}"
        settings = {**os.environ, "BROWSER": f"{browser} %s", "SEEN": str(seen)}
        run = subprocess.Popen(
            program("run", "motor_winding", "--port", "0"), env=settings, stdout=subprocess.PIPE, text=True
        )
        try:
            printed = printed_address(run)
            wait_for(seen.exists)
            address = urlsplit(printed)
            token, said = address.query.removeprefix("token="), seen.read_text().splitlines()
            assert said[0].startswith("/bin/sh") and token not in said[0]
            assert f'url={printed}"' in "\n".join(said) and len(list(runtime.iterdir())) == 1
            # The printed address still works, and the file is removed once a browser has come.
            connection = HTTPConnection("127.0.0.1", address.port)
            connection.request("GET", f"/?{address.query}")
            assert connection.getresponse().status == 303
            wait_for(lambda: not list(runtime.iterdir()))
            tokens.add(token)
        finally:
            run.send_signal(signal.SIGTERM)
            run.wait()
    assert len(tokens) == 2


@posix
def test_the_file_is_removed_with_a_session_that_no_browser_opened(runtime):
    words = program("run", "motor_winding", "--port", "0", "--duration", "1")
    subprocess.run(words, env={**os.environ, "BROWSER": "true %s"}, check=True, stdout=subprocess.DEVNULL)
    assert not list(runtime.iterdir())


@pytest.mark.browser
def test_the_file_opens_the_page_and_the_next_session_asks_for_its_own_address(browser, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    engine = Engine(twin(), lambda report: Scripted())
    server = PageServer(engine, port=0, viser_port=None, secret=SECRET)
    server.start()
    opening = BrowserPage(server.url)
    page = browser.new_context().new_page()
    try:
        page.goto(opening.path.as_uri())
        page.locator("#connection[data-state=live]").wait_for(state="attached")
        # The token is in a cookie then, no longer in the address.
        assert page.url == f"http://127.0.0.1:{server.port}/" and server.entered.is_set()
        page.reload()
        page.locator("#connection[data-state=live]").wait_for(state="attached")
        server.stop()
        wait_for(lambda: "trying again" in page.locator("#connection").inner_text())
        server = PageServer(engine, port=server.port, viser_port=None, secret=SECRET)
        server.start()
        page.get_by_text("This session has ended").wait_for()
    finally:
        opening.close()
        server.stop()


@pytest.mark.browser
def test_an_open_page_returns_to_a_session_that_is_killed_and_started_again(browser, runtime, port):
    words = program("run", "motor_winding", "--port", str(port), "--no-browser")

    def begun():
        run = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        return run, printed_address(run)

    page = browser.new_context().new_page()
    run, address = begun()
    try:
        page.goto(address)
        boots = []
        for _ in range(2):
            until(page, f"{DRAWN} && !{boots}.includes(document.body.dataset.settings)")
            boots.append(page.evaluate("document.body.dataset.settings"))
            run.kill()
            run.wait()
            page.get_by_text("Connection lost, trying again").wait_for()
            run, _ = begun()
        until(page, f"{DRAWN} && !{boots}.includes(document.body.dataset.settings)")
        # Another port's cookie and a file that others may write open nothing.
        kept = runtime / "nisus" / f"sessions-{port}"
        assert len(kept.read_text().split()) == 3 and kept.stat().st_mode & 0o777 == 0o600
        assert FormerSessions(port).digests() and not FormerSessions(port + 1).digests()
        kept.chmod(0o666)
        assert not FormerSessions(port).digests()
    finally:
        run.kill()
        run.wait()
