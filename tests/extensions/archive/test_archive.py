"""The archive holds the rows of `nisus fold`, each once, whatever happens to its files and its process."""

import json
import math
import os
import sys
import time
from functools import partial

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from app.cli.main import main
from app.cli.open_twin import live_source
from app.engine.commands import SetTuning
from app.extensions.archive import parts as archives
from app.extensions.archive.parts import parts_of
from app.extensions.archive.writer import archive_of
from app.record.rrd_file import Split, parse_split
from app.twin.twin import load_twin
from tests.app.engine.test_store import Session as StoredSession
from tests.app.scripted import random_walk, readings
from tests.cases import cases

OWN = ["twin", "revision", "row", "archived_ns"]
MIDNIGHT = 1_700_006_400  # s
DAILY = parse_split("day", None)


class Session(StoredSession):
    """A running twin without threads, and its archive."""

    def __init__(self, folder, *, split=DAILY, store=None, **options):
        super().__init__(store, archive=partial(archive_of, folder / "winding", split), **options)
        self.archive = self.running.archive

    def put(self, *batches):
        for batch in batches:
            super().put(batch)
            self.archive.write()
        return self

    def close(self):
        self.archive.write(closing=True)
        return self

    def notices(self):
        return [line.text for line in self.engine.notices.since(0) if line.text.startswith("archive")]


def rows(folder):
    parts = parts_of(folder / "winding")
    return pa.concat_tables([pq.read_table(path) for path in parts])


def same(archived, folded):
    """Compare columns bit for bit, NaN included."""
    assert archived.column_names == folded.column_names
    for name in folded.column_names:
        one, other = (table[name].combine_chunks() for table in (archived, folded))
        assert one.type == other.type
        if pa.types.is_floating(one.type):
            assert one.to_numpy(zero_copy_only=False).tobytes() == other.to_numpy(zero_copy_only=False).tobytes(), name
        else:
            assert one.equals(other), name


def walk(n, begin=MIDNIGHT - 100, seed=1):
    times, values = random_walk(n, seed)
    batch = readings(begin + times, values)
    return batch._replace(arrival=batch.t + 1000)


