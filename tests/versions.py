"""`make versions`: the cheap tests with the lowest versions that pyproject.toml allows, and with the newest.

The lowest are tried on the oldest interpreter of this machine, the newest on its newest, each in a venv that is thrown
away. What depends on other packages is tried: sources, schema, page, views, command line, what Numba offers to compile
with, pickling, and filters: those of test_log.py with the lowest Numba, and one with the newest, which compiles all in
`make test`.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from glob import glob
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

MINORS = range(11, 15)
"""Of Python 3, that are looked for."""

SECONDS = 1800
"""That one of the two may take at most."""

FOLDERS = ("config", "sources")
MODULES = (
    "test_imports.py", "test_readme.py", "test_affected.py", "estimators/numerics/test_jit.py",
    "estimators/numerics/test_simd_rows.py", "estimators/numerics/test_simd.py", "estimators/test_log.py",
    "app/web/test_server.py", "app/web/test_http_server.py", "app/explore/test_feed.py",
    "app/scene/test_view.py", "app/scene/test_numbers.py", "app/cli/test_new.py",
    "app/cli/test_progress.py",
    "estimators/compiled/test_black_box.py::test_a_function_that_processes_cannot_import",
)  # fmt: skip
"""Files under tests/; the last with one test of it."""

NEWEST = "not test_any_order_of_arrival_gives_the_same_bits or [kf]"
"""Of these tests, those with the newest versions; each of the others compiles a filter."""


def chosen() -> list[str]:
    """The arguments for pytest; ends with a message if a module is not there (renamed, say)."""
    found = [str(ROOT / "tests" / folder) for folder in FOLDERS]
    for folder in found:
        if not Path(folder).is_dir():
            sys.exit(f"tests/versions.py: there is no folder {folder}; mend FOLDERS")
    for module in MODULES:
        name, colons, test = module.partition("::")
        path = ROOT / "tests" / name
        if not path.is_file():
            sys.exit(f"tests/versions.py: there is no file tests/{name}; mend MODULES")
        found.append(f"{path}{colons}{test}")
    return found


def interpreters() -> dict[tuple[int, int], str]:
    """Those of this machine that run, by version: on the path, or under pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    candidates = [sys.executable]
    for minor in MINORS:
        candidates += [found for found in [shutil.which(f"python3.{minor}")] if found]
        candidates += sorted(glob(f"{pyenv}/3.{minor}.*/bin/python"))  # nothing of a folder that is not ours
    found: dict[tuple[int, int], str] = {}
    for path in candidates:
        ask = [path, "-c", "import sys, venv; print(*sys.version_info[:2])"]
        said = subprocess.run(ask, capture_output=True, text=True).stdout.split()
        if len(said) == 2 and int(said[1]) in MINORS:
            found.setdefault((int(said[0]), int(said[1])), path)
    return found


def attempt(python: str, resolution: str, tests: list[str]) -> int:
    """Install with uv, run the tests; the exit status of the first that fails."""
    with tempfile.TemporaryDirectory(prefix="nisus-versions-") as folder:
        venv = Path(folder) / "venv"
        inside = str(venv / "bin" / "python")
        uv = [sys.executable, "-m", "uv", "--quiet", "--no-python-downloads"]
        run = [
            inside,
            "-m",
            "pytest",
            "-q",
            "-n",
            "2",
            "--dist",
            "loadfile",
            "-m",
            "not browser",
            "-p",
            "no:cacheprovider",
        ]
        steps = (
            [*uv, "venv", "--python", python, str(venv)],
            [*uv, "pip", "install", "--python", inside, "--resolution", resolution, "-e", f"{ROOT}[test-all]"],
            [*run, *tests],
        )
        for step in steps:
            try:
                status = subprocess.run(step, cwd=ROOT, timeout=SECONDS).returncode
            except subprocess.TimeoutExpired:
                print(f"not done after {SECONDS} s: {' '.join(step[:4])} ...", file=sys.stderr)
                return 1
            if status:
                return status
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("which", nargs="*", default=["lowest", "newest"], help="lowest, newest, or both")
    tests, found, failed = chosen(), interpreters(), 0
    for which in parser.parse_args().which:
        version, python = (min if which == "lowest" else max)(found.items())
        print(f"{which} versions on Python {version[0]}.{version[1]}", flush=True)
        newest = which == "newest"
        if attempt(python, "highest" if newest else "lowest-direct", [*tests, "-k", NEWEST] if newest else tests):
            print(f"failed: {which} versions on Python {version[0]}.{version[1]}", file=sys.stderr)
            failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())
