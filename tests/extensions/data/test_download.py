"""Downloads that are slow, cut off, wrong or refused: one line, nothing wrong is kept, and the next attempt goes on."""

import errno
import os
import threading
from pathlib import Path

import pytest

from app.engine.jobs import start_in_thread
from app.extensions.data import download
from app.extensions.data.download import PIECE_BYTES, RETRIES, get
from app.extensions.data.sets import recordings, size_text
from app.record.rrd_file import Disk
from app.twin.source import missing
from config.loader import load
from estimators.errors import SourceError
from tests.extensions.data.origin import LABYRINTH, offer, serving, written
from tests.waiting import LIMIT_S, wait_for

NAME, TWIN = "agv_uwb_labyrinth", "uwb_rover_labyrinth"
FIRST, SECOND = LABYRINTH.values()


@pytest.fixture
def offered(monkeypatch, tmp_path, origin):
    """The recording, anew at each call, from a server that has it."""
    return offer(monkeypatch, tmp_path / "here", origin, origin.address, NAME, LABYRINTH)


def ranges(origin):
    """The first bytes that were asked for, of the first file."""
    return [int(begin[6:-1]) for path, begin in origin.asked if path.endswith("Input.txt")]


def test_a_missing_recording_names_the_command_that_gets_it(offered, nisus):
    assert nisus.refuses("fold", TWIN).endswith(f"; to get it: nisus data get {TWIN}")
    nisus("data", "get", TWIN)
    assert missing(load(TWIN)) is None and not offered().lacking


def test_recordings_are_in_the_users_cache(offered, nisus, monkeypatch, tmp_path):
    monkeypatch.delenv("NISUS_DATA")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert missing(load(TWIN)) is not None
    nisus("data", "get", NAME)
    kept = tmp_path / "cache" / "nisus" / "recordings" / NAME
    assert (kept / "truth.csv").read_text().splitlines()[:2] == ["t_s,x_m,y_m", "0.5,1.65,2.21"]
    assert missing(load(TWIN)) is None
    # A folder beside the YAML comes first, and NISUS_DATA before all.
    monkeypatch.setenv("NISUS_DATA", str(tmp_path / "empty"))
    assert missing(load(TWIN)) is not None


def test_a_slow_server_is_waited_for_and_its_progress_is_shown(offered, origin):
    origin.wait = threading.Event()
    over = start_in_thread(lambda: get(offered()), "download")
    arrived, whole = len(FIRST) // 2 // PIECE_BYTES * PIECE_BYTES, len(FIRST) + len(SECOND)
    wait_for(lambda: offered().progress() == f"{arrived / 1e3:.0f} kB of {whole / 1e3:.0f} kB")
    assert not over.done()
    origin.wait.set()
    over.result(LIMIT_S)
    assert not offered().lacking


@pytest.mark.parametrize("knows_ranges", [True, False])
def test_a_download_that_is_cut_off_goes_on(offered, origin, knows_ranges):
    origin.cuts, origin.ranges = [PIECE_BYTES + 100, 2 * PIECE_BYTES + 100], knows_ranges
    get(offered())
    assert ranges(origin) == [0, PIECE_BYTES, (3 if knows_ranges else 2) * PIECE_BYTES]
    assert (offered().folder / "ranges.csv").read_text().count("\n") == 501


def test_a_partial_file_that_is_too_long_begins_again(offered, origin, monkeypatch):
    monkeypatch.setattr(download, "RETRIES", 0)
    written(offered().parts, {"Indoor_UWB_Input.txt.part": FIRST + b"more"})
    get(offered())
    assert ranges(origin) == [0] and not offered().lacking


def test_the_progress_leaves_out_a_file_that_has_gone(offered, monkeypatch):
    written(offered().parts, {"a": b"1" * 3000})

    def gone(path, pattern):
        yield path / "a"
        raise FileNotFoundError(path / "b")

    monkeypatch.setattr(Path, "rglob", gone)
    assert offered().progress().startswith("3 kB of ")


def test_a_server_that_goes_is_one_line_and_the_next_attempt_goes_on(offered, origin, nisus):
    origin.cuts = [PIECE_BYTES] * (1 + RETRIES)
    line = nisus.refuses("data", "get", TWIN)
    assert line.startswith(f"nisus: {offered().files[0].url}: ") and "try again to continue the download" in line
    assert "Connection broken: IncompleteRead" in line and not offered().folder.exists()
    get(offered())
    assert ranges(origin) == [k * PIECE_BYTES for k in range(2 + RETRIES)]


