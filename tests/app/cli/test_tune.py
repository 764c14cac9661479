"""`nisus tune`: what it prints, saves and keeps, and its exit status, for one fit and for one window after another."""

import pytest
import yaml

from app.twin.defaults import natural_aim
from app.twin.twin import load_twin
from tests.app.twin.test_versions import pasted_text

TUNE = "tune", "motor_winding"
SHORT = "--set", "source.duration=300"
WRONG = "--set", "R.winding=0.2", *SHORT
WRONG_LONG = "--set", "R.winding=0.5", "--set", "source.duration=600", "--fit", "R"


def test_a_wrong_noise_is_found_and_proposed(nisus, tmp_path):
    file = tmp_path / "found.yaml"
    out = nisus(*TUNE, *WRONG, "--logs", 2, "--fit", "R", "--save", file).out
    assert "Proposed: +" in out and "R.winding  0.2" in out and "Nothing is written." not in out
    text = file.read_text(encoding="utf-8")
    found = pasted_text(load_twin("motor_winding"), text).tuning
    # 4 made the logs; of some 560 readings R has a deviation of 6 %.
    assert 4 * 0.76 < found.r[0] < 4 * 1.24
    assert float(yaml.safe_load(text)["sensors"]["winding"]["variance"]) == found.r[0]


def test_a_value_at_the_edge_of_its_range_is_reported(nisus):
    # Ten thousand times too much is further than is searched.
    assert "at the edge of its range" in nisus(*TUNE, "--set", "R.winding=1e5", "--fit", "R").out
    assert "at the edge" not in nisus(*TUNE, *WRONG, "--fit", "R").out


def test_a_right_noise_is_not_replaced(nisus, tmp_path):
    file = tmp_path / "found.yaml"
    done = nisus.run(*TUNE, "--fit", "R", *SHORT, "--save", file)
    assert done.status == 1 and "Not proposed:" in done.out and not file.exists()
    assert "Next: " in done.out


def test_json_has_all_of_it(nisus):
    found = nisus(*TUNE, *WRONG, "--fit", "R,Q.temperature", "--json").json
    assert found["proposed"] and found["twin"] == "motor_winding"
    by_key = {entry["key"]: entry for entry in found["entries"]}
    assert by_key["R.winding"]["low"] < 4 < by_key["R.winding"]["high"]
    assert by_key["Q.temperature"]["alone"] and by_key["Q.temperature"]["low"] is None
    assert found["after"]["held_out"]["log_density"] > found["before"]["held_out"]["log_density"]
    assert found["before"]["held_out"]["readings"] > 0
    assert set(found["after"]["fitted"]["states"]) == {"temperature", "rate"}


def test_a_fit_stays_within_the_data_sheet(nisus):
    bounds = "sensors.winding={std: {value: 1, from: 0.5, to: 1.5}}"
    asset = "source.sensors.winding.std=2"
    (entry,) = nisus.run(*TUNE, "--set", asset, *SHORT, "--set", bounds, "--fit", "R", "--json").json["entries"]
    # 4, which made the log, lies beyond.
    assert entry["after"] == 2.25 and entry["high"] == 2.25


def test_a_proposal_is_kept_as_a_version(nisus, winding):
    """With what it was fitted on and its scores on the blocks held out; a twin begins with it by name."""
    done = nisus("tune", winding, *WRONG, "--fit", "R", "--keep", "fitted", "--note", "R alone", "--json")
    assert done.err.rstrip().endswith("fitted.yaml: kept")
    twin = load_twin(winding, overrides={"tuning": "fitted"})
    head = twin.version.head
    assert head.note == "R alone" and head.fitted_on == ("winding, its own log",)
    assert head.scores["log_likelihood"] == pytest.approx(done.json["after"]["held_out"]["log_density"], rel=1e-6)
    assert head.scores["rmse.temperature"] > 0.0
    assert twin.tuning.r[0] == done.json["entries"][0]["after"]


def test_a_proposal_is_applied_to_the_file_in_one_step(nisus, winding, tmp_path):
    """In place, into a copy, and later from a version; the comments stay."""
    before, copy = winding.read_text(), tmp_path / "copy.yaml"
    done = nisus("tune", winding, *WRONG, "--fit", "R", "--keep", "fitted", "--out", copy, "--json")
    fitted = done.json["entries"][0]["after"]
    assert winding.read_text() == before and "copy.yaml: has the values" in done.err
    assert load_twin(copy).tuning.r[0] == pytest.approx(fitted, rel=1e-5)
    said = nisus("tunings", winding, "--apply", "fitted").out
    kept = winding.with_name("winding.yaml.1.bak")
    assert kept.name in said and kept.read_text() == before
    assert winding.read_text() == copy.read_text()
    changed = [(a, b) for a, b in zip(before.splitlines(), copy.read_text().splitlines(), strict=True) if a != b]
    assert len(changed) == 1 and "# °C²" in changed[0][1]


def test_a_part_of_a_log_is_fitted_from_the_state_of_the_filter_before_it(nisus):
    """The density of the part's measurements, fitted and held out, is that of a fold, which runs from the start."""
    given = "motor_winding", *SHORT, "--set", "R.winding=1", "--since", "40%", "--until", "200", "--json"
    found = nisus.run("tune", *given, "--fit", "R").json["before"]
    folded = nisus("fold", *given).json
    parts = found["fitted"], found["held_out"]
    assert sum(part["readings"] for part in parts) == folded["readings"] > 50
    total = sum(part["readings"] * part["log_density"] for part in parts)
    assert total == pytest.approx(folded["log_likelihood"], rel=1e-9)
    assert "--windows, which go through the whole log" in nisus.refuses("tune", *given, "--windows", 60)


