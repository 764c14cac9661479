"""`python -m tests.affected [--seconds 60]`: arguments for pytest that run the tests nearest to the present change.

The change is what differs from where the branch left main, committed or not. The distance of a test file from it:

- 0: the test file itself changed, or the module that it mirrors (app/cli/fold.py: tests/app/cli/test_fold.py).
- One step further: a module that imports another or names another file (`chart.js`; files of config/ by their stem, as
  twins are named), and a test file below a conftest.py, except the one of all tests.
- 1 from a file that is not Python: the test files in the folder that mirrors its own, or the nearest folder around it.
- 1 from a file of a bundled twin: of the tests over all of `shipped()`, those with the twin's name.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from estimators.numerics.cache import cache_folder
from tests import ROOT
from tests.conftest import DURATIONS, distances_of, within
from tests.imports import PACKAGES, edges, modules

START_S = 12.0
"""Duration of the reading of imports and of the start of pytest and its workers."""

MAX_WORKERS = 4  # as in the Makefile


def changed(root: Path = ROOT) -> list[str]:
    """Return the files that differ from the merge base with main, with untracked ones; none outside of git."""

    def git(*words: str) -> list[str]:
        run = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True)
        return [name for name in run.stdout.strip("\n").split("\0") if name]

    bases = [*git("merge-base", "HEAD", "origin/main"), *git("merge-base", "HEAD", "main"), "HEAD"]
    untracked = git("ls-files", "-z", "--others", "--exclude-standard")
    return sorted({*git("diff", "-z", "--name-only", "--relative", "--no-renames", bases[0]), *untracked})


def candidates(root: Path = ROOT) -> dict[str, str]:
    """Return the text of every test file without those of the browser alone."""
    texts = {path.relative_to(root).as_posix(): path.read_text() for path in (root / "tests").rglob("test_*.py")}
    return {path: text for path, text in texts.items() if "\npytestmark = pytest.mark.browser" not in text}


def distances(changes: list[str], root: Path = ROOT) -> dict[str, int]:
    """Return the distance of every affected test file; `file::word` stands for its tests with that word in the name."""
    tests, named = candidates(root), modules(*PACKAGES, "tests", root=root)
    paths = {name: path.relative_to(root).as_posix() for name, path in named.items()}
    dependents: dict[str, set[str]] = {path: set() for path in [*paths.values(), *changes]}
    for name, imports in edges(*PACKAGES, "tests", root=root).items():
        for other in imports:
            dependents[paths[other]].add(paths[name])
    for path in paths.values():
        if path.endswith("/conftest.py") and path != "tests/conftest.py":
            dependents[path] |= {test for test in tests if test.startswith(path.removesuffix("conftest.py"))}
    found = dict.fromkeys(changes, 0)
    for change in changes:
        path = PurePosixPath(change)
        mirror = "tests" / path.parent
        if path.suffix == ".py":
            found |= dict.fromkeys({str(mirror / f"test_{path.name}")} & tests.keys(), 0)
            continue
        word = path.stem if path.parts[0] == "config" else path.name
        whole = re.compile(rf"(?<!\w){re.escape(word)}(?!\w)")
        folder = next(folder for folder in (mirror, *mirror.parents) if (root / folder).is_dir())
        dependents[change] |= {paths[name] for name, file in named.items() if whole.search(file.read_text())}
        dependents[change] |= {test for test in tests if PurePosixPath(test).parent == folder}
        if path.parts[0] == "config":
            dependents[change] |= {f"{test}::{word}" for test, text in tests.items() if "shipped()" in text}
    queue = list(found)
    for near in queue:
        new = sorted(dependents.get(near, set()) - found.keys())
        found |= dict.fromkeys(new, found[near] + 1)
        queue += new
    return {entry: steps for entry, steps in found.items() if entry.partition("::")[0] in tests}


def expected(entries: Iterable[str], took: dict[str, float], root: Path = ROOT) -> list[str]:
    """Return the tests of the entries by the durations of earlier runs; one per function of a file that did not run."""
    distance, ran = distances_of(dict.fromkeys(entries, 0)), {name.partition("::")[0] for name in took}
    names = [name for name in took if distance(name) is not None]
    for file, _, word in (entry.partition("::") for entry in entries):
        functions = 0 if file in ran else (root / file).read_text().count("def test_")
        names += [f"{file}::{word}{number}" for number in range(functions)]
    return names


def main() -> None:
    """Print the arguments, and on the error stream what they leave out."""
    parser = argparse.ArgumentParser(prog="python -m tests.affected")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the run (default: 60)")
    seconds = parser.parse_args().seconds
    changes = changed()
    affected = distances(changes) if changes else {}
    entries = affected or dict.fromkeys(candidates(), 0)
    kept = ROOT / ".pytest_cache" / "v" / DURATIONS
    took = json.loads(kept.read_text()) if kept.exists() else {}
    names, workers = expected(entries, took), min(os.cpu_count() or 1, MAX_WORKERS)
    chosen = within(seconds - START_S, names, took, workers, distances_of(entries))
    files, whole = ({name.partition("::")[0] for name in some} for some in (chosen, entries))
    about = (
        f"{len(changes)} changed files affect" if affected else f"{len(changes)} changed files affect no test; of all"
    )
    about += f" {len(names):,} tests in {len(whole)} files: {len(chosen):,} in {len(files)} files are"
    print(about, f"chosen for {seconds:g} s, {len(whole - files)} files are left out", file=sys.stderr)
    if not cache_folder().exists():
        print("nothing is compiled from these sources yet: tests of filters take minutes more", file=sys.stderr)
    groups: dict[int, list[str]] = {}
    for steps, entry in sorted((steps, entry) for entry, steps in entries.items()):
        if entry.partition("::")[0] in files:
            groups.setdefault(steps, []).append(entry)
    near = (word for group in groups.values() for word in ("--near", ",".join(group)))
    print("--quickest", f"{seconds - START_S:g}", *near, *sorted(files))


if __name__ == "__main__":
    main()
