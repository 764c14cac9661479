"""`nisus tune`: what it prints, what it saves, and its exit status, on a simulated motor winding."""

import json

import pytest
import yaml

from app.cli.main import main
from app.twin.twin import load_twin
from tests.app.runs.test_tuning_yaml import pasted

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
    found = pasted(twin, text).tuning
    # 4 made the logs; of some 560 readings R has a deviation of 6 %.
    assert 4 * 0.76 < found.r[0] < 4 * 1.24
    assert float(yaml.safe_load(text)["sensors"]["winding"]["variance"]) == found.r[0]


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
