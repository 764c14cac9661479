"""`nisus tune --windows`: what it prints of each window, what it keeps, and its exit status."""

import json
import shutil

import pytest

from app.cli.main import main
from app.twin.twin import load_twin
from config.loader import TWINS

WRONG = ["--set", "R.winding=0.5", "--set", "source.duration=600", "--fit", "R"]


def printed(capsys, *arguments):
    status = main(["tune", "motor_winding", *arguments])
    return status, capsys.readouterr().out


def test_each_window_is_a_row_and_the_next_begins_with_what_won(capsys):
    status, out = printed(capsys, *WRONG, "--windows", "200", "--json")
    told = json.loads(out)
    windows = told["windows"]
    assert status == 0 and (told["window"], told["every"], len(windows)) == (200.0, 200.0, 3)
    assert [round(item["from"]) for item in windows] == [0, 200, 400]
    before = 0.5
    for item in windows:
        (entry,) = item["result"]["entries"]
        # 4 °C² made the log.
        assert entry["before"] == before and entry["low"] < 4.0 < entry["high"]
        before = entry["after"] if item["adopted"] else before
    assert any(item["adopted"] for item in windows) and not windows[-1]["adopted"]

    status, out = printed(capsys, *WRONG, "--windows", "200 s", "--every", "100")
    assert status == 0 and "R.winding, °C²" in out and "(adopted)" in out
    # Of each that was not adopted it is said why.
    assert out.count("(adopted)") + out.split("Verdict")[1].count(" s: ") == 5
    assert "no better prediction of the held-out blocks" in out.split("Verdict")[1]


def test_what_is_right_stays(capsys):
    status, out = printed(capsys, "--set", "source.duration=300", "--fit", "R", "--windows", "5 min")
    assert status == 1 and "0 of 1 windows were adopted" in out


def test_recordings_follow_each_other_and_the_last_is_kept_with_its_evidence(capsys, tmp_path):
    file = tmp_path / "winding.yaml"
    shutil.copy(TWINS / "motor_winding.yaml", file)
    status = main(["tune", str(file), *WRONG, "--windows", "1h", "--logs", "2", "--keep", "worn", "--json"])
    windows = json.loads(capsys.readouterr().out)["windows"]
    assert status == 0 and [item["recording"] for item in windows] == [0, 1]
    (first,), (second,) = (item["result"]["entries"] for item in windows)
    # A log that is shorter than a window is one, and the second begins with what the first found.
    assert windows[0]["adopted"] and second["before"] == first["after"]
    version = load_twin(file, overrides={"tuning": "worn"}).version
    kept = (second if windows[1]["adopted"] else first)["after"]
    moved = version.head.evidence.entries["R.winding"]
    assert moved.after == kept and moved.sigma > 3.0 and version.head.evidence.gain > 0.0
    assert load_twin(file, overrides={"tuning": "worn"}).tuning.get("R.winding") == kept


def test_wear_of_a_simulated_asset_is_followed(capsys):
    """The water jacket of a motor silts up halfway: its true resistance grows by 40 %, and nobody tells the twin."""
    asset = {
        "estimate": "{}", "source.initial": "{}", "source.truth": "{}", "view": "{}",
        "source.faults": "[{kind: model, parameter: yoke_coolant, size: 1.4, start: 600}]",
    }  # fmt: skip
    given = [word for key, value in asset.items() for word in ("--set", f"{key}={value}")]
    status = main(["tune", "motor_joint", *given, "--fit", "p.yoke_coolant", "--windows", "5min", "--json"])
    windows = json.loads(capsys.readouterr().out)["windows"]
    assert status == 0 and len(windows) == 4
    for item, true in zip(windows, [0.03, 0.03, 0.042, 0.042], strict=True):
        (entry,) = item["result"]["entries"]
        assert entry["low"] < true < entry["high"]
    assert [item["adopted"] for item in windows[:2]] == [False, False]
    adopted = [item["result"]["entries"][0] for item in windows if item["adopted"]]
    assert adopted and adopted[-1]["sigma"] > 10.0


def test_what_no_window_looked_at_is_said(capsys):
    main(["tune", "motor_winding", "--set", "source.duration=120", "--fit", "R", "--windows", "50"])
    said = capsys.readouterr().out
    # Of 121 readings, one a second, two windows hold 100.
    assert "The last 21 s are less than half a window, or half a step, and were not fitted." in said
    main(["tune", "motor_winding", "--set", "source.duration=120", "--fit", "R", "--windows", "60"])
    assert "were not fitted" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--windows", "soon"], "--windows soon: give seconds, or a number with its unit, as in 10min"),
        (["--windows", "0"], "--windows 0: must be positive"),
        (["--windows", "60", "--every", "-1"], "--every -1: must be positive"),
        (["--every", "60"], "--every: is the time between the ends of two --windows; give both"),
        (["--windows", "60", "--aim", "crps"], "--aim crps: windows are fitted by their likelihood"),
        (["--windows", "60", "--fit", "R.wnding"], "R.wnding is no entry that can be fitted; did you mean R.winding"),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, said):
    assert main(["tune", "motor_winding", *arguments]) == 2
    complaint = capsys.readouterr().err
    assert said in complaint and complaint.count("\n") == 1
