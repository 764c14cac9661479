"""What tests share: recordings and browser, which a machine may lack, but not the one that judges (CI=true).

How long each test takes is kept between runs, for `--quickest`.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.chromium import find_chromium

ROOT = Path(__file__).resolve().parent.parent

LIVE = ROOT / "tests" / "app"

DURATIONS = "nisus/durations"
"""In pytest's cache: seconds of each test, the least of all runs, so that neither compiling nor other work counts."""


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "run only the quickest tests, as many as take so many seconds together by earlier runs, and all new ones"
    parser.addoption("--quickest", type=float, metavar="SECONDS", help=text)
    text = "pages send and receive so much later: a browser test that asks before an answer can be there fails always"
    parser.addoption("--lag", type=float, default=0.0, metavar="SECONDS", help=text)


def within(budget: float, names: list[str], took: dict[str, float]) -> set[str]:
    """The quickest of the tests that take `budget` seconds together at most; those of unknown duration are in."""
    chosen = {name for name in names if name not in took}
    for name in sorted(set(names) - chosen, key=lambda name: (took[name], name)):
        budget -= took[name]
        if budget < 0.0:
            break
        chosen.add(name)
    return chosen


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("browser") or LIVE in item.path.parents:
            # Chromium beside other work misses a click now and then, and a thread of a live twin is late. What fails
            # twice is ours; once is said as "rerun".
            item.add_marker(pytest.mark.flaky(reruns=1))
    budget, cache = config.getoption("--quickest"), getattr(config, "cache", None)
    if budget is None or cache is None:
        return
    chosen = within(budget, [item.nodeid for item in items], cache.get(DURATIONS, {}))
    config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in chosen])
    items[:] = [item for item in items if item.nodeid in chosen]


class Durations:
    """Adds up what setup, call and teardown of each test take, and keeps the least of all runs."""

    def __init__(self, config: pytest.Config) -> None:
        self.config, self.took = config, dict[str, float]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.took[report.nodeid] = self.took.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        cache = self.config.cache
        before = cache.get(DURATIONS, {})
        least = {name: round(min(took, before.get(name, took)), 3) for name, took in self.took.items()}
        cache.set(DURATIONS, before | least)


def pytest_configure(config: pytest.Config) -> None:
    # Workers of xdist send their reports to the process that started them, which alone keeps them.
    if getattr(config, "cache", None) is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Durations(config), "durations")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print why the first try of a test failed that was tried again."""
    for report in terminalreporter.stats.get("rerun", ()):
        terminalreporter.section(f"first try of {report.nodeid}")
        terminalreporter.line(report.longreprtext)


def absent(reason: str) -> None:
    """Skip, and say why; under CI=true fail instead, so that a green run has tested everything."""
    if os.environ.get("CI", "").lower() in ("true", "1"):
        pytest.fail(f"{reason}; with CI=true that is a failure", pytrace=False)
    pytest.skip(reason)


def recorded(name: str) -> tuple[Any, Any]:
    """A bundled twin and its own log; the test skips where the recording is absent."""
    from app.twin.log_reader import read_log
    from app.twin.twin import load_twin
    from estimators.errors import SourceError

    twin = load_twin(name)
    try:
        return twin, read_log(twin, None)[0]
    except SourceError as error:
        if "is not there" in str(error):
            absent(str(error))
        raise


def data_folder() -> Path:
    """Where recordings lie: NISUS_DATA, or beside the checkout."""
    return Path(os.environ.get("NISUS_DATA") or ROOT.parent / "shared" / "data")


@pytest.fixture(scope="session")
def data() -> Callable[..., Path]:
    """data("set", "file"): a recording; the test skips where it is absent."""

    def find(*parts: str) -> Path:
        path = data_folder().joinpath(*parts)
        if not path.exists():
            absent(f"recording {'/'.join(parts)} is not in {data_folder()}; set NISUS_DATA to the folder that has it")
        return path

    return find


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of a Chromium; the test skips where there is none."""
    found = find_chromium()
    if found is None:
        absent("no Chromium found; install one (Debian: apt install chromium) or set NISUS_CHROMIUM to its path")
    return str(found)
