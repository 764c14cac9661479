"""The choice of `--quickest`."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from tests import ROOT, conftest
from tests.conftest import DURATIONS, distances_of, within

TOOK = {"a": 3.0, "b": 0.5, "c": 1.0, "d": 0.25}


@pytest.fixture(autouse=True)
def collected_at_once(monkeypatch):
    monkeypatch.setattr(conftest, "FILE_S", 0.0)


@pytest.mark.parametrize(
    ("seconds", "chosen"),
    [(0.0, ""), (0.74, "d"), (0.75, "db"), (1.25, ["d", "b", "new"]), (100.0, ["d", "b", "new", "c", "a"])],
)
def test_the_quickest_tests_that_fit_are_chosen_and_new_ones_count_half_a_second(seconds, chosen):
    assert within(seconds, ["a", "b", "new", "c", "d"], TOOK) == set(chosen)


def test_a_test_that_is_not_asked_for_takes_no_time_from_the_others():
    assert within(1.0, ["c"], TOOK) == {"c"}


def test_nearer_tests_come_first_and_what_does_not_fit_makes_room_for_farther_ones():
    distance = {"a": 0, "c": 0, "b": 1, "d": 2}.get
    assert within(1.0, TOOK, TOOK, distance=distance) == {"c"}
    assert within(1.3, TOOK, TOOK, distance=distance) == {"c", "d"}
    assert within(100.0, TOOK, TOOK, distance={"b": 5}.get) == {"b"}


def test_workers_share_the_files_and_each_collects_all(monkeypatch):
    took = {"x::1": 1.0, "x::2": 1.0, "x::3": 1.0, "y::1": 1.5, "z::1": 1.5}
    assert within(2.0, took, took) == {"x::1", "x::2"}
    assert within(2.0, took, took, workers=2) == {"x::1", "x::2", "y::1"}  # x::3 would be 3 s on one of them
    monkeypatch.setattr(conftest, "FILE_S", 0.5)
    assert within(2.0, took, took, workers=2) == {"x::1"}  # with y: 2.5 s of tests and 2 s of collection
    assert within(3.0, took, took, workers=2) == {"x::1", "x::2", "y::1"}


def test_the_distance_of_a_test_is_the_least_of_its_entries():
    distance = distances_of({"x.py::motor": 1, "x.py": 3, "y.py::car": 2})
    expected = {"x.py::a[motor]": 1, "x.py::a": 3, "y.py::a[car]": 2, "y.py::motor": None, "z.py::car": None}
    assert {name: distance(name) for name in expected} == expected


@pytest.mark.parametrize(
    ("near", "workers", "left"),
    [([], 1, ["x::c", "x::b"]), (["y,z", "x"], 1, ["y::a"]), (["y", "x::b"], 2, ["y::a", "x::b"])],
)
def test_pytest_runs_only_the_chosen_in_its_own_order(near, workers, left):
    took = {"y::a": 1.0, "x::b": 0.5, "x::c": 0.25}
    gone = []
    hook = SimpleNamespace(pytest_deselected=lambda items: gone.extend(item.nodeid for item in items))
    options = {"--quickest": 1.0, "--near": near, "-m": "release"}
    config = SimpleNamespace(
        getoption=options.get,
        hook=hook,
        cache=SimpleNamespace(get=lambda *_: took),
        workerinput={"workercount": workers},
    )
    items = [SimpleNamespace(nodeid=name) for name in ("y::a", "x::c", "x::b")]
    conftest.pytest_collection_modifyitems(config, items)
    assert [item.nodeid for item in items] == left
    assert sorted(gone) == sorted(took.keys() - set(left))


def test_a_run_keeps_the_duration_of_each_of_its_tests(tmp_path):
    name = "tests/test_conftest.py::test_a_test_that_is_not_asked_for_takes_no_time_from_the_others"
    command = [sys.executable, "-m", "pytest", "-q", "-o", f"cache_dir={tmp_path}", name]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert json.loads((tmp_path / "v" / DURATIONS).read_text()).keys() == {name}
