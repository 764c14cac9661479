"""Tables: columns to events, times exact, and every complaint with its file and line."""

import json
import re
from collections import Counter
from datetime import UTC, datetime, timedelta, timezone
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from estimators.errors import SourceError
from estimators.log import INPUT, READING, TRUTH
from sources import formats
from sources.inspect import inspect_recordings
from sources.source import UNDATED, Channel, Condition
from sources.tables.table import Table
from sources.tables.text import TextMatch
from sources.tables.times import ASSUMED, SKIPPED, TWICE, TimeColumn, TimeReader
from tests.cases import cases
from tests.sources.can.can_tools import Reports, same
from tests.support import error_of, read_all

CHANNELS = (
    Channel(READING, 0, "temp", ("temp",), units=("degC",), model_units=("K",)),
    Channel(READING, 1, "pair", ("a", "b"), where=(Condition("ok", 1, 1),)),
    Channel(INPUT, 1, "power", ("power",), units=("kW",), model_units=("W",)),
    Channel(TRUTH, 2, "x", ("x",)),
)
HEADER = "t,temp,a,b,ok,power,x\n"
NAN = float("nan")


def write(folder, text, name="drive.csv"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def table(path, *, unit="s", channels=CHANNELS, report=lambda key, text: None):
    files = path if isinstance(path, list) else [path]
    return Table(files, time=TimeColumn("t", unit), channels=channels, width=2, report=report)


X = (Channel(READING, 0, "x", ("x",)),)


def read_reports(path, channels=CHANNELS, **more):
    reports = Reports()
    return read_all(table(path, channels=channels, report=reports, **more)), reports


def events(batch):
    return [
        (t, kind, channel, *value)
        for t, kind, channel, value in zip(
            batch.t.tolist(), batch.kind.tolist(), batch.channel.tolist(), batch.value.tolist(), strict=True
        )
    ]


def test_a_row_is_inputs_then_readings_then_truths(tmp_path):
    got, reports = read_reports(write(tmp_path, HEADER + "0.1,20,1,2,1,3,7\n0.2,21,3,4,0,,8\n"))
    expected = [
        (100_000_000, INPUT, 0, NAN, 3000.0),
        (100_000_000, READING, 0, 293.15, NAN),
        (100_000_000, READING, 1, 1.0, 2.0),
        (100_000_000, TRUTH, 2, 7.0, NAN),
        (200_000_000, READING, 0, 294.15, NAN),
        (200_000_000, READING, 1, NAN, NAN),
        (200_000_000, TRUTH, 2, 8.0, NAN),
    ]
    np.testing.assert_array_equal(events(got), expected)
    assert reports.counts == {"condition pair": 1}


def test_true_states_of_a_row_are_blocks(tmp_path):
    """A block begins with a state that is known and reaches as far as the log is wide; here are 2 columns."""
    names = {0: "w", 1: "a", 2: "b", 5: "power"}
    channels = [Channel(TRUTH, index, names[index], (names[index],)) for index in (5, 2, 0, 1)]
    channels[1] = Channel(TRUTH, 2, "b", ("b",), where=(Condition("ok", 1, 1),))
    path = write(tmp_path, "t,w,a,b,ok,power\n0,1,2,3,1,6\n1,,2,3,1,6\n2,1,,3,1,\n3,1,2,3,0,6\n4,,,,1,\n5,nan,2,3,1,\n")
    got = events(read_all(table(path, channels=channels)))
    expected = [
        (0, TRUTH, 0, 1.0, 2.0),
        (0, TRUTH, 2, 3.0, NAN),
        (0, TRUTH, 5, 6.0, NAN),
        (10**9, TRUTH, 1, 2.0, 3.0),
        (10**9, TRUTH, 5, 6.0, NAN),
        (2 * 10**9, TRUTH, 0, 1.0, NAN),
        (2 * 10**9, TRUTH, 2, 3.0, NAN),
        (3 * 10**9, TRUTH, 0, 1.0, 2.0),
        (3 * 10**9, TRUTH, 5, 6.0, NAN),
        (5 * 10**9, TRUTH, 1, 2.0, 3.0),
    ]
    np.testing.assert_array_equal(got, expected)


def test_blank_says_nothing_and_what_is_no_number_is_missing_with_its_line(tmp_path):
    path = write(tmp_path, HEADER + "0,,1,2,1,,\n\n1,hot,3,,1,nan,oops\n2,NaN,inf,1,1,n/a,\n")
    got, reports = read_reports(path)
    expected = [
        (0, READING, 1, 1.0, 2.0),
        (10**9, INPUT, 0, NAN, NAN),
        (10**9, READING, 0, NAN, NAN),
        (10**9, READING, 1, 3.0, NAN),
        (2 * 10**9, INPUT, 0, NAN, NAN),
        (2 * 10**9, READING, 0, NAN, NAN),
        (2 * 10**9, READING, 1, NAN, 1.0),
    ]
    np.testing.assert_array_equal(events(got), expected)
    assert reports.counts == {"unreadable value": 2, "never seen": 3}  # temp, power and x have no number
    assert reports.texts["unreadable value"] == "drive.csv:4: x is 'oops', which is not a number; the value is missing"


def test_words_of_quality_are_missing_values_counted_by_word(tmp_path):
    words = (
        "Bad",
        "I/O Timeout",
        "No Data",
        "#N/A",
        "[-11059] No Good Data For Calculation",
        "Uncertain (last)",
        "Bad",
    )
    path = write(tmp_path, "t,x\n" + "".join(f"{k},{word}\n" for k, word in enumerate((*words, "1.5", "badge"))))
    got, reports = read_reports(path, X)
    np.testing.assert_array_equal(got.value[:, 0], [NAN] * 7 + [1.5, NAN])
    assert reports.counts == {"unreadable value": 1, **{f"no value x: {w}": words.count(w) for w in words}}
    assert inspect_recordings([path]).faults[0] == "no value x: Bad (rows: 2, the first drive.csv:2)"


def test_rows_without_a_time_or_with_missing_cells_are_left_out_and_counted(tmp_path):
    got, reports = read_reports(write(tmp_path, HEADER + "soon,1,1,2,1,1,1\n1,2,3\n2,20,1,2,1,3,7\n3,20,1"))
    assert set(got.t.tolist()) == {2 * 10**9}
    assert reports.counts == {"undated row": 1, "unreadable value": 1, "truncated file": 1}
    assert (
        reports.texts["undated row"]
        == "drive.csv:2: t is 'soon', which is neither a time in s nor a date; the row is left out: correct it, or "
        "give its unit or format"
    )
    assert reports.texts["unreadable value"] == "drive.csv:3: has 3 cells, not 7; the row is left out"
    assert reports.texts["truncated file"] == "drive.csv:5: the last line has 3 cells, not 7"


@pytest.mark.parametrize("rest", ["", "\n", "\r\n", "\n \n\n"])
def test_a_header_without_rows_is_named(tmp_path, rest):
    path = write(tmp_path, HEADER.rstrip() + rest)
    assert error_of(SourceError, table, path) == f"{path}: it has a header and no rows; record it again"


@pytest.mark.parametrize(
    "content", [b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 40, b"t,\x1b[31mx\n0,1\n"], ids=["picture", "colours"]
)
def test_a_file_that_is_no_text_is_told_in_letters_and_briefly(tmp_path, content):
    path = tmp_path / "drive.csv"
    path.write_bytes(content)
    text = error_of(SourceError, table, path)
    begins = " ".join(f"{byte:02x}" for byte in content[:8])
    assert text.startswith(f"{path}:1: it begins with the bytes {begins} and is not text; give a CSV in UTF-8")
    assert text.isprintable() and len(text) < len(str(path)) + 250


def test_what_is_quoted_from_a_file_is_escaped_and_cut(tmp_path):
    path = write(tmp_path, HEADER.replace("temp", "n" * 500 + "\x9b31m") + "0,1,1,1,1,1,1\n")
    text = error_of(SourceError, table, path)
    assert re.search("there is no column 'temp'; choose from t, 'nnn.*[.]{3}', a, b", text)
    assert text.isprintable() and len(text) < len(str(path)) + 200
    _, reports = read_reports(write(tmp_path, HEADER + f"0,\x9b31m{'9' * 500}x,1,2,1,3,7\n"))
    text = reports.texts["unreadable value"]
    assert text.startswith("drive.csv:2: temp is '\\x9b31m999") and text.isprintable() and len(text) < 150


@cases(__file__, "times.csv")
def test_times_are_exact(tmp_path, file, rows, options, assumed, ns):
    """2020-10-25T01:00Z is 1,603,587,600 s, and 2024-03-04 1,709,510,400 s (date -u +%s); a clock passes midnight."""
    rows, expected, reports = rows.split("|"), [int(t) for t in ns.split()], Reports()
    time = TimeColumn("t", clock="u" if ";" in rows[0] else None, **json.loads(options))
    path = write(tmp_path, "".join([";".join(time.names), ";x\n", *(f"{cells};1\n" for cells in rows)]), file)
    got = read_all(Table([path], time=time, channels=X, width=1, report=reports))
    counts = {UNDATED: len(rows) - len(expected), ASSUMED: int(assumed)}
    assert (got.t.tolist(), reports.counts) == (expected, {key: count for key, count in counts.items() if count})


@pytest.mark.parametrize(
    ("column", "unit", "expected"),
    [
        (pa.array([1, None, 3], pa.int64()), "us", [1000, 3000]),
        (pa.array([1.5, float("nan"), 2.5]), "s", [1_500_000_000, 2_500_000_000]),
        (pa.array([10**15 + 1, None, 10**15 + 2], pa.timestamp("us")), "s", [10**18 + 1000, 10**18 + 2000]),
        (pa.array([1, None, 2], pa.timestamp("ms", "Europe/Berlin")), "s", [10**6, 2 * 10**6]),
        (pa.array(["1", "soon", "2"]), "s", [10**9, 2 * 10**9]),
    ],
)
def test_parquet_times(tmp_path, column, unit, expected):
    pq.write_table(pa.table({"t": column, "x": [1.0, 2.0, 3.0]}), tmp_path / "a.parquet")
    got, reports = read_reports(tmp_path / "a.parquet", X, unit=unit)
    assert got.t.tolist() == expected and got.value[:, 0].tolist() == [1.0, 3.0]
    rule = "is 'soon', which is neither a time in s nor a date" if column[1].as_py() == "soon" else "is empty"
    assert reports.texts["undated row"].startswith(f"a.parquet:2: t {rule}; the row is left out")


def test_parquet_and_csv_of_one_table_agree(tmp_path):
    """Random numbers, null and blank alike, across chunks."""
    rng, n = np.random.default_rng(0), 10_000
    columns = {name: rng.normal(size=n) for name in HEADER.strip().split(",")}
    columns["t"] = np.arange(n) * 0.01
    columns["ok"] = (rng.random(n) < 0.9).astype(float)
    blank = rng.random(n) < 0.2
    lines = [HEADER]
    for k in range(n):
        cells = ["" if name == "temp" and blank[k] else repr(float(columns[name][k])) for name in columns]
        lines.append(",".join(cells) + "\n")
    plain = write(tmp_path, "".join(lines))
    arrays = {name: pa.array(values, mask=blank if name == "temp" else None) for name, values in columns.items()}
    pq.write_table(pa.table(arrays), tmp_path / "a.parquet")
    a, b = read_all(table(plain)), read_all(table(tmp_path / "a.parquet"))
    assert same(a, b)
    assert (a.channel[a.kind == READING] == 0).sum() == n - blank.sum()


def test_other_marks_and_files_one_after_the_other(tmp_path):
    one = write(tmp_path, "\ufefft;x\n1;10\n", "one.csv")
    two = write(tmp_path, '"t"\t"x"\n2\t"20"\n', "two.csv")
    got = read_all(table([one, two], channels=X))
    assert got.t.tolist() == [10**9, 2 * 10**9] and got.value[:, 0].tolist() == [10.0, 20.0]


@cases(__file__, "lacking.csv")
def test_what_a_table_lacks_is_one_line(tmp_path, monkeypatch, name, content, expected):
    monkeypatch.setattr(formats, "added", lambda kind: {})
    if content != "absent":
        (tmp_path / name).write_bytes(content.encode().decode("unicode_escape").encode("latin-1"))
    text = error_of(SourceError, table, tmp_path / name)
    assert text.startswith(str(tmp_path / expected))


def test_only_picks_the_rows_that_speak_of_a_sensor(tmp_path):
    """Ranges to one anchor or the other in one column; a row of neither, or whose anchor is blank, says nothing."""
    path = write(tmp_path, "t,range,anchor,ok\n0,1,7,1\n1,2,8,1\n2,3,7,0\n3,4,9,1\n4,5,,1\n5,nan,8,1\n", "ranges.csv")
    channels = [
        Channel(READING, k, f"r{k}", ("range",), only=(Condition("anchor", a, a),), where=(Condition("ok", 1, 1),))
        for k, a in enumerate((7, 8))
    ]
    got, reports = read_reports(path, channels)
    expected = [
        (0, READING, 0, 1.0, NAN),
        (10**9, READING, 1, 2.0, NAN),
        (2 * 10**9, READING, 0, NAN, NAN),
        (5 * 10**9, READING, 1, NAN, NAN),
    ]
    np.testing.assert_array_equal(events(got), expected)
    assert reports.counts == {"condition r0": 1, "row of no sensor": 1}
    assert reports.texts["row of no sensor"] == (
        "ranges.csv:6: anchor has no value, so the row is of no sensor and is left out; give it its anchor"
    )


def test_a_shift_moves_the_clock(tmp_path):
    path = write(tmp_path, HEADER + "1.5,20,1,2,1,3,7\n")
    moved = Table([path], time=TimeColumn("t", shift=-0.2), channels=CHANNELS, width=2)
    assert set(read_all(moved).t.tolist()) == {1_300_000_000}


def test_times_beyond_any_clock_are_left_out():
    """Milliseconds that are read as seconds: 64 bits of nanoseconds end at 9.2e9 s."""
    for column in (["0", "1e10", "-1e10", "1e300", "2"], pa.array([0.0, 1e10, -1e10, 1e300, 2.0])):
        time, known = TimeReader(TimeColumn("t")).read(column)
        np.testing.assert_array_equal(known, [True, False, False, False, True])
        np.testing.assert_array_equal(time[known], [0, 2_000_000_000])
    time, known = TimeReader(TimeColumn("t")).read(pa.array([0, 10**10, 2]))
    np.testing.assert_array_equal(known, [True, False, True])
    np.testing.assert_array_equal(time[known], [0, 2_000_000_000])


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_a_column_that_is_there_twice_is_refused_if_it_is_needed(tmp_path, ending):
    names, rows = ["t", "x", "y", "x", "y"], [[0, 1, 2, 3, 4], [1, 5, 6, 7, 8]]
    path = tmp_path / f"a{ending}"
    if ending == ".csv":
        path.write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]) + "\n")
    else:
        pq.write_table(pa.Table.from_arrays([pa.array(column) for column in zip(*rows, strict=True)], names), path)
    assert (
        error_of(SourceError, table, path, channels=X)
        == f"{path}: there are 2 columns 'x', the 2nd and the 4th; give each its own name"
    )
    path.write_text("t,x,y,y\n0,1,2,3\n") if ending == ".csv" else None
    if ending == ".csv":
        assert len(read_all(table(path, channels=X))) == 1


