"""The track over HTTP: the same table as the command line writes, bit for bit, of any run whose track is kept."""

import io
import json

import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from app.cli.arguments import FoldCommand
from app.cli.fold import fold_twin
from app.engine.commands import Load, Maintenance, SetTuning
from app.render import track_file
from tests.app.cli.test_check import ParsedHtml
from tests.app.scripted import pull_all
from tests.app.served import Client
from tests.app.web.page.browsed import running
from tests.waiting import wait_for

TWIN = "motor_joint"
SECONDS = 200.0
OWN = ("arrival_ns", "tuning_version")
"""Of each process: when readings came, and how many tunings it has made."""


def run():
    return running(TWIN, **{"source.duration": str(SECONDS)})


@pytest.fixture(scope="module")
def session():
    """For tests that change nothing: they run in any order."""
    with run() as session:
        yield session


@pytest.fixture
def own():
    """The engine of a test that changes its tuning or model, and its client."""
    with run() as session:
        yield session.engine, Client(session.running.server)


@pytest.fixture(scope="module")
def client(session):
    return Client(session.running.server)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """What `nisus fold` writes of the same twin."""
    folder = tmp_path_factory.mktemp("fold")
    for name in ("track.csv", "track.parquet"):
        fold_twin(FoldCommand(TWIN, set=(f"source.duration={SECONDS}",), out=folder / name))
    return folder


def parquet(answer):
    assert answer.status == 200, answer.text
    return pq.read_table(io.BytesIO(answer.body))


def same(one, other):
    """Whether two tables have the same columns, types and bits."""
    assert one.schema.names == other.schema.names and one.schema.types == other.schema.types
    for name in one.schema.names:
        a, b = (table[name].combine_chunks().to_numpy(zero_copy_only=False) for table in (one, other))
        if a.dtype == object:
            assert a.tolist() == b.tolist(), name
        else:
            assert a.tobytes() == b.tobytes(), name


def edited(engine, key, number):
    engine.submit(SetTuning(key, 0.5))
    wait_for(lambda: engine.status().revision == number)


@pytest.mark.parametrize("piece", [8192, 64])
def test_parquet_is_what_the_command_line_writes(client, written, monkeypatch, piece):
    monkeypatch.setattr(track_file, "PIECE", piece)
    answer = client.get("/api/track.parquet")
    table, expected = parquet(answer), pq.read_table(written / "track.parquet")
    same(table.drop_columns(list(OWN)), expected.drop_columns(list(OWN)))
    assert table.schema.metadata[b"episodes"] == expected.schema.metadata[b"episodes"]
    assert answer.headers["content-disposition"] == 'attachment; filename="motor_joint-run0.parquet"'
    assert answer.headers["content-type"] == "application/vnd.apache.parquet"


def test_csv_is_what_the_command_line_writes(client, written, monkeypatch):
    monkeypatch.setattr(track_file, "PIECE", 64)
    answer = client.get("/api/track.csv")
    lines, expected = answer.body.splitlines(), (written / "track.csv").read_bytes().splitlines()
    assert len(lines) == len(expected) > 500 and lines[0] == expected[0]
    own = [lines[0].split(b",").index(f'"{name}"'.encode()) for name in OWN]
    without = [[cell for k, cell in enumerate(line.split(b",")) if k not in own] for line in (*lines, *expected)]
    assert without[: len(lines)] == without[len(lines) :]
    # Numbers in text are the bits of the estimate.
    found = pyarrow.csv.read_csv(io.BytesIO(answer.body))["winding"].to_numpy()
    assert found.tobytes() == pq.read_table(written / "track.parquet")["winding"].to_numpy().tobytes()


def test_a_span_is_those_rows(client, session):
    table = parquet(client.get("/api/track.parquet?since=5&until=7.5"))
    t = pull_all(session.engine).events.t
    inside = t[(t >= t[0] + 5_000_000_000) & (t <= t[0] + 7_500_000_000)]
    assert table["t_ns"].to_numpy().tolist() == inside.tolist() and inside.size
    assert parquet(client.get("/api/track.parquet?since=1e6")).num_rows == 0


def test_what_cannot_be_is_one_line(client):
    for query in ("run=99", "run=a", "since=nan", "until=x", "since=1e300"):
        answer = client.get(f"/api/track.csv?{query}")
        assert answer.status == 409 and "\n" not in json.loads(answer.text)["error"]
    assert client.raw("GET", "/api/track.csv", [("Host", client.host)]).status == 403
    foreign = [("Host", client.host), ("Cookie", client.cookie), ("Origin", "http://evil.example")]
    assert client.raw("GET", "/api/track.parquet", foreign).status == 403


def test_versions_of_the_model_and_runs_that_are_kept(own, monkeypatch):
    engine, client = own
    first = pull_all(engine)
    engine.submit(Maintenance("bearings", ("magnet", "winding")))
    wait_for(lambda: engine.status().model_version == 2)
    whole = parquet(client.get("/api/track.parquet"))
    versions = whole["model_version"].to_numpy()
    last = np.flatnonzero(np.diff(versions))
    assert versions[0] == 1 and versions[-1] == 2 and last.size == 1
    for piece in range(1, 5):
        monkeypatch.setattr(track_file, "PIECE", piece)
        since = (whole["t_ns"][int(last[0]) - 1].as_py() - int(first.events.t[0])) / 1e9
        part = parquet(client.get(f"/api/track.parquet?since={since - 1e-9}"))
        assert part["model_version"].to_pylist() == versions[-part.num_rows :].tolist()
    monkeypatch.setattr(track_file, "PIECE", 8192)

    before = pull_all(engine)
    edited(engine, "Q.winding", 1)
    same(parquet(client.get("/api/track.parquet?run=0")), whole)
    now = parquet(client.get("/api/track.parquet?run=1"))
    assert np.any(now["winding"].to_numpy()[10:] != whole["winding"].to_numpy()[10:])
    assert now["winding_std"].to_numpy()[500] > before.track.std[500, 0]
    edited(engine, "Q.tooth", 2)
    gone = client.get("/api/track.csv?run=0")
    assert gone.status == 409 and "its track is gone" in gone.text


def test_the_report_of_a_run_is_that_of_the_page(own):
    engine, client = own
    edited(engine, "Q.winding", 1)
    answer = client.get("/api/report.html?run=1")
    page = ParsedHtml(answer.text)
    text = " ".join(page.text)
    assert answer.status == 200 and 'filename="motor_joint-run1.html"' in answer.headers["content-disposition"]
    assert not page.tags & {"link", "img", "iframe"}
    first = engine.twin.tuning.get("Q.winding")
    assert "1: Q.winding" in text and f"Changed: Q.winding {first:.6g} → 0.5." in text
    assert "Runs of the session" in text and "as it began" in text


def test_the_report_names_no_run_that_has_left_the_table(own):
    """A run that is loaded goes on under another number."""
    engine, client = own
    edited(engine, "Q.winding", 1)
    edited(engine, "Q.tooth", 2)
    engine.submit(Load(1))
    wait_for(lambda: engine.status().revision == 3)
    assert [run.number for run in engine.revisions.runs] == [0, 2, 3]
    text = " ".join(ParsedHtml(client.get("/api/report.html").text).text)
    assert text.count("back to an earlier run: Q.tooth 0.5 →") == 2 and "back to run" not in text
