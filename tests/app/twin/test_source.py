import os
from pathlib import Path

import numpy as np
import pytest

from app.twin.log_reader import read_log
from app.twin.sources.can import make_player
from estimators import errors
from estimators.errors import ConfigError, SourceError
from estimators.log import INPUT, READING, TRUTH, Events
from estimators.models import MODELS
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases
from tests.support import error_of, read_all

DBC = """\
VERSION ""
BU_: A
BO_ 256 THERMAL: 4 A
 SG_ WindingTemp : 0|16@1+ (0.01,-50) [0|0] "degC" A
 SG_ Valid : 16|1@1+ (1,0) [0|1] "" A
"""

LOG = """\
model: motor_winding
source:
  type: can_log
  folder: data
  files: drive.log
  get: ask the test bench
  dbc: thermal.dbc
  sensors:
    winding:
      message: THERMAL
      signals: WindingTemp
      valid_if: {Valid: 1}
"""

TABLE = """\
model: motor_winding
source:
  type: table
  files: [a*.csv]
  time: {column: t_ms, unit: ms}
  sensors:
    winding: {columns: temp_f, units: degF}
  truth:
    rate: {columns: rate, units: K/min}
"""

CSV = "t_ms,temp_f,rate\n0,32,60\n500,212,30\n1000,,0\n"


@pytest.fixture(autouse=True)
def _recordings(inside):
    Path("data").mkdir()
    Path("data/thermal.dbc").write_text(DBC)
    Path("data/drive.log").write_text(
        "(1.000000) can0 100#401F0100\n(1.500000) can0 100#FFFF0000\n(2.000000) can0 100#50230100\n"
    )


def events(twin, *, live=False):
    reports: list[tuple[str, str]] = []
    source = twin.open_source(lambda key, text: reports.append((key, text)), live=live)
    events = read_all(source)
    source.close()
    return events


def of(batch, kind):
    return batch.select(batch.kind == kind)


def message(text, kind, **options):
    return error_of(kind, lambda: events(twin_of(text, **options)))


def test_a_can_log_is_read_through_its_dbc_and_conditions():
    batch = of(events(twin_of(LOG)), READING)
    np.testing.assert_array_equal(batch.t, [1_000_000_000, 1_500_000_000, 2_000_000_000])
    np.testing.assert_allclose(batch.value[:, 0], [30.0, np.nan, 40.4], rtol=1e-12)


def test_a_table_is_read_in_the_models_units():
    Path("a1.csv").write_text(CSV)
    batch = events(twin_of(TABLE))
    readings, truth = of(batch, READING), of(batch, TRUTH)
    np.testing.assert_array_equal(readings.t - readings.t[0], [0, 500_000_000])  # an empty cell is no reading
    np.testing.assert_allclose(readings.value[:, 0], [0.0, 100.0], atol=1e-9)
    assert set(truth.channel.tolist()) == {1}
    np.testing.assert_allclose(truth.value[:, 0], [1.0, 0.5, 0.0], rtol=1e-12)


def test_nisus_data_replaces_the_folder(monkeypatch):
    Path("data").rename("elsewhere")
    monkeypatch.setenv("NISUS_DATA", "elsewhere")
    assert len(of(events(twin_of(LOG)), READING)) == 3


def test_a_recording_that_others_can_get_is_in_the_users_cache(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(Path("cache").absolute()))
    Path("cache/nisus").mkdir(parents=True)
    Path("data").rename("cache/nisus/recordings")
    assert len(of(events(twin_of(LOG)), READING)) == 3
    assert "is not there: data/drive.log" in message(LOG.replace("  get: ask the test bench\n", ""), SourceError)


def test_nisus_data_leaves_a_twin_without_folder_alone(monkeypatch):
    Path("a1.csv").write_text(CSV)
    monkeypatch.setenv("NISUS_DATA", "elsewhere")
    assert len(of(events(twin_of(TABLE)), READING)) == 2


def test_log_files_replace_the_recording():
    Path("other.log").write_text("(5.000000) can0 100#401F0100\n")
    assert of(events(twin_of(LOG, log_files=["other.log"])), READING).t.tolist() == [5_000_000_000]


