"""A browser, the command line, and a twin file for the tests of `app`."""

import asyncio
import json
import re
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from app.cli.main import main
from config.loader import TWINS
from tests.chromium import launched
from tests.waiting import LIMIT_S

LATE = """(() => {
    const { send } = WebSocket.prototype;
    WebSocket.prototype.send = function (data) {
        setTimeout(() => this.readyState === WebSocket.OPEN && send.call(this, data), LAG);
    };
    for (const name of ["onopen", "onmessage", "onclose"]) {
        const { set } = Object.getOwnPropertyDescriptor(WebSocket.prototype, name);
        Object.defineProperty(WebSocket.prototype, name, {
            set(taken) { set.call(this, (event) => setTimeout(() => taken.call(this, event), LAG)); },
        });
    }
    const { fetch } = window;
    window.fetch = async (...what) => {
        const answer = await fetch(...what);
        await new Promise((resolve) => setTimeout(resolve, LAG));
        return answer;
    };
})()"""


@pytest.fixture(scope="session")
def shared_chromium(chromium: str, pytestconfig: pytest.Config) -> Iterator[Any]:
    """Chromium, as Playwright drives it, one for each worker; its event loop is marked as running in this thread."""
    from playwright.sync_api import expect

    expect.set_options(timeout=1e3 * LIMIT_S)
    lag = 1e3 * pytestconfig.getoption("--lag")
    with launched(chromium) as browser:
        loop, new_context = asyncio.get_running_loop(), browser.new_context

        def patient(**options: Any) -> Any:
            context = new_context(**options)
            context.set_default_timeout(1e3 * LIMIT_S)
            if lag:
                context.add_init_script(LATE.replace("LAG", f"{lag:g}"))
            return context

        browser.new_context = patient
        asyncio._set_running_loop(None)
        yield browser, loop
        asyncio._set_running_loop(loop)


@pytest.fixture
def browser(shared_chromium: tuple[Any, asyncio.AbstractEventLoop]) -> Iterator[Any]:
    """Chromium, for contexts of a test's own. `--lag` makes its pages late.

    Between tests with a browser the mark of Playwright's loop is taken away: others call `asyncio.run`.
    """
    browser, loop = shared_chromium
    asyncio._set_running_loop(loop)
    try:
        yield browser
        for context in browser.contexts:
            context.close()
    finally:
        asyncio._set_running_loop(None)


class Finished(NamedTuple):
    """A command that has ended: exit status, and what it printed."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Its last line of output as strict JSON."""
        return json.loads(self.out.splitlines()[-1], parse_constant=pytest.fail)

    @property
    def words(self) -> str:
        """Its output on one line."""
        return " ".join(self.out.split())


class CommandLine:
    """Runs commands in this process; arguments may be anything with a text."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def run(self, *arguments: object) -> Finished:
        """Run a command, whatever its exit status."""
        self._capsys.readouterr()
        return Finished(main([str(argument) for argument in arguments]), *self._capsys.readouterr())

    def __call__(self, *arguments: object) -> Finished:
        """Run a command that succeeds."""
        done = self.run(*arguments)
        assert done.status == 0, done
        return done

    def refuses(self, *arguments: object) -> str:
        """Run a command that is refused with status 2 and one line, and return the line."""
        done = self.run(*arguments)
        # Beside it stands at most the progress of work that took long.
        progress = re.compile(r"(?!nisus: ).*( \.\.\.|\b\d+ s(, .*)?)")
        lines = [line for line in done.err.splitlines() if not progress.fullmatch(line)]
        assert done.status == 2 and len(lines) == 1 and lines[0].startswith("nisus: "), done
        return lines[0]


@pytest.fixture
def nisus(capsys: pytest.CaptureFixture[str]) -> CommandLine:
    """The command line."""
    return CommandLine(capsys)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt, though servers of other tests handle it, and background shells ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def winding(tmp_path: Path) -> Path:
    """A twin file of a test's own: the bundled one of a motor winding."""
    return Path(shutil.copy(TWINS / "motor_winding.yaml", tmp_path / "winding.yaml"))
