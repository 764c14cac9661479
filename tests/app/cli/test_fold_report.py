"""What `nisus fold` prints: a line of calibration for the many rows of a sensor, and the probability of a mode."""

from app.cli.arguments import FoldCommand
from app.cli.fold import fold_twin
from app.study.calibration_lines import calibration_lines, coverage_rows
from app.twin.twin import load_twin
from estimators.diagnostics.calibration import Calibration, CoverageBin
from estimators.diagnostics.intervals import UNKNOWN, Interval
from tests.models import level_model

RIGHT = Interval(1.0, 0.95, 1.05)


MODEL = level_model({"wall": 1.0, "grid": {f"g{k}": 1.0 for k in range(16)}}, 0.1, state="air")


def entry(subject, role, share, words=()):
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
        "air, truth: scale 1.00 (0.95 to 1.05), bias +0.00 σ, 50, 90, 3 % in the 50, 90, 95 % bands",
        "grid, 16 rows used: in the 95 % band 93 %; beyond the limits 1, as grid.g15: bands a half too narrow",
    ]
    assert calibration_lines(grid, MODEL) == ["grid, 15 rows used: in the 95 % band 94 %; none beyond the limits"]
    assert calibration_lines([entry("air", "truth", 0.95)], MODEL) == [
        "air, truth: scale 1.00 (0.95 to 1.05), bias +0.00 σ, 50, 90, 95 % in the 50, 90, 95 % bands"
    ]


def test_fold_prints_the_probability_and_its_brier_score(capsys):
    assert fold_twin(FoldCommand("gripper_contact", duration=0.5)) == 0
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if "probability of contact" in line]
    # Nothing is touched in the first half second, and the filter knows.
    assert "0.000 at the end" in line and "Brier score" in line
    assert not any("RMSE contact" in line for line in lines)


def test_only_a_mode_of_two_values_is_a_probability():
    model = load_twin("gripper_contact").model
    assert [model.label(name) for name in model.state_names[:2]] == ["probability of contact", "depth"]
    assert load_twin("motor_winding").model.label("temperature") == "temperature"


def test_the_rows_with_the_lowest_coverage_name_where_it_is_lowest():
    """A band counts as too narrow from 88.3 % on, 2 Φ(1.96 / 1.25) - 1; times count from the first of all."""

    def part(subject, by, low, value, high):
        return CoverageBin(subject, "used", by, low, low + 60.0, 100, Interval(value, value - 0.05, high), 0.95, 1.4)

    found = [part(f"g{k}", "whole log", 1000.0, 0.95 - 0.01 * k, 0.99) for k in range(14)]
    found += [part("g13", "time", 1000.0, 0.9, 0.94), part("g13", "time", 1060.0, 0.7, 0.882)]
    found += [part("g13", "air", 3.0, 0.8, 0.884)]
    rows = coverage_rows(found, MODEL)
    assert [row[0] for row in rows] == [f"g{k}" for k in range(2, 14)]
    assert rows[0][2:] == ("93 % (88 to 99)", "-", "-", "1.40 × band: 95 %")
    assert rows[-1][3:5] == ("70 % (65 to 88.2) at 60 to 120 s", "none of 1 below 88.3 %")