def test_a_quote_that_is_not_closed_is_named_with_its_line_and_what_it_takes(tmp_path):
    lines = [f"{k},{k}.5,note" for k in range(20)]
    lines[6] = '6,6.5,"note'
    got, reports = read_reports(write(tmp_path, "t,x,words\n" + "\n".join(lines) + "\n"), X)
    assert got.value[:, 0].tolist() == [k + 0.5 for k in range(6)]
    assert reports.counts == {"truncated file": 1}
    assert reports.texts["truncated file"] == (
        "drive.csv:8: a quote is opened and not closed; this line and the 13 after it are left out"
    )


def test_a_quote_that_is_closed_may_hold_lines(tmp_path):
    got, reports = read_reports(write(tmp_path, 't,x,words\n0,1,"two\nlines"\n1,2,one\n'), X)
    assert got.value[:, 0].tolist() == [1, 2] and not reports.counts


def test_a_decimal_comma_is_read_if_the_table_uses_it(tmp_path):
    path = write(tmp_path, "t;x\n0;1\n0,5;2,25\n1;1.234,5\n2;3.5\n")
    got, reports = read_reports(path, X)
    assert got.t.tolist() == [0, 500_000_000, 10**9, 2 * 10**9]
    np.testing.assert_array_equal(got.value[:, 0], [1.0, 2.25, 1234.5, NAN])
    assert f"{path.name}:5: x is '3.5', with a point in a table of decimal commas" in reports.texts["unreadable value"]
    path = write(tmp_path, "t;x\n" + "".join(f"{k};{k}.5\n" for k in range(20_000)) + "20000;2,5\n")
    _, reports = read_reports(path, X)
    assert reports.counts == {"unreadable value": 1}
    assert "x is '2,5', with a decimal comma; write 2.5; the value is missing" in reports.texts["unreadable value"]


