from pathlib import Path

from config.loader import load_text
from estimators.errors import ConfigError
from tests.cases import cases
from tests.support import error_of

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
          valid_if: {ImuValid: 1, Temp: [null, 80]}
        gnss:
          message: gnss_pos
          signals: [Latitude, Longitude]
          valid_if: {PositionValid: true, PositionAccuracy: [null, 20]}
          convert: east_north
          origin: [55.6, 12.5]
    - type: table
      files: truth.csv
      time: {column: t_utc}
      truth: {speed: {columns: v, units: m/s}}
      sensors: {gnss_speed: {columns: speed_mps}}
"""


def message(text: str) -> str:
    return error_of(ConfigError, load_text, text, Path("car.yaml"))


@cases(__file__, "source_mistakes.csv")
def test_a_mistake_in_a_source_is_one_line(old: str, new: str, expected: str) -> None:
    assert old in CAR
    assert message(CAR.replace(old, new, 1)) == expected
