"""Lines of the calibration: one for a row, one for the many rows of a sensor."""

from app.present.export.calibration_lines import calibration_lines
from estimators.diagnostics.calibration import Calibration
from estimators.diagnostics.intervals import UNKNOWN, Interval
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel

RIGHT = Interval(1.0, 0.95, 1.05)


def still(x, u, p, dt, out):
    out[0] = x[0]


def same(x, u, p, out):
    for k in range(out.size):
        out[k] = x[0]


MODEL = StateSpaceModel(
    name="oven",
    title="oven",
    states=(State("air", "°C", 0.0, 1.0),),
    noises=(Noise("air", "°C²/s", 0.1),),
    sensors=(
        Sensor("wall", (Row("wall", "°C", 1.0),), h=same),
        Sensor("grid", tuple(Row(f"g{k}", "°C", 1.0) for k in range(16)), h=same),
    ),
    f=still,
)


def entry(subject: str, role: str, share: float, words: tuple[str, ...] = ()) -> Calibration:
    coverage = tuple(Interval(one, one, one) for one in (0.5, 0.9, share))
    none = Interval(0.0, -0.1, 0.1)
    shown = UNKNOWN if role == "truth" else none
    return Calibration(subject, role, 0.0, 9.0, 10, RIGHT, RIGHT, none, shown, shown, coverage, words)


def test_many_rows_of_one_sensor_are_one_line():
    grid = [entry(f"grid.g{k}", "used", 0.94) for k in range(15)]
    found = [
        entry("wall", "used", 0.95),
        *grid,
        entry("grid.g15", "used", 0.78, ("grid.g15: bands a half too narrow",)),
    ]
    found.append(entry("air", "truth", 0.03, ("air: truth in its 95 % band 3 % of the time", "air: truth above")))
    assert calibration_lines(found, MODEL) == [
        "wall: scale 1.00 (0.95 to 1.05), bias +0.00 σ, correlation +0.00, 50, 90, 95 % in the 50, 90, 95 % bands",
        "air: truth in its 95 % band 3 % of the time",
        "air: truth above",
        "grid, 16 rows used: in the 95 % band 93 %; beyond the limits 1, as grid.g15: bands a half too narrow",
    ]
    assert calibration_lines(grid, MODEL) == ["grid, 15 rows used: in the 95 % band 94 %; none beyond the limits"]
    assert calibration_lines([entry("air", "truth", 0.95)], MODEL) == [
        "air, truth: scale 1.00 (0.95 to 1.05), bias +0.00 σ, 50, 90, 95 % in the 50, 90, 95 % bands"
    ]
