"""Budgets of lines and tokens, over a small repository whose files are counted by hand."""

import os
import subprocess
from pathlib import Path

import pytest

from tests import size

# 14 lines. Tokens: import os (2), def area ( side : float ) : (8), return f"" + os . name (6), area ( 1.5 , ) (5).
PYTHON = '''"""Docstring,
of two lines."""

import os  # not counted


def area(side: float):
    """Docstring."""
    # Comment.
    return f"{side * side} m2 {'a'}" + os.name

area(
    1.5,
)
'''
# 7 lines. Tokens: const url = "" ; (5), let n = 1.5 + $x ; (7), s = ` it ' s not $ { n } ' ` (13).
JAVASCRIPT = """/* Comment
   of two lines */
const url = "http://a b/*"; // comment
let n = 1.5/* here */+ $x;

s = `it's
not ${n}'`
"""
FILES = {
    "app/a.py": PYTHON,
    "app/page/b.js": JAVASCRIPT,
    "tests/c.py": "x = 1\n",
    "tests/slow/d.py": "y = (1,\n     2)\n",
}
COUNTS = {"app": (14, 21), "app/page": (7, 25), "tests": (1, 3), "tests/slow": (2, 7)}


def git(*words: str) -> None:
    subprocess.run(["git", "-c", "user.name=n", "-c", "user.email=e", *words], check=True)


def budget(counts: dict[str, tuple[int, int]]) -> None:
    lines = [f'"{name}" = {{ lines = {lines}, tokens = {tokens} }}  # why' for name, (lines, tokens) in counts.items()]
    Path("pyproject.toml").write_text("\n".join(["[tool.nisus.size]", *lines, "", "[tool.other]", "app = 1", ""]))


def write(path: str, text: str) -> None:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")


@pytest.fixture(autouse=True)
def repository(tmp_path, monkeypatch):
    (tmp_path / "a repository").mkdir()
    monkeypatch.chdir(tmp_path / "a repository")
    for name in [name for name in os.environ if name.startswith("GIT_")]:  # set in a hook, for the repository around
        monkeypatch.delenv(name)
    git("init", "-q")
    for path, text in FILES.items():
        write(path, text)
    budget(COUNTS)
    git("add", ".")


def problems() -> list[str]:
    with pytest.raises(SystemExit) as stopped:
        size.main("--check")
    return str(stopped.value).splitlines()


def test_lines_and_tokens_are_those_counted_by_hand(capsys):
    size.main("--check")  # passes: nothing is over
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert rows == [[name, f"{n}", f"{n}", "0", f"{m}", f"{m}", "0"] for name, (n, m) in COUNTS.items()]


def test_lines_with_tokens_are_code():
    assert size.count_python(PYTHON) == {"files": 1, "lines": 14, "code": 6, "tokens": 21}
    assert size.count_javascript(JAVASCRIPT) == {"files": 1, "lines": 7, "code": 4, "tokens": 25}


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize(("lines", "tokens", "says"), [(1, 0, "lines"), (0, 1, "tokens")])
def test_one_more_than_the_budget_fails(name, lines, tokens, says):
    counts = COUNTS[name]
    budget({**COUNTS, name: (counts[0] - lines, counts[1] - tokens)})
    figure = counts[says == "tokens"]
    (line,) = problems()
    assert line.startswith(f"{name}: {figure} {says}, budget {figure - 1} in pyproject.toml; ")


def test_a_joined_line_does_not_make_room_for_a_token():
    write("tests/c.py", "x = 1; y\n")
    (line,) = problems()
    assert line.startswith("tests: 5 tokens, budget 3 in ")


@pytest.mark.parametrize("path", ["setup.py", "apps/e.py", "site/f.js"])
def test_a_file_in_no_budget_fails(path):
    write(path, "1\n")
    (line,) = problems()
    assert line.startswith(f"{path}: in no budget")


def test_new_files_count_unless_ignored_and_deleted_files_do_not():
    write(".gitignore", "build/\n")
    write("build/g.py", "1\n")
    Path("tests/c.py").unlink()
    size.main("--check")
    write("tests/h.py", "1\n2\n")
    (line,) = problems()
    assert line.startswith("tests: 2 lines, budget 1 in ")


def test_a_revision_is_counted_with_its_own_budgets(capsys):
    git("commit", "-q", "-m", "first")
    write("app/a.py", "")
    budget({"app": (100, 100)})
    size.main("HEAD")
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["app", "1", "14", "6", "21"] in rows
    assert ["app/page", "1", "7", "4", "25"] in rows
    assert ["app", "14", "14", "0", "21", "21", "0"] in rows
