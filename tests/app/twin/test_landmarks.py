"""One declared sensor of many landmarks: the same estimate as of a sensor for each, written by hand."""

import dataclasses
import json

import numpy as np
import pytest

from app.cli.prepare import fold_log, prepare
from app.study.calibration_lines import calibration_lines
from app.study.fold_result import calibration_of
from app.twin.changes import difference
from app.twin.log_reader import read_log
from app.twin.tuning_yaml import tuning_yaml
from app.twin.twin import load_twin
from estimators import Log, fold
from estimators.errors import EstimatorError, ModelError, NisusError
from estimators.model.landmarks import with_landmarks
from estimators.model.state_space import Parameter
from estimators.models import MODELS
from tests.cases import cases
from tests.models import write_plant
from tests.support import error_of, measured

LANDMARKS = {6: (4.0, 1.0), 7: (-3.0, 5.0), 15: (1.0, -6.0)}
MODEL = """\
import math
from estimators.model import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel

def move(x, u, p, dt, out):
    out[0] = x[0] + dt * u[0] * math.cos(x[2])
    out[1] = x[1] + dt * u[0] * math.sin(x[2])
    out[2] = x[2] + dt * u[1]

def see(x, u, p, place, out):
    east, north = place[0] - x[0], place[1] - x[1]
    out[0] = p[0] * math.hypot(east, north)
    out[1] = math.atan2(north, east) - x[2]

def to(k):
    def h(x, u, p, out):
        east, north = p[1 + 2 * k] - x[0], p[2 + 2 * k] - x[1]
        out[0] = p[0] * math.hypot(east, north)
        out[1] = math.atan2(north, east) - x[2]
    return h

ROWS = (Row("range", "m", variance=0.01), Row("bearing", "rad", variance=0.0004, circular=True))
PLACES = {places}

def robot(sensors, parameters):
    return StateSpaceModel(
        name="robot", title="Robot among landmarks",
        states=(State("east", "m", std=0.5), State("north", "m", std=0.5),
                State("heading", "rad", std=0.2, circular=True)),
        inputs=(Input("speed", "m/s"), Input("yaw_rate", "rad/s")),
        parameters=(Parameter("scale", "1", 1.0), *parameters),
        noises=(Noise("east", "m²/s", 1e-3), Noise("north", "m²/s", 1e-3), Noise("heading", "rad²/s", 1e-3)),
        sensors=sensors, f=move,
    )

One = robot((Sensor("sighting", ROWS, h=see, place=(("east", "m"), ("north", "m"))),), ())
Many = robot(
    tuple(Sensor(f"sighting_{{name}}", ROWS, h=to(k)) for k, name in enumerate(PLACES)),
    [Parameter(f"sighting_{{name}}_{{axis}}", "m", value) for name, at in PLACES.items()
     for axis, value in zip(("east", "north"), at)],
)
"""
SOURCE = """\
source:
  type: table
  files: drive.csv
  time: {column: t, unit: s}
  inputs: {speed: {columns: v}, yaw_rate: {columns: w}}
  sensors:
"""
ONE = f"""\
model: ./robot.py:One
sensors:
  sighting: {{std: [0.2, 0.03], landmarks: {{6: [4, 1], 7: [-3, 5], 15: [1, -6]}}}}
{SOURCE}\
    sighting: {{columns: [r, b], landmark_column: id}}
"""
MANY = "\n".join(
    [
        "model: ./robot.py:Many",
        "sensors:",
        *(f"  sighting_{name}: {{std: [0.2, 0.03]}}" for name in LANDMARKS),
        SOURCE.rstrip(),
        *(f"    sighting_{name}: {{columns: [r, b], only: {{id: {name}}}}}" for name in LANDMARKS),
    ]
)


