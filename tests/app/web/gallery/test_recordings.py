"""The folder of recordings: list, receive, review, delete; nothing outside it can be touched."""

import json
import os
import re

import numpy as np
import pytest

from app.cli.main import main
from app.engine.commands import Record
from app.record.reader import facts_of, read_recording
from app.web.gallery.recordings import Recordings
from estimators.errors import ConfigError, SourceError
from estimators.track import USED
from tests.app.scripted import pull_all
from tests.app.web.gallery.opened import opened
from tests.support import error_of
from tests.waiting import wait_for

OUTSIDE = [
    "../private.rrd", "..", ".", "", "/etc/passwd", "a/b.rrd", "a\\b.rrd", ".hidden.rrd", "..\\private.rrd",
    "private.rrd\x00", "link.rrd", "folder.rrd", "C:private.rrd", "no\nname.rrd", "x" * 300 + ".rrd",
    3, None, ["a.rrd"],
]  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    """A folder with a recording that is none, beside a file that is nobody's business."""
    (tmp_path / "private.rrd").write_bytes(b"private")
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "folder.rrd").mkdir()
    (folder / "link.rrd").symlink_to(tmp_path / "private.rrd")
    (folder / "here.rrd").write_bytes(b"RRF2 and so on")
    (folder / "notes.md").write_text("not ours")
    return folder


@pytest.mark.parametrize("name", OUTSIDE, ids=repr)
def test_nothing_outside_the_folder_can_be_touched(folder, name):
    before = {path: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file()}
    recordings = Recordings(folder)
    for act in (recordings.find, recordings.delete, lambda name: recordings.receive(name, 0, b"mine", last=True)):
        if act not in (recordings.find, recordings.delete) and name in ("link.rrd", "folder.rrd"):
            continue  # names that are taken: what is sent gets another one, see below
        error_of(ConfigError, act, name)
    assert {path: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file()} == before


def test_only_recordings_and_logs_are_listed(folder):
    (folder / "drive.MF4").write_bytes(b"")
    (folder / "drive.asc.gz").write_bytes(b"")
    (folder / "console.txt").write_bytes(b"")
    assert {entry["name"]: entry["log"] for entry in Recordings(folder).entries()} == {
        "here.rrd": False, "drive.MF4": True, "drive.asc.gz": True, "console.txt": True,
    }  # fmt: skip
    assert Recordings(folder / "nowhere").entries() == []


def test_what_cannot_be_read_says_so(folder):
    recordings = Recordings(folder)

    def error():
        return next(entry["error"] for entry in recordings.entries() if entry["name"] == "here.rrd")

    assert error() is None
    wait_for(lambda: error() is not None)
    assert error() == "it cannot be read; is it an .rrd file?"
    with pytest.raises(SourceError, match="is it an .rrd file"):
        facts_of(folder / "here.rrd")


def test_a_file_comes_in_pieces_and_never_replaces_another(folder):
    recordings = Recordings(folder)
    data = os.urandom(10_000)
    for name in ("here.rrd", "link.rrd", "folder.rrd"):
        assert recordings.receive(name, 0, data[:4000], last=False) is None
        assert name not in [entry["name"] for entry in recordings.entries() if entry["bytes"] == 4000]
        kept = recordings.receive(name, 4000, data[4000:], last=True)
        assert kept == name.replace(".", "-2.") and (folder / kept).read_bytes() == data
    assert (folder / "here.rrd").read_bytes() == b"RRF2 and so on"
    assert (folder.parent / "private.rrd").read_bytes() == b"private"
    assert recordings.receive("here.rrd", 0, b"third", last=True) == "here-3.rrd"


def test_a_piece_that_is_missing_or_no_log_is_refused(folder):
    recordings = Recordings(folder)
    with pytest.raises(ConfigError):
        recordings.receive("new.csv", 4, b"late", last=True)
    recordings.receive("new.csv", 0, b"t,x\n", last=False)
    with pytest.raises(ConfigError, match="a piece of it is missing"):
        recordings.receive("new.csv", 9, b"late", last=True)
    with pytest.raises(ConfigError, match=r"is neither a recording \(.rrd\), a log \(.* nor a database \(.dbc\)"):
        recordings.receive("new.py", 0, b"import os", last=True)
    # Begun anew, it is whole.
    recordings.receive("new.csv", 0, b"t,x\n", last=False)
    assert recordings.receive("new.csv", 4, b"0,1\n", last=True) == "new.csv"
    assert (folder / "new.csv").read_text() == "t,x\n0,1\n"


