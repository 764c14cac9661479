"""Spellings of a date: each is the moment that it names, or refused."""

from __future__ import annotations

import random
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pyarrow as pa
import pytest

from estimators.errors import SourceError
from sources.inspect import inspect_recordings
from sources.tables.times import ASSUMED, TimeColumn, TimeReader
from tests.support import error_of

SPELLINGS = (Path(__file__).parent / "spellings.csv").read_text("utf-8").splitlines()[1:]
MOMENT_NS = 1_710_489_600 * 10**9  # 2024-03-15T08:00:00Z by `date -u +%s`


def read(*cells: str, **column: str) -> list[int | None]:
    """Return the time (ns) of each cell, None of one that is refused."""
    t, known = TimeReader(TimeColumn("t", **column)).read(list(cells))
    return [value if there else None for value, there in zip(t.tolist(), known.tolist(), strict=True)]


@pytest.mark.parametrize("cell", SPELLINGS)
def test_a_spelling_is_the_moment_that_it_names(cell):
    assert read(cell) == [MOMENT_NS]


@pytest.mark.parametrize(
    "cell",
    [
        "Fri Mar 15 08:00:00 CST 2024",  # in Chicago or Shanghai
        "2024-03-15 08:00:00 CET+1",
        "2024-03-15T08:00:00[Europe/Berlin]",  # no offset
        "15.03.2024 08.30",  # half past eight, or 08.30 h
        "15.03.2024 08:00:00:05",  # 5 of which unit
        "30 February 2024 08:00:00",
        "15 March 2024 24:30:00",
        "15 March 2024 13:00 PM",
        "15 Brumaire 2024 08:00:00",
        "15 March 08:00:00",
        "March 2024",
        "2024-366-1",
        "2023-366T08:00:00",
        "2024-000T08:00:00",
        "15-03/2024",
        "1.15.03.2024 08:00:00",
        "48765432100",  # s in the year 3515; ms in 1971
        "1_000",
        "inf",
    ],
)
def test_a_spelling_that_may_be_two_moments_or_none_is_refused(cell):
    assert read(cell) == [None]


FORMATS = (
    "%a, %d %b %Y %H:%M:%S +0000",
    "%a %b %d %H:%M:%S UTC %Y",
    "%b %d, %Y %I:%M:%S %p",
    "%A, %B %d, %Y %I:%M:%S %p",
    "%d %B %Y %H:%M:%S.%f",
    "%d-%b-%y %H.%M.%S.%f",
    "%d.%m.%Y %H.%M.%S",
    "%d.%m.%Y %H:%M:%S,%f",
    "%Y-%m-%d %H:%M:%S.%f UTC",
    "%Y/%m/%d-%H:%M:%S",
    "%Y-%jT%H:%M:%S",
    "%Y%m%d_%H%M%S",
    "%Y%m%d%H%M%S",
    "%Y-%m-%d_%H-%M-%S",
)


