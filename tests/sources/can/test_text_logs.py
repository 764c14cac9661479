"""Text logs: CSV of GVRET and CANedge, console output of candump, headers and lines of ASC."""

import gzip

import pytest

from estimators.errors import SourceError
from sources.can.log import CanLog
from sources.can.readers import LogSummary, read_messages
from sources.inspect import inspect_recordings, is_table
from sources.tables.times import TimeColumn
from tests.sources.can.can_tools import Reports
from tests.sources.can.test_log import START, decoder_of, messages, write  # noqa: F401  a fixture
from tests.support import error_of, read_all

GVRET = """Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
1700000000123456,00000100,false,Rx,0,8,F4,01,00,00,00,00,00,00,
1700000000133457,00000100,true,Rx,1,2,F4,01,
"""
CANEDGE = """TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes
1700000000.123456;0;100;0;8;8;0;0;0;F401000000000000
1700000000.133457;1;00000100;1;2;2;0;0;0;F401
"""
CONSOLE = """  can0  100   [8]  F4 01 00 00 00 00 00 00   '........'
  can1  00000100   [2]  F4 01
  can0  20000004   [8]  00 00 00 00 00 00 00 00   ERRORFRAME
  can0  RX B -  101  [12]  01 02 03 04 05 06 07 08 09 0A 0B 0C
  can0  101   [4]  remote request
"""


def lines_of(times, form=" ({})  can0  100   [2]  F4 01"):
    """As can-utils' candump.c prints a frame."""
    return "".join(form.format(time) + "\n" for time in times)


def keys_and_times(path, zone=None):
    """Bus, id and times (s) of the frames of a log, and its faults, for `nisus log`."""
    found = inspect_recordings([path], time=TimeColumn("", zone=zone))
    return [(m.bus, m.key & 0xFFF, m.key >> 31, (m.t / 1e9).round(6).tolist()) for m in found.messages], found.faults


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.csv", GVRET), ("a.txt", GVRET), ("a.csv", CANEDGE), ("a.CSV", CANEDGE.replace(";", ",")), ("a.csv.gz", GVRET)],
)
def test_a_csv_of_frames_is_a_can_log(tmp_path, name, text):
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    assert not is_table(path)
    assert keys_and_times(path) == ([(0, 256, 0, [START + 0.123456]), (1, 256, 1, [START + 0.133457])], [])
    got = read_all(CanLog([path], decoder_of(tmp_path)))
    assert got.value[:, 0].tolist() == [10.0]  # 0x01F4 · 0.1 - 40 by the DBC
    assert got.t.tolist() == [START * 10**9 + 123_456_000]


@pytest.mark.parametrize("text", [GVRET, CANEDGE])
def test_a_line_with_too_few_bytes_is_counted(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text.replace("F4,01,\n", "F4,\n").replace("F401\n", "F4\n"))
    found, (fault,) = keys_and_times(path)
    assert len(found) == 1 and "1 line cannot be read, the first line 3: it has 1 of 2 bytes" in fault


def test_a_csv_of_python_can_and_a_table_are_what_they_were(tmp_path, messages):  # noqa: F811
    write(tmp_path / "a.csv", messages[:3])
    (tmp_path / "b.csv").write_text("Time Stamp,ID,speed\n1,2,3\n")
    (tmp_path / "c.txt").write_text("time,speed\n1,2\n")
    assert [is_table(tmp_path / name) for name in ("a.csv", "b.csv", "c.txt")] == [False, True, True]


@pytest.mark.parametrize(
    ("times", "seconds"),
    [
        (["1700000000.100000", "1700000000.250000"], [START + 0.1, START + 0.25]),  # -ta
        (["2023-11-14 22:13:20.100000", "2023-11-14 22:13:20.250000"], [START + 0.1, START + 0.25]),  # -tA
        ([f"00{k}.{k}00000" for k in range(9)], [k * 1.1 for k in range(9)]),  # -tz
        (["000.000000", "000.010000", "000.000200", "000.009800"], [0.0, 0.01, 0.0102, 0.02]),  # -td
        (["000.000000"] + ["000.010000"] * 3, [0.0, 0.01, 0.02, 0.03]),
    ],
)
@pytest.mark.parametrize("name", ["dump.log", "dump.txt"])
def test_times_of_candumps_console_output(tmp_path, name, times, seconds):
    (tmp_path / name).write_text(lines_of(times))
    (item,), _ = keys_and_times(tmp_path / name)
    assert item == ("can0", 256, 0, pytest.approx(seconds, abs=1e-6))


