"""The wheel has every file of the packages, whatever `package-data` of pyproject.toml says, all in one package."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from textwrap import dedent
from zipfile import ZipFile

import pytest

from tests import ROOT
from tests.imports import PACKAGES


def wheel_of(folder: Path, into: Path) -> Path:
    """Build the wheel of a project, as pip does, and return its file."""
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(into)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=folder, capture_output=True, check=True)
    return next(into.glob("*.whl"))


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The files of the checkout, as git lists them, and their wheel."""
    git = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    names = [name for name in listed if name and (ROOT / name).is_file() and not name.startswith("tests/")]
    copy = tmp_path_factory.mktemp("copy")
    for name in names:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy / name)
    return names, wheel_of(copy, copy / "dist")


def test_the_wheel_has_all_files_of_the_packages(built):
    """`py.typed` tells type checkers that a package has types. Pictures are the guides'."""
    names, wheel = built
    with ZipFile(wheel) as file:
        packed = set(file.namelist())
        texts = {name: file.read(name).decode() for name in packed if name.endswith(".py")}
    wanted = {f"nisus/{name}" for name in names if name.startswith(tuple(f"{package}/" for package in PACKAGES))}
    wanted |= {name for name in names if name.startswith("nisus/")}
    assert "nisus/py.typed" in wanted
    assert sorted(name for name in wanted - packed if not name.startswith("nisus/config/pictures/")) == []
    assert {name.split("/")[0] for name in packed if ".dist-info/" not in name} == {"nisus", "nisus-0.1.0.data"}
    former = re.compile(rf"\b(?:from|import) (?:{'|'.join(PACKAGES)})[. ]")  # also in the models that it writes
    assert [name for name, text in texts.items() if former.search(text)] == []


def test_an_installation_stands_beside_packages_of_the_same_names(built, tmp_path):
    """Its command and a model of a user run, also one that was written for a checkout, which is told; so do theirs."""
    _, wheel = built
    with ZipFile(wheel) as file:
        file.extractall(tmp_path / "site")
    for name in ("app", "config"):
        (tmp_path / "site" / f"{name}.py").write_text("OWNER = 'theirs'")
    (tmp_path / "model.py").write_text("from estimators import State\nfrom estimators.errors import ConfigError\n")
    code = """
        import sys
        from pathlib import Path
        sys.path = [folder for folder in sys.path if not Path(folder, "estimators").is_dir()]  # of this checkout
        import app, config, nisus.estimators, nisus.estimators.errors
        from nisus.app.cli.main import main
        from nisus.estimators.model.user_file import run_file
        from nisus.estimators.numerics.cache_entries import ContentLocator, __file__ as file
        assert ContentLocator(main, file).get_cache_path().endswith("nisus.estimators.numerics")  # not a checkout's
        assert main(["twins"]) == 0
        model = run_file("model", Path("model.py"))
        assert model.State is nisus.estimators.State and model.ConfigError is nisus.estimators.errors.ConfigError
        print(app.OWNER, config.OWNER, sorted({name.split(".")[0] for name in sys.modules} & {"sources", "nisus"}))
    """
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site")}
    done = subprocess.run(
        [sys.executable, "-c", dedent(code)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.stderr.splitlines() == [
        "nisus: model.py:1: write nisus.estimators for estimators, which the next version does not find"
    ]
    assert "motor_can" in done.stdout and done.stdout.splitlines()[-1] == "theirs theirs ['nisus']"
    assert done.returncode == 0


def test_a_module_of_a_checkout_is_loaded_once_and_keeps_its_name():
    import estimators.errors
    import nisus.estimators.errors

    assert nisus.estimators.errors is estimators.errors
    assert estimators.errors.__spec__.name == "estimators.errors" == estimators.errors.ConfigError.__module__
    assert nisus.fold is estimators.fold and {"app", "fold", "StateSpaceModel"} <= {*dir(nisus)}
    assert nisus.__all__ is estimators.__all__
    with pytest.raises(AttributeError, match="no attribute 'flod'"):
        nisus.flod  # noqa: B018


@pytest.mark.parametrize("name", PACKAGES)
def test_a_foreign_package_in_the_place_of_one_of_nisus_is_named(name, tmp_path):
    (tmp_path / f"{name}.py").touch()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    said = f"{tmp_path / name}.py is in the place of {name} of Nisus; use an environment of its own"
    for code, line in (("import nisus.config", f"ImportError: {said}"), ("exit(nisus.main())", f"nisus: {said}")):
        command = [sys.executable, "-c", f"import nisus; {code}"]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.stderr.splitlines()[-1] == line
    assert done.returncode == 2 and done.stderr.count("\n") == 1


def test_a_type_checker_knows_what_scripts_import(tmp_path):
    api = pytest.importorskip("mypy.api")
    (script := tmp_path / "script.py").write_text("from nisus import Log\nwrong: int = Log")
    out, _, _ = api.run([str(script)])
    assert 'expression has type "type[Log]"' in out
