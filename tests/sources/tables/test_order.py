"""Times that run backwards or stand still: told once, with the line, in whatever pieces they are read."""

import numpy as np
import pytest

from estimators.log import READING
from sources.source import WRONG_TIME, Channel, Condition
from sources.tables.order import BACKWARDS, MAX_EQUAL_TIMES, SORTED, STANDING, Order
from sources.tables.table import Table, TimeColumn
from sources.tables.text import TextMatch
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
        order.check("drive.csv", lines[some], t[some])
    order.report_late(True)
    return told


@pytest.mark.parametrize("pieces", [1, 2, 7, 60])
def test_a_reversed_file_is_told_once_at_the_first_row_beyond_the_horizon(pieces):
    told = looked(np.arange(60)[::-1] * 0.5 + 100.0, pieces)
    # 0.5 s a row: the fifth row after the first, in line 2, is the first of 55 more than 2 s behind it.
    ((key, text),) = set(told)
    assert key == SORTED and len(told) == 55
    assert text == (
        "drive.csv:7: t is 2.5 s before that of drive.csv:2; the rows are out of order and were sorted by t; "
        "if its clock was set there, correct it"
    )


@pytest.mark.parametrize("pieces", [1, 2, 3, 5, 9])
def test_the_newest_row_before_is_named(pieces):
    ((_, text),) = set(looked([0, 1, 50, 2, 51, 3, 4, 5, 6], pieces))
    assert text.startswith("drive.csv:5: t is 48 s before that of drive.csv:4; ")


@pytest.mark.parametrize("pieces", [1, 2, 5])
def test_late_rows_within_the_horizon_are_as_recorded(pieces):
    assert looked([0, 1, 3, 1, 4, 2, 2, 6, 4.0], pieces) == []
    assert looked([9, 5, 0], pieces, horizon=None) == []