def test_no_server_is_one_line(monkeypatch, tmp_path, origin, nisus):
    with serving() as (gone, address):
        offered = offer(monkeypatch, tmp_path, gone, address, NAME, LABYRINTH)
    line = nisus.refuses("data", "get", TWIN)
    assert line.startswith(f"nisus: {offered().files[0].url}: ") and "Connection refused" in line
    assert "HTTPConnection" not in line


@pytest.mark.parametrize(("status", "reason"), [(404, "404 Client Error: Not Found"), (503, "503 Server Error")])
def test_a_server_that_refuses_is_one_line(offered, origin, nisus, status, reason):
    origin.status = status
    line = nisus.refuses("data", "get", TWIN)
    assert f"{offered().files[0].url}: {reason}" in line
    assert line.endswith(f"or download it by hand: nisus data get {TWIN} --file FILE...")
    assert len(origin.asked) == 1 + RETRIES and not offered().folder.exists()


@pytest.mark.parametrize("other", [FIRST[::-1], FIRST + b"more", FIRST[:-8]])
def test_other_content_is_not_kept(offered, origin, nisus, other):
    (path,) = (path for path in origin.files if path.endswith("Input.txt"))
    wanted = offered()
    origin.files[path] = other
    with pytest.raises(SourceError, match="its SHA-256 is not|ended after") as refused:
        get(wanted)
    assert "\n" not in str(refused.value) and not wanted.folder.exists()
    origin.files[path] = FIRST
    get(wanted)
    assert not wanted.lacking


def test_a_full_disk_is_one_line(offered, origin, nisus, monkeypatch):
    monkeypatch.setattr(Disk, "free", lambda disk: 50_000)
    line = nisus.refuses("data", "get", TWIN)
    size = 2 * sum(map(len, LABYRINTH.values()))
    assert f"has room for 50 kB, and {NAME} takes {size_text(size)}; free some" in line and origin.asked == []


def test_a_disk_that_becomes_full_is_one_line(offered, origin, nisus, monkeypatch):
    replace = os.replace

    def full(source, target):
        if Path(source).suffix == ".csv":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        replace(source, target)

    monkeypatch.setattr(download.os, "replace", full)
    line = nisus.refuses("data", "get", TWIN)
    assert line.endswith("No space left on device; free some space and try again: the download goes on where it ended")
    monkeypatch.setattr(download.os, "replace", replace)
    asked = len(origin.asked)
    get(offered())
    assert len(origin.asked) == asked and not offered().lacking


def test_a_folder_that_cannot_be_written_is_one_line(offered, nisus, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("NISUS_DATA", str(tmp_path / "file"))
    assert "file" in nisus.refuses("data", "get", TWIN)


def test_a_proxy_of_the_environment_is_used(monkeypatch, tmp_path, origin):
    monkeypatch.setenv("http_proxy", origin.address)
    offered = offer(monkeypatch, tmp_path, origin, "http://sources.invalid", NAME, LABYRINTH)
    get(offered())
    assert not offered().lacking and all(path.startswith("/") for path, _ in origin.asked)


def test_existing_files_are_left_alone(offered):
    (own,) = written(offered().folder, {"truth.csv": b"mine"})
    get(offered())
    assert own.read_bytes() == b"mine" and not offered().lacking


def test_files_of_the_user_are_known_by_their_content(offered, origin, nisus, tmp_path):
    first, second = written(tmp_path, {"a.bin": FIRST, "b.bin": SECOND})
    line = nisus.refuses("data", "get", TWIN, "--file", first)
    assert "Indoor_UWB_GT.txt of https://github.com/TUC-ProAut/libRSF is missing or has another SHA-256" in line
    assert "No such file or directory; check the path" in nisus.refuses("data", "get", TWIN, "--file", tmp_path / "c")
    nisus("data", "get", TWIN, "--file", second, first)
    assert not offered().lacking and origin.asked == []


def test_wrong_arguments_are_one_line(nisus, monkeypatch, tmp_path):
    monkeypatch.setenv("NISUS_DATA", str(tmp_path))
    assert "nisus data lists them" in nisus.refuses("data", "get")
    assert "did you mean road_car" in nisus.refuses("data", "get", "roadcar")
    assert "nisus data get NAME" in nisus.refuses("data", "list", "road_car")
    table = nisus("data").out
    assert all(name in table for name in recordings()) and "no" in table
