"""TDMS files, written by npTDMS: channels, waveforms, groups and units."""

from datetime import datetime

import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import READING
from sources.inspect import inspect_recordings
from sources.source import Channel
from sources.tables.dialect import Dialect
from sources.tables.rows import names_of
from sources.tables.table import Table
from sources.tables.times import TimeColumn
from tests.sources.can.can_tools import Reports
from tests.support import error_of, read_all

nptdms = pytest.importorskip("nptdms", reason="needs nisus[tdms]")

N = 9000
SPEED = np.sin(np.arange(N) / 50)
START = datetime(2024, 3, 5, 8)  # 1,709,625,600 s (date -u +%s)


def write(path, *channels):
    """A file of channels: group, name, values, properties."""
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject(*channel) for channel in channels])
    return path


def wave(start=START, step=0.25, **more):
    return {"wf_increment": step, "wf_start_offset": 0.0, **({"wf_start_time": start} if start else {}), **more}


def read(path, *columns, time="time", dialect=Dialect(), report=None):  # noqa: B008
    channels = [Channel(READING, k, name, (name,)) for k, name in enumerate(columns)]
    return read_all(
        Table([path], time=TimeColumn(time), channels=channels, width=1, report=report or Reports(), dialect=dialect)
    )


@pytest.mark.parametrize(("start", "first"), [(START, 1_709_625_600), (datetime(1904, 1, 1), 0), (None, 0)])
def test_waveforms_have_the_times_of_their_properties(tmp_path, start, first):
    path = write(
        tmp_path / "a.tdms",
        ("Log", "speed", SPEED, wave(start, unit_string="m/s")),
        ("Log", "count", np.arange(N, dtype=np.int32), wave(start)),
    )
    assert names_of(path) == ["time", "speed [m/s]", "count"]
    reports = Reports()
    events = read(path, "speed [m/s]", "count", report=reports)
    np.testing.assert_array_equal(events.value[events.channel == 0, 0], SPEED)
    np.testing.assert_array_equal(events.value[events.channel == 1, 0], np.arange(N))
    np.testing.assert_array_equal(events.t[events.channel == 0], first * 10**9 + np.arange(N) * 250_000_000)
    assert not reports.counts
    found = inspect_recordings([path])
    assert [(one.name, one.unit) for one in found.columns] == [("speed [m/s]", "m/s"), ("count", "")]


def test_a_channel_may_hold_the_time_and_others_of_its_length_are_columns(tmp_path):
    t = np.arange(N) * 0.5
    path = write(
        tmp_path / "a.tdms",
        ("Log", "t", t),
        ("Log", "speed", SPEED),
        ("Log", "slow", SPEED[:10]),
        ("Log", "note", ["a"]),
    )
    assert names_of(path) == ["t", "speed"]
    reports = Reports()
    events = read(path, "speed", time="t", report=reports)
    np.testing.assert_array_equal(events.t, np.round(t * 1e9).astype(np.int64))
    np.testing.assert_array_equal(events.value[:, 0], SPEED)
    left = "a.tdms:1: channels of another length or time are left out: slow"
    assert reports.texts["format of a table"] == left


def test_the_first_group_is_read_and_others_are_named(tmp_path):
    path = write(tmp_path / "a.tdms", ("A", "speed", SPEED, wave()), ("B", "torque", -SPEED, wave()))
    reports = Reports()
    read(path, "speed", report=reports)
    assert reports.texts["format of a table"] == "a.tdms:1: group 'A' is read, of A, B (sheet, --sheet)"
    np.testing.assert_array_equal(read(path, "torque", dialect=Dialect(sheet="B")).value[:, 0], -SPEED)
    text = error_of(SourceError, names_of, path, "", Dialect(sheet="C"))
    assert text.startswith(f"{path}: there is no group 'C' of numbers; ")


def test_files_that_cannot_be_read_are_one_line(tmp_path):
    path = write(tmp_path / "a.tdms", ("A", "note", ["a", "b"]))
    assert error_of(SourceError, names_of, path) == f"{path}: no group has channels with numbers; record it again"
    path.write_bytes(b"no TDMS file" * 20)
    assert error_of(SourceError, names_of, path).startswith(f"{path}: it cannot be read as TDMS (")
    path = write(tmp_path / "b.tdms", ("A", "speed", SPEED, wave())).rename(tmp_path / "a.csv")
    assert error_of(SourceError, names_of, path) == f"{path}: is no table; it is TDMS; let its name end in .tdms"
