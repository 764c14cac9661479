"""Dialects of tables: names, values and the remark of each, against the numbers written and against pandas."""

import io

import numpy as np
import pandas as pd
import pytest

from estimators.errors import SourceError
from estimators.log import READING
from sources.inspect import inspect_recordings
from sources.source import Channel
from sources.tables.dialect import DETECTED, Dialect, dialect_of
from sources.tables.rows import names_of, remarks_of
from sources.tables.table import Table
from sources.tables.text import READ_AS
from sources.tables.times import TimeColumn
from tests.sources.can.can_tools import Reports
from tests.sources.tables.dialects import FLOW, HEAD, LOGGER, NAMES, REPORTED, SAMPLES, SEMI, VALUES, N, T, body
from tests.support import error_of, read_all


def read(path, time, columns, dialect=DETECTED, report=None):
    channels = [Channel(READING, k, name, (name,)) for k, name in enumerate(columns)]
    return read_all(Table([path], time=time, channels=channels, width=1, report=report or Reports(), dialect=dialect))


def values_of(events, count):
    return np.stack([events.value[events.channel == k, 0] for k in range(count)], axis=1)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_dialect_is_read_as_it_was_written_and_told(tmp_path, name):
    sample = SAMPLES[name]
    path = tmp_path / "drive.csv"
    path.write_bytes(sample.text.encode(sample.encoding))
    assert tuple(names_of(path)) == sample.names
    reports = Reports()
    time, *columns = sample.names[:3]
    events = read(path, TimeColumn(time), columns, report=reports)
    expected = VALUES[:, 1 : 1 + len(columns)]
    np.testing.assert_array_equal(values_of(events, len(columns)), expected)
    if "words" not in name:
        np.testing.assert_array_equal(events.t[events.channel == 0], np.round(VALUES[:, 0] * 1e9).astype(np.int64))
    frame = pd.read_csv(io.StringIO(sample.text), **sample.pandas)
    np.testing.assert_array_equal(frame.iloc[:, 1 : 1 + len(columns)].to_numpy(float), expected)
    footer = {"unreadable value": 1} if name == "footer" else {}
    assert reports.counts == ({READ_AS: 1} if sample.remark else {}) | footer
    assert reports.texts.get(READ_AS, "drive.csv: ") == f"drive.csv: {sample.remark}"


@pytest.mark.parametrize("name", REPORTED)
def test_a_reported_file_is_read_as_pandas_reads_it_when_it_is_told_how(tmp_path, name):
    text, told = REPORTED[name]
    path = tmp_path / "reported.csv"
    path.write_bytes(text.encode("cp1252"))
    frame = pd.read_csv(io.StringIO(text), **told)
    names = names_of(path)
    assert [one.partition(" [")[0] for one in names] == [one.partition(" [")[0] for one in frame.columns]
    columns = [names[k] for k in range(1, len(names)) if frame.dtypes.iloc[k] == np.float64]
    time = TimeColumn("TimeStamp", format="%m/%d/%Y %H:%M") if name == "b_section" else TimeColumn(names[0], zone="UTC")
    events = read(path, time, columns)
    np.testing.assert_array_equal(values_of(events, len(columns)), frame.select_dtypes(float).to_numpy())


def write(folder, text, name="drive.csv"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "given", "names", "count"),
    [
        ("a,b,c\n" + HEAD + body(), {"heading": 2}, NAMES, N),
        (LOGGER + HEAD + body(), {"heading": 5}, NAMES, N),
        (LOGGER + HEAD + body(), {"skip": 4}, NAMES, N),
        (HEAD + body(), {"heading": "none"}, ("c1", "c2", "c3"), N),
        (body(), {"heading": "none", "skip": 3}, ("c1", "c2", "c3"), N - 3),
        (body(), {"heading": 1}, tuple(body().splitlines()[0].split(",")), N - 1),
        (HEAD.replace(",", "^") + body("^"), {"delimiter": "^"}, NAMES, N),
        (HEAD.replace(",", "\t") + body("\t"), {"delimiter": "tab"}, NAMES, N),
        ("Rate: 1\n" * 20_000 + HEAD + body(), {"skip": 20_000}, NAMES, N),
    ],
)
def test_keys_of_the_source_come_before_what_is_detected(tmp_path, text, given, names, count):
    path, dialect, reports = write(tmp_path, text), dialect_of(**given), Reports()
    assert tuple(names_of(path, "", dialect)) == names
    events = read(path, TimeColumn(names[0]), names[1:], dialect, reports)
    np.testing.assert_array_equal(values_of(events, 2), VALUES[N - count :, 1:])
    assert READ_AS not in reports.counts