def test_a_recording_stands_in_for_a_bus():
    bus = LOG.replace("can_log", "can\n  interface: virtual\n  channel: x\n  recording: data/drive.log")
    bus = bus.replace("  folder: data\n  files: drive.log\n  get: ask the test bench\n", "").replace(
        "dbc: t", "dbc: data/t"
    )
    assert len(of(events(twin_of(bus)), READING)) == 3
    without = bus.replace("  recording: data/drive.log\n", "")
    assert message(without, SourceError) == (
        "motor.yaml:2: source is a live bus, which does not end; give a recording of it with --log FILE"
    )
    assert len(of(events(twin_of(without, log_files=["data/drive.log"])), READING)) == 3


@cases(__file__, "unopened.csv")
def test_a_source_that_cannot_be_opened_is_one_line(old, new, kind, expected):
    assert old in LOG
    assert message(LOG.replace(old, new, 1), getattr(errors, kind)) == expected


@cases(__file__, "dbc_lacks.csv")
def test_what_the_dbc_lacks_is_one_line_at_the_mapping(old, new, words):
    assert old in LOG
    text = message(LOG.replace(old, new, 1), SourceError)
    assert text.startswith("motor.yaml:9: source.sensors.winding: ") and "\n" not in text
    for word in words.split():
        assert word in text


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [("columns: temp_f", "columns: temp_c", ["temp_c", "temp_f"]), ("units: degF", "units: m/s", ["m/s", "°C"])],
)
def test_what_a_table_lacks_is_one_line_at_the_mapping(old, new, words):
    Path("a1.csv").write_text(CSV)
    text = message(TABLE.replace(old, new, 1), SourceError)
    assert text.startswith("motor.yaml:7: source.sensors.winding: ") and "\n" not in text
    for word in words:
        assert word in text


def test_what_is_no_channels_fault_is_not_blamed_on_one():
    Path("a1.csv").write_text(CSV)
    text = message(TABLE.replace("t_ms", "t_s"), SourceError)
    assert text.startswith("motor.yaml:2: source: ") and "t_s" in text and "did you mean t_ms?" in text
    Path("data/thermal.dbc").write_text("no DBC at all {")
    text = message(LOG, SourceError)
    assert text.startswith("motor.yaml:2: source: ") and "thermal.dbc" in text and "\n" not in text
    Path("data/thermal.dbc").write_text(DBC)
    text = message(LOG.replace("drive.log", "thermal.dbc"), SourceError)
    assert text.startswith("motor.yaml:5: source.files: ") and "thermal.dbc" in text and "\n" not in text


def test_log_files_that_fit_nothing_are_one_line():
    assert message(LOG, SourceError, log_files=["."]).startswith(".: holds no recording; name a file that ends in .csv")
    assert (
        message(LOG, SourceError, log_files=["absent.blf"]) == "--log absent.blf: there is no such file; check the path"
    )
    assert message(LOG, SourceError, log_files=[os.devnull]) == (
        f"--log {os.devnull}: it is a device or a pipe; name a file, which can be read again"
    )
    simulator = "model: motor_winding\nsource: {type: simulator}\n"
    assert message(simulator, SourceError, log_files=["a.blf"]).startswith(
        "--log a.blf: the source of motor is a simulator; --log needs type can, can_log, table"
    )


