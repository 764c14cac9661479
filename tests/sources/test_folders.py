"""Folders and ZIP archives as recordings: all files of the one format in them, by name."""

import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest

from app.cli.main import main
from app.study.log_overview import overview
from estimators.errors import SourceError
from estimators.log import READING
from sources.formats import files_of, is_recording
from sources.inspect import inspect_recordings
from sources.source import Channel
from sources.tables.table import Table
from sources.tables.times import TimeColumn
from tests.app.twin.written import twin_of
from tests.sources.can.can_tools import Reports
from tests.support import error_of, read_all

DAYS = {f"2024-03-0{day}.csv": range(100 * day, 100 * day + 50) for day in (2, 1, 3)}


def text(seconds):
    return "t,w\n" + "".join(f"{t},{40 + t % 7}\n" for t in seconds)


@pytest.fixture(params=["folder", "zip"])
def days(tmp_path, request):
    """Three daily files, which were written in another order, and files that are no recordings."""
    others = {"README.txt": "x", ".hidden.csv": "x", "car.dbc": "x", "__MACOSX/._a.csv": "x"}
    content = {name: text(seconds) for name, seconds in DAYS.items()} | others
    if request.param == "zip":
        with zipfile.ZipFile(tmp_path / "days.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, one in content.items():
                archive.writestr(name, one)
        return tmp_path / "days.zip"
    for name, one in content.items():
        (tmp_path / "days" / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / "days" / name).write_text(one)
    return tmp_path / "days"


def table(files, report=None):
    channels = [Channel(READING, 0, "w", ("w",))]
    return Table(files, time=TimeColumn("t"), channels=channels, width=1, report=report or Reports())


def test_a_folder_is_its_files_by_name(days, monkeypatch):
    files = files_of(days)
    assert [file.name for file in files] == sorted(DAYS)
    expected = [t for name in sorted(DAYS) for t in DAYS[name]]
    events = read_all(table(files))
    assert (events.t // 10**9).tolist() == expected
    assert events.value[:, 0].tolist() == [40 + t % 7 for t in expected]
    assert inspect_recordings(files).t.size == 150
    monkeypatch.chdir(days.parent)
    given = f"model: motor_winding\nsource: {{type: table, files: {days.name}, time: {{column: t}}, "
    twin = twin_of(given + "sensors: {winding: {columns: w}}}\n")
    assert (read_all(twin.open_source(Reports(), live=False)).t // 10**9).tolist() == expected
    one = f"{days.name}/2024-03-02.csv"
    twin = twin_of(given.replace(days.name, one) + "sensors: {winding: {columns: w}}}\n")
    assert read_all(twin.open_source(Reports(), live=False)).t.size == 50


def test_a_folder_is_named_on_the_command_line(days, monkeypatch, capsys):
    monkeypatch.chdir(days.parent)
    assert main(["log", days.name]) == 0
    assert "2024-03-01.csv and 2 more: 150 rows" in capsys.readouterr().out


def test_an_archive_that_is_dropped_on_the_page_is_its_files(days):
    *_, last = overview(days, None, [], None)
    assert [(one.name, one.number) for one in last.signals] == [("w", 150)] and last.time == "t"


def test_what_is_no_one_recording_is_refused_with_a_choice(tmp_path):
    assert error_of(SourceError, files_of, tmp_path).startswith(
        f"{tmp_path}: holds no recording; name a file that ends"
    )
    (tmp_path / "a.csv").write_text(text(range(3)))
    (tmp_path / "b.npz").write_text("x")
    several = "holds recordings of several formats (.csv, .npz); name some: "
    assert error_of(SourceError, files_of, tmp_path) == f"{tmp_path}: {several}{tmp_path}/*.csv"
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        archive.writestr("b.npz", "x")
        archive.writestr("a.csv", "x")
    assert error_of(SourceError, files_of, tmp_path / "c.zip") == f"{tmp_path}/c.zip: {several}{tmp_path}/c.zip/a.csv"
    (tmp_path / "d.zip").write_bytes(b"PK\x03\x04 and no more")
    assert "d.zip: it cannot be read as ZIP (File is not a zip file)" in error_of(
        SourceError, files_of, tmp_path / "d.zip"
    )
    missing = error_of(SourceError, inspect_recordings, [tmp_path / "c.zip" / "z.csv"])
    assert missing == f"{tmp_path}/c.zip/z.csv: there is no such file; check the path of the recording"


def test_a_damaged_member_gives_its_rows_and_says_so(tmp_path):
    path = tmp_path / "a.zip"
    rows = "t,x\n" + "".join(f"{k},{np.sin(k)!r}\n" for k in range(20_000)).replace("x", "w")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.csv", rows.replace("t,x", "t,w", 1))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    reports = Reports()
    count = read_all(table(files_of(path), reports)).t.size
    assert 1000 < count < 20_000 and reports.counts["truncated file"] == 1


def test_formats_in_an_archive_are_those_outside(tmp_path):
    t, w = np.arange(50.0), np.sin(np.arange(50.0))
    np.savez(tmp_path / "a.npz", t=t, w=w)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.write(tmp_path / "a.npz", "a.npz")
    np.testing.assert_array_equal(read_all(table(files_of(tmp_path / "a.zip"))).value[:, 0], w)
    assert is_recording("a.zip")


@pytest.mark.parametrize("kind", ["feather", "stream", "gz"])
def test_arrow_files_and_streams_are_read(tmp_path, kind):
    """Null is blank, and text a number."""
    n = 10_000
    columns = {"t": np.arange(n), "w": [None if k == 7 else f"{k / 8}" for k in range(n)], "other": ["x"] * n}
    data, path = pa.table(columns), tmp_path / "a.feather"
    if kind == "stream":
        path = tmp_path / "a.arrow"
        with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, data.schema) as writer:
            writer.write_table(data, max_chunksize=3000)
    else:
        pyarrow.feather.write_feather(data, str(path), version=2)
    if kind == "gz":
        packed = tmp_path / "a.feather.gz"
        with pa.CompressedOutputStream(str(packed), "gzip") as file:
            file.write(path.read_bytes())
        path = packed
    events = read_all(table([path]))
    kept = [k for k in range(n) if k != 7]
    assert (events.t // 10**9).tolist() == kept and events.value[:, 0].tolist() == [k / 8 for k in kept]
    path.write_bytes(path.read_bytes()[:2000])
    text = error_of(SourceError, lambda: read_all(table([path])))
    assert text.startswith(f"{path}: it cannot be read as Arrow")


def test_a_copy_of_a_file_under_another_name_is_refused(days):
    if days.suffix == ".zip":
        return
    (days / "2024-03-04.csv").write_text((days / "2024-03-02.csv").read_text())
    said = f"{days / '2024-03-04.csv'}: has the same content as {days / '2024-03-02.csv'}; leave one out"
    assert error_of(SourceError, inspect_recordings, files_of(days)) == said
    (days / "2024-03-04.csv").write_text((days / "2024-03-02.csv").read_text().replace("46", "45"))
    assert inspect_recordings(files_of(days)).t.size == 200