def test_a_number_that_may_be_two_is_refused_until_the_decimal_sign_is_given(tmp_path):
    path = write(tmp_path, 't,x\n0,"1,234"\n1,"2,345"\n2,"5,678"\n')
    text = error_of(SourceError, names_of, path)
    assert text == f"{path}:2: '1,234' may be 1234 or 1.234; give --decimal . or --decimal , (decimal of the source)"
    for decimal, expected in ((".", [1234.0, 2345.0, 5678.0]), (",", [1.234, 2.345, 5.678])):
        events = read(path, TimeColumn("t"), ["x"], Dialect(decimal=decimal))
        assert events.value[:, 0].tolist() == expected


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (["0;1,234", "0.5;2,345"], [1.234, 2.345]),  # a time with a point says nothing of the values
        (["0;1,234", "1;2,345.5"], [1234.0, 2345.5]),
        (["0;1,234", "1;0.5"], [1234.0, 0.5]),
        (["0;1.234", "1;1.234,5"], [1234.0, 1234.5]),
        (["0;1.234", "1;2.5"], [1.234, 2.5]),
        (["0;-1 234 567,5", "1;2,5"], [-1234567.5, 2.5]),
    ],
)
def test_the_sign_between_thousands_is_known_from_the_column(tmp_path, rows, expected):
    events = read(write(tmp_path, "t;x\n" + "\n".join(rows) + "\n"), TimeColumn("t"), ["x"])
    assert events.value[:, 0].tolist() == expected


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("#1 T,#2 T\n" + "".join(f"{k},{k}.5\n" for k in range(9)), ("#1 T", "#2 T")),
        ("%RH,t\n" + "".join(f"{k},{k}.5\n" for k in range(9)), ("%RH", "t")),
        ("#,t,x\n" + "".join(f"{k},{k}.5,1\n" for k in range(9)), ("#", "t", "x")),
        ("t,1,2,3\n" + "".join(f"{k},4,5,6\n" for k in range(9)), ("t", "1", "2", "3")),
        ("t,x,list\n" + "".join(f"{k},{k}.5,1;2;3;4\n" for k in range(9)), ("t", "x", "list")),
        ("t,t_s\n" + "".join(f"{k},{k}.5\n" for k in range(9)), ("t", "t_s")),
    ],
)
def test_a_heading_in_line_1_stays_as_it_is(tmp_path, text, names):
    path, reports = write(tmp_path, text), Reports()
    assert tuple(names_of(path)) == names
    assert read(path, TimeColumn(names[1]), names[:1], report=reports).t.size == 9 and not reports.counts


def test_a_comma_in_a_note_is_no_decimal_sign(tmp_path):
    rows = "".join(f'{k}.5,{k}.25,"{k},5"\n' for k in range(9))
    events = read(write(tmp_path, "t,x,note\n" + rows), TimeColumn("t"), ["x"])
    assert events.value[:, 0].tolist() == [k + 0.25 for k in range(9)]


def test_names_of_sensors_that_begin_with_a_number_sign_are_no_comments(tmp_path):
    rows = "".join(f"#{1 + k % 2},{k},{k}.5\n" for k in range(9))
    events = read(write(tmp_path, "# exported\nid,t,x\n" + rows), TimeColumn("t"), ["x"])
    assert events.value[:, 0].tolist() == [k + 0.5 for k in range(9)]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"heading": "x"}, "--heading x: is no line; give its number from 1 on, or none"),
        ({"heading": "0"}, "--heading 0: is no line; give its number from 1 on, or none"),
        ({"delimiter": "::"}, "--delimiter '::': is no single sign; give one, or tab or space"),
        ({"decimal": ":"}, "--decimal ':': is no decimal sign; give . or ,"),
        ({"skip": -1}, "--skip -1: is below 0; give the number of lines before the table"),
    ],
)
def test_a_wrong_key_is_one_line(options, expected):
    assert error_of(SourceError, dialect_of, **options, sign="--") == expected


@pytest.mark.parametrize("line", [2, 99])
def test_a_heading_that_is_blank_or_behind_the_end_is_refused(tmp_path, line):
    path = write(tmp_path, HEAD + ",,\n" + body())
    text = error_of(SourceError, names_of, path, "", Dialect(heading=line))
    assert text == f"{path}: its heading is to be line {line}, which is blank or not there; correct it"


def test_a_summary_names_the_units_and_the_dialect(tmp_path):
    found = inspect_recordings([write(tmp_path, SAMPLES["three_rows"].text)])
    assert [(one.name, one.unit) for one in found.columns] == [("TT101 [degC]", "degC"), ("FT201", "")]
    assert found.faults[0] == "drive.csv: heading in line 1, units in line 2"
    assert found.time.name == "time [s]" and found.t[0] == round(T[0] * 1e9)
    np.testing.assert_array_equal(found.columns[1].values, FLOW)


def test_files_of_one_dialect_are_one_line(tmp_path):
    paths = [write(tmp_path, "[Data]\n" + HEAD + body() + "\n" * k, f"{k}.csv") for k in range(3)]
    assert inspect_recordings(paths).faults[0] == "0.csv and 2 more: heading in line 2"