def test_merged_recordings_and_their_replacements():
    Path("a1.csv").write_text(CSV)
    indent = lambda text: "".join("      " + line + "\n" for line in text.split("source:\n")[1].splitlines())  # noqa: E731
    part = lambda text: "    - " + indent(text).replace("        ", "      ").lstrip()  # noqa: E731
    merged = "model: motor_winding\nsource:\n  type: merged\n  parts:\n" + part(LOG) + part(TABLE)
    batch = events(twin_of(merged))
    assert len(of(batch, READING)) == 5 and len(of(batch, TRUTH)) == 3
    assert np.all(np.diff(batch.t) >= 0)
    Path("new.log").write_text("(5.000000) can0 100#401F0100\n")
    assert of(events(twin_of(merged, log_files=["new.log"])), READING).t.tolist() == [5_000_000_000]
    Path("new.csv").write_text(CSV)
    assert len(of(events(twin_of(merged, log_files=["new.log", "new.csv"])), READING)) == 3
    truth_only = part(TABLE).replace("sensors:\n        winding: {columns: temp_f, units: degF}\n      ", "")
    assert "sensors" not in truth_only
    log_and_truth = merged.replace(part(TABLE), truth_only)
    assert len(of(events(twin_of(log_and_truth)), TRUTH)) == 3
    assert message(merged[: merged.index("    - ")] + truth_only, ConfigError).startswith(
        "motor.yaml:2: source feeds no"
    )
    two = merged + part(TABLE).replace("a*.csv", "b*.csv")
    Path("b1.csv").write_text(CSV)
    assert message(two, SourceError, log_files=["new.csv"]) == (
        "--log new.csv: 2 parts of motor.yaml:4 could read it; give it the name of the file that it replaces"
    )
    Path("new").mkdir()
    Path("new/b7.csv").write_text(CSV)
    assert len(of(events(twin_of(two, log_files=["new/b7.csv"])), READING)) == 2


def test_a_simulators_inputs_and_plans_reach_it():
    text = """\
model: motor_drive
source:
  type: simulator
  step: 0.5
  duration: 5
  inputs: {i_q: [10, {steps: [[0, 0], [2, 5]]}], ambient: {sine: {mean: 20, amplitude: 1, period: 4}}}
  sensors: {winding: {every: 2, std: 1e-9}, tooth: {drop_every: 5}}
"""
    twin = twin_of(text)
    batch = events(twin)
    readings, inputs = of(batch, READING), of(batch, INPUT)
    assert np.bincount(readings.channel).tolist() == [5, 10, 10]
    assert np.isnan(readings.value[readings.channel == 1, 0]).sum() == 2
    i_q = inputs.value[:, 1]
    assert i_q[inputs.t < 2_000_000_000][0] == 10.0 and np.nanmax(i_q) == 15.0
    ambient = inputs.value[:, 4]  # 20 + sin(2π t / 4 s) at every half second
    np.testing.assert_allclose([np.nanmin(ambient), np.nanmax(ambient)], [19.0, 21.0], atol=1e-9)
    truth = of(batch, TRUTH)
    winding = readings.select(readings.channel == 0)
    exact = truth.select((truth.channel == 0) & np.isin(truth.t, winding.t))
    np.testing.assert_allclose(winding.value[:, 0], exact.value[:, 0], atol=1e-7)


JOINT = """\
model: motor_drive
parameters: {yoke_coolant: {std: 0.01, drift: 1e-3, role: estimated}}
source:
  type: simulator
  step: 0.5
  duration: 5
  TRUTH
"""


def test_a_true_parameter_may_be_one_that_the_twin_estimates():
    found = events(twin_of(JOINT.replace("TRUTH", "truth: {parameters: {yoke_coolant: 0.04, tooth_yoke: 0.05}}")))
    # The same asset, said by its state and noise.
    spelled = (
        "initial: {yoke_coolant: 0.04}\n  truth: {parameters: {tooth_yoke: 0.05}, noise: {yoke_coolant: {variance: 0}}}"
    )
    np.testing.assert_array_equal(found.value, events(twin_of(JOINT.replace("TRUTH", spelled))).value)
    truth = of(found, TRUTH)
    np.testing.assert_array_equal(truth.value[:, 4], 0.04)


def test_a_true_parameter_that_drifts_begins_at_its_value():
    drifting = "truth: {parameters: {yoke_coolant: 0.04}, noise: {yoke_coolant: {variance: 1e-8}}}"
    found = of(events(twin_of(JOINT.replace("TRUTH", drifting))), TRUTH).value[:, 4]
    assert 0.0 < np.std(found) < 6e-4  # a random walk: √(1e-8 · 5 s) = 2.2e-4 at its end
    np.testing.assert_allclose(found, 0.04, atol=1.1e-3)


