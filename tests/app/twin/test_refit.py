"""The section `refit` of a twin's YAML: what it takes, and what is refused with its line."""

import pytest

from config.loader import TWINS
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases

pytestmark = pytest.mark.usefixtures("inside")

JOINT = (TWINS / "motor_joint.yaml").read_text()


def section_of(text):
    return twin_of(f"{JOINT}\nrefit:\n{text}").config.refit


def test_durations_and_a_lone_entry():
    section = section_of("  entries: p.copper_resistance\n  every: 10 min\n  window: 0.5 h\n")
    assert (section.entries, section.every, section.window) == (("p.copper_resistance",), 600.0, 1800.0)
    assert section.adopt == "by hand"
    section = section_of(
        "  entries: [R, Q.winding, options.inflation]\n  every: 60\n  window: 60\n  adopt: if better\n"
    )
    assert section.adopt == "if better"


@cases(__file__, "refits.csv")
def test_what_is_refused_has_its_line(section, said):
    text = refusal(f"{JOINT}\nrefit:\n{section}")
    assert said in text and "motor.yaml:" in text
