"""Files that grow, are rotated or appear in a folder: each row is read once, as from the whole file."""

import io
import os
import re
from types import SimpleNamespace

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from app.twin.twin import load_twin
from app.web.running import OpenedTwin, RunningTwin
from estimators.errors import NisusError
from estimators.log import READING, Events, Log
from sources.source import Channel
from sources.tables import follow
from sources.tables.follow import FollowedTable
from sources.tables.table import Table
from sources.tables.times import TimeColumn
from tests.app.scripted import pull_all
from tests.app.twin.written import refusal, twin_of
from tests.cases import cases
from tests.support import as_log, assert_same, error_of, folded, read_all

CHANNEL = Channel(READING, 0, "winding", ("w",))


def followed(folder, said=None, pattern="*.csv"):
    report = (lambda key, text: said.append(text)) if said is not None else (lambda key, text: None)
    return FollowedTable(
        lambda: sorted(folder.glob(pattern)), time=TimeColumn("t"), channels=[CHANNEL], width=1, report=report
    )


def rest(source):
    """All events that can be read at present."""
    source._closing.set()  # do not wait for more
    found, mark = [], -1
    while mark != source.mark:
        mark = source.mark
        found.append(source.read(0.0))
    return Events.concat(found, 1)


def lines(begin, end):
    return "".join(f"{t},{40 + t % 7}\n" for t in range(begin, end))


def times(events):
    return (events.t // 10**9).tolist()


@pytest.mark.parametrize("seed", range(5))
def test_random_pieces_of_bytes_give_the_fold_of_the_whole_file(tmp_path, seed):
    """With a mark of the encoding, two line ends, decimal commas from some row on, blanks, and wrong cells."""
    rng = np.random.default_rng(seed)
    cells = [f"{k / 4:.2f};{40 + rng.normal():.3f}".replace(".", ",") for k in range(1000)]
    for k, text in ((3, "1,0;"), (50, "12,5;wärmer"), (77, ""), (200, "50,0;41,0;3"), (300, ";41"), (301, "75,5;NaN")):
        cells[k] = text
    end = "\r\n" if seed % 2 else "\n"
    data = ("\ufeff" + end.join(["t;w", "0;40", *cells, ""])).encode()
    whole = tmp_path / "whole.csv"
    whole.write_bytes(data)
    said: list[str] = []
    growing = tmp_path / "growing" / "a.csv"
    growing.parent.mkdir()
    source, found, at = followed(growing.parent, said), [], 0
    while at < len(data):
        step = int(rng.integers(1, 200 if seed else 20))
        with growing.open("ab") as file:
            file.write(data[at : at + step])
        at += step
        found.append(rest(source))
    expected = read_all(Table([whole], time=TimeColumn("t"), channels=[CHANNEL], width=1))
    assert_same(Events.concat(found, 1)._replace(arrival=expected.arrival), expected)
    assert any("wärmer" in text for text in said) and any("3 cells" in text for text in said)
    log = Log(1)
    for batch in found:
        log.extend(batch)
    model = load_twin("motor_winding").model
    assert_same(folded("kf", model, log).track, folded("kf", model, as_log(expected)).track)


def test_a_preamble_and_units_are_waited_for_and_then_skipped(tmp_path):
    """In pieces of 3 bytes, again after a restart, and the decimal sign from later rows."""
    text = "Logger;7\nRate;2\nt;w\ns;degC\n" + "".join(f"{k};{40 + k}\n" for k in range(20)) + "20;1,5\n21;2,5\n"
    said: list[str] = []
    source = FollowedTable(
        lambda: [tmp_path / "a.csv"] if (tmp_path / "a.csv").exists() else [],
        time=TimeColumn("t [s]"),
        channels=[Channel(READING, 0, "winding", ("w [degC]",))],
        width=1,
        report=lambda key, one: said.append(one),
    )
    found = []
    for at in range(0, len(text), 3):
        with (tmp_path / "a.csv").open("a") as file:
            file.write(text[at : at + 3])
        found.append(rest(source))
    events = Events.concat(found, 1)
    assert times(events) == [*range(22)] and events.value[:, 0].tolist() == [*range(40, 60), 1.5, 2.5]
    assert [one for one in said if "left out" not in one] == ["a.csv: heading in line 3, units in line 4"]
    again = FollowedTable(
        lambda: [tmp_path / "a.csv"],
        time=TimeColumn("t [s]"),
        channels=[Channel(READING, 0, "winding", ("w [degC]",))],
        width=1,
    )
    again.restore(source.numbers(source.mark))
    assert times(rest(again)) == [*range(22)]


def test_a_half_written_line_waits_for_its_end_and_what_comes_later_has_its_arrival(tmp_path, monkeypatch):
    monkeypatch.setattr(follow, "time", SimpleNamespace(time_ns=lambda: 77))
    path, source = tmp_path / "a.csv", followed(tmp_path)
    path.write_text("t,w\n1,40\n2,4")
    assert times(rest(source)) == [1]
    with path.open("a") as file:
        file.write("1.5\n")
    events = rest(source)
    assert times(events) == [2] and events.value[0, 0] == 41.5 and events.arrival[0] == events.t[0]
    with path.open("a") as file:
        file.write("3,42\n")
    assert rest(source).arrival.tolist() == [77]


def test_rotated_truncated_and_rewritten_files_are_read_once_to_their_end(tmp_path):
    path, source = tmp_path / "a.csv", followed(tmp_path)
    path.write_text("t,w\n" + lines(0, 5))
    assert times(rest(source)) == [*range(5)]
    with path.open("a") as file:
        file.write(lines(5, 8))
    path.rename(tmp_path / "a.csv.1")  # of no pattern
    path.write_text("t,w\n" + lines(8, 10))
    assert times(rest(source)) == [5, 6, 7, 8, 9]
    path.rename(tmp_path / "a-old.csv")  # of the pattern
    path.write_text("t,w\n" + lines(10, 12))
    assert times(rest(source)) == [10, 11]
    path.write_text("t,w\n" + lines(12, 13))  # the same inode, shorter
    assert times(rest(source)) == [12]
    path.write_text("t,w\n" + lines(13, 30))  # and longer
    assert times(rest(source)) == [*range(13, 30)]
    path.unlink()
    assert times(rest(source)) == []


def test_files_of_a_folder_are_read_once_in_the_order_of_their_names(tmp_path):
    said: list[str] = []
    for name, begin in (("b.csv", 10), ("a.csv", 0)):
        (tmp_path / name).write_text("t,w\n" + lines(begin, begin + 3))
    source = followed(tmp_path, said)
    assert times(rest(source)) == [0, 1, 2, 10, 11, 12]
    (tmp_path / "c.tmp").write_text("t,w\n" + lines(20, 23))
    assert times(rest(source)) == []
    (tmp_path / "c.tmp").rename(tmp_path / "c.csv")
    (tmp_path / "bad.csv").write_text("t,v\n1,2\n")
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)) + b"\n")
    os.utime(tmp_path / "a.csv")
    assert times(rest(source)) == [20, 21, 22]
    assert any("bad.csv: there is no column 'w'" in text for text in said)
    assert any("binary.csv:1: it begins with the bytes" in text for text in said)
    assert times(rest(source)) == [] and len(said) == 2


