"""The lines of an advice: what becomes of a YAML in which they are put."""

import json

import pytest

from app.study.advice.verdict import Advice, changed, lines, with_entry
from config.old_names import rewrite
from config.yaml_files import parse
from estimators.errors import ConfigError
from tests.cases import cases

BEFORE = """\
# A twin.
model: motor_winding
estimator:                       # chosen long ago
  name: ukf

  options: {alpha: 0.5}
# about the gate
gate: null
"""


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_the_section_gives_way_and_nothing_else(end, tmp_path):
    told = Advice(estimator="kf", options={"robust": 2.0, "dof": 7.0}, because=("linear", "tails"))
    (tmp_path / "a.yaml").write_text(BEFORE, newline=end)
    rewrite(tmp_path / "a.yaml", lambda text: changed(text, lines(told)))
    text = (tmp_path / "a.yaml").read_bytes().decode()
    assert text.count(end) == text.count("\n")
    data, _ = parse(text, "x")
    assert data["estimator"] == {"name": "kf", "options": {"robust": "student-t", "dof": 7}}
    assert data["model"] == "motor_winding" and data["gate"] is None
    assert "# A twin." in text and "# about the gate" in text and "alpha" not in text


@cases(__file__, "entries.csv")
def test_an_entry_takes_the_place_of_what_it_says_too(before, after):
    text = with_entry(before, "noise.a", {"variance": 4.0, "correlation_time": "3 s"})
    data, _ = parse(text, "x")
    for comment in ("# Q", "# by hand", "# of old", "# of b"):
        assert text.count(comment) == before.count(comment)
    assert "# of b\n" not in before or "# of b\n  b:" in text
    assert data == {"noise": {"a": {"variance": 4, "correlation_time": "3 s"}, **json.loads(after)}, "gate": None}


def test_what_else_an_entry_says_stays():
    text = with_entry("sensors:\n  a: {std: 2, from: 1}\n", "sensors.a", {"variance": 1.0, "error": {"over": "2 s"}})
    data, _ = parse(text, "x")
    assert data["sensors"]["a"] == {"from": 1, "variance": 1, "error": {"over": "2 s"}}
    with pytest.raises(ConfigError, match="sensors.a: an alias shares it with another key; put a: {variance: 1} in by"):
        with_entry("sensors:\n  a: &one {std: 2}\n  b: *one\n", "sensors.a", {"variance": 1.0})


def test_a_file_without_the_section_gets_it():
    data, _ = parse(changed("model: motor_winding", lines(Advice(estimator="ekf", because=("curvature",)))), "x")
    assert data == {"model": "motor_winding", "estimator": "ekf"}


def test_what_was_there_is_kept(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(BEFORE)
    kept = [rewrite(path, lambda text, name=name: changed(text, f"estimator: {name}\n")) for name in ("kf", "ekf")]
    assert kept[0] != kept[1] and kept[0].read_text() == BEFORE and "estimator: kf" in kept[1].read_text()
    assert rewrite(path, lambda text: changed(text, "estimator: ukf\n"), tmp_path / "b.yaml") is None
    assert "estimator: ekf" in path.read_text() and "estimator: ukf" in (tmp_path / "b.yaml").read_text()


def test_the_command_says_and_applies(tmp_path, nisus):
    out = tmp_path / "winding.yaml"
    told = nisus("advise", "motor_winding", "--json", "--out", str(out)).json
    assert told["estimator"] == "kf" and told["because"] == ["linear", "steady"]
    # One reading in 15 is lost, so the share of intervals that are twice as long is 1 in 15, rounded by the ends.
    steady = next(claim for claim in told["claims"] if claim["key"] == "steady")
    assert steady["figure"] == pytest.approx(1 / 15, abs=0.01) and steady["answer"] == "no"
    nisus("fold", str(out), "--json")