@pytest.mark.parametrize("line", ["(170x000.1)  can0  100   [1]  00", "can0  100   [1]  00", "(17000 can0  100   [1]"])
def test_a_garbled_first_line_of_candump_loses_only_itself(tmp_path, line):
    times = ["1700000000.100000", "1700000000.250000"]
    (tmp_path / "dump.log").write_text(f"{line}\n{lines_of(times)}")
    (item,), (fault,) = keys_and_times(tmp_path / "dump.log")
    assert item[3] == pytest.approx([START + 0.1, START + 0.25], abs=1e-6)
    rule = "1 line cannot be read, the first line 1: it is no line of candump"
    assert fault == f"dump.log: damaged: {rule}: {' '.join(line.split())}"


def test_fields_of_candumps_console_output(tmp_path):
    path = tmp_path / "dump.log"
    rows = CONSOLE.splitlines()
    path.write_text("".join(f" (1700000000.{k}00000){row}\n" for k, row in enumerate(rows)))
    found, faults = keys_and_times(path)
    assert found == [
        ("can0", 256, 0, [START]),
        ("can0", 257, 0, [pytest.approx(START + 0.3)]),
        ("can1", 256, 1, [pytest.approx(START + 0.1)]),
    ]
    assert faults == ["1 error frames"]
    path.write_text(path.read_text().replace("(", "\x1b[31m(").replace("[8]", "\x1b[0m[8]"))
    assert keys_and_times(path)[0] == found


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("a.txt", CONSOLE, "it is console output of candump without times; record with candump -L, or with -ta"),
        (
            "a.log",
            lines_of(["000.000000", "000.010000", "000.020000"]),
            "its times may be those of candump -tz (from the first frame) or -td; record with candump -L",
        ),
        (
            "a.log",
            "***BUSMASTER Ver 3.2.2***\n***PROTOCOL CAN***\n11:49:12:9420 Rx 1 0x023 s 1 40\n",
            "is a log of BUSMASTER; convert it to ASC there (Format Converters, Log to ASC)",
        ),
    ],
)
def test_a_log_without_usable_times_is_refused_with_the_remedy(tmp_path, name, text, line):
    path = tmp_path / name
    path.write_text(text)
    assert error_of(SourceError, lambda: CanLog([path], decoder_of(tmp_path))) == f"{path}: {line}"


HEADER = "date {date}\nbase hex  timestamps absolute\nno internal events logged\n"
FRAMES = "   0.010000 1  100             Rx   d 2 F4 01\n   0.020000 1  101             Rx   d 2 F4 01\n"
SATURDAY = 1_506_783_973.191  # 2017-09-30 15:06:13.191 UTC


@pytest.mark.parametrize(
    ("head", "start"),
    [
        (HEADER.format(date="Sat Sep 30 15:06:13.191 2017"), SATURDAY),
        (HEADER.format(date="Sat Sep 30 03:06:13.191 pm 2017"), SATURDAY),
        (HEADER.format(date="Sat Sep 30 15:06:13 2017"), SATURDAY - 0.191),
        (HEADER.format(date="Don Mär 30 15:06:13.191 2017").encode("cp1252"), SATURDAY - 184 * 86_400),
        ("***BUSMASTER Ver 3.2.2***\n" + HEADER.format(date="Sat Sep 30 15:06:13.191 2017"), SATURDAY),
        ("date Sat Sep 30 15:06:13.191 2017\nbase hex timestamps absolute\n", SATURDAY),  # a frame follows at once
        ("***BUSMASTER Ver 3.2.2***\nbase hex timestamps absolute\n", 0.0),
        # The times of a trigger block without a start of its own count on.
        (
            HEADER.format(date="Sat Sep 30 15:06:13.191 2017") + "Begin Triggerblock Sat Sep 30 15:07:13.191 2017\n",
            SATURDAY,
        ),
        (
            HEADER.format(date="Sat Sep 30 15:06:13.191 2019")
            + "Begin Triggerblock Sat Sep 30 15:06:13.191 2017\n   0.000000 Start of measurement\n",
            SATURDAY,
        ),
    ],
)
def test_the_date_of_an_asc_log_is_the_start_of_its_times(tmp_path, head, start):
    path = tmp_path / "a.asc"
    path.write_bytes((head if isinstance(head, bytes) else head.encode()) + FRAMES.encode())
    found, faults = keys_and_times(path)
    assert [item[:3] for item in found] == [(0, 256, 0), (0, 257, 0)], "the first frame is there"
    assert [item[3][0] for item in found] == pytest.approx([start + 0.01, start + 0.02], abs=1e-6)
    line = "a.asc: its date has no time zone and is taken to be UTC; give one with --time-zone"
    assert faults == ([line] if start else [])


