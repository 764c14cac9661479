"""The guides: Python blocks and console commands run as printed, other commands exist, links lead somewhere."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from app.cli.main import main, parse
from tests import ROOT

GUIDES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
PATH_OF_NISUS = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


def blocks(path: Path, language: str) -> list[str]:
    """Return the fenced code blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def name(path: Path) -> str:
    return path.name


@pytest.mark.parametrize("path", [path for path in GUIDES if blocks(path, "python")], ids=name)
def test_python_blocks_run(path, tmp_path, monkeypatch):
    """In one namespace per page, from top to bottom, as a reader would enter them."""
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": path.stem}
    for k, block in enumerate(blocks(path, "python")):
        file = tmp_path / f"block_{k}.py"  # Numba wants a file for what it compiles
        file.write_text(block, encoding="utf-8")
        exec(compile(block, str(file), "exec"), names)


@pytest.mark.parametrize("path", [path for path in GUIDES if blocks(path, "console")], ids=name)
def test_console_commands_succeed(path, tmp_path, monkeypatch, capsys):
    """`nisus` runs in this process, which has it loaded, except `nisus run`, which ends with its process."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config").symlink_to(ROOT / "config")
    lines = "".join(blocks(path, "console")).splitlines()
    commands = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    assert commands
    for command in commands:
        words = shlex.split(command)
        if words[0] == "nisus" and words[1] != "run":
            status, said = main(words[1:]), capsys.readouterr().err
        else:
            environment = os.environ | {"PATH": PATH_OF_NISUS, "PYTHONPATH": str(ROOT)}
            run = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True)
            status, said = run.returncode, run.stderr
        # `tune` ends with 1 if it has nothing to propose, which is a result.
        assert status in ((0, 1) if command.startswith("nisus tune") else (0,)), f"{command}\n{said}"


@pytest.mark.parametrize("path", [path for path in GUIDES if blocks(path, "sh")], ids=name)
def test_other_commands_exist(path, monkeypatch):
    """Their options are parsed as the command line does; they are not run."""
    monkeypatch.chdir(ROOT)
    for line in "".join(blocks(path, "sh")).splitlines():
        words = shlex.split(line, comments=True)
        if words and words[0] == "nisus":
            parse(words[1:])


@pytest.mark.parametrize("path", GUIDES, ids=name)
def test_links_and_pictures_lead_to_files(path):
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8"))
    missing = [target for target in targets if "://" not in target and not (path.parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("path", GUIDES, ids=name)
def test_files_that_are_named_exist(path):
    """Such as `app/live/jobs.py`, so that a file that moves takes the guides along."""
    text = path.read_text(encoding="utf-8")
    named = re.findall(r"`((?:app|estimators|sources|config|tests|docs)/[\w/.]+)`", text)
    assert [file for file in named if not (ROOT / file).exists()] == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
