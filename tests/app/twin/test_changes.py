"""The way back to the settings that a session began with, in a review those of the recording."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.cli.run import open_review
from app.engine import commands
from app.engine.engine import Engine
from app.record.writer import RecordingPart
from app.twin.changes import turned
from app.twin.twin import load_twin
from app.web.commands_json import command_from_json
from app.web.twin_json import status_json
from estimators.errors import ConfigError
from estimators.tuning import Tuning
from tests.app.scripted import Scripted, Stepped, fresh_status, pull_all, readings
from tests.support import assert_same

TURNED = (
    commands.SetEstimator("ukf"),
    commands.SetOption("alpha", 0.5),
    commands.SetTuning("R.winding", 2.25),
    commands.SetTuning("gate", 0.99),
)


def carry_out(engine, *wanted):
    for command in wanted:
        engine.submit(command)
    engine.settle()
    fresh_status(engine)


@pytest.fixture
def review(tmp_path):
    """A review of a session whose filter was turned while it was recorded; and the track that it ended with."""
    stepped = Stepped(of=load_twin("motor_winding"))
    part = RecordingPart(stepped.engine, tmp_path / "run.rrd", lambda stream: lambda pull: None)
    t = np.arange(1.0, 301.0)
    stepped.put(readings(t, 40.0 + 0.05 * t + np.random.default_rng(1).normal(0.0, 1.5, 300)))
    part.write()
    stepped.submit(*TURNED)
    part.end()
    part.release()
    session, _ = open_review(tmp_path / "run.rrd", None)
    carry_out(session.engine)
    return session.engine, pull_all(stepped.engine).track


def test_a_review_goes_back_to_what_was_recorded(review):
    engine, seen = review
    assert_same(pull_all(engine).track, seen)
    said = status_json(engine)
    assert (said["began_as"], said["turned"]) == ("recorded", {})
    assert (said["estimator"], said["options"]["alpha"]) == ("ukf", 0.5)
    assert (said["tuning"]["R.winding"], engine.tuning.gate) == (2.25, 0.99)

    more = (
        commands.SetOption("alpha", 1.0),
        commands.SetTuning("R.winding", 100.0),
        commands.UseSensor("winding", False),
    )
    carry_out(engine, *more, commands.SetTuning("gate", None))
    assert status_json(engine)["turned"] == {
        "options.alpha": 0.5, "R.winding": 2.25, "use.winding": True, "gate": 0.99,
    }  # fmt: skip
    carry_out(engine, commands.SetEstimator("kf"))
    # Another filter's options are not compared with those of the recorded one.
    assert status_json(engine)["turned"] == {
        "estimator": "ukf", "R.winding": 2.25, "use.winding": True, "gate": 0.99,
    }  # fmt: skip
    assert not np.array_equal(pull_all(engine).track.mean, seen.mean)

    carry_out(engine, command_from_json({"command": "Restore"}, engine))
    assert status_json(engine)["turned"] == {}
    assert_same(pull_all(engine).track, seen)


def test_a_live_twin_goes_back_to_its_file():
    twin = load_twin("motor_winding")
    engine = Engine(twin, lambda report: Scripted())
    assert status_json(engine)["began_as"] == "configured"
    found = turned(twin, twin.estimator, twin.tuning.set("Q.rate", 123.0))
    was = twin.tuning.get("Q.rate")
    assert found == {"Q.rate": was}
    with pytest.raises(ConfigError, match="Restore: name is not known; it takes no field"):
        command_from_json({"command": "Restore", "name": "kf"}, engine)


def test_rows_that_share_an_entry_are_told_one_by_one_where_their_mean_stays():
    model = load_twin("thermal_field").model
    first = Tuning.of(model)
    twin = SimpleNamespace(estimator="ensrf", tuning=first)
    a, b = (f"R.{name}" for name in model.row_names[:2])
    value = first.get(a)
    assert turned(twin, "ensrf", first.set("R.thermocouples", 4.0)) == {"R.thermocouples": value}
    moved = first.set(a, 0.75 * value).set(b, 1.25 * value)
    # Quarters add up without rounding: the mean is the same to the bit.
    assert first.get("R.thermocouples") == moved.get("R.thermocouples")
    assert turned(twin, "ensrf", moved) == {a: value, b: value}


def test_a_review_of_a_file_that_was_not_closed_says_so(review, tmp_path, capsys):
    whole, cut = tmp_path / "run.rrd", tmp_path / "cut.rrd"
    cut.write_bytes(whole.read_bytes()[:-1000])
    capsys.readouterr()
    for path in (whole, cut):
        session, _ = open_review(path, None)
        told = [line.text for line in session.engine.notices.since(0) if "was not closed" in line.text]
        assert len(told) == (path == cut)
        assert ("cut.rrd: was not closed" in capsys.readouterr().err) == (path == cut)
