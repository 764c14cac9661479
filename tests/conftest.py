"""What tests share: recordings and browser, the limit of a test, and how long each takes, for `make fast`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.chromium import find_chromium
from tests.skips import recording, skip_without, summary
from tests.waiting import TEST_LIMIT_S

# On a busy machine an example takes longer than Hypothesis allows.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

DURATIONS = "nisus/durations"
"""In pytest's cache: seconds of each test, the least of all runs, so that neither compiling nor other work counts."""


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "pages send and receive so much later: a browser test that asks before an answer can be there fails always"
    parser.addoption("--lag", type=float, default=0.0, metavar="SECONDS", help=text)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if "release" not in config.getoption("-m"):
        kept = [item for item in items if item.get_closest_marker("release") is None]
        config.hook.pytest_deselected(items=[item for item in items if item.get_closest_marker("release")])
        items[:] = kept


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


@pytest.hookimpl(tryfirst=True)  # before pytest-timeout reads it
def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("timeout", None) is None:
        config.option.timeout = TEST_LIMIT_S
    # Workers of xdist send their reports to the process that started them, which alone keeps them.
    # The cache itself is made after this.
    if config.pluginmanager.hasplugin("cacheprovider") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Durations(config), "durations")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print one line for each reason of skips."""
    reports = terminalreporter.stats.get("skipped", ())
    for line in summary(report.longrepr[2].removeprefix("Skipped: ") for report in reports):
        terminalreporter.line(line)


@pytest.fixture(scope="session")
def data() -> Callable[..., Path]:
    """data("set", "file"): a recording; the test skips where it is absent."""
    return recording


@pytest.fixture(scope="session")
def chromium() -> str:
    """Path of a Chromium; the test skips where there is none."""
    found = find_chromium()
    return found or skip_without("Chromium")
