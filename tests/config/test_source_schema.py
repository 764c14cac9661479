from pathlib import Path

import pytest

from config.loader import load_text
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
