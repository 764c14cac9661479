"""`make bench` goes on after a section that cannot run, and writes every figure."""

import json
from collections.abc import Iterator

from estimators.errors import SourceError
from tests.benchmarks.timing import BenchmarkRow, Bound, run_sections


def good() -> Iterator[BenchmarkRow]:
    """Two rows."""
    yield BenchmarkRow("kf", {"step [µs]": 0.5}, (Bound("step [µs]", 1.0),))
    yield BenchmarkRow("ukf", {"step [µs]": 2.0, "ratio": float("nan")}, (Bound("step [µs]", 1.0),))


def absent() -> Iterator[BenchmarkRow]:
    """A section without its recording."""
    raise SourceError("no recording")
    yield


def uninstalled() -> Iterator[BenchmarkRow]:
    """A section without its peer."""
    raise ImportError("no peer")
    yield


def broken() -> Iterator[BenchmarkRow]:
    """A section that fails after a row."""
    yield BenchmarkRow("pf", {"step [µs]": 3.0})
    raise ValueError("wrong shape")


def test_a_section_that_cannot_run_is_reported_and_the_others_run(tmp_path, capsys):
    file = tmp_path / "figures.json"
    run_sections([absent, uninstalled, broken, good], file)
    found = json.loads(file.read_text())
    of = {name.rpartition(".")[2]: section for name, section in found.items()}
    assert of["absent"] == {"rows": {}, "skipped": "no recording"} and of["uninstalled"]["skipped"] == "no peer"
    assert of["broken"] == {"rows": {"pf": {"step [µs]": 3.0}}, "failed": "ValueError: wrong shape"}
    assert of["good"]["rows"]["kf"] == {"step [µs]": 0.5, "met": {"step [µs]": True}}
    assert of["good"]["rows"]["ukf"] == {"step [µs]": 2.0, "ratio": None, "met": {"step [µs]": False}}
    printed = capsys.readouterr().out
    assert "skipped: no recording" in printed and "PASS" in printed and "FALLS SHORT" in printed
