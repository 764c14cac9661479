"""What a command says on standard error: with file and line, and nothing that a terminal would obey."""

import pytest

import app.cli.open_twin
import app.cli.prepare
from app.cli.main import main
from app.engine.compile_queue import CompileQueue
from app.terminal import printable
from tests.app.cli.test_fold import DRIVE, ROWS


@pytest.fixture
def drive(tmp_path):
    (tmp_path / "drive.csv").write_text(ROWS)
    (tmp_path / "drive.yaml").write_text(DRIVE)
    return tmp_path


def said(capsys, *arguments):
    """The complaints of a command; beside them stands at most that it compiled, if that took long."""
    code = main(arguments)
    lines = capsys.readouterr().err.splitlines()
    assert all(line.isprintable() for line in lines)
    lines = [line for line in lines if not line.startswith("compil")]
    assert all(line.startswith("nisus: ") for line in lines)
    assert code == (2 if lines and "stale" not in lines[0] else 0)
    return lines


def test_only_what_is_shown_as_it_is_passes():
    assert printable("Wärme µ ² → ok\nnext") == "Wärme µ ² → ok\nnext"
    assert printable("\x1b[31m\x00\x9b\r\u202e\udcff") == r"\x1b[31m\x00\x9b\r\u202e\udcff"


@pytest.mark.parametrize("way", ["log", "yaml", "name"])
def test_raw_bytes_of_a_file_stay_in_it(drive, way, capsys):
    raw = b"\x1b]0;title\x07\x1b[2J" + bytes(range(256)) * 20
    if way == "log":
        (drive / "raw.csv").write_bytes(raw)
        (line,) = said(capsys, "fold", str(drive / "drive.yaml"), "--log", str(drive / "raw.csv"))
        assert "drive.yaml:2: source: " in line and "raw.csv:1: it begins with the bytes 1b 5d 30 3b" in line
    elif way == "yaml":
        (drive / "drive.csv").write_bytes(raw)
        (line,) = said(capsys, "fold", str(drive / "drive.yaml"))
        assert "drive.csv:1: it begins with the bytes 1b 5d 30 3b" in line
    else:
        (line,) = said(capsys, "fold", str(drive / "drive.yaml"), "--log", "\x1b[2Jraw.csv")
        assert line == r"nisus: --log \x1b[2Jraw.csv: there is no such file; check the path"
    assert len(line) < 600


def test_a_recording_without_rows_is_named_and_so_is_one_that_feeds_nothing(drive, capsys):
    (drive / "drive.csv").write_text(ROWS.splitlines()[0] + "\n")
    (line,) = said(capsys, "fold", str(drive / "drive.yaml"))
    assert "drive.yaml:2: source: " in line and line.endswith("drive.csv: it has a header and no rows; record it again")
    (drive / "mute.csv").write_text("t,y,temperature,rate\n0,,,\n1,,,\n")
    *never, line = said(capsys, "fold", str(drive / "drive.yaml"), "--log", str(drive / "mute.csv"))
    assert never and all("has no value in 2 rows" in item for item in never), never
    assert line == (
        f"nisus: --log {drive / 'mute.csv'}: the source has no values for any sensor; check the channel maps"
    )


def test_a_fault_after_the_end_is_said_to_have_no_effect(drive, capsys):
    late = "faults=[{kind: bias, sensor: winding, start: 4000, size: 1}, {kind: silence, start: 2}]"
    assert main(["fold", str(drive / "drive.yaml"), "--set", late]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "effect" in line]
    # The silence begins with the last row.
    assert said == ["nisus: the bias of winding begins after 4000 s and has no effect: the log ends after 2 s"]


@pytest.mark.parametrize("arguments", [["fold"], ["run", "--headless", "--speed", "inf"]])
def test_times_that_run_backwards_are_said_once(drive, arguments, capsys):
    rows = "".join(f"{60 - k},40,20,0\n" for k in range(60))
    (drive / "drive.csv").write_text("t,y,temperature,rate\n" + rows)
    assert main([arguments[0], str(drive / "drive.yaml"), *arguments[1:]]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "drive.csv" in line]
    assert len(told) == 1 and "drive.csv:5: t is 3 s before that of drive.csv:2; the rows are out of order" in told[0]


@pytest.mark.parametrize("options", [[], ["--headless"]])
def test_files_of_a_source_are_looked_at_before_anything_is_compiled(drive, options, capsys, monkeypatch):
    def too_late(*_):
        raise AssertionError("it went on")

    monkeypatch.setattr(app.cli.open_twin, "begin_to_compile", lambda *_: CompileQueue())
    monkeypatch.setattr(app.cli.open_twin, "compile_for", too_late)
    monkeypatch.setattr(app.cli.prepare, "attend", too_late)
    (drive / "drive.csv").write_text("t,y\n0,1\n")
    (line,) = said(capsys, "run", str(drive / "drive.yaml"), "--no-browser", "--port", "0", *options)
    assert "drive.yaml:" in line and "drive.csv" in line
    (line,) = said(capsys, "run", "motor_can", "--log", str(drive / "drive.yaml"), "--port", "0", *options)
    assert "is not a CAN log format" in line
