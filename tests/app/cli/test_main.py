"""The command line: lazy imports, arguments refused before long work, errors of writing that name what was written."""

import json
import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from app.cli import arguments
from app.cli.main import described, main, parse
from config.extensions import maker, registered, schemas
from config.loader import shipped
from estimators.registry import ESTIMATORS
from tests import ROOT
from tests.cases import cases
from tests.support import run_python

NAMES = arguments.NAMES | schemas("commands")
FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="there is no /dev/full")


def test_twins_are_listed_without_numba_and_pydantic():
    run_python("import sys, app.cli.main as it; it.main(['twins']); assert not {'numba', 'pydantic'} & {*sys.modules}")


@pytest.mark.parametrize(
    ("words", "option", "picture"),
    [("fold motor_winding --plot run.png", "--plot", "track"), ("twins motor_winding --picture", "--picture", "twin")],
)
def test_a_picture_without_its_extension_names_the_extra(words, option, picture, nisus, monkeypatch):
    monkeypatch.delitem(registered("pictures"), picture, raising=False)
    line = f"nisus: {option}: needs an extension; install it with `pip install 'nisus[plot]'`"
    assert nisus.refuses(*words.split()).startswith(line)


@pytest.mark.parametrize("name", NAMES)
def test_every_command_has_a_module_and_a_function(name):
    import importlib

    if name in arguments.NAMES:
        module, _, function = arguments.COMMANDS[NAMES[name]].partition(":")
        assert callable(getattr(importlib.import_module(f"app.cli.{module}"), function))
    else:
        assert callable(maker("commands", name))


@needs_full
@pytest.mark.parametrize("words", [["fold", "motor_winding", "--duration", "20", "--html"], ["schema", "--out"]])
def test_a_full_disk_is_reported_with_the_file(words, nisus):
    told = nisus.refuses(*words, str(FULL))
    assert f"{words[-1]} {FULL}: cannot be written: No space left" in told and told.count("nisus: ") == 1


@needs_full
@pytest.mark.parametrize("words", [["twins"], ["log", "huge.csv"]])
def test_a_full_standard_output_is_reported_and_nothing_else(words, tmp_path, monkeypatch):
    """Such as a warning of NumPy: the squares of these values are no numbers."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)
    Path("huge.csv").write_text("time,a\n" + "".join(f"{k},{k % 7 - 3}e307\n" for k in range(99)))
    with FULL.open("w") as full:
        command = [sys.executable, "-m", "app.cli.main", *words]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "nisus: standard output: No space left on device\n")


def test_the_version_is_that_of_the_package(nisus):
    assert nisus("--version").out == f"nisus {version('nisus')}\n"


def examples(name):
    return described(NAMES[name]).partition("Examples:\n")[2].splitlines()


@pytest.mark.parametrize("name", NAMES)
def test_examples_in_the_help_are_commands_of_bundled_twins(name, capsys):
    lines = examples(name)
    assert lines
    for line in lines:
        program, *words = shlex.split(line)
        command = parse(words)
        assert program == "nisus" and isinstance(command, NAMES[name])
        named = getattr(command, "twin", None)
        assert named is None or named in shipped() or named.endswith(".yaml")
    with pytest.raises(SystemExit) as left:
        main([name, "--help"])
    shown = capsys.readouterr().out
    assert left.value.code == 0 and f"nisus {name}" in shown and all(line in shown for line in lines)


TO_FULL_PIPES = [
    "--help", "twins", "fold --help", "filters", "schema", "--tyro-print-completion bash", "log nothing.csv", "fld",
]  # fmt: skip


@pytest.mark.parametrize("words", TO_FULL_PIPES)
def test_a_closed_pipe_ends_a_command_quietly(words):
    """Standard output and standard error go to a pipe that nobody reads, as with `2>&1 | head` once head has ended."""
    code = f"""
import os, sys
from app.cli.main import main
read, write = os.pipe()
os.close(read)
said = os.dup(2)
os.dup2(write, 1)
os.dup2(write, 2)
try:
    status = main({words.split()!r})
except SystemExit as left:
    status = left.code