def shuffled(rng, t, how):
    """Rows of a regular recording in another order."""
    if how == "blocks":
        begin, end, to = np.sort(rng.choice(np.arange(20, t.size - 20), 3, replace=False))
        return np.concatenate((t[:begin], t[end:to], t[begin:end], t[to:]))
    return {"reversed": t[::-1], "shuffled": rng.permutation(t), "halves": np.roll(t, t.size // 2)}[how]


@pytest.mark.parametrize("how", ["blocks", "reversed", "shuffled", "halves"])
def test_rows_out_of_order_are_sorted_and_none_is_lost(tmp_path, how):
    rng = np.random.default_rng(3)
    for _ in range(10):
        t = shuffled(rng, np.round(np.cumsum(rng.uniform(0.3, 0.7, 400)), 3), how)
        came, reports = read_table(tmp_path, t)
        late = np.any(t < np.maximum.accumulate(t) - 2.0)
        assert came == (np.argsort(t, kind="stable") if late else np.arange(t.size)).tolist()
        assert set(reports.counts) == ({SORTED} if late else set())


@pytest.mark.parametrize(("back", "key"), [(3600.0, BACKWARDS), (64.375, SORTED)])
def test_a_change_of_time_zone_stays_as_recorded(tmp_path, back, key):
    """Sorted, the hour that comes twice would be mixed. Two recorders that overlap by 64 s are in order of time."""
    t = np.concatenate((np.arange(0, 5000, 0.5), np.arange(5000, 5400, 0.5) - back))
    came, reports = read_table(tmp_path, t)
    assert came == (list(range(t.size)) if key == BACKWARDS else np.argsort(t, kind="stable").tolist())
    assert set(reports.counts) == {key}
    assert reports.texts[key].startswith(f"pump.csv:10002: t is {back - 0.5:g} s before that of pump.csv:10001")


def test_tags_one_after_the_other_are_one_recording(tmp_path):
    """A long table that is sorted by its tag: each sensor has its own rows, which are in order."""
    path = tmp_path / "historian.csv"
    path.write_text(
        "t,tag,v\n" + "".join(f"{s},{tag},{s + 1000 * k}\n" for k, tag in enumerate("AB") for s in range(50))
    )
    channels = tuple(
        Channel(READING, k, tag, ("v",), only=(Condition(TextMatch("tag", (tag,)), 1.0, 1.0),))
        for k, tag in enumerate("AB")
    )
    reports = Reports()
    table = Table([path], time=TimeColumn("t"), channels=channels, width=1, report=reports, horizon=2.0)
    batch = read_all(table)
    assert set(reports.counts) == {SORTED}
    assert batch.channel.tolist() == [0, 1] * 50
    assert batch.value[:, 0].tolist() == [s + 1000 * k for s in range(50) for k in range(2)]


@pytest.mark.parametrize("pieces", [1, 2, 25, 26])
def test_a_time_that_stands_still_is_told_once(pieces):
    moving = np.arange(10.0)
    still = np.full(MAX_EQUAL_TIMES, 10.0)
    told = looked(np.concatenate((moving, still, [11.0], still + 2.0)), pieces)
    assert [key for key, _ in told] == [STANDING]
    assert told[0][1].startswith(f"drive.csv:12: t stays 10 s for {MAX_EQUAL_TIMES} rows and more; check that it is")
    assert "time.column" in told[0][1] and told[0][1].endswith("and its unit (time.unit, s)")
    assert looked(np.concatenate((moving, still[1:], [11.0], still[1:] + 2.0)), pieces) == []


def test_files_in_a_wrong_order_are_sorted_and_told_with_both(tmp_path):
    for name, start in (("a.csv", 100), ("b.csv", 0)):
        (tmp_path / name).write_text("t,x\n" + "".join(f"{start + k},1\n" for k in range(5)))
    reports = Reports()
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    batch = read_all(Table(files, time=TimeColumn("t"), channels=X, width=1, report=reports, horizon=2.0))
    assert batch.t.tolist() == [s * SECOND for s in (*range(5), *range(100, 105))]
    assert reports.counts == {SORTED: 5}
    assert reports.texts[SORTED].startswith("b.csv:2: t is 104 s before that of a.csv:6; the rows are out of order")


def read_table(tmp_path, t):
    """What comes of a table with these times (s) and the row's number in x: numbers that came, and what was told."""
    path = tmp_path / "pump.csv"
    path.write_text("t,x\n" + "".join(f"{s:.3f},{k}\n" for k, s in enumerate(t)))
    reports = Reports()
    batch = read_all(Table([path], time=TimeColumn("t"), channels=X, width=1, report=reports, horizon=2.0))
    return batch.value[:, 0].astype(int).tolist(), reports


@pytest.mark.parametrize("rows", [1, 3])
def test_a_first_time_ahead_of_all_others_is_the_one_that_is_left_out(tmp_path, rows):
    came, reports = read_table(tmp_path, [3600.0] * rows + [*np.arange(600) * 0.5])
    assert came == list(range(rows, rows + 600)) and reports.counts == {WRONG_TIME: 1}
    text = reports.texts[WRONG_TIME]
    assert text.startswith(f"pump.csv:2: t is 3600 s after that of pump.csv:{rows + 2} and of all that follow; ")


@pytest.mark.parametrize("t", [[5.0, 0, 1, 2, 6, 7], [1.9, 0, 1, 1.5], [50, 51, 0, 1, 2, 3.0], [9.0, 1, 0, 2, 3]])
def test_what_may_be_right_is_kept(tmp_path, t):
    """It is reached again, is within the horizon, is not the first, not alone, or what follows has no order either."""
    came, reports = read_table(tmp_path, t)
    assert sorted(came) == list(range(len(t))) and WRONG_TIME not in reports.counts


@pytest.mark.parametrize("wrong", [3600.0, -3600.0])
def test_a_lone_wrong_time_stays_where_it_was_recorded(tmp_path, wrong):
    t = np.arange(600) * 0.5
    t[300] += wrong
    came, reports = read_table(tmp_path, t)
    assert came == list(range(600)) and set(reports.counts) == {BACKWARDS}