def test_a_part_that_is_a_link_is_not_followed(folder):
    (folder / ".new.csv.part").symlink_to(folder.parent / "private.rrd")
    Recordings(folder).receive("new.csv", 0, b"mine", last=True)
    assert (folder.parent / "private.rrd").read_bytes() == b"private" and (folder / "new.csv").read_bytes() == b"mine"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A session that recorded, the folder, and the recorded rows."""
    folder = tmp_path_factory.mktemp("recordings")
    with opened(folder, "motor_winding", speed=1e6) as session:
        engine = session.engine
        wait_for(lambda: engine.status().finished)
        assert session.post("/api/command", {"command": "Record", "path": "run.rrd"})[0] == 202
        wait_for(lambda: engine.status().recording is not None)
        busy = {item["name"]: item for item in session.get("/api/gallery/recordings")["files"]}
        assert busy["run.rrd"]["error"] == "is being recorded"
        assert session.post("/api/gallery/recordings/delete", {"name": "run.rrd"})[0] == 400
        assert session.post("/api/gallery/recordings/open", {"name": "run.rrd"})[0] == 400
        engine.submit(Record(None))
        wait_for(lambda: session.session.recorder.finished)
        yield session, folder, pull_all(engine)


def test_a_recording_is_listed_with_what_it_was_worth(recorded):
    session, folder, rows = recorded

    def entry():
        return next(item for item in session.get("/api/gallery/recordings")["files"] if item["name"] == "run.rrd")

    wait_for(lambda: not entry()["looking"])
    found = entry()
    assert (found["twin"], found["estimator"]) == ("motor_winding", "kf")
    assert found["bytes"] == (folder / "run.rrd").stat().st_size
    assert found["seconds"] == pytest.approx((rows.events.t[-1] - rows.events.t[0]) * 1e-9)
    used = rows.track.verdict == USED
    assert found["summary"]["nis"] == pytest.approx(np.sum(rows.track.nis[used]) / np.sum(used))
    assert found["summary"]["error"]["name"] == "temperature"
    # As the article has it.
    assert found["summary"]["error"]["rmse"] == pytest.approx(1.04, abs=0.005)
    assert session.client.get("/recordings/run.rrd").body == (folder / "run.rrd").read_bytes()


@pytest.mark.parametrize("target", ["..%2fprivate.rrd", "%2e%2e/private.rrd", "nothing.rrd", "%2Fetc%2Fpasswd"])
def test_a_download_stays_within_the_folder(recorded, target):
    session, folder, _ = recorded
    (folder.parent / "private.rrd").write_bytes(b"private")
    answer = session.client.get(f"/recordings/{target}")
    assert answer.status == 404 and b"private" not in answer.body


def drop(session, name, data, **more):
    client = session.client
    query = "&".join(f"{key}={value}" for key, value in {"name": name, "offset": 0, "last": 1, **more}.items())
    kind = ("Content-Type", "application/octet-stream")
    headers = [("Host", client.host), ("Cookie", client.cookie), ("Origin", client.origin), kind]
    answer = client.raw("POST", f"/api/gallery/recordings/drop?{query}", headers, data)
    return answer.status, json.loads(answer.body)


def test_open_review_and_back_and_delete(recorded):
    session, folder, rows = recorded
    status, answer = session.post("/api/gallery/recordings/open", {"name": "run.rrd"})
    assert status == 202 and answer == {"opening": "run.rrd"}
    state = session.settled()
    assert state["failed"] is None and state["running"]["review"] and state["running"]["title"] == "run.rrd"
    wait_for(lambda: session.engine.status().finished)
    # The same bits as live, by the same engine and page.
    np.testing.assert_array_equal(pull_all(session.engine).track.mean, rows.track.mean)
    assert session.get("/api/status")["began_as"] == "recorded"
    # Dropped on a page it opens too, and a damaged one is named.
    data = (folder / "run.rrd").read_bytes()
    for name, content in (("given.rrd", data), ("broken.rrd", data[:100])):
        assert drop(session, name, content) == (200, {"name": name})
        session.post("/api/gallery/recordings/open", {"name": name})
        state = session.settled()
        assert state["running"]["title"] == "given.rrd" and (name in str(state["failed"])) == (name == "broken.rrd")
    assert session.start("motor_winding")["running"]["review"] is False
    assert session.post("/api/gallery/recordings/delete", {"name": "../recordings0/run.rrd"})[0] == 400
    assert session.post("/api/gallery/recordings/delete", {"name": "run.rrd"}) == (200, {"deleted": "run.rrd"})
    assert not (folder / "run.rrd").exists()
    assert session.post("/api/gallery/recordings/open", {"name": "run.rrd"})[0] == 400
    (folder / "run.rrd").write_bytes(data)  # as it was, for the other tests


def test_a_log_that_is_dropped_is_read_by_a_twin(tmp_path):
    yaml = tmp_path / "winding.yaml"
    yaml.write_text(
        "model: motor_winding\nestimator: kf\nsource: {type: table, files: own.csv, time: {column: t}, "
        "sensors: {winding: {columns: [T]}}}\n"
    )
    (tmp_path / "own.csv").write_text("t,T\n0,1\n1,2\n")
    values = [40.0 + 0.25 * k for k in range(12)]
    log = "t,T\n" + "".join(f"{k},{value}\n" for k, value in enumerate(values))
    with opened(tmp_path / "recordings", yaml) as session:
        assert drop(session, "drive.csv", log.encode()) == (200, {"name": "drive.csv"})
        status, answer = session.post("/api/gallery/recordings/open", {"name": "drive.csv"})
        assert status == 400 and "name the twin" in answer["error"]
        assert session.post("/api/gallery/recordings/open", {"name": "drive.csv", "twin": str(yaml)})[0] == 202
        state = session.settled()
        assert state["failed"] is None and state["running"]["title"] == "winding on drive.csv"
        wait_for(lambda: session.engine.status().finished)
        read = pull_all(session.engine).events.value[:, 0]
        np.testing.assert_array_equal(read[np.isfinite(read)], values)
        # Of a twin that cannot read it one learns why, and what runs goes on.
        session.post("/api/gallery/recordings/open", {"name": "drive.csv", "twin": "motor_winding"})
        state = session.settled()
        assert "simulator" in state["failed"]["text"] and state["running"]["title"] == "winding on drive.csv"
        assert drop(session, "evil.py", b"1")[0] == 400 and drop(session, "../up.csv", b"1")[0] == 400
        assert drop(session, "big.csv", b"1", offset="-1")[0] == 400


def test_what_the_session_recorded_elsewhere_is_listed_as_well_and_nothing_else_there(tmp_path):
    """Two recordings outside the folder whose names begin alike, of two twins one after the other."""
    folder, elsewhere = tmp_path / "recordings", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "private.rrd").write_bytes(b"private")

    def files():
        return {item["name"]: item for item in session.get("/api/gallery/recordings")["files"]}

    with opened(folder, "motor_winding", speed=1e6) as session:
        wait_for(lambda: session.engine.status().finished)
        assert files() == {}
        for name in ("run.rrd", "run2.rrd"):
            session.engine.submit(Record(elsewhere / name))
            wait_for(lambda n=name: n in files())
            assert files()[name]["error"] == "is being recorded" and files()[name]["folder"] == str(elsewhere)
        # The first is finished, whatever the second is called.
        wait_for(lambda: files()["run.rrd"]["error"] is None)
        wait_for(lambda: session.get("/api/status")["recording_folder"] == str(elsewhere))
        session.engine.submit(Record(None))
        wait_for(lambda: files()["run2.rrd"]["error"] is None)
        assert session.start("lorenz63")["failed"] is None
        assert set(files()) == {"run.rrd", "run2.rrd"}
        assert session.client.get("/recordings/run.rrd").body == (elsewhere / "run.rrd").read_bytes()
        for name in ("private.rrd", "../elsewhere/private.rrd"):
            assert session.post("/api/gallery/recordings/delete", {"name": name})[0] == 400
        assert session.post("/api/gallery/recordings/open", {"name": "run2.rrd"})[0] == 202
        assert session.settled()["running"]["title"] == "run2.rrd"
        # What is in the folder goes before what has its name elsewhere.
        folder.mkdir(exist_ok=True)
        (folder / "run.rrd").write_bytes(b"RRF2 another")
        assert files()["run.rrd"]["folder"] is None and files()["run.rrd"]["bytes"] == 12
        assert session.post("/api/gallery/recordings/delete", {"name": "run2.rrd"})[0] == 200
        assert sorted(path.name for path in elsewhere.iterdir()) == ["private.rrd", "run.rrd"]


def test_a_file_that_is_no_recording_is_named_as_it_is_and_not_as_its_copy(folder):
    (folder / "bad.rrd").write_bytes(os.urandom(3000))
    text = error_of(SourceError, read_recording, folder / "bad.rrd")
    assert text.startswith(f"{folder / 'bad.rrd'}: cannot be read (") and "file at bad.rrd: " in text
    assert text.count("/") == str(folder / "bad.rrd").count("/")


def test_what_a_fold_wrote_is_listed_with_the_same_scores_as_it_printed(tmp_path, capsys):
    assert main(["fold", "motor_winding", "--out", str(tmp_path / "folded.rrd")]) == 0
    printed = capsys.readouterr().out
    facts = facts_of(tmp_path / "folded.rrd")
    assert (facts.twin, facts.estimator) == ("motor_winding", "kf")
    nis, decimals, where = re.search(r"mean NIS\s+(\d+\.(\d+))\s+(.*); \d+ readings", printed).groups()
    assert float(nis) == pytest.approx(facts.summary["nis"], abs=0.5 * 10.0 ** -len(decimals))
    assert facts.summary["nis_words"] == f"mean NIS {nis} {where}"
    rmse, band = re.search(r"RMSE temperature\s+([\d.]+) °C\s+in the 95 % band: ([\d.]+) %", printed).groups()
    assert float(rmse) == pytest.approx(facts.summary["error"]["rmse"], rel=1e-4)
    assert float(band) == pytest.approx(100 * facts.summary["error"]["coverage"], abs=0.05)
