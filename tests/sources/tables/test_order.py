"""Times that run backwards or stand still: told once, with the line, in whatever pieces they are read."""

import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import READING, Log
from sources.source import WRONG_TIME, Channel
from sources.tables.order import BACKWARDS, MAX_EQUAL_TIMES, STANDING, Order
from sources.tables.table import Table
from tests.sources.can.can_tools import Reports
from tests.support import SECOND, read_all

X = (Channel(READING, 0, "x", ("x",)),)


def looked(t, pieces=1, horizon=2 * SECOND):
    """What is told of rows at these times (s), which stand in the lines from 2 on."""
    told = []
    order = Order("t", "s", horizon, lambda key, text: told.append((key, text)))
    t = np.round(np.asarray(t) * SECOND).astype(np.int64)
    lines = np.arange(t.size) + 2
    for some in np.array_split(np.arange(t.size), pieces):
        order.look("drive.csv", lines[some], t[some])
    return told


@pytest.mark.parametrize("pieces", [1, 2, 7, 60])
def test_a_reversed_file_is_told_once_at_the_first_row_beyond_the_horizon(pieces):
    ((key, text),) = looked(np.arange(60)[::-1] * 0.5 + 100.0, pieces)
    # 0.5 s a row: the fifth row after the first, in line 2, is the first more than 2 s behind it.
    assert key == BACKWARDS
    assert text.startswith("drive.csv:7: t is 2.5 s before that of drive.csv:2, more than time.horizon (2 s)")
    assert text.endswith("; sort the rows by t, or raise time.horizon") and "\n" not in text


@pytest.mark.parametrize("pieces", [1, 2, 3, 5, 9])
def test_the_newest_row_before_is_named(pieces):
    ((_, text),) = looked([0, 1, 50, 2, 51, 3, 4, 5, 6], pieces)
    assert text.startswith("drive.csv:5: t is 48 s before that of drive.csv:4, ")


@pytest.mark.parametrize("pieces", [1, 2, 5])
def test_late_rows_within_the_horizon_are_as_recorded(pieces):
    assert looked([0, 1, 3, 1, 4, 2, 2, 6, 4.0], pieces) == []
    assert looked([9, 5, 0], pieces, horizon=None) == []


def test_what_is_told_is_what_the_log_drops(tmp_path):
    rng = np.random.default_rng(3)
    for trial in range(20):
        t = np.arange(40) * 0.25 + np.where(rng.random(40) < 0.1, -rng.uniform(0, 4, 40), 0.0)
        path = tmp_path / f"{trial}.csv"
        path.write_text("t,x\n" + "".join(f"{s:.3f},1\n" for s in t))
        reports = Reports()
        table = Table([path], time_column="t", time_unit="s", channels=X, width=1, report=reports, horizon=2.0)
        batch = read_all(table)
        log = Log(1)
        dropped = [k for k in range(len(batch)) if log.extend(batch.select(slice(k, k + 1)), 2 * SECOND)[1]]
        assert reports.counts[BACKWARDS] == (1 if dropped else 0)
        if dropped:
            assert reports.texts[BACKWARDS].startswith(f"{trial}.csv:{dropped[0] + 2}: t is ")


@pytest.mark.parametrize("pieces", [1, 2, 25, 26])
def test_a_time_that_stands_still_is_told_once(pieces):
    moving = np.arange(10.0)
    still = np.full(MAX_EQUAL_TIMES, 10.0)
    told = looked(np.concatenate((moving, still, [11.0], still + 2.0)), pieces)
    assert [key for key, _ in told] == [STANDING]
    assert told[0][1].startswith(f"drive.csv:12: t stays 10 s for {MAX_EQUAL_TIMES} rows and more; check that it is")
    assert "time.column" in told[0][1] and told[0][1].endswith("and its unit (time.unit, s)")
    assert looked(np.concatenate((moving, still[1:], [11.0], still[1:] + 2.0)), pieces) == []


def test_files_in_a_wrong_order_are_told_with_both(tmp_path):
    for name, start in (("a.csv", 100), ("b.csv", 0)):
        (tmp_path / name).write_text("t,x\n" + "".join(f"{start + k},1\n" for k in range(5)))
    reports = Reports()
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    read_all(Table(files, time_column="t", time_unit="s", channels=X, width=1, report=reports, horizon=2.0))
    assert reports.counts == {BACKWARDS: 1}
    assert reports.texts[BACKWARDS].startswith("b.csv:2: t is 104 s before that of a.csv:6, more than")


def read_table(tmp_path, t):
    """What comes of a table with these times (s) and the row's number in x: numbers that came, and what was told."""
    path = tmp_path / "pump.csv"
    path.write_text("t,x\n" + "".join(f"{s:.3f},{k}\n" for k, s in enumerate(t)))
    reports = Reports()
    batch = read_all(Table([path], time_column="t", time_unit="s", channels=X, width=1, report=reports, horizon=2.0))
    return batch.value[:, 0].astype(int).tolist(), reports


@pytest.mark.parametrize("rows", [1, 3])
def test_a_first_time_ahead_of_all_others_is_the_one_that_is_left_out(tmp_path, rows):
    came, reports = read_table(tmp_path, [3600.0] * rows + [*np.arange(600) * 0.5])
    assert came == list(range(rows, rows + 600)) and reports.counts == {WRONG_TIME: 1}
    text = reports.texts[WRONG_TIME]
    assert text.startswith(f"pump.csv:2: t is 3600 s after that of pump.csv:{rows + 2} and of all that follow; ")


@pytest.mark.parametrize(
    "t", [[5.0, 0, 1, 2, 6, 7], [1.9, 0, 1, 1.5], [0, 3600, 1, 2, 3.0], [50, 51, 0, 1, 2, 3.0], [9.0, 1, 0, 2, 3]]
)
def test_what_may_be_right_is_kept(tmp_path, t):
    """It is reached again, is within the horizon, is not the first, not alone, or what follows has no order either."""
    came, reports = read_table(tmp_path, t)
    assert came == list(range(len(t))) and WRONG_TIME not in reports.counts


@pytest.mark.parametrize("rows", [20, 9000])
def test_a_table_whose_newest_row_comes_first_is_refused_in_one_line(tmp_path, rows):
    with pytest.raises(SourceError) as error:
        read_table(tmp_path, np.repeat(np.arange(rows)[::-1] * 0.5, 2))
    text = str(error.value)
    assert text.startswith("pump.csv:4: t is 0.5 s before that of the row above") and text.endswith(
        "sort the rows by t"
    )
    assert "\n" not in text
