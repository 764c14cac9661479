"""What tests share: recordings and browser, the limit of a test, and how long each takes, for `--quickest`."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.chromium import find_chromium
from tests.skips import recording, skip_without, summary
from tests.waiting import TEST_LIMIT_S

DURATIONS = "nisus/durations"
"""In pytest's cache: seconds of each test, the least of all runs, so that neither compiling nor other work counts."""


UNKNOWN_S = 0.5
"""Assumed duration of a test that has not run yet."""

FILE_S = 0.1
"""Duration of the collection of a test file, on every worker."""


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "run only the quickest tests, as many as take so many seconds by earlier runs on the workers there are"
    parser.addoption("--quickest", type=float, metavar="SECONDS", help=text)
    text = (
        "of `--quickest`: test files, `FILE::WORD` for tests with that word in their name; repeat it for others that "
    )
    text += "come after these (`python -m tests.affected` prints them)"
    parser.addoption("--near", action="append", default=[], metavar="FILE,FILE", help=text)
    text = "pages send and receive so much later: a browser test that asks before an answer can be there fails always"
    parser.addoption("--lag", type=float, default=0.0, metavar="SECONDS", help=text)


def distances_of(entries: Mapping[str, int]) -> Callable[[str], int | None]:
    """Return the distance of a test by its name, from those of `FILE` and `FILE::WORD`; None for any other test."""
    words: dict[str, list[tuple[str, int]]] = {}
    for entry, distance in entries.items():
        file, _, word = entry.partition("::")
        words.setdefault(file, []).append((word, distance))

    def distance_of(name: str) -> int | None:
        file, _, test = name.partition("::")
        return min((distance for word, distance in words.get(file, ()) if word in test), default=None)

    return distance_of


def within(
    seconds: float,
    names: Iterable[str],
    took: Mapping[str, float],
    workers: int = 1,
    distance: Callable[[str], int | None] = lambda name: 0,
) -> set[str]:
    """Return the nearest tests, of equally near ones the quickest, that the workers finish within the time.

    The tests of one file run on one worker, and each worker collects all files. Tests without a distance are left out.
    """
    near = [(at, took.get(name, UNKNOWN_S), name) for name in set(names) if (at := distance(name)) is not None]
    left, per_file, chosen = seconds * workers, dict[str, float](), set[str]()
    for _, test_s, name in sorted(near):
        file = name.partition("::")[0]
        cost = test_s + (0.0 if file in per_file else FILE_S * workers)
        if cost <= left and per_file.get(file, FILE_S) + test_s <= seconds:
            left -= cost
            per_file[file] = per_file.get(file, FILE_S) + test_s
            chosen.add(name)
    return chosen


@pytest.hookimpl(trylast=True)  # after -m and -k have deselected theirs
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    kept, seconds, cache = list(items), config.getoption("--quickest"), getattr(config, "cache", None)
    if "release" not in config.getoption("-m"):
        kept = [item for item in kept if item.get_closest_marker("release") is None]
    if seconds is not None and cache is not None:
        workers = getattr(config, "workerinput", {}).get("workercount", 1)
        near = {entry: at for at, entries in enumerate(config.getoption("--near")) for entry in entries.split(",")}
        distance = distances_of(near) if near else lambda name: 0
        chosen = within(seconds, [item.nodeid for item in kept], cache.get(DURATIONS, {}), workers, distance)
        kept = [item for item in kept if item.nodeid in chosen]
    left = {item.nodeid for item in kept}
    config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in left])
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