@pytest.fixture
def folder(tmp_path):
    """A robot on a circle that sees one or two landmarks at a time, and a robot that is none (id 3)."""
    rng = np.random.default_rng(2)
    lines, x = ["t,id,r,b,v,w"], np.zeros(3)
    for k in range(600):
        x = x + 0.1 * np.array([np.cos(x[2]), np.sin(x[2]), 0.3])
        lines.append(f"{0.1 * k:.1f},,,,1,0.3")
        for name in rng.choice([*LANDMARKS, 3], rng.integers(0, 3), replace=False).tolist():
            east, north = np.array(LANDMARKS.get(name, (9.0, 9.0))) - x[:2]
            r, b = np.hypot(east, north) + rng.normal(0, 0.1), np.arctan2(north, east) - x[2] + rng.normal(0, 0.02)
            lines.append(f"{0.1 * k:.1f},{name},{r},{b},,")
    (tmp_path / "drive.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "robot.py").write_text(MODEL.format(places=LANDMARKS))
    (tmp_path / "one.yaml").write_text(ONE)
    (tmp_path / "many.yaml").write_text(MANY)
    return tmp_path


def folded(path, **overrides):
    twin = load_twin(path, overrides={key.replace("__", "."): value for key, value in overrides.items()})
    prepare(twin)
    log, _ = read_log(twin, None)
    return twin, fold_log(twin, log)


def test_the_estimate_is_that_of_a_sensor_for_each_landmark(folder):
    (one, by_id), (many, by_hand) = folded(folder / "one.yaml"), folded(folder / "many.yaml")
    assert one.model.sensor_names == many.model.sensor_names == tuple(f"sighting_{name}" for name in LANDMARKS)
    assert (by_id.track.verdict == by_hand.track.verdict).all() and np.isin(by_id.track.verdict, 1).sum() > 60
    for name in ("mean", "std", "innovation", "innovation_std", "nis", "log_likelihood"):
        np.testing.assert_array_equal(getattr(by_id.track, name), getattr(by_hand.track, name))
    # The truth after 60 s at 0.3 rad/s; 0.1 rad are five deviations of one bearing.
    np.testing.assert_allclose(by_id.track.mean[-1, 2], 18.0 - 6 * np.pi, atol=0.1)


def test_there_is_one_entry_for_all_landmarks_of_a_sensor(folder):
    one, run = folded(folder / "one.yaml", R__sighting__range="0.09", use__sighting="false")
    names = [item.key for item in one.tuning.items()]
    assert [name for name in names if name[0] in "Rp"] == ["R.sighting.range", "R.sighting.bearing", "p.scale"]
    assert one.tuning.r.tolist() == pytest.approx([0.09, 0.0009] * 3) and not one.tuning.used.any()
    assert len(calibration_lines(calibration_of(run, run.log.events, run.track), one.model)) == 1
    # One landmark can still differ, and its coordinates can be set.
    other = one.tuning.set("R.sighting_7.range", 0.5).set("p.sighting_7_east", -3.5)
    assert other.r[2] == 0.5 and other.r[0] == 0.09
    keys = [change.key for change in difference("ekf", one.tuning, "ekf", other)]
    assert keys == ["R.sighting_7.range", "p.sighting_7_east"]
    (change,) = difference("ekf", one.tuning, "ekf", one.tuning.set("R.sighting.range", 0.2))
    assert change.key == "R.sighting.range"


def test_the_section_of_one_landmark_goes_before_that_of_all(folder):
    own = "{variance: [1, 2], use: false, expected: steadily}"
    twin = load_twin(
        folder / "one.yaml", overrides={"sensors.sighting.expected": "by chance", "sensors.sighting_15": own}
    )
    assert [sensor.by_chance for sensor in twin.model.sensors] == [True, True, False]
    assert twin.tuning.r.tolist() == pytest.approx([0.04, 0.0009] * 2 + [1.0, 2.0])
    assert twin.tuning.used.tolist() == [True, True, False]


def test_a_fit_has_one_entry_for_all_landmarks(folder, nisus):
    """The declared deviations are twice and one and a half times those of the recording, 0.1 m and 0.02 rad."""
    found = nisus.run("tune", folder / "one.yaml", "--fit", "R", "--aim", "likelihood", "--json").json
    entries = {entry["key"]: entry for entry in found["entries"]}
    assert list(entries) == ["R.sighting.range", "R.sighting.bearing"]
    for key, variance in (("R.sighting.range", 0.01), ("R.sighting.bearing", 0.0004)):
        # A weak prior holds the fit back, but it ends nearer to the recording's value than to the declared one.
        before, after = entries[key]["before"], entries[key]["after"]
        assert abs(np.log(after / variance)) < abs(np.log(after / before)) and after < 0.7 * before


def test_a_yaml_written_from_a_run_keeps_the_landmarks(folder):
    twin = load_twin(folder / "one.yaml", overrides={"R.sighting_7.range": "0.5"})
    own = ONE[: ONE.index("sensors:")] + ONE[ONE.index("source:") :]
    (folder / "written.yaml").write_text(own + tuning_yaml(twin.config, "ekf", twin.tuning))
    again = load_twin(folder / "written.yaml")
    np.testing.assert_array_equal(again.tuning.r, twin.tuning.r)
    np.testing.assert_array_equal(again.tuning.p, twin.tuning.p)


def test_one_line_names_a_column_for_each_member(tmp_path):
    """20 thermometers: a line each, landmarks of one sensor, and sensors of the model with a family and a name each."""
    each, run = folded(write_plant(tmp_path / "each", 20, family=False))
    placed, landmarks = folded(write_plant(tmp_path / "placed", 20, family=True))
    assert placed.model.sensor_names == tuple(f"TT_{k:04d}" for k in range(20))
    path = write_plant(tmp_path / "own", 20, family=False)
    model, text = path.with_suffix(".py").read_text(), path.read_text()
    path.with_suffix(".py").write_text(model.replace("(*channel))", "(*channel), family='thermometer')"))
    lines = "sensors: {thermometer: {std: 0.5}}\n" + text[text.index("source:") : text.index("    TT0000:")]
    path.write_text(text[: text.index("sensors:")] + lines + '    thermometer: {columns: "*"}\n')
    own, families = folded(path)
    assert own.model.sensor_names == each.model.sensor_names and run.n == 20 * 20
    for name in ("mean", "std", "innovation", "nis"):
        np.testing.assert_array_equal(getattr(families.track, name), getattr(run.track, name))
        np.testing.assert_array_equal(getattr(landmarks.track, name), getattr(run.track, name))


@cases(__file__, "wrong_landmarks.csv")
def test_a_wrong_landmark_is_one_clear_line(folder, overrides, message):
    given = json.loads(overrides)
    assert message in error_of(NisusError, lambda: load_twin(folder / "one.yaml", overrides=given).check_files())


def test_landmarks_in_python():
    """The bundled rover with an added sensor: without places it is refused, with them it is folded."""
    rover = MODELS["uwb_rover"]

    def h(x, u, p, place, out):
        out[0] = place[0] - x[0]

    gate = dataclasses.replace(rover.sensors[0], name="gate", h=h, place=(("east", "m"),), family="")
    model = dataclasses.replace(rover, sensors=(gate,))
    with pytest.raises(EstimatorError, match="sensor gate has no landmarks.*with_landmarks"):
        fold("ekf", model, Log.of(model))
    with pytest.raises(ModelError, match="sensor range_1 takes no landmarks"):
        with_landmarks(model, {"range_1": {"1": (2.0,)}})
    known = with_landmarks(model, {"gate": {"a": (2.0,), "b": (5.0,)}})
    assert known.parameters[-1] == Parameter("gate_b_east", "m", 5.0, listed=False)
    log = measured(known, "gate_b", [1.0, 2.0], [1.0, 1.0])
    run = fold("ekf", known, log, R={"gate": 1e-6})
    assert run.mean[-1, 0] == pytest.approx(4.0, abs=0.01)
