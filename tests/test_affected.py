"""The choice of `make fast`: what a change is, how far from it each test file is, and what fits into the time."""

import json
import subprocess
import sys

import pytest

from tests import ROOT
from tests.affected import UNKNOWN_S, changed, durations, fitting, nearest
from tests.conftest import DURATIONS

CHECKOUT = {
    "app/a.py": "",
    "app/b.py": "from .a import x",
    "app/c.py": "def later():\n    import app.b",
    "app/web/page/strip.js": "",
    "tests/test_b.py": "from app.b import x",
    "tests/test_helped.py": "from tests.helper import x",
    "tests/helper.py": "import app.c",
    "tests/test_nothing.py": "def test_one(): ...\ndef test_two(): ...",
    "tests/app/test_a.py": "",
    "tests/app/test_page_browser.py": "from app.a import x",
    "tests/app/web/test_http_server.py": "",
}


@pytest.fixture
def checkout(tmp_path):
    for name, text in CHECKOUT.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("change", "distances"),
    [
        ("app/a.py", {"tests/app/test_a.py": 0, "tests/test_b.py": 2, "tests/test_helped.py": 4}),
        ("app/c.py", {"tests/test_helped.py": 2}),
        ("app/web/page/strip.js", {"tests/app/web/test_http_server.py": 1}),
        ("tests/test_nothing.py", {"tests/test_nothing.py": 0}),
        ("app/gone.py", {}),
    ],
)
def test_distance_is_the_number_of_imports(checkout, change, distances):
    assert nearest([change], checkout) == distances


def test_a_change_is_what_differs_from_main_and_what_is_new(checkout):
    def git(*words):
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=checkout, check=True)

    git("init", "-q", "-b", "main")
    git("add", ".")
    git("commit", "-qm", "first")
    assert changed(checkout) == []
    git("checkout", "-qb", "work")
    (checkout / "app" / "a.py").write_text("x = 1")
    git("commit", "-qam", "second")
    (checkout / "app" / "b.py").write_text("")
    (checkout / "app" / "new.py").write_text("")
    assert changed(checkout) == ["app/a.py", "app/b.py", "app/new.py"]


def test_near_files_come_first_and_what_does_not_fit_makes_room(checkout):
    took = {"a": 5.0, "b": 1.0, "c": 3.0, "d": 2.0}
    assert fitting({"a": 0, "b": 2, "c": 1, "d": 2}, took, 4.0) == ["c", "b"]
    assert fitting({"a": 0, "b": 2, "c": 1, "d": 2}, took, 11.0) == ["a", "c", "b", "d"]


def test_durations_are_those_of_earlier_runs(checkout):
    names = ["tests/test_b.py", "tests/test_nothing.py"]
    assert durations(names, checkout) == {"tests/test_b.py": 0.0, "tests/test_nothing.py": 2 * UNKNOWN_S}
    kept = checkout / ".pytest_cache" / "v" / "nisus" / "durations"
    kept.parent.mkdir(parents=True)
    kept.write_text(json.dumps({"tests/test_b.py::test_one": 1.0, "tests/test_b.py::test_two[x]": 0.5}))
    assert durations(names, checkout)["tests/test_b.py"] == 1.5


def test_a_run_keeps_the_duration_of_each_of_its_tests(tmp_path):
    name = "tests/test_affected.py::test_near_files_come_first_and_what_does_not_fit_makes_room"
    run = [sys.executable, "-m", "pytest", "-q", "-o", f"cache_dir={tmp_path}", name]
    subprocess.run(run, cwd=ROOT, check=True, capture_output=True)
    assert [*json.loads((tmp_path / "v" / DURATIONS).read_text())] == [name]