def test_the_rows_are_those_of_the_fold_of_the_same_log(tmp_path, monkeypatch):
    """A log over two days, with a late row, maintenance, a lost value and a small history; files by day and size."""
    monkeypatch.chdir(tmp_path)
    times = [MIDNIGHT - 3000 + k for k in range(6000)]
    times[1000], times[1001] = times[1001], times[1000]
    cells = ["" if k % 97 == 0 else f"{40 + math.sin(k / 50):.3f}" for k in range(6000)]
    (tmp_path / "log.csv").write_text("t,w\n" + "".join(f"{t},{w}\n" for t, w in zip(times, cells, strict=True)))
    (tmp_path / "winding.yaml").write_text(
        "model: motor_winding\nhistory: 2048\n"
        f"maintenance:\n- {{at: {MIDNIGHT + 7.5}, what: new sensor, states: [temperature]}}\n"
        "source: {type: table, files: log.csv, time: {column: t}, sensors: {winding: {columns: w}}}\n"
    )
    twin = load_twin("winding.yaml")
    session = Session(tmp_path, split=Split(size=1e5, daily=True), twin=twin, source=live_source(twin))
    engine = session.engine
    while engine._feeder.read(0.0) is not None:
        while not engine._inbox.empty():
            engine._round(0.0)
        session.archive.write()
    engine.settle()
    session.close()
    assert main(["fold", "winding.yaml", "--out", "fold.parquet"]) == 0
    archived, folded = rows(tmp_path), pq.read_table("fold.parquet").replace_schema_metadata(None)
    assert set(archived["model_version"].to_pylist()) == {1, 2}
    assert archived["row"].to_pylist() == list(range(len(folded)))
    assert set(archived["twin"].to_pylist()) == {"winding"} and set(archived["revision"].to_pylist()) == {0}
    counted = ["tuning_version"]  # in each process, over all tunings
    same(archived.drop_columns(OWN + counted), folded.drop_columns(counted))
    parts = parts_of(tmp_path / "winding")
    days = [np.unique(pq.read_table(path, columns=["t_ns"])["t_ns"].to_numpy() // archives.DAY_NS) for path in parts]
    assert all(day.size == 1 for day in days) and len(parts) > 2
    assert [path.name[:10] for path in parts] == [str(np.datetime64(int(day[0]), "D")) for day in days]


def test_a_row_is_written_once_no_late_measurement_can_change_it(tmp_path):
    session, batch = Session(tmp_path, split=Split(seconds=0.0)), walk(600)
    late = np.r_[0:300, 301:310, 300, 310:600]
    session.put(*(batch.select(late[k : k + 7]) for k in range(0, 600, 7)))
    whole = Session(tmp_path / "whole").put(batch)
    session.close()
    whole.close()
    written, expected = rows(tmp_path), rows(tmp_path / "whole")
    assert written["row"].to_pylist() == list(range(600))
    other = ["archived_ns", "tuning_version"]
    same(written.drop_columns(other), expected.drop_columns(other))


def test_a_refold_leaves_the_archived_estimates_as_they_were_published(tmp_path):
    session, batch = Session(tmp_path), walk(1500)
    session.put(batch.select(slice(0, 1000)))
    session.engine.submit(SetTuning("R.winding", 100.0))
    session.engine.settle()
    session.put(batch.select(slice(1000, None))).close()
    table = rows(tmp_path)
    assert table["row"].to_pylist() == list(range(1500))
    revision = table["revision"].to_numpy()
    before = int(np.count_nonzero(revision == 0))
    assert 0 < before < 1000 and np.all(revision[before:] == 1)
    assert Session(tmp_path / "b").put(batch).close()
    np.testing.assert_array_equal(
        table["temperature"].to_numpy()[:before], rows(tmp_path / "b")["temperature"].to_numpy()[:before]
    )


def test_a_folder_that_cannot_be_written_is_one_notice_and_loses_nothing(tmp_path, monkeypatch):
    (tmp_path / "winding").write_text("")
    session, batch = Session(tmp_path), walk(1800, MIDNIGHT)
    session.put(*(batch.select(slice(k, k + 300)) for k in range(0, 900, 300)))
    assert session.engine.end() == 900
    assert [text.split(": ")[1][:17] for text in session.notices()] == ["cannot be written"]
    (tmp_path / "winding").unlink()
    session.put(batch.select(slice(900, 1500)))
    free = archives.Disk.free
    monkeypatch.setattr(archives.ParquetPart, "write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    session.put(batch.select(slice(1500, 1700)))
    session.archive.write(closing=True)
    assert list((tmp_path / "winding").glob("*")) == []
    monkeypatch.undo()
    monkeypatch.setattr(archives.Disk, "free", lambda self: -1)
    session.put(batch.select(slice(1700, 1800)))
    monkeypatch.setattr(archives.Disk, "free", free)
    session.close()
    assert rows(tmp_path)["row"].to_pylist() == list(range(1800))
    assert len(session.notices()) == 2 and session.notices()[1].endswith("it is written again")


def test_rows_that_left_the_history_before_they_were_written_are_reported(tmp_path, monkeypatch):
    session, batch = Session(tmp_path), walk(9000)
    for k in range(0, 9000, 500):  # nobody looks meanwhile, as on a disk that hangs
        session.source.put(batch.select(slice(k, k + 500)))
        session.engine.settle()
    first = session.engine._log.first
    session.close()
    assert first > 0 and rows(tmp_path)["row"].to_pylist() == list(range(first, 9000))
    assert session.notices() == [
        f"archive {tmp_path / 'winding'}: {first} rows left the history before they were written"
    ]


def test_a_killed_process_leaves_complete_files_and_its_store_continues_them(tmp_path):
    store, batch, split = tmp_path / "a.store", walk(6000), Split(seconds=0.0)
    session = Session(tmp_path, split=split, store=store).put(
        *(batch.select(slice(k, k + 100)) for k in range(0, 3000, 100))
    )
    session.running.store.write()
    session.archive._part = archives.ParquetPart(tmp_path / "winding")
    session.running.store._store.close()
    session.archive._part._file.close()  # as the end of the process does, and with it the lock
    assert 2000 < len(rows(tmp_path)) < 3000
    again = Session(tmp_path, split=split, store=store).put(
        *(batch.select(slice(k, k + 100)) for k in range(3000, 6000, 100))
    )
    again.close()
    assert list((tmp_path / "winding").glob("*.open")) == []
    written = rows(tmp_path)
    assert written["row"].to_pylist() == list(range(6000))
    np.testing.assert_array_equal(written["t_ns"].to_numpy(), batch.t)
    assert again.notices() == []


def test_two_processes_do_not_write_into_one_folder(tmp_path):
    first, second = Session(tmp_path), Session(tmp_path)
    first.put(walk(10), walk(10, MIDNIGHT + 50))
    second.put(walk(10), walk(10, MIDNIGHT + 50)).close()
    assert "another process writes into it" in second.notices()[0]
    first.close()
    assert len(rows(tmp_path)) == 20


@pytest.mark.parametrize(("keep", "left"), [("100kB", 1), ("30d", 2)])
def test_the_oldest_files_are_removed(tmp_path, keep, left):
    split = parse_split("day", keep)
    folder = tmp_path / "winding"
    folder.mkdir()
    for number, age in ((1, 40), (2, 20)):
        old = folder / f"2023-01-0{number}-00000{number}.parquet"
        old.write_bytes(bytes(90_000))
        os.utime(old, (time.time() - age * 86400,) * 2)
    Session(tmp_path, split=split).put(walk(2000, MIDNIGHT)).close()
    assert len(parts_of(folder)) == left and parts_of(folder)[-1].name.endswith("-000003.parquet")


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive")
    Session(folder).put(walk(3000)).close()
    return folder


def test_query_prints_a_table_json_or_csv(archive, capsys):
    sql = "SELECT twin, verdict, count(*) AS n FROM winding GROUP BY ALL"
    assert main(["query", str(archive), sql]) == 0
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["1", "row"], ["twin", "verdict", "n"], ["winding", "used", "3,000"],
    ]  # fmt: skip
    assert main(["query", str(archive), sql.replace("winding", "archive"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "columns": ["twin", "verdict", "n"], "rows": [["winding", "used", 3000]],
    }  # fmt: skip
    assert main(["query", str(archive), sql, "--csv"]) == 0
    assert capsys.readouterr().out == '"twin","verdict","n"\n"winding","used",3000\n'
    expected = rows(archive)
    assert main(["query", str(archive), "SELECT * FROM winding ORDER BY row", "--csv"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(expected)


@cases(__file__, "queries.csv")
def test_query_only_reads_the_archive(archive, capsys, sql, text):
    assert main(["query", str(archive), sql % archive if "%" in sql else sql]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("nisus: query: ") and text in lines[0]
    assert [path.name for path in archive.iterdir()] == ["winding"]


def test_query_without_an_archive_or_the_package_is_one_line(archive, tmp_path, capsys, monkeypatch):
    assert main(["query", str(tmp_path), "SELECT 1"]) == 2
    assert "there is no archive" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "duckdb", None)
    assert main(["query", str(archive), "SELECT 1"]) == 2
    assert capsys.readouterr().err == "nisus: query needs DuckDB: pip install 'nisus[archive]'\n"
