from pathlib import Path

import pytest

from config.loader import load_text
from config.source_schema import CanLogSection, CanSection, MergedSection, TableSection
from estimators.errors import ConfigError

CAR = """\
model: road_car
source:
  type: merged
  parts:
    - type: can_log
      folder: ../data
      files: [a.MF4, "b*.MF4"]
      get: ask the owner
      dbc: [{file: gps.dbc, channel: 2}, {file: obd.dbc, channel: 1}]
      sensors:
        obd_speed: {message: OBD_RX, signals: Speed, units: km/h}
        gyro:
          message: gnss_imu
          signals: AngularRateX
          units: deg/s
          scale: -1
          where: {ImuValid: 1, Temp: {max: 80}}
        gnss:
          message: gnss_pos
          signals: [Latitude, Longitude]
          where: {PositionValid: true, PositionAccuracy: {max: 20}}
          convert: east_north
          origin: [55.6, 12.5]
    - type: table
      files: truth.csv
      time: {column: t_utc}
      truth: {speed: {columns: v, units: m/s}}
      sensors: {gnss_speed: {columns: speed_mps}}
"""


def message(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_text(text, Path("car.yaml"))
    return str(caught.value)


def test_a_car_with_two_buses_and_a_table_can_be_written() -> None:
    source = load_text(CAR, Path("car.yaml")).config.source
    assert isinstance(source, MergedSection)
    log, table = source.parts
    assert isinstance(log, CanLogSection) and isinstance(table, TableSection)
    assert [(item.file, item.channel) for item in log.dbc] == [("gps.dbc", 2), ("obd.dbc", 1)]
    assert log.files == ("a.MF4", "b*.MF4")
    assert log.sensors["obd_speed"].units == ("km/h",)
    gyro = log.sensors["gyro"]
    assert gyro.scale == (-1.0,) and gyro.offset == (0.0,)
    assert {name: (limit.min, limit.max) for name, limit in gyro.where.items()} == {
        "ImuValid": (1, 1),
        "Temp": (None, 80),
    }
    gnss = log.sensors["gnss"]
    assert gnss.convert == "east_north" and gnss.origin == (55.6, 12.5)
    assert gnss.where["PositionValid"].min == 1
    assert table.time.unit == "s" and table.truth["speed"].columns == ("v",)


def test_a_live_bus_can_be_written() -> None:
    text = """\
model: motor_drive
source:
  type: can
  interface: virtual
  channel: motor
  dbc: ../dbc/motor_can.dbc
  options: {receive_own_messages: false}
  sensors: {winding: {message: THERMAL, signals: WindingTemp}}
  asset: {step: 0.1, inputs: {i_q: {steps: [[0, 1], [5, 2]], repeat: 10}}}
"""
    source = load_text(text, Path("motor.yaml")).config.source
    assert isinstance(source, CanSection)
    assert source.dbc[0].file == "../dbc/motor_can.dbc" and source.dbc[0].channel is None
    assert source.asset is not None and source.asset.inputs["i_q"][0].repeat == 10


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("          signals: AngularRateX\n", "          signal: AngularRateX\n",
            "car.yaml:14: source.parts[0].sensors.gyro.signal is not known; did you mean signals?"),
        ("          scale: -1\n", "          scale: [1, 2]\n",
            "car.yaml:16: source.parts[0].sensors.gyro.scale has 2 entries; give one, or one for each of the 1 values"),
        ("signals: [Latitude, Longitude]", "signals: Latitude", "car.yaml:22: source.parts[0].sensors.gnss.convert is "
            "east_north; it needs two values, latitude and longitude, and 1 are named"),
        ("convert: east_north", "convert: utm",
            "car.yaml:22: source.parts[0].sensors.gnss.convert is 'utm'; it must be 'east_north'"),
        ("time: {column: t_utc}", "time: {column: t_utc, unit: sec}", "car.yaml:26: source.parts[1].time.unit is "
            "'sec'; it must be 's', 'ms', 'us', 'ns', 'min', 'h', 'excel' or 'matlab'"),
        ("      time: {column: t_utc}\n", "", "car.yaml:24: source.parts[1].time is missing; add it"),
        ("    - type: table", "    - type: can", "car.yaml:24: source.parts[1].type is 'can'; did you mean can_log?"),
        ("    - type: table", "    - typ: table",
            "car.yaml:24: source.parts[1].type is missing; it must be one of can_log, table"),
        ("Temp: {max: 80}", "Temp: hot", "car.yaml:17: source.parts[0].sensors.gyro.where compares Temp with the text "
            "'hot'; give the signal's raw number"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_source_is_one_line(old: str, new: str, expected: str) -> None:
    assert old in CAR
    assert message(CAR.replace(old, new, 1)) == expected


def test_a_receiver_that_knows_its_accuracy_can_be_written() -> None:
    own = "convert: east_north\n          accuracy: {std: PositionAccuracy, units: cm, scale: 0.5}"
    source = load_text(CAR.replace("convert: east_north", own), Path("car.yaml")).config.source
    assert isinstance(source, MergedSection)
    accuracy = source.parts[0].sensors["gnss"].accuracy
    assert accuracy is not None and accuracy.std == ("PositionAccuracy",) and accuracy.variance is None
    assert accuracy.units == ("cm",) and accuracy.scale == (0.5,)