def test_a_true_parameter_is_given_once():
    both = "initial: {yoke_coolant: 0.03}\n  truth: {parameters: {yoke_coolant: 0.04}}"
    assert refusal(JOINT.replace("TRUTH", both)) == (
        "motor.yaml:7: source.initial.yoke_coolant is in source.truth too; give it in one place"
    )
    no_state = "truth: {parameters: {winding: 40}}"
    assert "source.truth.parameters.winding is no parameter of motor_drive" in refusal(JOINT.replace("TRUTH", no_state))


LENGTHY = """\
model: motor_drive
source:
  type: simulator
  step: STEP
  duration: DURATION
"""


@cases(__file__, "endless.csv")
def test_a_simulation_that_would_never_end_is_one_line(step, duration, expected):
    # motor_drive has three sensors.
    runs = f"{1e9 / MODELS['motor_drive'].max_step:.3g}"
    text = LENGTHY.replace("STEP", step).replace("DURATION", duration)
    assert refusal(text) == expected.replace("RUNS", runs)


def test_a_long_simulation_may_be_as_long_as_said():
    # 3 sensors · 2 a second: 1e8 events take 16.7 million seconds.
    twin_of(LENGTHY.replace("STEP", "0.5").replace("DURATION", "16600000"))
    with pytest.raises(ConfigError):
        twin_of(LENGTHY.replace("STEP", "0.5").replace("DURATION", "16700000"))


BUS = """\
model: motor_winding
source:
  type: can
  interface: virtual
  channel: CHANNEL
  dbc: data/thermal.dbc
  sensors: {winding: {message: THERMAL, signals: WindingTemp}}
  asset: {step: 0.01, duration: 0.2, initial: {temperature: 60}, sensors: {winding: {std: 1e-9}}}
"""


def test_a_virtual_bus_plays_its_own_asset():
    source = twin_of(BUS.replace("CHANNEL", "test-played")).open_source(lambda key, text: None)
    assert source.live
    batches: list[Events] = []
    try:
        for _ in range(100):  # reads wait for frames; 20 come, and silence for ten seconds is a failure
            batches.append(source.read(0.1) or Events.empty(1))
            if sum(map(len, batches)) >= 20:
                break
    finally:
        source.close()
    batch = Events.concat(batches, 1)
    assert len(batch) == 20 and set(batch.kind.tolist()) == {READING}
    # 60 °C ± the process noise of 0.2 s, some hundredths, in steps of the DBC's 0.01 °C.
    np.testing.assert_allclose(batch.value[:, 0], 60.0, atol=1.0)
    np.testing.assert_allclose(batch.value[:, 0] * 100, np.round(batch.value[:, 0] * 100), atol=1e-6)
    assert source.read(0.0) is None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (LOG, "motor.yaml:2: source is of type can_log; only one of type can has a bus to play an asset on"),
        (BUS[: BUS.index("  asset")], "motor.yaml:2: source has no asset to play; describe one under source.asset"),
    ],
)
def test_what_has_no_asset_cannot_play_one(text, expected):
    twin = twin_of(text)
    assert error_of(SourceError, make_player, twin.loaded, twin.model, lambda key, text: None) == expected


def test_a_truth_of_another_model_must_fit():
    Path("other.py").write_text("from estimators.models import MODELS\nOther = MODELS['motor_drive']\n")
    text = "model: motor_winding\nsource:\n  type: simulator\n  duration: 2\n  truth:\n    model: ./other.py:Other\n"
    assert message(text, ConfigError) == (
        "motor.yaml:6: source.truth.model has states winding, tooth, yoke, magnet; they must be temperature, rate"
    )
    assert len(events(twin_of(text.replace("./other.py:Other", "motor_winding")))) == 5


CAR = """\
model: road_car
source:
  type: table
  files: car.csv
  time: {column: t}
  sensors:
    gnss_position: {columns: [lat, lon], convert: east_north, origin: [55.0, 12.0]}
    gnss_heading: {columns: compass, units: deg, scale: -1, offset: 1.5}
"""


