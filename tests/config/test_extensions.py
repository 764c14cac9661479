"""Extensions of other packages: what they add, and what a broken one costs."""

import json
import shlex

import pytest

from app.twin.source import SOURCES
from config.extensions import RESERVED, registered
from config.model_schema import KINDS
from config.output_schema import OutputsSection
from config.schema import json_schema
from tests import ROOT
from tests.cases import cases
from tests.support import run_python

NAME = "nisus_depth"

MODULE = '''
from dataclasses import dataclass
from typing import Callable, Literal

from config.channels import MessagesSection
from config.extensions import Extension, Part


class DepthSection(MessagesSection):
    type: Literal["depth"]
    reading: float


def open_depth(opening):
    from app.twin.sources.push import messages_of

    messages = messages_of(opening)
    messages.send([{"values": {messages.names[0]: opening.section.reading}, "time": 10**18}])
    return messages


@dataclass
class SoundCommand:
    """Measure a depth."""


EXTENSION = Extension(
    commands={"sound": Part("nisus_depth:SoundCommand", "nisus_depth:sound")},
    sources={"depth": Part("nisus_depth:DepthSection", "nisus_depth:open_depth")},
)
'''

OPENED = """
import sys
from app.twin.twin import load_twin
twin = load_twin("motor_winding", overrides={"source": "{type: depth, reading: 41.5}"})
events = twin.open_source(print).read(0.0)
print(events.t.tolist(), events.value[:, 0].tolist())
"""


def installed(folder, module, entry="depth = nisus_depth:EXTENSION", name=NAME):
    """Install a package of one module as pip does, and return its folder."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (folder / f"{name}.py").write_text(module)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[nisus.extensions]\n{entry}\n")
    return folder


def run(monkeypatch, folder, code, **options):
    monkeypatch.setenv("PYTHONPATH", f"{folder}:{ROOT}")
    return run_python(code, **options)


def test_a_package_adds_a_source(tmp_path, monkeypatch):
    done = run(monkeypatch, installed(tmp_path, MODULE), OPENED)
    assert done.stdout == "[1000000000000000000] [41.5]\n"


COMMANDS = """
from app.cli.main import main
main(['twins', 'motor_winding', '--json'])
main(['run', 'motor_winding', '--headless', '--duration', '1', '--set', 'source={type: depth, reading: 1.0}'])
"""


@cases(__file__, "broken_extensions.csv")
def test_a_broken_one_is_a_line_and_stops_only_a_twin_that_needs_it(tmp_path, monkeypatch, old, new, text):
    assert old in MODULE
    module = MODULE.replace(old, new) if old else new
    done = run(monkeypatch, installed(tmp_path, module), COMMANDS)
    assert json.loads(done.stdout)["name"] == "motor_winding"
    line, told = done.stderr.splitlines()
    assert line == f"nisus: extension depth is left out: {text}"
    assert "is 'depth'" in told and told.endswith(f"; extensions that cannot be loaded: depth ({text})")


@cases(__file__, "failing_functions.csv")
def test_a_function_that_fails_is_one_line_for_who_asks_for_it(tmp_path, monkeypatch, part, name, words, text):
    module = MODULE.replace(f"nisus_depth:{part}", f"nisus_depth:{name}")
    module += "\nnothing = lambda given: None\nbroken = lambda given: 1 / 0\n"
    code = f"from app.cli.main import main; raise SystemExit(main({shlex.split(words)}))"
    told = run(monkeypatch, installed(tmp_path, module), code, status=2).stderr.splitlines()
    assert [line for line in told if not line.startswith("compil")] == [f"nisus: extension depth: {text}"]


@pytest.mark.parametrize("kind", ["sources", "outputs", "models"])
def test_a_section_without_a_json_schema_is_left_out_of_that_of_a_twin(tmp_path, monkeypatch, kind):
    module = MODULE.replace("reading: float", "depth: Callable[[], int]").replace("sources=", f"{kind}=")
    folder = installed(tmp_path, module)
    done = run(monkeypatch, folder, "from app.cli.main import main; main(['schema'])")
    reason = "PydanticInvalidForJsonSchema: Cannot generate a JsonSchema for core_schema.CallableSchema"
    assert done.stderr == f"nisus: extension depth is left out: {reason}\n"
    assert json.loads(done.stdout) == json_schema()


def test_names_of_the_core_are_reserved():
    assert {kind: {*names} for kind, names in RESERVED.items()} == {
        "sources": {*SOURCES},
        "outputs": {*OutputsSection.model_fields} - {*registered("outputs")},
        "receivers": set(),
        "models": {*KINDS} - {*registered("models")},
    }


@cases(__file__, "left_out.csv")
def test_a_part_that_cannot_be_used_is_left_out_with_a_line(tmp_path, monkeypatch, old, new, asked, text):
    folder = installed(tmp_path, MODULE.replace(old, new))
    code = f"from app.cli.main import main; from config.extensions import made; {asked}"
    assert run(monkeypatch, folder, code).stderr == f"nisus: extension depth{text}\n"


def test_of_two_with_one_name_the_first_by_name_counts(tmp_path, monkeypatch):
    installed(tmp_path, MODULE)
    other = MODULE.replace("nisus_depth:", "nisus_other:").replace("opening.section.reading", "-1.0")
    done = run(monkeypatch, installed(tmp_path, other, "other = nisus_other:EXTENSION", name="nisus_other"), OPENED)
    assert done.stdout == "[1000000000000000000] [41.5]\n"
    assert done.stderr == "extension other: depth of its sources is left out, as there is one of that name\n"
