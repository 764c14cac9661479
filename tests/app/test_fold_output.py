"""The table that `nisus fold --out` writes: a row an event, with what is true where it is known."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from app.cli import Fold
from app.fold import fold_twin, read_log
from app.twin import load_twin

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