def test_rows_with_more_cells_are_left_out_unless_these_are_blank(tmp_path):
    reports = Reports()
    path = write(tmp_path, SEMI.replace(";", ",") + "0,1,2,\n1,1,2,3\n2,1,2,,\n3,1,2\n")
    events = read(path, TimeColumn("time"), ["TT101"], report=reports)
    assert (events.t // 10**9).tolist() == [0, 2, 3]
    assert reports.texts["unreadable value"] == "drive.csv:3: has 4 cells, not 3; the row is left out"


def test_the_times_and_the_series_of_an_annotated_csv_are_those_of_its_rows(tmp_path):
    """Annotated CSV of InfluxDB: _start and _stop are those of the query, _field names the series."""
    head = (
        "#group,false,false,true,true,false,false,true,true\n"
        "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string\n"
        "#default,_result,,,,,,,\n,result,table,_start,_stop,_time,_value,_field,_measurement\n"
    )
    query = "2024-03-15T08:00:00Z,2024-03-15T09:00:00Z"
    rows = (
        f",,{table},{query},2024-03-15T08:00:{second:02d}Z,{10 * table + second / 8},{field},tank\n"
        for table, field in enumerate(("temp", "level"))
        for second in range(30)
    )
    found = inspect_recordings([write(tmp_path, head + "".join(rows))])
    assert found.time.name == "_time" and found.by == "_field"
    assert np.unique(found.t).tolist() == [(1_710_489_600 + second) * 10**9 for second in range(30)]
    series = {one.name: one.values.tolist() for one in found.columns if one.only}
    assert series["_value_temp"] == [k / 8 for k in range(30)]
    assert series["_value_level"] == [10 + k / 8 for k in range(30)]


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("from,Uhr\n2024-03-15,08:00:00\n2024-03-15,08:00:01\n", "from"),  # a date and a clock are both taken
        ("from,at,x\n2024-03-15 08:00,2024-03-15 08:01,1\n2024-03-15 08:00,2024-03-15 08:02,2\n", "at"),
        ("from,x,my time\n2024-03-15 08:00,1,0.5\n2024-03-15 08:00,2,1.5\n", "my time"),
        ("from,x\n2024-03-15 08:00,1\n2024-03-15 08:00,2\n", "from"),
        ("from,x,my time\n2024-03-15 08:00,1,0.5\n", "from"),
    ],
)
def test_a_date_that_stays_the_same_is_a_time_only_if_there_is_no_other(tmp_path, text, time):
    assert inspect_recordings([write(tmp_path, text)]).time.name == time


def test_the_units_of_a_campbell_logger_are_those_of_its_second_row(tmp_path):
    """TOA5: line of the logger, names, units (TS and RN of time and record), and how each was processed."""
    head = (
        '"TOA5","CR1000","CR1000","1011","CR1000.Std.22","CPU:a.CR1","19246","Table1"\n'
        '"TIMESTAMP","RECORD","BattV_Avg","AirTC_Avg","WS","Turb"\n'
        '"TS","RN","Volts","Deg C","meters/second","NTU"\n"","","Avg","Avg","Smp","Smp"\n'
    )
    rows = "".join(f'"2024-03-15 08:{k:02}:00",{k},12.5,2{k % 10}.5,{k % 7},{k % 5}.1\n' for k in range(40))
    found = inspect_recordings([write(tmp_path, head + rows)])
    units = {one.name: one.unit for one in found.columns}
    assert units == {
        "RECORD": "",
        "BattV_Avg [Volts]": "Volts",
        "AirTC_Avg [Deg C]": "Deg C",
        "WS [meters/second]": "meters/second",
        "Turb": "",
    }
    assert found.faults[0] == (
        "drive.csv: heading in line 2, units in line 3 (not known: NTU; give them under `units`)"
    )


def test_the_unit_of_a_heading_that_is_not_known_is_said(tmp_path):
    rows = "".join(f"{k},{k},{k},{k}\n" for k in range(9))
    found = inspect_recordings([write(tmp_path, "t,A [NTU],B (cfu),C [bar]\n" + rows)])
    assert found.faults[0] == "the unit of A [NTU] and of 1 more is not known; give it under `units`"
    assert [one.unit for one in found.columns] == ["", "", "bar"]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (["0;1,200", "1;1,250"], "1,200 is taken as 1.2; give --decimal . (decimal of the source) if it is 1200"),
        (["0;1,200", "1;1,25"], None),
        (["0;1,200", "1;0,250"], None),
        (["0;1,200", "1;1.200,5"], None),
    ],
)
def test_a_comma_that_may_be_a_sign_between_thousands_is_said(tmp_path, rows, said):
    path = write(tmp_path, "t;x\n" + "\n".join(rows) + "\n")
    assert inspect_recordings([path]).faults[:1] == ([f"drive.csv: {said}"] if said else remarks_of([path]))
    assert "taken as" not in "".join(inspect_recordings([path], dialect=Dialect(decimal=",")).faults)
