"""The table that `nisus fold --out` writes: a row an event, with what is true where it is known."""

import json
import re
import textwrap
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from app.cli.compare_fold import fold_row
from app.cli.fold import fold_twin, read_log
from app.cli.main import Fold
from app.twin.twin import load_twin

DRIVE = """\
model: motor_winding
source:
  type: table
  files: drive.csv
  time: {column: t, unit: s}
  sensors: {winding: {columns: y}}
  truth: {temperature: {columns: temperature}, rate: {columns: rate}}
"""
ROWS = "t,y,temperature,rate\n0,40,41,0.5\n1,40,,0.25\n2,41,42,\n"


def test_true_states_have_columns_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_text(ROWS)
    (tmp_path / "drive.yaml").write_text(DRIVE)
    out = tmp_path / "track.parquet"
    assert fold_twin(Fold(str(tmp_path / "drive.yaml"), out=out, json=True)) == 0
    table = pq.read_table(out)
    truth = np.array(table["event"].to_pylist()) == "truth"
    nan = np.nan
    for name, expected in (("temperature", [41.0, nan, 42.0]), ("rate", [0.5, 0.25, nan])):
        column = table[f"{name}_true"].to_numpy()
        np.testing.assert_array_equal(column[truth], expected)
        assert np.isnan(column[~truth]).all() and np.sum(~truth) == 3
    # The events as they were read are in the table too.
    log, _ = read_log(load_twin(str(tmp_path / "drive.yaml")), None)
    np.testing.assert_array_equal(table["value_1"].to_numpy(), log.readings.value[:, 1])


BOX = """\
from estimators.model import Noise, Row, Sensor, State, StateSpaceModel


def f(X, u, p, dt):
    if dt > 1.5:
        raise ValueError("the step is too long")
    return X


def h(X, u, p):
    return X


Box = StateSpaceModel(
    name="box", title="box", states=(State("level", "m", 40.0, 5.0),), noises=(Noise("level", "m2/s", 0.1),),
    sensors=(Sensor("gauge", (Row("level", "m", 1.0),), h=h),), f=f, black_box=True,
)
"""
BOXED = """\
model: ./box.py:Box
estimator: filterpy-ukf
source: {type: table, files: drive.csv, time: {column: t, unit: s}, sensors: {gauge: {columns: y}}}
"""


def test_what_a_black_box_failed_with_is_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Of readings at 0, 1, 2, 4 and 5 s the last two are more than 1.5 s behind the last state that f reached."""
    (tmp_path / "drive.csv").write_text("t,y\n0,40\n1,40\n2,41\n4,41\n5,40\n")
    (tmp_path / "box.py").write_text(BOX)
    (tmp_path / "box.yaml").write_text(BOXED)
    path = str(tmp_path / "box.yaml")
    said = (
        f"{tmp_path / 'box.py'}:6: model box: f fails on a block of 3 states: ValueError: the step is too long; mend it"
    )
    assert fold_twin(Fold(path)) == 0
    printed = capsys.readouterr().out
    assert "\nfailed " in printed and "  2: no estimate" in printed
    assert f"the model failed 2 time(s)  {said}" in printed
    assert fold_twin(Fold(path, json=True)) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["failed"] == 2 and told["failure"].startswith(said)
    twin = load_twin(path)
    row = fold_row(twin, "filterpy-ukf", [read_log(twin, None)[0].readings])
    assert row.failure.startswith(said)


def test_what_of_the_model_made_a_reading_fail_is_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """h ends at 42 m, beyond which the level rises: √ of a negative number."""
    box = """\
        import numpy as np
        from estimators.model import Noise, Row, Sensor, State, StateSpaceModel

        def f(x, u, p, dt, out):
            out[0] = x[0] + dt

        def h(x, u, p, out):
            out[0] = x[0] + 0.0 * np.sqrt(42.0 - x[0])

        Box = StateSpaceModel(
            name="box", title="box", states=(State("level", "m", 40.0, 0.01),), f=f,
            noises=(Noise("level", "m2/s", 1e-6),), sensors=(Sensor("gauge", (Row("level", "m", 1e-4),), h=h),),
        )
        """
    (tmp_path / "drive.csv").write_text("t,y\n0,40\n1,41\n2,41.9\n3,43\n")
    (tmp_path / "box.py").write_text(textwrap.dedent(box))
    (tmp_path / "box.yaml").write_text(BOXED.replace("filterpy-ukf", "ukf"))
    assert fold_twin(Fold(str(tmp_path / "box.yaml"))) == 0
    printed = capsys.readouterr().out
    said = r"h\(x, u\) of sensor gauge is \[nan\] at x = \[4\d.*\], where the estimate got; it must be finite"
    assert re.search(rf"\nbecause +{re.escape(str(tmp_path))}/box.py:7: model box: {said}", printed)
    assert fold_twin(Fold(str(tmp_path / "box.yaml"), json=True)) == 0
    assert re.search(said, json.loads(capsys.readouterr().out)["failure"])
