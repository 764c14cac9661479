"""The archive of a fleet has each measurement once, and the fold of an asset's rows is the fleet's estimate."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from app.extensions.archive.parts import ArchivePlan, parts_of
from app.extensions.fleet import archive as archives
from app.extensions.fleet import running as live
from app.extensions.fleet.archive import AssetHistory, FleetArchive
from app.extensions.fleet.plan import load_fleet
from app.extensions.fleet.running import RunningFleet
from app.record.rrd_file import Split, parse_split
from app.twin.twin import load_twin
from app.web.readings import messages_of
from estimators.log import Log
from tests.extensions.fleet.written_archive import BEGIN, SECOND, SPLIT, Written

DAY_S = 86_400
MODEL = load_twin("motor_can").model


def started(folder, *, store=None, split=SPLIT):
    """A fleet of pushed messages whose archive is written by the test."""
    folder.mkdir(exist_ok=True)
    path = folder / "drives.yaml"
    path.write_text(json.dumps({"twin": "motor_can", "source": {"type": "push"}}))
    plan = ArchivePlan(folder / "archive" / "drives", split)
    fleet = RunningFleet(load_fleet(path), lambda *_: None, threads=1, store=store)
    fleet.archive = FleetArchive(plan, fleet.twin.model, fleet.names, fleet.note, fleet.archived)
    return fleet, messages_of(fleet)


def messages(seed=1, assets=7, count=60):
    """Measurements and inputs of several assets, some missing, some a little late."""
    rng = np.random.default_rng(seed)
    rows = [sensor.name for sensor in MODEL.sensors]
    found = []
    for k in range(count):
        for a in range(assets):
            values = {name: float(rng.normal()) for name in rows}
            if rng.random() < 0.1:
                values[rows[0]] = None  # missing
            if rng.random() < 0.3:
                values |= {name: float(rng.random()) for name in MODEL.input_names}
            found.append({"time": BEGIN + k * SECOND // 10, "asset": f"drive {a}", "values": values})
    for k in rng.choice(len(found) - assets, len(found) // 14, replace=False):  # late by one tick
        found[k], found[k + assets] = found[k + assets], found[k]
    return found


def folded(fleet, asset, archive, tmp_path):
    """The last row of the fold over the archived rows of an asset, read as its page does."""
    (folder := tmp_path / asset).mkdir()
    rows = AssetHistory(archive, asset).read(10**6)
    pq.write_table(rows, folder / "0.parquet")
    twin = load_twin("motor_can", overrides=fleet.plan.archived(asset, folder))
    source, log = twin.open_source(lambda *_: None), Log.of(twin.model)
    while log.n < rows.num_rows:
        log.extend(source.read(1.0))
    source.close()
    expected = np.isin(np.arange(len(twin.model.sensors)), fleet.plan.source.fed)
    fold = twin.fold(log, policy=twin.policy, expected=expected)
    fold.advance()
    return fold.track.select(fold.n - 1)


@pytest.mark.parametrize("closing", [False, True], ids=["journal", "complete"])
def test_the_fold_of_archived_rows_has_the_bits_of_the_fleet(closing, tmp_path):
    fleet, source = started(tmp_path)
    for part in np.array_split(np.array(messages(), object), 9):
        assert {item.status for item in source.send(part.tolist())} == {"accepted"}
        fleet.step()
        fleet.archive.write()
    _, names, table = fleet.table()
    fleet.archive.write(closing=closing)
    archive = tmp_path / "archive" / "drives"
    assert bool(parts_of(archive)) == closing and table.stale.sum() == 0
    for k, asset in enumerate(names):
        last = folded(fleet, asset, archive, tmp_path)
        assert last.mean.tobytes() == table.mean[k].tobytes() and last.std.tobytes() == table.std[k].tobytes()
        assert (last.health, last.verdict) == (table.health[k], table.verdict[k])
        assert last.nis_mean.tobytes() == table.nis_mean[k].tobytes()
    fleet.stop()


@pytest.mark.parametrize("killed", ["before the transaction", "after", "and completed", "and a journal of none"])
def test_rows_of_a_store_are_archived_once_whenever_it_is_killed(killed, tmp_path, monkeypatch):
    """Neither lost, as those of the last second, nor twice, as those whose messages come again."""
    store, sent, folder = tmp_path / "drives.store", messages(count=24), tmp_path / "archive" / "drives"
    monkeypatch.setattr(live, "STORE_PERIOD_S", 1e9)

    def kill(fleet):
        if fleet.archive._journal is not None:
            fleet.archive._journal._file.close()  # as the end of the process does
        fleet.file.close()

    def steps(fleet, source, parts):
        for part in parts:
            fleet._due = 0.0
            source.send(part)
            fleet.step()

    parts = [part.tolist() for part in np.array_split(np.array(sent, object), 6)]
    fleet, source = started(tmp_path, store=store)
    steps(fleet, source, parts[:3])
    if killed == "and completed":
        fleet.archive.write(closing=True)
    if killed != "before the transaction":
        kill(fleet)
    if killed == "and a journal of none":
        other, its = started(tmp_path)
        steps(other, its, [parts[5]])
        other.archive.write()
        other.archive._journal._file.close()
    if killed == "before the transaction":
        monkeypatch.setattr(fleet.file, "write_blocks", lambda blocks: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            steps(fleet, source, parts[3:4])
        kill(fleet)
    again, source = started(tmp_path, store=store)
    steps(again, source, parts[3:5] if killed == "and a journal of none" else parts[3:])
    again.archive.write()
    kill(again)
    last, source = started(tmp_path, store=store)
    last.archive.write(closing=True)
    found = pa.concat_tables([pq.read_table(path) for path in parts_of(folder)])
    rows = ["asset", "t_ns", "event", "channel"]
    assert found.select(rows).group_by(rows).aggregate([]).num_rows == found.num_rows
    whole, source = started(tmp_path / "whole")
    steps(whole, source, parts)
    assert found.num_rows == whole.table()[2].events.sum()
    assert sum(AssetHistory(folder, f"drive {a}").read(10**6).num_rows for a in range(7)) == found.num_rows
    for each in (last, whole):
        each.stop()


def test_rows_of_a_store_wait_while_the_archive_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(live, "STORE_PERIOD_S", 0.0)
    monkeypatch.setattr(live, "STORE_SHARE", 1e9)
    (tmp_path / "archive").mkdir()
    (tmp_path / "archive" / "drives").write_text("")
    fleet, source = started(tmp_path, store=tmp_path / "drives.store")
    for part in np.array_split(np.array(messages(count=6), object), 3):
        source.send(part.tolist())
        fleet.step()
    assert fleet.counts["archive"] == 1 and fleet.has(source.accepted)
    (tmp_path / "archive" / "drives").unlink()
    source.send(messages(seed=2, assets=1, count=1))
    fleet.step()
    fleet.archive.write(closing=True)
    found = [pq.read_table(path).num_rows for path in parts_of(tmp_path / "archive" / "drives")]
    assert len(found) == 2 and sum(found) == sum(
        column.sum() for column in (fleet.table()[2].events, fleet.table()[2].stale)
    )
    fleet.stop()


def test_files_end_with_the_day_and_with_their_size(tmp_path):
    daily = Written(tmp_path / "a", parse_split("day", None)).put(DAY_S - 10).put(DAY_S)
    assert [path.name for path in parts_of(daily.folder)] == ["2026-01-01-000001.parquet"]
    assert daily.values() == [*map(float, range(DAY_S - 10, DAY_S + 10))]
    endless = Written(tmp_path / "d", Split()).put(DAY_S - 10).put(DAY_S)
    assert parts_of(endless.folder) == [] and len(endless.values()) == 20
    small = Written(tmp_path / "b", Split(size=100.0)).put(0).put(10)
    assert len(parts_of(small.folder)) == 2 and not [*small.folder.glob("*.arrows")]
    kept = Written(tmp_path / "c", Split(size=100.0, kept_bytes=1.0)).put(0).put(10)
    assert kept.values() == [*map(float, range(10, 20))]


def test_the_rows_of_an_asset_are_in_one_or_two_groups_of_a_file_and_old_files_are_left(tmp_path, monkeypatch):
    monkeypatch.setattr("app.extensions.archive.parts.GROUP_ROWS", 100)
    written = Written(tmp_path, Split(size=30_000.0))
    for k in range(0, 3000, 500):
        written.put(k, 500)
    written.archive.write(closing=True)
    parts = parts_of(written.folder)
    assert len(parts) >= 2
    read = []
    groups = pq.ParquetFile.read_row_groups
    monkeypatch.setattr(pq.ParquetFile, "read_row_groups", lambda file, k: read.append(len(k)) or groups(file, k))
    found = AssetHistory(written.folder, "pump 2").read(10**6)["value_0"].to_pylist()
    assert found == [*map(float, range(2, 3000, 5))]
    assert len(read) == len(parts) and sum(read) < sum(pq.ParquetFile(path).num_row_groups for path in parts) / 2
    last = AssetHistory(written.folder, "pump 2").read(1)["value_0"].to_pylist()
    assert last == found[-len(last) :] and len(last) < len(found)
    assert AssetHistory(written.folder, "pump 9").read(10**6) is None


def test_each_row_of_an_asset_is_read_once_while_files_are_completed(tmp_path):
    rng, written = np.random.default_rng(5), Written(tmp_path, Split())
    history, found, files = AssetHistory(written.folder, "pump 2"), [], set()
    for k in range(0, 600, 10):
        written.put(k)
        if rng.random() < 0.2:
            written.archive.write(closing=True)
        if rng.random() < 0.5 and (rows := history.read(10**6)) is not None:
            found += rows["value_0"].to_pylist()
        files.add(len(parts_of(written.folder)))
    found += written.put(600) and history.read(10**6)["value_0"].to_pylist()
    assert history.read(10**6) is None and len(files) > 5
    assert found == [*map(float, range(2, 610, 5))]


def test_the_page_of_an_asset_has_no_outputs_of_the_twin(tmp_path):
    own = load_twin("motor_winding").loaded.text + "\noutputs: {mqtt: {host: broker}}\n"
    (tmp_path / "own.yaml").write_text(own)
    (tmp_path / "pumps.yaml").write_text("{twin: own.yaml, source: {type: push}}")
    plan = load_fleet(tmp_path / "pumps.yaml")
    assert plan.twin.config.outputs.mqtt is not None
    page = load_twin(plan.twin.path, overrides=plan.archived("a", tmp_path)).config
    assert page.outputs.mqtt is None and page.view.window == 60.0


@pytest.mark.parametrize(("span", "window"), [(60.0, 60.0), (61.0, 300.0), (7e4, 86_400.0), (1e9, 86_400.0)])
def test_the_page_of_an_asset_begins_with_its_history(span, window, tmp_path):
    (tmp_path / "pumps.yaml").write_text("{twin: motor_winding, source: {type: push}}")
    overrides = load_fleet(tmp_path / "pumps.yaml").archived("a", tmp_path, span)
    assert load_twin("motor_winding", overrides=overrides).config.view.window == window


def test_a_folder_that_cannot_be_written_is_one_report_and_loses_nothing(tmp_path, monkeypatch):
    (tmp_path / "pumps").write_text("")
    written = Written(tmp_path).put(0).put(10)
    assert len(written.said) == 1 and written.said[0].startswith(f"archive {tmp_path / 'pumps'}: cannot be written")
    (tmp_path / "pumps").unlink()
    written.put(20)
    flush = archives.Journal.write

    def full(journal, table):
        journal._file.write(b"half of a batch")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archives.Journal, "write", full)
    written.put(30)
    monkeypatch.setattr(archives.Journal, "write", flush)
    written.put(40).archive.write(closing=True)
    assert written.values() == [*map(float, range(50))]
    assert len(written.said) == 2 and "No space left on device" in written.said[1]


def test_rows_beyond_those_that_may_wait_are_dropped_and_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "MAX_WAITING", 25)
    (tmp_path / "pumps").write_text("")
    written = Written(tmp_path).put(0).put(10).put(20)
    (tmp_path / "pumps").unlink()
    written.archive.write()
    assert written.said[1:] == [f"archive {written.folder}: 10 rows were dropped; the disk is too slow"]
    assert written.values() == [*map(float, range(20))]


def test_rows_whose_write_fails_late_are_archived_once(tmp_path, monkeypatch):
    """A disk may refuse at `fsync` what it took, or take at `close` what it refused."""
    monkeypatch.setattr(live, "STORE_PERIOD_S", 0.0)
    monkeypatch.setattr(live, "STORE_SHARE", 1e9)
    fleet, source = started(tmp_path, store=tmp_path / "drives.store")
    synced = archives.os.fsync

    def full(file):
        raise OSError(28, "No space left on device")

    for k, part in enumerate(np.array_split(np.array(messages(count=8), object), 4)):
        monkeypatch.setattr(archives.os, "fsync", full if k in (0, 2) else synced)
        source.send(part.tolist())
        fleet.step()
    fleet.archive.write(closing=True)
    assert fleet.counts["archive"] == 1
    table = fleet.table()[2]
    found = [pq.read_table(path).num_rows for path in parts_of(tmp_path / "archive" / "drives")]
    assert sum(found) == table.events.sum() + table.stale.sum()
    fleet.stop()


def test_a_journal_in_a_folder_that_was_emptied_is_cut_as_in_the_old_one(tmp_path, monkeypatch):
    """Its number is not among those of the journals that the store has whole."""
    monkeypatch.setattr(live, "STORE_PERIOD_S", 0.0)
    store, folder, sent = tmp_path / "drives.store", tmp_path / "archive" / "drives", messages(count=8)
    monkeypatch.setattr(live, "STORE_SHARE", 1e9)
    fleet, source = started(tmp_path, store=store)
    for part in (sent[:14], sent[14:28]):
        source.send(part)
        fleet.step()
        fleet.archive.write(closing=True)
    for path in folder.iterdir():
        path.unlink()
    monkeypatch.setattr(fleet.file, "write_blocks", lambda blocks: 1 / 0)
    source.send(sent[28:])
    with pytest.raises(ZeroDivisionError):
        fleet.step()
    fleet.archive._journal._file.close()  # as the end of the process does
    fleet.file.close()
    again, source = started(tmp_path, store=store)
    source.send(sent[28:])
    again.step()
    again.archive.write(closing=True)
    found = pa.concat_tables([pq.read_table(path) for path in parts_of(folder)])
    found = found.select(["asset", "t_ns", "event", "channel"])
    assert found.num_rows and found.group_by(found.column_names).aggregate([]).num_rows == found.num_rows
    again.stop()
