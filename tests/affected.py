"""`python -m tests.affected [SECONDS]`: the test files nearest to what differs from main that fit into the time.

A file's distance is the number of imports between it and the change; the test that mirrors a changed module is first.
A file that is not Python affects the tests of the folder that mirrors its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

from tests import ROOT
from tests.conftest import DURATIONS
from tests.imports import PACKAGES, edges, modules

SECONDS = 60.0
START_S, WORKERS = 12.0, 2
"""Duration of the reading of imports and the start of pytest, and the workers of the least machine."""

UNKNOWN_S = 0.5
"""Assumed duration of a test that has not run yet."""


def changed(root: Path = ROOT) -> list[str]:
    """Return the files that differ from the merge base with main, committed or not; none outside of git."""

    def git(*words: str) -> list[str]:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True).stdout.splitlines()

    base = [*git("merge-base", "HEAD", "origin/main"), *git("merge-base", "HEAD", "main"), "HEAD"][0]
    return sorted({*git("diff", "--name-only", base), *git("ls-files", "--others", "--exclude-standard")})


def nearest(changes: Iterable[str], root: Path = ROOT) -> dict[str, int]:
    """Return the distances of all affected test files without those of the browser."""
    paths = {name: path.relative_to(root).as_posix() for name, path in modules(*PACKAGES, "tests", root=root).items()}
    importers: dict[str, set[str]] = {path: set() for path in paths.values()}
    for name, imports in edges(*PACKAGES, "tests", root=root).items():
        for other in imports:
            importers[paths[other]].add(paths[name])
    found: dict[str, int] = {}
    for change in changes:
        path = PurePosixPath(change)
        mirror = str(path.parent).removeprefix("app/" if path.parts[1:2] == ("extensions",) else "")
        found |= dict.fromkeys((change, f"tests/{mirror}/test_{path.name}"), 0)
        if path.suffix != ".py":
            folders = [f"tests/{folder}/" for folder in path.parents[:-1]]
            near = next((folder for folder in folders if (root / folder).is_dir()), "tests/")
            found |= {test: 1 for test in paths.values() if test.rpartition("/")[0] + "/" == near}
    queue = list(found)
    for near in queue:
        new = sorted(importers.get(near, set()) - found.keys())
        found |= dict.fromkeys(new, found[near] + 1)
        queue += new
    tests = {path for path in paths.values() if PurePosixPath(path).name.startswith("test_")}
    return {path: steps for path, steps in found.items() if path in tests and not path.endswith("_browser.py")}


def fitting(distances: Mapping[str, int], took: Mapping[str, float], seconds: float) -> list[str]:
    """Return the nearest files, of equally near ones the quickest, whose durations add up to at most `seconds`."""
    chosen = []
    for _, duration, file in sorted((steps, took[file], file) for file, steps in distances.items()):
        if duration <= seconds:
            seconds -= duration
            chosen.append(file)
    return chosen


def durations(files: Iterable[str], root: Path = ROOT) -> dict[str, float]:
    """Return the seconds of each file by earlier runs, which pytest keeps."""
    kept = root / ".pytest_cache" / "v" / DURATIONS
    found: dict[str, float] = {}
    for name, duration in (json.loads(kept.read_text()) if kept.exists() else {}).items():
        file = name.partition("::")[0]
        found[file] = found.get(file, 0.0) + duration
    return {file: found.get(file, UNKNOWN_S * (root / file).read_text().count("def test_")) for file in files}


def main(seconds: float = SECONDS) -> None:
    """Print the chosen files, and on the error stream how many there are."""
    changes = changed()
    every_test = (path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("test_*.py"))
    affected = nearest(changes) or nearest(every_test)
    chosen = fitting(affected, durations(affected), WORKERS * (seconds - START_S))
    print(
        f"{len(changes)} changed files: {len(chosen)} of {len(affected)} test files in {seconds:g} s", file=sys.stderr
    )
    print(*chosen)


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