def test_a_table_in_utf_16(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_bytes("t;x\n0;1,5\n".encode("utf-16"))
    assert read_reports(path, X)[0].value[:, 0].tolist() == [1.5]


def test_text_of_another_encoding_and_units_in_headings(tmp_path):
    """Latin letters of Windows; millimetres become the model's metres, and `units` in the YAML goes first."""
    path = tmp_path / "werk.csv"
    path.write_bytes("Zeit;Füllstand [mm];Zähler [raw]\n0;1500;7\n".encode("cp1252"))
    channels = (
        Channel(READING, 0, "level", ("Füllstand [mm]",), model_units=("m",)),
        Channel(READING, 1, "count", ("Zähler [raw]",), model_units=("m",)),
    )
    got = read_all(Table([path], time=TimeColumn("Zeit"), channels=channels, width=1))
    assert got.value[:, 0].tolist() == [1.5, 7.0]
    own = (Channel(READING, 0, "level", ("Füllstand [mm]",), units=("cm",), model_units=("m",)),)
    assert read_all(Table([path], time=TimeColumn("Zeit"), channels=own, width=1)).value.tolist() == [[15.0]]


TAGS = "t,tag,x,quality\n0,TT101,20.5,Good\n0,PT200,1.5,Good\n1,TT101,99,Bad\n1,PT200,1.6,Good\n2,TT101,21,Uncertain\n"


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_tags_select_rows_and_quality_judges_them(tmp_path, ending):
    """Rows of another tag are no measurement; one of bad quality is a missing one."""
    path = write(tmp_path, TAGS)
    if ending == ".parquet":
        path = tmp_path / "drive.parquet"
        pq.write_table(pacsv.read_csv(tmp_path / "drive.csv"), path)
    good = (Condition(TextMatch("quality", ("Good", "Uncertain")), 1, 1),)
    channels = tuple(
        Channel(READING, k, name, ("x",), where=good, only=(Condition(TextMatch("tag", (tag,)), 1, 1),))
        for k, (name, tag) in enumerate([("temperature", "TT101"), ("pressure", "PT200")])
    )
    got, reports = read_reports(path, channels)
    assert got.channel.tolist() == [0, 1, 0, 1, 0]
    np.testing.assert_array_equal(got.value[:, 0], [20.5, 1.5, NAN, 1.6, 21.0])
    assert "it needs quality = Good or Uncertain" in reports.texts["condition temperature"]


def test_a_tag_that_never_comes_is_reported(tmp_path):
    channels = (Channel(READING, 0, "flow", ("x",), only=(Condition(TextMatch("tag", ("FT9",)), 1, 1),)),)
    got, reports = read_reports(write(tmp_path, TAGS), channels)
    assert not len(got)
    assert "column 'tag' is never 'FT9' in 5 rows, so flow has no values" in str(reports.texts)


def test_a_date_that_may_be_two_needs_a_format():
    with pytest.raises(SourceError, match=r'"%d/%m/%Y %H:%M" or "%m/%d/%Y %H:%M"'):
        TimeReader(TimeColumn("t")).read(["01/02/2020 10:00", "03/02/2020 10:00"])
    t, known = TimeReader(TimeColumn("t", format="%m/%d/%Y")).read(["01/02/1970", "01/12/1970"])
    assert known.tolist() == [True, True] and t.tolist() == [86_400 * 10**9, 11 * 86_400 * 10**9]
    t, known = TimeReader(TimeColumn("t", format="%m/%d/%Y")).read(["01/02/1970", "13/01/1970"])
    assert known.tolist() == [True, False] and t[0] == 86_400 * 10**9


@pytest.mark.parametrize(("unit", "day"), [("excel", 44_129.5), ("matlab", 738_089.5)])
def test_serial_dates(unit, day):
    """Noon of 25 October 2020: 44,129 days after 30 December 1899, datenum(2020, 10, 25) = 738,089."""
    for cells in ([str(day)], pa.array([day])):
        t, known = TimeReader(TimeColumn("t", unit)).read(cells)
        assert known.all() and t.tolist() == [1_603_627_200 * 10**9]


@pytest.mark.parametrize("kind", [list, pa.array])
def test_local_times_go_on_when_the_clock_is_set_back(kind):
    """On 25 October 2020 the hour from 02:00 came twice in Berlin, at UTC+2 and UTC+1."""
    cells = [f"2020-10-25 {clock}:00" for clock in ("01:30", "02:30", "02:00", "02:30", "03:00")]
    reader = TimeReader(TimeColumn("t", zone="Europe/Berlin"))
    if kind is not list:
        cells = pa.array(np.array(cells, "datetime64[ns]"))
    t, known = reader.read(cells)
    assert known.all() and (t // 10**9 - 1_603_582_200).tolist() == [0, 3600, 5400, 7200, 9000]


@pytest.mark.parametrize("rows", ["as they came", "sorted", "never set forward"])
@pytest.mark.parametrize(("minutes", "tags"), [(10, 2), (15, 1), (60, 1), (1, 3)])
def test_local_times_are_those_of_the_order_of_the_rows(rows, minutes, tags):
    """zoneinfo gives the local times, of half a day; another chunk begins in the hour that occurs twice or never."""
    start = (
        datetime(2024, 3, 30, 19, tzinfo=UTC) if rows == "never set forward" else datetime(2024, 10, 26, 18, tzinfo=UTC)
    )
    utc = [start + k * timedelta(minutes=minutes) for k in range(720 // minutes) for _ in range(tags)]
    zone = timezone(timedelta(hours=1)) if rows == "never set forward" else ZoneInfo("Europe/Berlin")
    both = [(when.astimezone(zone).strftime("%Y-%m-%d %H:%M"), when) for when in utc]
    if rows == "sorted":
        both.sort(key=lambda one: one[0])
    cells, expected = [cell for cell, _ in both], [when.timestamp() * 1e9 for _, when in both]
    reader, half = TimeReader(TimeColumn("t", zone="Europe/Berlin")), len(cells) * 13 // 24 // tags * tags
    t = np.concatenate([reader.read(part)[0] for part in (cells[:half], cells[half:])])
    assert t.tolist() == expected
    keys = Counter(key for _, key, _ in reader.notes)
    spring = {SKIPPED: 60 // minutes * tags, ASSUMED: 1}
    assert keys == (spring if rows == "never set forward" else {TWICE: 120 // minutes * tags})


def test_the_clock_of_a_date_is_found(tmp_path):
    path = write(tmp_path, "Kommentar,Time,Date,x\na,00:00,2024-03-04,1\nb,12:00,2024-03-04,2\n")
    assert inspect_recordings([path]).time.names == ("Date", "Time")


def test_what_only_python_takes_for_a_number_is_none(tmp_path):
    """1_5 is fifteen in a program's text; in a table it is nobody knows what."""
    got, reports = read_reports(write(tmp_path, "t,x\n0,1_5\n1_0,2\n2,3\n"), X)
    assert reports.counts == {"unreadable value": 1, "undated row": 1}
    np.testing.assert_array_equal(got.value[:, 0], [NAN, 3.0])
    assert got.t.tolist() == [0, 2 * 10**9]
