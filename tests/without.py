"""`python -m tests.without [NAME ...]`: the core's commands and tests in a copy without these extensions, or all.

Those that need them go, too. It is done twice: with their entry points left in place, as by an installation that is
damaged, of which each is one line, and without these.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path

from config.extensions import GROUP, extensions
from tests import ROOT

FOLDERS = ("nisus", "app", "config", "estimators", "sources", "tests", "docs/examples")
QUICK = ("tests/config", "tests/app/twin/test_source.py", "tests/app/test_result.py")
"""Tests of the core that take seconds."""

COMMANDS = (
    "run motor_winding --headless --duration 5 --record drive.rrd",
    "review drive.rrd --duration 1 --no-browser --port 0",
    "fold motor_can --duration 10",
    "compare motor_winding --duration 10 --estimators kf ekf --jobs 1",
    "tune motor_winding --duration 60 --set R.winding=40",
    "check motor_winding --duration 10",
    "new pump",
    "fold motor_winding --duration 60 --out drive.csv",
    "advise drive.csv",
)


def with_dependents(names: Iterable[str]) -> set[str]:
    """Return extensions and those that need them, directly or through others."""
    found = set(names)
    while more := {name for name, item in extensions().items() if found & {*item.needs}} - found:
        found |= more
    return found


def copied(into: Path, names: set[str], *, registered: bool) -> Path:
    """Return the folder of a copy without these extensions and their tests, which may stay `registered`."""
    for folder in FOLDERS:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / folder, into / folder, ignore=ignored)
    for name in names:
        shutil.rmtree(into / "app" / "extensions" / name)
        shutil.rmtree(into / "tests" / "extensions" / name, ignore_errors=True)
    for file in ("pyproject.toml", "README.md", "docs/alarms.md"):
        (into / file).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / file, into / file)
    # What an installation has of it, found before that of this checkout.
    points = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"][GROUP]
    lines = [f"{name} = {value}" for name, value in points.items() if registered or name not in names]
    (into / "nisus.egg-info").mkdir()
    (into / "nisus.egg-info" / "PKG-INFO").write_text("Metadata-Version: 2.1\nName: nisus\nVersion: 0.1.0\n")
    (into / "nisus.egg-info" / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines, ""]))
    return into


def tried(copy: Path, command: list[str], told: set[str]) -> str:
    """Run a command in a copy; return what is wrong: its end, or that it does not tell these extensions, each once."""
    variables = os.environ | {"PYTHONPATH": str(copy)}
    done = subprocess.run([sys.executable, "-m", *command], cwd=copy, env=variables, capture_output=True, text=True)
    if done.returncode:
        return f"{' '.join(command)}: ended with {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
    lines = [line.split()[2] for line in done.stderr.splitlines() if line.startswith("nisus: extension ")]
    return "" if sorted(lines) == sorted(told) else f"{' '.join(command)}: tells of {lines}, not of {sorted(told)}"


def problems(names: set[str]) -> list[str]:
    """Return what does not work without these extensions."""
    found = []
    for registered in (True, False):
        with tempfile.TemporaryDirectory(prefix="nisus-without-") as folder:
            copy = copied(Path(folder), names, registered=registered)
            told = names if registered else set()
            found += [tried(copy, ["app.cli.main", *words.split()], told) for words in COMMANDS]
            if not registered:
                found.append(tried(copy, ["pytest", "-q", "-x", "-p", "no:cacheprovider", *QUICK], set()))
    return [text for text in found if text]


if __name__ == "__main__":
    cases = [set(sys.argv[1:])] if sys.argv[1:] else [*({name} for name in extensions()), {*extensions()}]
    told = [(names, problems(names)) for names in map(with_dependents, cases)]
    print("\n".join(f"without {', '.join(sorted(names))}: {'; '.join(wrong) or 'works'}" for names, wrong in told))
    sys.exit(any(wrong for _, wrong in told))