def test_a_taken_name_is_refused_before_the_fit(nisus, winding, monkeypatch):
    nisus("tunings", winding, "--save", "taken")
    monkeypatch.setattr("app.cli.tune.fit", lambda *_, **__: pytest.fail("it was fitted"))
    said = nisus.refuses("tune", winding, "--keep", "taken")
    assert "taken.yaml: there is a version of that name; choose another name" in said


def test_an_unknown_figure_is_a_dash(nisus):
    """Of no reading there is no NIS and no share in a band, and of a lone sensor nothing is held out."""
    beyond = "--set", "sensors.winding.range=[1000, 2000]"
    done = nisus.run(*TUNE, "--set", "source.duration=100", *beyond)
    assert done.status == 1 and "- -> -" in done.out and "nan" not in done.out
    assert ("Sensors held out in turn" in done.out) == ("truth  temperature" in done.out)


def test_a_stuck_sensor_is_left_out(nisus):
    """A fifth of the log repeats one reading: of what is left R is that of the rest."""
    given = *TUNE, *SHORT, "--set", "source.faults=[{sensor: winding, kind: stuck, start: 100, end: 160}]", "--fit", "R"
    out = nisus.run(*given).out
    assert "winding was stuck: " in out and "of its readings were left out" in out
    found = nisus.run(*given, "--json").json
    assert found["left_out"]["winding"] >= 50 and found["power"] == 1.0


def test_the_default_aim_uses_the_truth_of_a_recording_and_not_that_of_a_simulation():
    assert natural_aim(load_twin("motor_winding").config) == "likelihood"
    assert natural_aim(load_twin("battery_dmegc").config) == "witnesses"


def test_each_window_is_a_row_and_the_next_begins_with_the_adopted_value(nisus):
    told = nisus(*TUNE, *WRONG_LONG, "--windows", 200, "--json").json
    windows = told["windows"]
    assert (told["window"], told["every"], len(windows)) == (200.0, 200.0, 3)
    assert [round(item["from"]) for item in windows] == [0, 200, 400]
    before = 0.5
    for item in windows:
        (entry,) = item["result"]["entries"]
        # 4 °C² made the log.
        assert entry["before"] == before and entry["low"] < 4.0 < entry["high"]
        before = entry["after"] if item["adopted"] else before
    assert any(item["adopted"] for item in windows) and not windows[-1]["adopted"]
    out = nisus(*TUNE, *WRONG_LONG, "--windows", "200 s", "--every", 100).out
    assert "R.winding, °C²" in out and "(adopted)" in out
    # Each that was not adopted has a reason.
    verdict = out.split("Verdict")[1]
    assert out.count("(adopted)") + verdict.count(" s: ") == 5
    assert "no better prediction of the held-out blocks" in verdict


def test_windows_keep_a_right_noise(nisus):
    done = nisus.run(*TUNE, *SHORT, "--fit", "R", "--windows", "5 min")
    assert done.status == 1 and "0 of 1 windows were adopted" in done.out


def test_recordings_follow_each_other_and_the_last_is_kept_with_its_evidence(nisus, winding):
    given = "--windows", "1h", "--logs", 2, "--keep", "worn", "--json"
    windows = nisus("tune", winding, *WRONG_LONG, *given).json["windows"]
    assert [item["recording"] for item in windows] == [0, 1]
    (first,), (second,) = (item["result"]["entries"] for item in windows)
    # A log that is shorter than a window is one, and the second begins with what the first found.
    assert windows[0]["adopted"] and second["before"] == first["after"]
    twin = load_twin(winding, overrides={"tuning": "worn"})
    kept = (second if windows[1]["adopted"] else first)["after"]
    evidence = twin.version.head.evidence
    moved = evidence.entries["R.winding"]
    assert moved.after == kept == twin.tuning.get("R.winding") and moved.sigma > 3.0 and evidence.gain > 0.0


def test_wear_of_a_simulated_asset_is_followed(nisus):
    """The water jacket of a motor silts up halfway: its true resistance grows by 40 %, unknown to the twin."""
    asset = {
        "parameters": "{}", "source.initial": "{}", "source.truth": "{}", "view": "{}",
        "source.faults": "[{kind: model, parameter: yoke_coolant, size: 1.4, start: 600}]",
    }  # fmt: skip
    given = [word for key, value in asset.items() for word in ("--set", f"{key}={value}")]
    windows = nisus("tune", "motor_joint", *given, "--fit", "p.yoke_coolant", "--windows", "5min", "--json").json[
        "windows"
    ]
    assert len(windows) == 4
    for item, true in zip(windows, [0.03, 0.03, 0.042, 0.042], strict=True):
        (entry,) = item["result"]["entries"]
        assert entry["low"] < true < entry["high"]
    assert [item["adopted"] for item in windows[:2]] == [False, False]
    adopted = [item["result"]["entries"][0] for item in windows if item["adopted"]]
    assert adopted and adopted[-1]["sigma"] > 10.0


@pytest.mark.parametrize(("windows", "left"), [(50, True), (60, False)])
def test_an_unfitted_end_is_reported(nisus, windows, left):
    """Of 121 readings, one a second, two windows hold 100 or 120."""
    out = nisus.run(*TUNE, "--set", "source.duration=120", "--fit", "R", "--windows", windows).out
    assert ("The last 21 s are less than half a window, or half a step, and were not fitted." in out) == left
    assert ("were not fitted" in out) == left
