"""The choice of `make fast`: what a change is, and how far from it each test file is."""

import subprocess

import pytest

from tests import affected

CHECKOUT = {
    "app/a.py": "",
    "app/b.py": "from .a import x",
    "app/c.py": "def later():\n    import app.b",
    "app/alone.py": "",
    "app/web/page/strip.js": "",
    "app/web/serves.py": 'PAGE = "page/strip.js"',
    "config/twins/pump.yaml": "",
    "docs/guides/start.md": "",
    "tests/__init__.py": "",
    "tests/conftest.py": "import app.a",
    "tests/test_b.py": "from app.b import x",
    "tests/test_c.py": "from app import c",
    "tests/test_helped.py": "from tests.helper import x",
    "tests/helper.py": "import app.c",
    "tests/test_nothing.py": 'NAMES = "pump_can", "xstrip.js"',
    "tests/test_pump.py": 'NAME = "pump"',
    "tests/test_twins.py": "for name in shipped(): ...",
    "tests/test_serves.py": "import app.web.serves",
    "tests/app/test_a.py": "",
    "tests/app/test_browser.py": "from app.a import x\n\npytestmark = pytest.mark.browser",
    "tests/app/web/conftest.py": "import app.alone",
    "tests/app/web/test_door.py": "",
    "tests/app/web/page/test_colours.py": "",
    "tests/config/test_loader.py": "",
    "tests/docs/test_guides.py": "",
}


@pytest.fixture
def checkout(tmp_path):
    for name, text in CHECKOUT.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


NEAR = {
    "app/a.py": {"tests/app/test_a.py": 0, "tests/test_b.py": 2, "tests/test_c.py": 3, "tests/test_helped.py": 4},
    "app/b.py": {"tests/test_b.py": 1, "tests/test_c.py": 2, "tests/test_helped.py": 3},
    "app/alone.py": {"tests/app/web/test_door.py": 2, "tests/app/web/page/test_colours.py": 2},
    "app/web/page/strip.js": {"tests/app/web/page/test_colours.py": 1, "tests/test_serves.py": 2},
    "config/twins/pump.yaml": {
        "tests/test_pump.py": 1,
        "tests/test_twins.py::pump": 1,
        "tests/config/test_loader.py": 1,
    },
    "docs/guides/start.md": {"tests/docs/test_guides.py": 1},
    "tests/helper.py": {"tests/test_helped.py": 1},
    "tests/test_nothing.py": {"tests/test_nothing.py": 0},
    "tests/app/web/conftest.py": {"tests/app/web/test_door.py": 1, "tests/app/web/page/test_colours.py": 1},
    "app/removed.py": {},
}


@pytest.mark.parametrize("change", NEAR)
def test_distances_count_imports_names_and_folders(checkout, change):
    assert affected.distances([change], checkout) == NEAR[change]


def test_of_several_changes_the_nearest_counts(checkout):
    assert affected.distances(["app/a.py", "tests/test_c.py"], checkout) == NEAR["app/a.py"] | {
        "tests/test_c.py": 0,
    }


def git(folder, *words):
    identity = ("-c", "user.name=n", "-c", "user.email=n@example.org", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True)


def commit(folder, **texts):
    for name, text in texts.items():
        (folder / name).write_text(text)
    git(folder, "add", ".")
    git(folder, "commit", "-m", "x")


@pytest.fixture
def branch(tmp_path):
    """A branch with one commit of its own; main has gone on since."""
    git(tmp_path, "init", "-b", "main")
    commit(tmp_path, kept="", edited="", removed="", committed="", staged="")
    git(tmp_path, "checkout", "-b", "other")
    commit(tmp_path, committed="new")
    git(tmp_path, "checkout", "main")
    commit(tmp_path, kept="later")
    git(tmp_path, "checkout", "other")
    return tmp_path


def test_a_change_is_what_main_does_not_have(branch):
    assert affected.changed(branch) == ["committed"]
    (branch / "edited").write_text("new")
    (branch / "staged").write_text("new")
    git(branch, "add", "staged")
    (branch / "removed").unlink()
    (branch / "with a blank").write_text("")
    (branch / ".gitignore").write_text("ignored")
    (branch / "ignored").write_text("")
    assert affected.changed(branch) == [".gitignore", "committed", "edited", "removed", "staged", "with a blank"]


def test_on_main_a_change_is_what_is_not_committed(branch):
    git(branch, "checkout", "main")
    assert affected.changed(branch) == []
    (branch / "kept").write_text("later still")
    assert affected.changed(branch) == ["kept"]


def test_main_of_the_origin_counts_before_the_own_one(branch):
    git(branch, "update-ref", "refs/remotes/origin/main", "other")
    assert affected.changed(branch) == []


def test_without_a_main_a_change_is_what_is_not_committed(branch):
    git(branch, "branch", "-D", "main")
    (branch / "kept").write_text("new")
    assert affected.changed(branch) == ["kept"]


def test_outside_of_git_nothing_has_changed(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert affected.changed(tmp_path) == []


def test_tests_of_a_file_that_ran_are_known_and_of_others_one_per_function(tmp_path):
    (tmp_path / "new.py").write_text("def test_a(): ...\n\ndef test_b(): ...")
    took = {"old.py::test_x[pump]": 1.0, "old.py::test_x[car]": 1.0, "other.py::test_y": 1.0}
    assert affected.expected(["old.py::car", "new.py"], took, tmp_path) == [
        "old.py::test_x[car]",
        "new.py::0",
        "new.py::1",
    ]


OWN = "tests/test_affected.py"


@pytest.mark.parametrize(("changes", "affects"), [([], False), (["sources/none.py"], False), ([OWN], True)])
def test_the_arguments_name_files_by_distance_and_all_to_collect(monkeypatch, capsys, changes, affects):
    monkeypatch.setattr(affected, "changed", lambda: changes)
    monkeypatch.setattr("sys.argv", ["affected", "--seconds", "20"])
    affected.main()
    out, err = capsys.readouterr()
    option, seconds, near, entries, *files = out.split()
    assert (option, float(seconds), near) == ("--quickest", 20.0 - affected.START_S, "--near")
    assert entries.split(",") == files
    assert (files == [OWN]) == affects
    assert ("affect no test; of all" in err) == (not affects)
