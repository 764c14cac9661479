"""The command line: lazy imports, and errors of writing that name what was written."""

import subprocess
import sys
from pathlib import Path

import pytest

from app.cli.arguments import COMMANDS, NAMES
from app.cli.main import main

FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="there is no /dev/full")


def test_twins_are_listed_without_numba():
    code = "import sys; from app.cli.main import main; main(['twins']); assert 'numba' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


@pytest.mark.parametrize("name", NAMES)
def test_every_command_has_a_module_a_function_and_help(name, capsys):
    import importlib

    module, _, function = COMMANDS[NAMES[name]].partition(":")
    assert callable(getattr(importlib.import_module(f"app.cli.{module}"), function))
    with pytest.raises(SystemExit) as left:
        main([name, "--help"])
    assert left.value.code == 0 and f"nisus {name}" in capsys.readouterr().out


@needs_full
@pytest.mark.parametrize("words", [["fold", "motor_winding", "--duration", "20", "--html"], ["schema", "--out"]])
def test_a_full_disk_is_reported_with_the_file(words, nisus):
    told = nisus.refuses(*words, str(FULL))
    assert f"{words[-1]} {FULL}: cannot be written: No space left" in told and told.count("nisus: ") == 1


@needs_full
def test_a_full_standard_output_is_reported():
    with FULL.open("w") as full:
        command = [sys.executable, "-m", "app.cli.main", "twins"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "nisus: standard output: No space left on device\n")