@pytest.mark.parametrize("form", FORMATS)
def test_dates_as_strftime_writes_them(form):
    rng = random.Random(form)
    step = timedelta(microseconds=1) if "%f" in form else timedelta(seconds=1)
    since = [rng.randrange(timedelta(days=15_000) // step) * step for _ in range(300)]
    moments = [datetime(2000, 1, 1, tzinfo=UTC) + each for each in since]
    expected = [(946_684_800 * 10**6 + each // timedelta(microseconds=1)) * 1000 for each in since]
    assert read(*(moment.strftime(form) for moment in moments)) == expected


@pytest.mark.parametrize(("unit", "factor"), [("ms", 10**6), ("us", 10**3), ("ns", 1)])
def test_the_unit_of_times_since_1970_is_told(unit, factor):
    """A column of integers and text alike; the first number decides for all, so a later small one is small."""
    numbers = [MOMENT_NS // factor + k for k in (0, 7, 1_000_000)]
    for cells in (list(map(str, numbers)), pa.array(numbers), pa.array(map(float, numbers))):
        times = TimeReader(TimeColumn("stamp"))
        t, known = times.read(cells)
        near = 256 if factor == 1 and not isinstance(cells, list) and pa.types.is_floating(cells.type) else 0
        assert known.all() and all(abs(a - b * factor) <= near for a, b in zip(t.tolist(), numbers, strict=True))
        text = f"stamp is {numbers[0]}, taken as {unit} since 1970 (2024-03-15 08:00 UTC); set the time's unit"
        assert [(row, key, note.startswith(text)) for row, key, note in times.notes] == [(0, ASSUMED, True)]


def test_seconds_that_grow_stay_seconds():
    assert read("1.5", "1710489600000") == [1_500_000_000, None]


CLOCK = [f"{k // 3600:02}{k // 60 % 60:02}{k % 60:02}" for k in range(36_000 - 90, 36_000 + 90)]
"""Clocks from 09:58:30 on, one a second: 095830 to 100129."""


def times_of(cells, name="log.csv"):
    """Return the times (s) of cells, and the notes without their remedy."""
    times = TimeReader(TimeColumn("t"), Path(name))
    t, known = times.read(cells)
    assert known.all()
    return [each / 1e9 for each in t.tolist()], [text for _, _, text in times.notes]


@pytest.mark.parametrize(
    ("cells", "first"),
    [
        (CLOCK, 35_910),
        (CLOCK[90:], 36_000),  # no leading zero
        ([f"{cell}.25" for cell in CLOCK], 35_910.25),
        (pa.array(list(map(int, CLOCK))), 35_910),
        (pa.array([int(cell) + 0.25 for cell in CLOCK]), 35_910.25),
    ],
)
def test_numbers_that_spell_a_clock_are_one(cells, first):
    t, notes = times_of(cells, "log_2024-03-15.csv")
    day = MOMENT_NS / 1e9 - 8 * 3600
    assert t == pytest.approx([day + first + k for k in range(len(cells))], abs=1e-6) and not notes
    t, notes = times_of(cells)
    assert t[0] == first and notes == ["t is a clock without a date, counted from 1970-01-01; give it in time.date"]


def test_clocks_once_a_minute_pass_the_hour():
    cells = [f"{k // 60:02}{k % 60:02}00" for k in range(600 - 5, 600 + 70)]
    assert times_of(cells[5:])[0] == [60.0 * k for k in range(600, 670)]


@pytest.mark.parametrize(
    "numbers",
    [
        range(36_000 - 90, 36_000 + 90),  # seconds of the day
        range(100_000, 100_060),  # within a minute it may be either, at the same intervals
        range(10_000, 16_000, 100),  # each of which could be a clock
        [5, 6, 7, 130, 131, 132, 210, 211],  # bursts
        [20_240_229, 20_240_230],  # no such day
        [0.0, 0.5, 1.0],
    ],
)
def test_numbers_that_count_are_seconds(numbers):
    for cells in ([str(each) for each in numbers], pa.array(list(numbers))):
        assert times_of(cells) == ([float(each) for each in numbers], [])


def test_whole_numbers_that_are_all_days_are_dates():
    days = ["20240229", "20240301", "20240302"]
    first = 1_709_164_800.0  # 2024-02-29T00:00:00Z by `date -u +%s`
    for cells in (days, pa.array(list(map(int, days)))):
        t, notes = times_of(cells)
        assert t == [first, first + 86_400, first + 2 * 86_400] and notes == ["t is 20240229, taken as a date"]


def test_seconds_of_labview_count_from_1904():
    """3,793,334,400 = 1,710,489,600 + 66 years of 365 days and 17 leap days."""
    number = 1_710_489_600 + (66 * 365 + 17) * 86_400
    for cells in ([str(number), str(number + 1)], pa.array([number, number + 1])):
        t, (note,) = times_of(cells)
        assert t == [MOMENT_NS / 1e9, MOMENT_NS / 1e9 + 1]
        assert note == f"t is {number}, taken as seconds since 1904, as of LabVIEW (2024-03-15)"


@pytest.mark.parametrize("day", ["20240315", "15.03.2024"])
def test_numbers_that_spell_clocks_follow_the_day_beside_them(tmp_path, day):
    path = tmp_path / "log.csv"
    path.write_text("Date,Time,level\n" + "".join(f"{day},{cell},{k % 7}\n" for k, cell in enumerate(CLOCK)))
    found = inspect_recordings([path])
    assert found.t.tolist() == [MOMENT_NS + (k - 8 * 3600 + 35_910) * 10**9 for k in range(len(CLOCK))]
    assert [one.name for one in found.columns] == ["level"]


@pytest.mark.parametrize(("unit", "day"), [("excel", 45_366), ("matlab", 739_326)])
def test_serial_dates_that_are_read_as_seconds_are_named(tmp_path, unit, day):
    """Both are 2024-03-15, by a spreadsheet and by MATLAB's manual."""
    path = tmp_path / "log.csv"
    path.write_text("t,level\n" + "".join(f"{day + (28_800 + k) / 86_400:.8f},{k % 7}\n" for k in range(50)))
    line = f"column t looks like serial dates of {unit}: add --time-unit {unit}"
    assert inspect_recordings([path]).faults == [line]
    found = inspect_recordings([path], time=TimeColumn("t", unit))
    zone = "log.csv: its dates have no time zone and are taken to be UTC; give one with --time-zone"
    assert found.faults == [zone] and found.t[0] == pytest.approx(MOMENT_NS, abs=10**6)


def columns_of(tmp_path, heading, row, name="log.csv"):
    """Return what is read of 60 rows, each `row(k)`."""
    (tmp_path / name).write_text(f"{heading}\n" + "".join(f"{row(k)}\n" for k in range(60)))
    return inspect_recordings([tmp_path / name])


def test_steps_that_are_too_long_for_seconds_are_said(tmp_path):
    line = "timestamp grows by 20000 a row, taken as s; if that is ms, us or ns, give --time-unit"
    assert columns_of(tmp_path, "timestamp,x", lambda k: f"{k * 20_000},{k % 7}").faults == [line]
    assert columns_of(tmp_path, "timestamp,x", lambda k: f"{1_710_489_600 + k * 20_000},{k % 7}").faults == []
    assert columns_of(tmp_path, "timestamp,x", lambda k: f"{k * 20},{k % 7}").faults == []


def test_values_that_are_no_numbers_are_counted(tmp_path):
    found = columns_of(tmp_path, "t,dT", lambda k: f"{k},{'−' if k % 3 == 0 else ''}{k}.5")
    why = "dT is '−0.5', which is not a number; the value is missing"
    assert found.faults == [f"dT: no number (rows: 20, the first log.csv:2: {why})"]


def test_a_code_far_from_all_values_is_said(tmp_path):
    found = columns_of(tmp_path, "t,a,b,c", lambda k: f"{k},{-999 if k % 20 == 3 else k},{k},{1e9 if k == 5 else k}")
    rule = "if that is a missing value, set a: [-59, 118] in valid_if of its sensor"
    assert found.faults == [f"a is -999 in 3 rows, far from all other values; {rule}"]


def test_a_temperature_is_no_time_and_a_date_in_two_digits_no_clock(tmp_path):
    with pytest.raises(SourceError, match="which column holds the time is not known; name it with --time, one of n, T"):
        columns_of(tmp_path, "n,T,U", lambda k: f"{k},{20 + k},{k % 7}")
    found = columns_of(tmp_path, "Date,x", lambda k: f"0503{24 + k // 40},{k % 7}")
    assert found.t.tolist() == [(50_324 + k // 40) * 10**9 for k in range(60)]


def test_ticks_of_dotnet_are_no_time_since_1970():
    assert read("638452441310000000") == [None]


def test_years_of_two_digits_may_be_days():
    forms = '"%y-%m-%d %H:%M" or "%d-%m-%y %H:%M"'
    with pytest.raises(SourceError, match=re.escape(forms)):
        read("24-03-05 08:00")
    assert read("24-03-24 08:00") == [MOMENT_NS + 9 * 86_400 * 10**9]  # the same in either order


def test_the_rows_before_a_cell_that_is_too_long_are_read(tmp_path):
    found = columns_of(tmp_path, "t,x,text", lambda k: f"{k},{k % 7},{'a' * 200_000 if k == 30 else 'b'}")
    assert found.columns[0].values.tolist() == [k % 7 for k in range(30)]
    assert found.faults == ["log.csv:32: field larger than field limit (131072); the rest is left out"]


def test_the_months_of_a_two_digit_year_are_told_by_its_formats():
    with pytest.raises(SourceError, match='"%d/%m/%y %H:%M" or "%m/%d/%y %H:%M"'):
        read("3/4/24 8:00")
    assert read("3/4/24 8:00", format="%m/%d/%y %H:%M") == [1_709_539_200 * 10**9]


@pytest.mark.parametrize(
    ("cell", "form"),
    [
        ("03/05/2026 08:00:00:000", "%d/%m/%Y %H:%M:%S:%f"),
        ("03-05-26 8:00:00.5 pm", "%d-%m-%y %I:%M:%S.%f %p"),
        ("03/05/2026", "%d/%m/%Y"),
    ],
)
def test_the_formats_that_are_offered_read_the_cell(cell, form):
    with pytest.raises(SourceError, match=f'"{form}" or '):
        read(cell)
    assert read(cell, format=form) != [None]


@pytest.mark.parametrize(
    ("heading", "ahead_s", "said"),
    [
        ("Date Time, GMT-05:00", -18_000, "-05:00"),  # of an Onset HOBO
        ("Time (UTC+01:00)", 3600, "+01:00"),
        ("Zeit GMT+0530", 19_800, "+05:30"),
        ("time_utc+1", 3600, "+01:00"),
        ("timestamp_utc", 0, ""),
        ("Date Time (UTC)", 0, ""),
    ],
)
def test_an_offset_in_the_heading_is_that_of_its_dates(tmp_path, heading, ahead_s, said):
    (tmp_path / "a.csv").write_text(f'"{heading}",x\n03/15/24 08:00:00 AM,1\n03/15/24 08:00:01 AM,2\n')
    found = inspect_recordings([tmp_path / "a.csv"])
    assert found.t.tolist() == [MOMENT_NS - ahead_s * 10**9, MOMENT_NS + (1 - ahead_s) * 10**9]
    rule = (
        f"a.csv:2: {heading} is taken as local time of UTC{said}, by its heading; set the time's zone (time.zone, --t"
    )
    assert [text.startswith(rule) for text in found.faults] == [True] * bool(said)
    utc = inspect_recordings([tmp_path / "a.csv"], time=TimeColumn(heading, zone="UTC"))
    assert utc.t[0] == MOMENT_NS and not utc.faults


@pytest.mark.parametrize("rows", [("2024-03-15 08:00", "2024-03-15 08:01"), ("1.5.24 08:00 UTC", "1.5.24 08:01 UTC")])
def test_dates_without_a_time_zone_are_said_to_be_utc(tmp_path, rows):
    (tmp_path / "a.csv").write_text("time,x\n" + "".join(f"{row},1\n" for row in rows))
    line = "a.csv: its dates have no time zone and are taken to be UTC; give one with --time-zone"
    assert inspect_recordings([tmp_path / "a.csv"]).faults == [line] * ("UTC" not in rows[0])
    assert inspect_recordings([tmp_path / "a.csv"], time=TimeColumn("time", zone="Europe/Berlin")).faults == []


@pytest.mark.parametrize(
    ("cells", "first"),
    [
        (["24-03-15 08:00", "24-03-15 08:01", "24-03-16 00:00"], MOMENT_NS),  # its last field changes, so it is the day
        (["15-03-24 08:00", "16-03-24 00:00", "16-03-24 00:01"], MOMENT_NS),
        (
            ["15-03-99 08:00"],
            MOMENT_NS + 27_393 * 86_400 * 10**9,
        ),  # no month has 99 days; date -u -d 2099-03-15T08:00 +%s
        (["99-03-15 08:00"], MOMENT_NS + 27_393 * 86_400 * 10**9),
        (["03-15-24 08:00"], MOMENT_NS),  # nor has a year 15 months
        (["15/03/24 08:00", "15/03/24 08:01"], MOMENT_NS),
    ],
)
def test_the_order_of_three_fields_of_two_digits_is_known_from_the_rows(cells, first):
    assert read(*cells)[0] == first


def test_three_fields_of_two_digits_that_stay_open_are_refused():
    text = error_of(SourceError, read, "24-03-15 08:00:00", "24-03-15 08:00:01")
    assert text == (
        "t is '24-03-15 08:00:00', which may be year-month-day or day-month-year; set the time's format (time.format, "
        '--time-format): "%y-%m-%d %H:%M:%S" or "%d-%m-%y %H:%M:%S"'
    )
    assert read("24-03-15 08:00:00", format="%y-%m-%d %H:%M:%S") == [MOMENT_NS]