def yaml(more="files: inbox/, follow: true"):
    source = f"{{type: table, {more}, time: {{column: t}}, sensors: {{winding: {{columns: w}}}}}}"
    return f"model: motor_winding\nsource: {source}\n"


def test_a_restart_from_a_store_takes_no_row_twice(tmp_path):
    inbox, store = tmp_path / "inbox", tmp_path / "a.store"
    inbox.mkdir()
    (tmp_path / "a.yaml").write_text(yaml())
    twin = load_twin(tmp_path / "a.yaml")
    assert not twin.plan.recorded

    def begin():
        running = RunningTwin(
            OpenedTwin(twin, lambda report: twin.open_source(report, speed=None), store=store), http_server=None
        )
        assert running.engine.source.live
        return running

    def settle(running):
        # Two reads without an event, as one waits for rows.
        for _ in range(3):
            running.engine.settle()

    (inbox / "a.csv").write_text("t,w\n" + lines(0, 500) + "500,4")
    (inbox / "b.csv").write_text("t,w\n" + lines(500, 600))
    running = begin()
    settle(running)
    assert running.engine.end() == 600
    running.store.write()
    with (inbox / "b.csv").open("a") as file:
        file.write(lines(600, 620))
    settle(running)
    assert running.engine.end() == 620
    running.store._store.close()  # killed before these were stored
    running.engine.stop()
    (inbox / "b.csv").rename(inbox / "b-old.csv")
    (inbox / "b.csv").write_text("t,w\n" + lines(620, 700))
    running = begin()
    settle(running)
    assert (pull_all(running.engine).events.t // 10**9).tolist() == [*range(700)]
    running.stop()


@cases(__file__, "not_followed.csv")
def test_what_cannot_be_followed_is_one_line(tmp_path, monkeypatch, more, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    (tmp_path / "bad.csv").write_text("t,v\n1,2\n")

    assert re.search(text, error_of(NisusError, lambda: twin_of(yaml(more)).plan.check_files()))


def test_parquet_files_are_read_once_they_are_complete(tmp_path):
    """Each once, after a restart in the middle of one from the next row on."""
    whole = [(float(t), 40.0 + t % 7) for t in range(10_000)]

    def written(rows):
        sink = io.BytesIO()
        t, w = zip(*rows, strict=True)
        pyarrow.parquet.write_table(pyarrow.table({"t": t, "w": w}), sink)
        return sink.getvalue()

    first, second = written(whole[:9_000]), written(whole[9_000:])
    (tmp_path / "day1.parquet").write_bytes(first)
    source = followed(tmp_path, pattern="*.parquet")
    source.restore({})
    found = []
    while len(found) < 5_000:
        found += times(source.read(0.1))
    kept = source.numbers(source.mark)
    source.close()
    again = followed(tmp_path, said := [], pattern="*.parquet")
    again.restore(kept)
    while len(found) < 9_000:
        found += times(again.read(0.1))
    (tmp_path / "day2.parquet").write_bytes(second[:-100])
    assert not len(again.read(0.0)) and not said
    (tmp_path / "day2.parquet").write_bytes(second)
    while len(found) < 10_000:
        found += times(again.read(0.1))
    assert not len(again.read(0.0)) and not said
    again.close()
    assert found == [*range(10_000)]


def test_a_merged_source_follows_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    part = "{type: table, files: a.csv, follow: true, time: {column: t}, sensors: {winding: {columns: w}}}"
    assert "have one with follow" in refusal(f"model: motor_winding\nsource: {{type: merged, parts: [{part}]}}\n")