def test_scale_offset_and_origin_reach_the_source():
    Path("car.csv").write_text("t,lat,lon,compass\n0,55.0,12.0,90\n1,55.001,12.0,0\n")
    batch = of(events(twin_of(CAR)), READING)
    twin = twin_of(CAR)
    position = batch.select(batch.channel == twin.model.sensor_names.index("gnss_position"))
    # One thousandth of a degree of latitude at 55° is 111.34 m on the WGS84 ellipsoid.
    np.testing.assert_allclose(position.value[:, :2], [[0.0, 0.0], [0.0, 111.34]], atol=0.02)
    heading = batch.select(batch.channel == twin.model.sensor_names.index("gnss_heading"))
    np.testing.assert_allclose(heading.value[:, 0], [1.5 - np.pi / 2, 1.5], atol=1e-9)
    moved = of(events(twin_of(CAR.replace("[55.0, 12.0]", "[55.001, 12.0]"))), READING)
    np.testing.assert_allclose(moved.value[0, :2], [0.0, -111.34], atol=0.02)


def test_conversions_that_make_no_sense_are_one_line():
    inputs = CAR + "  inputs:\n    accel: {columns: a, convert: east_north}\n"
    assert message(inputs, ConfigError) == (
        "motor.yaml:10: source.inputs.accel.convert is east_north; it needs two values, latitude and longitude, "
        "and 1 are named"
    )
    inputs = CAR + "  inputs:\n    accel: {columns: [a, b], convert: east_north}\n"
    assert message(inputs, ConfigError) == "motor.yaml:10: source.inputs.accel.columns names 2; accel takes 1: accel"
    nothing = CAR[: CAR.index("  sensors")]
    assert message(nothing, ConfigError).startswith("motor.yaml:2: source feeds no sensor; name at least one of ")


def test_every_type_of_the_schema_has_its_line_in_the_registry():
    from typing import get_args

    from app.twin.source import SOURCES
    from config.extensions import registered
    from config.source_schema import SourceSection

    types = [get_args(section.model_fields["type"].annotation)[0] for section in get_args(get_args(SourceSection)[0])]
    assert sorted(types) == sorted([*SOURCES, *registered("sources")])


THREE = """\
model: motor_drive
source:
  type: merged
  parts:
""" + "".join(
    f"    - {{type: table, files: {name}.csv, time: {{column: t}}, sensors: {{{name}: {{columns: y}}}}}}\n"
    for name in ("winding", "tooth", "yoke")
)


def stepped(seconds, how):
    """Times of a recording whose rows are out of order, or whose clock was set."""
    late = seconds >= 200.0
    return {
        "blocks": np.concatenate((seconds[:200], seconds[328:500], seconds[200:328], seconds[500:])),
        "newest first": seconds[::-1],
        "overlap": np.where(late, seconds - 64.375, seconds),
        "set back an hour": seconds - 3600.0 * late,
        "set ahead for a while": seconds + 64.0 * (late & (seconds < 300.0)),
    }[how]


@pytest.mark.parametrize("how", ["blocks", "newest first", "overlap", "set back an hour", "set ahead for a while"])
def test_disorder_in_one_file_of_a_merged_source_alters_no_other(how):
    """The oracle is the recording itself: all rows of the other files at their times, and none of its own lost."""
    seconds = np.arange(0.0, 600.0, 0.5)
    for name in ("winding", "tooth", "yoke"):
        t = stepped(seconds, how) if name == "tooth" else seconds + 0.1
        Path(f"{name}.csv").write_text("t,y\n" + "".join(f"{s:.3f},{k}\n" for k, s in enumerate(t)))
    log, counts = read_log(twin_of(THREE), None)
    assert counts["stale"] == 0 and log.n == 3 * seconds.size
    for k, name in enumerate(("winding", "tooth", "yoke")):
        own = log.events.channel == k
        if name != "tooth":
            assert log.events.value[own, 0].tolist() == list(range(seconds.size))
            np.testing.assert_array_equal(log.events.t[own], np.round((seconds + 0.1) * 1e3).astype(np.int64) * 10**6)
        elif how == "set back an hour":
            np.testing.assert_allclose(log.events.t[own] * 1e-9, seconds, atol=0.5)
        elif how != "set ahead for a while":  # which its file alone does not distinguish from a gap
            np.testing.assert_allclose(log.events.t[own] * 1e-9, np.sort(stepped(seconds, how)))