os.write(said, str(status).encode())
sys.stdout.flush()
"""
    assert run_python(code).stderr == "0"


COMPLETED = {
    "": {*NAMES},
    "comp": {"compare"},
    "fold motor_can --es": {"--estimator"},
    "fleet --archive-": {"--archive-split", "--archive-keep"},
    "tune motor_can --aim l": {"likelihood"},
    "serve --log-format ": {"text", "json"},
    "fold --out dri": {"drive.csv"},
    "fold dri": set(),  # the shell completes names of files
}


def test_the_lines_of_the_guide_complete_words_in_bash(tmp_path):
    program = tmp_path / "nisus"
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m app.cli.main "$@"\n')
    program.chmod(0o755)
    (tmp_path / "drive.csv").touch()
    guide = Path("docs/reference.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"```sh\n(source .*?)```", guide, re.DOTALL)
    typed = [" ".join(map(shlex.quote, ["nisus", *words.split(" ")])) for words in COMPLETED]
    ask = "COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _nisus; echo ${COMPREPLY[@]}"
    asked = [f"COMP_WORDS=({words}); {ask}" for words in typed]
    script = "\n".join([f"PATH={tmp_path}:$PATH", lines, f"cd {tmp_path}", *asked])
    said = subprocess.check_output(["bash", "-c", script], text=True).splitlines()
    found = [{word for word in line.split() if not word.startswith("-h") and word != "--help"} for line in said]
    assert dict(zip(COMPLETED, found, strict=True)) == COMPLETED


def test_a_shell_without_a_script_is_one_line(nisus):
    line = "--tyro-print-completion: give one of bash, zsh"
    assert line in nisus.refuses("--tyro-print-completion", "csh") and line in nisus.refuses("--tyro-print-completion")


def documented():
    """Fields of the JSON of each command by the guide."""
    text = Path("docs/reference.md").read_text(encoding="utf-8").partition("## JSON of the commands")[2]
    rows = re.findall(r"^\| `([a-z]+)[^|]*\|(.*)\|$", text, re.MULTILINE)
    found = {}
    for name, fields in rows:
        found.setdefault(name, set()).update(re.findall(r"`(\w+)`", fields))
    return found


WITH_JSON = [name for name, command in NAMES.items() if "json" in command.__dataclass_fields__]
RUNS = Path(__file__).with_name("runs.csv")


def test_every_command_with_a_result_prints_json_that_the_guide_describes():
    assert set(WITH_JSON) == set(documented()) >= {words.split()[0] for words in RUNS.read_text().splitlines()[1:]}
    without = set(NAMES) - set(WITH_JSON)
    assert without == {"review", "serve", "schema"}  # pages, a JSON Schema


@cases(__file__, "runs.csv")
def test_json_is_one_document_of_documented_fields_without_nan(words, nisus, tmp_path, monkeypatch):
    fields = documented()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.csv").write_text("t,a,b\n" + "".join(f"{k},{k % 7},{k % 5}\n" for k in range(200)))
    words = shlex.split(words)

    def refuse(constant):
        raise AssertionError(f"{constant} in the JSON of {words}")

    document = json.loads(nisus(*words, "--json").out, parse_constant=refuse)
    first = document[0] if isinstance(document, list) else document
    assert set(first) <= fields[words[0]], set(first) - fields[words[0]]


VARIABLES = {"PORT": "0", "HEADLESS": "yes", "SET": "Q.rate=2 use.winding=false", "LOG": "a.csv b.csv", "STORE": " "}


def test_options_of_run_come_from_the_environment_unless_they_are_given(monkeypatch):
    for name, value in VARIABLES.items():
        monkeypatch.setenv(f"NISUS_RUN_{name}", value)
    command = parse(["run", "motor_can", "--port", "8080"])
    assert (command.twin, command.port, command.headless, command.store) == ("motor_can", 8080, True, None)
    assert command.set == ("Q.rate=2", "use.winding=false") and command.log == (Path("a.csv"), Path("b.csv"))


@cases(__file__, "wrong_variables.csv")
def test_a_wrong_variable_is_one_line(nisus, monkeypatch, variable, value, line):
    monkeypatch.setenv(f"NISUS_RUN_{variable}", value)
    assert line in nisus.refuses("run", "motor_can")


def test_every_line_of_a_service_is_json(tmp_path):
    told = subprocess.run(
        [sys.executable, "-m", "app.cli.main", "run", "motor_winding", "--headless", "--duration", "1"]
        + ["--log-format", "json", "--store", str(tmp_path / "a.store")],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = [json.loads(line) for line in told.stderr.splitlines()]
    assert lines and all(line.keys() >= {"time", "level", "text"} for line in lines)
    assert any("a new one; the twin continues" in line["text"] for line in lines)


@cases(__file__, "bad_arguments.csv")
def test_a_wrong_argument_is_one_line(said, command, nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said.replace("ESTIMATORS", ", ".join(ESTIMATORS)) in nisus.refuses(*shlex.split(command))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("more", ["", "--windows 60"])
def test_an_unknown_entry_is_refused_before_anything_is_compiled(more, nisus, monkeypatch):
    monkeypatch.setattr("app.cli.tune.prepare", lambda twin: pytest.fail("it was compiled"))
    assert "p.nosuch is no entry" in nisus.refuses("tune", "motor_bench", "--fit", "p.nosuch", *more.split())
