"""The section `refit` of a twin's YAML: what it takes, and what is refused with its line."""

import pytest

from app.twin.twin import load_twin
from config.loader import TWINS
from estimators.errors import ConfigError


def loaded(tmp_path, section, name="motor_joint"):
    path = tmp_path / "twin.yaml"
    path.write_text(f"{(TWINS / f'{name}.yaml').read_text()}\nrefit:\n{section}")
    return load_twin(path).config.refit


def test_durations_and_a_lone_entry(tmp_path):
    section = loaded(tmp_path, "  entries: p.copper_resistance\n  every: 10 min\n  window: 0.5 h\n")
    assert (section.entries, section.every, section.window) == (("p.copper_resistance",), 600.0, 1800.0)
    assert section.adopt == "by hand"
    section = loaded(
        tmp_path, "  entries: [R, Q.winding, options.inflation]\n  every: 60\n  window: 60\n  adopt: if better\n"
    )
    assert section.adopt == "if better"


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("  entries: [p.coper]\n  every: 60\n  window: 60\n", "refit.entries names p.coper: p.coper is no entry"),
        ("  entries: [p.yoke_coolant]\n  every: 60\n  window: 60\n", "which `estimate` moves into the state"),
        ("  entries: [prior.magnet.std]\n  every: 60\n  window: 60\n", "a window begins where the filter is"),
        ("  entries: []\n  every: 60\n  window: 60\n", "refit.entries"),
        ("  entries: [p]\n  every: 0\n  window: 60\n", "refit.every"),
        ("  entries: [p]\n  every: 60\n", "refit.window"),
        ("  entries: [p]\n  every: 60\n  window: 60\n  adopt: always\n", "refit.adopt"),
        ("  entries: [p]\n  every: soon\n  window: 60\n", "refit.every"),
    ],
)
def test_what_is_refused_has_its_line(tmp_path, section, said):
    with pytest.raises(ConfigError) as caught:
        loaded(tmp_path, section)
    text = str(caught.value)
    assert said in text and "twin.yaml:" in text and text.count("\n") == 0