def test_the_zone_of_the_logger_applies_to_its_dates(tmp_path):
    path = tmp_path / "a.asc"
    path.write_text(HEADER.format(date="Sat Sep 30 15:06:13.191 2017") + FRAMES)
    for zone in ("Europe/Berlin", "+02:00"):  # summer time
        found, faults = keys_and_times(path, zone)
        assert found[0][3] == [pytest.approx(SATURDAY - 7200 + 0.01)] and not faults
    got = read_all(CanLog([path], decoder_of(tmp_path), zone="Europe/Berlin"))
    assert got.t[0] / 1e9 == pytest.approx(SATURDAY - 7200 + 0.01, abs=1e-6)


def test_a_trigger_block_at_the_end_is_the_end(tmp_path):
    path = tmp_path / "a.asc"
    path.write_text(HEADER.format(date="Sat Sep 30 15:06:13.191 2017") + FRAMES + "Begin Triggerblock Sat Sep 30 15:07")
    assert [item[:3] for item in keys_and_times(path)[0]] == [(0, 256, 0), (0, 257, 0)]


def test_a_date_that_cannot_be_read_is_said(tmp_path):
    path = tmp_path / "a.asc"
    path.write_text(HEADER.format(date="2017年9月30日") + FRAMES)
    found, (fault,) = keys_and_times(path)
    assert found[0][3] == [0.01] and "date '2017年9月30日' cannot be read; times do not count from 1970" in fault


@pytest.mark.parametrize("base", ["hex", "dec"])
@pytest.mark.parametrize("name", ["", "EngineData", "1Data", "12", "Engine data of it"])
def test_symbolic_names_of_fd_frames_are_no_data(tmp_path, name, base):
    """The fields as in samples of CANoe: name, BRS, ESI, DLC (hexadecimal), length, bytes, duration, ..."""
    bytes_ = [(f"{k:02x}" if base == "hex" else str(k)) for k in range(32)]
    key = "100" if base == "hex" else "256"
    rest = "  130000  130   303000 e0006659 46500250 4b140250 20011736 2001040d"
    path = tmp_path / "a.asc"
    path.write_text(
        f"date Sat Sep 30 15:06:13.191 2017\nbase {base}  timestamps absolute\n"
        "   0.000000 CANFD   Start of measurement\n"
        f"   0.010000 CANFD   1 Rx        {key}  {name:32} 1 0 d 32 {' '.join(bytes_)}{rest}\n"
        f"   0.020000 CANFD   1 Rx        {key}  {name:32} 1 0 0  0{rest}\n"
    )
    reports = Reports()
    log = CanLog([path], decoder_of(tmp_path, reports), report=reports)
    got = read_all(log)
    assert log.frames == 2 and not reports.counts
    assert got.value[:, 0].tolist() == [pytest.approx(0x0100 * 0.1 - 40)]


def test_a_symbolic_name_in_place_of_an_id_is_its_id(tmp_path):
    path = tmp_path / "a.asc"
    tail = "  Length = 240000 BitCount = 124 ID = {}"
    path.write_text(
        HEADER.format(date="Sat Sep 30 15:06:13.191 2017")
        + f"   0.010000 1  EngineData      Rx   d 2 F4 01{tail.format(256)}\n"
        + f"   0.020000 1  Dead            Rx   d 2 F4 01{tail.format('257x')}\n"
        + "   0.030000 2 ErrorFrame Flags = 0xe CodeExt = 0x20a2 Code = 0x82 ID = 0 DLC = 0 Position = 5 Length = 113\n"
    )
    assert [item.fault for item in read_messages(path, None, 8) if isinstance(item, LogSummary)] == [""]
    assert [item[:3] for item in keys_and_times(path)[0]] == [(0, 256, 0), (0, 257, 1)]
    got = read_all(CanLog([path], decoder_of(tmp_path)))
    assert got.value[:, 0].tolist() == [10.0]
