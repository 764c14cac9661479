"""The wheel has every file of the packages, whatever `package-data` of pyproject.toml says."""

import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

from tests import ROOT
from tests.imports import PACKAGES


def wheel_of(folder: Path, into: Path) -> Path:
    """Build the wheel of a project, as pip does, and return its file."""
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(into)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=folder, capture_output=True, check=True)
    return next(into.glob("*.whl"))


def test_the_wheel_has_all_files_of_the_packages(tmp_path):
    """As git lists them; `py.typed` tells type checkers that a package has types. Pictures are the guides'."""
    git = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    names = [name for name in listed if name and (ROOT / name).is_file() and not name.startswith("tests/")]
    copy = tmp_path / "copy"
    for name in names:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy / name)
    with ZipFile(wheel_of(copy, tmp_path)) as file:
        packed = set(file.namelist())
    wanted = {name for name in names if name.startswith(tuple(f"{package}/" for package in PACKAGES))}
    assert {f"{package}/py.typed" for package in PACKAGES} <= wanted
    assert sorted(name for name in wanted - packed if not name.startswith("config/pictures/")) == []
