"""`nisus tune`: what it prints, what it saves, and its exit status, on a simulated motor winding."""

import json
import shutil

import pytest
import yaml

from app.cli.main import main
from app.twin.defaults import natural_aim
from app.twin.twin import load_twin
from config.loader import TWINS
from tests.app.live.tunings.test_versions import pasted_text

WRONG = ["--set", "R.winding=0.2", "--set", "source.duration=300"]


def printed(capsys, *arguments):
    status = main(["tune", "motor_winding", *arguments])
    return status, capsys.readouterr().out


def test_a_wrong_noise_is_found_and_proposed(capsys, tmp_path):
    file = tmp_path / "found.yaml"
    status, out = printed(capsys, *WRONG, "--logs", "2", "--fit", "R", "--save", str(file))
    assert status == 0 and "Proposed: +" in out and "R.winding  0.2" in out
    text = file.read_text(encoding="utf-8")
    twin = load_twin("motor_winding")
    found = pasted_text(twin, text).tuning
    # 4 made the logs; of some 560 readings R has a deviation of 6 %.
    assert 4 * 0.76 < found.r[0] < 4 * 1.24
    assert float(yaml.safe_load(text)["sensors"]["winding"]["variance"]) == found.r[0]


def test_a_value_at_the_edge_of_its_range_is_said(capsys):
    # Ten thousand times too much is further than is searched.
    status, out = printed(capsys, "--set", "R.winding=1e5", "--fit", "R")
    assert status == 0 and "at the edge of its range" in out
    _, out = printed(capsys, *WRONG, "--fit", "R")
    assert "at the edge" not in out


def test_what_is_right_is_not_replaced(capsys, tmp_path):
    file = tmp_path / "found.yaml"
    status, out = printed(capsys, "--fit", "R", "--set", "source.duration=300", "--save", str(file))
    assert status == 1 and "Not proposed:" in out and not file.exists()


def test_json_has_all_of_it(capsys):
    status, out = printed(capsys, *WRONG, "--fit", "R,Q.temperature", "--json")
    found = json.loads(out)
    assert status == 0 and found["proposed"] and found["twin"] == "motor_winding"
    by_key = {entry["key"]: entry for entry in found["entries"]}
    assert by_key["R.winding"]["low"] < 4 < by_key["R.winding"]["high"]
    assert by_key["Q.temperature"]["alone"] and by_key["Q.temperature"]["low"] is None
    assert found["after"]["held_out"]["log_density"] > found["before"]["held_out"]["log_density"]
    assert found["before"]["held_out"]["readings"] > 0 and set(found["after"]["fitted"]["states"]) == {
        "temperature",
        "rate",
    }


def test_a_fit_stays_within_the_data_sheet(capsys):
    bounds = "sensors.winding={std: {value: 1, from: 0.5, to: 1.5}}"
    asset = "source.sensors.winding.std=2"
    _, out = printed(capsys, "--set", asset, "--set", "source.duration=300", "--set", bounds, "--fit", "R", "--json")
    (entry,) = json.loads(out)["entries"]
    # 4, which made the log, lies beyond.
    assert entry["after"] == 2.25 and entry["high"] == 2.25


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["--fit", "R.wnding"], "R.wnding is no entry that can be fitted; did you mean R.winding"),
        (["--fit", ","], "--fit names nothing; write for example --fit Q,R"),
        (["--blocks", "2"], "--blocks 2: must be 3 or more"),
        (["--predict", "winding"], "--predict: is for --aim crps and --aim error"),
        (["--duration", "-1"], "--duration -1: must be positive"),
        (["--save", "found.txt"], "--save found.txt: must end in .yaml"),
        (["--save", "nowhere/found.yaml"], "--save nowhere/found.yaml: there is no folder nowhere; create it first"),
        (["--logs", "0"], "--logs 0: must be 1 or more"),
        (["--aim", "crps"], "the aim is crps; it needs a sensor to hold out, and another one that is used"),
        (
            ["--set", "sensors.winding={std: {value: 2, from: 3}}"],
            "sensors.winding.std.value is 2; it must lie between",
        ),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, said):
    assert main(["tune", "motor_winding", *arguments]) == 2
    complaint = capsys.readouterr().err
    assert said in complaint and complaint.count("\n") == 1


def test_what_is_proposed_is_kept_as_a_version(capsys, tmp_path):
    """With what it was fitted on and what it was worth on the blocks held out; a twin begins with it by name."""
    file = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", file)
    status = main(["tune", str(file), *WRONG, "--fit", "R", "--keep", "fitted", "--note", "R alone", "--json"])
    out = capsys.readouterr()
    assert status == 0 and out.err.rstrip().endswith("fitted.yaml: kept")
    found = json.loads(out.out)
    version = load_twin(file, overrides={"tuning": "fitted"}).version
    assert version.head.note == "R alone" and version.head.fitted_on == (f"{file.stem}, its own log",)
    assert version.head.scores["log_likelihood"] == pytest.approx(found["after"]["held_out"]["log_density"], rel=1e-6)
    assert version.head.scores["rmse.temperature"] > 0.0
    assert load_twin(file, overrides={"tuning": "fitted"}).tuning.r[0] == found["entries"][0]["after"]


def test_a_name_that_is_none_is_told_before_the_fit(capsys):
    assert main(["tune", "motor_winding", "--keep", "../x"]) == 2
    assert "the version's name is" in capsys.readouterr().err


def test_a_name_that_is_taken_is_told_before_the_fit(capsys, tmp_path, monkeypatch):
    file = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", file)
    assert main(["tunings", str(file), "--save", "taken"]) == 0
    monkeypatch.setattr("app.cli.tune.fit", lambda *_, **__: pytest.fail("it was fitted"))
    assert main(["tune", str(file), "--keep", "taken"]) == 2
    assert "taken.yaml: there is a version of that name; choose another name" in capsys.readouterr().err


def test_what_nothing_tells_is_a_dash(capsys):
    """Of no reading there is no NIS and no share in a band, and of a lone sensor nothing is held out."""
    beyond = ["--set", "sensors.winding.range=[1000, 2000]"]
    status, out = printed(capsys, "--set", "source.duration=100", *beyond)
    assert status == 1 and "- -> -" in out and "nan" not in out
    assert ("Sensors held out in turn" in out) == ("truth  temperature" in out)


def test_a_sensor_that_was_stuck_is_said(capsys):
    """A fifth of the log repeats one reading: of what is left R is that of the rest."""
    stuck = ["--set", "source.faults=[{sensor: winding, kind: stuck, start: 100, end: 160}]"]
    _, out = printed(capsys, "--set", "source.duration=300", *stuck, "--fit", "R")
    assert "winding was stuck: " in out and "of its readings were left out" in out
    _, out = printed(capsys, "--set", "source.duration=300", *stuck, "--fit", "R", "--json")
    found = json.loads(out)
    assert found["left_out"]["winding"] >= 50 and found["power"] == 1.0


def test_what_a_recording_knows_is_aimed_at_and_a_simulated_truth_is_not():
    assert natural_aim(load_twin("motor_winding").config) == "likelihood"
    assert natural_aim(load_twin("battery_dmegc").config) == "witnesses"
