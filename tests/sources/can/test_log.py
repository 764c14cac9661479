"""Logs: written with python-can and read back equal, in every format; recordings; files that are damaged."""

import gzip
import re
import shutil
import sys
import threading
import zipfile

import can
import cantools
import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import READING, Events
from sources.can import log_writer
from sources.can.decoder import Decoder
from sources.can.log import CanLog
from sources.source import Channel, Condition
from sources.units import to_ns
from tests.sources.can.can_tools import Reports, dbc, decoded, decoding, frame, same, sensor
from tests.support import error_of, read_all
from tests.waiting import LIMIT_S

FORMATS = [".asc", ".blf", ".csv", ".db", ".log", ".mf4", ".trc"]
START = 1_700_000_000


@pytest.fixture
def messages():
    """A thousand frames at microseconds, some that nobody wants, and one error frame."""
    rng, out = np.random.default_rng(3), []
    for k in range(1000):
        t = START + k // 100 + (k % 100) * 0.01 + 0.000123
        wanted = k % 3 != 2
        out.append(frame(256 if wanted else 300, rng.bytes(8), t=round(t, 6), bus=0))
        out[-1].is_rx = True
    return out


def write(path, messages):
    # python-can's SQLite writer appends, and loses what is beyond 500 frames when it is stopped.
    size = 400 if path.suffix == ".db" else len(messages)
    for start in range(0, len(messages), size):
        with log_writer(path) as logger:
            for message in messages[start : start + size]:
                logger(message)


def decoder_of(tmp_path, report=lambda key, text: None):
    return decoding(tmp_path, [sensor(0, "ENGINE", "Temp", "Rpm", "Torque")], width=3, report=report)


def read(path, decoder):
    reports = Reports()
    got = read_all(CanLog([path], decoder, report=reports))
    return got, reports


@pytest.mark.parametrize("suffix", FORMATS)
def test_written_and_read_equal(tmp_path, messages, suffix):
    path = tmp_path / f"drive{suffix}"
    write(path, messages)
    reports = Reports()
    decoder = decoder_of(tmp_path, reports)
    log = CanLog([path], decoder, report=reports)
    got = read_all(log)
    expected = decoded(decoder, messages)
    np.testing.assert_array_equal(got.value, expected.value)
    assert log.frames == 1000 and not reports.counts
    # ASC and TRC tell times from the start of the log, and TRC in tenths of a millisecond; a double in days holds
    # less than a microsecond there.
    tolerance = {".trc": 200_000, ".asc": 1000, ".blf": 500, ".mf4": 500}.get(suffix, 0)
    shift = got.t[0] - expected.t[0] if suffix in (".asc", ".trc") else 0
    assert np.abs(got.t - expected.t - shift).max() <= tolerance
    assert np.array_equal(got.arrival, got.t)


def test_mf4_equals_python_cans_reader(tmp_path, data):
    path = data("can_css_imu100_obd2", "session_00000164", "00000005-60FEB5A8.MF4")
    decoder = css_decoder(data, Reports())
    expected = decoded(decoder, list(can.LogReader(path)))
    got = read_all(CanLog([path], decoder))
    np.testing.assert_array_equal(got.value, expected.value)
    assert np.array_equal(got.channel, expected.channel)
    assert np.abs(got.t - expected.t).max() <= 1000  # the reader's seconds are floats


def test_files_follow_one_another_and_chunks_do_not_matter(tmp_path, messages):
    parts = [tmp_path / "a.blf", tmp_path / "b.log.gz", tmp_path / "c.mf4"]
    write(parts[0], messages[:400])
    write(tmp_path / "b.log", messages[400:401])
    with (tmp_path / "b.log").open("rb") as plain, gzip.open(parts[1], "wb") as packed:
        shutil.copyfileobj(plain, packed)
    write(parts[2], messages[401:])
    decoder = decoder_of(tmp_path)
    got = read_all(CanLog(parts, decoder))
    np.testing.assert_array_equal(got.value, decoded(decoder, messages).value)
    one_by_one = [decoded(decoder, [message]) for message in messages]
    assert same(Events.concat(one_by_one, 3), decoded(decoder, messages))


def test_a_cut_file_gives_what_is_there_and_says_so(tmp_path, messages):
    whole = {}
    for suffix in (".blf", ".asc", ".log", ".csv", ".trc"):
        path, cut = tmp_path / f"whole{suffix}", tmp_path / f"cut{suffix}"
        write(path, messages)
        content = path.read_bytes()
        cut.write_bytes(content[: int(len(content) * 0.7) - 7])
        reports = Reports()
        log = CanLog([cut], decoder_of(tmp_path), report=reports)
        got = read_all(log)
        whole = read_all(CanLog([path], decoder_of(tmp_path)))
        n = len(got) - 1  # the last frame may have lost bytes
        assert 300 < n < 600, suffix
        np.testing.assert_array_equal(got.value[:n], whole.value[:n])
        assert reports.counts["truncated file"] == 1, suffix
        assert f"cut{suffix}: " in reports.texts["truncated file"], suffix
        assert f"{log.frames} frames were read" in reports.texts["truncated file"], suffix


def test_a_trc_without_a_line_end_is_complete_if_its_last_byte_is(tmp_path, messages):
    write(tmp_path / "a.trc", messages)
    content = (tmp_path / "a.trc").read_text().rstrip()
    for cut, faults in ((0, 0), (1, 1), (3, 1)):
        (tmp_path / "b.trc").write_text(content[: len(content) - cut])
        got, reports = read(tmp_path / "b.trc", decoder_of(tmp_path))
        assert reports.counts["truncated file"] == faults, reports.texts
    assert len(got)


def test_a_text_log_whose_archive_is_cut_says_so(tmp_path, messages):
    write(tmp_path / "a.log", messages * 9)
    content = gzip.compress((tmp_path / "a.log").read_bytes())
    (tmp_path / "a.log.gz").write_bytes(content[: int(len(content) * 0.7)])
    text = read(tmp_path / "a.log.gz", decoder_of(tmp_path))[1].texts["truncated file"]
    told = r"Compressed file ended before the end-of-stream marker was reached after frame (\d+)"
    assert re.fullmatch(rf"a.log.gz: the file is damaged \({told}\); \1 frames were read", text)


def test_a_cut_database_and_archive_say_so(tmp_path, messages):
    write(tmp_path / "a.log", messages)
    with (tmp_path / "a.log").open("rb") as plain, gzip.open(tmp_path / "b.log.gz", "wb") as packed:
        shutil.copyfileobj(plain, packed)
    write(tmp_path / "a.db", messages * 10)
    for source, cut in (("b.log.gz", "c.log.gz"), ("a.db", "c.db")):
        content = (tmp_path / source).read_bytes()
        (tmp_path / cut).write_bytes(content[: int(len(content) * 0.7)])
        try:
            assert read(tmp_path / cut, decoder_of(tmp_path))[1].counts["truncated file"] == 1
        except SourceError as error:
            assert str(tmp_path / cut) in str(error) and "\n" not in str(error)
    (tmp_path / "d.db").write_bytes(content[:20480] + bytes(4096) + content[24576:])
    told = str(read(tmp_path / "d.db", decoder_of(tmp_path))[1].texts)
    assert re.search(r"d.db: the file is damaged \(.* malformed after frame (\d{3})\); \1 frames were read", told)


def test_a_database_whose_last_page_is_cut_says_so(tmp_path, messages):
    """SQLite itself reads on: what is missing of a page counts as zeros."""
    write(tmp_path / "a.db", messages[:40])
    whole = (tmp_path / "a.db").read_bytes()
    _, reports = read(tmp_path / "a.db", decoder_of(tmp_path))
    assert reports.counts["truncated file"] == 0
    texts = []
    for size in range(4500, len(whole), 300):
        (tmp_path / "c.db").write_bytes(whole[:size])
        reports = Reports()
        log = CanLog([tmp_path / "c.db"], decoder_of(tmp_path), report=reports)
        while log.read(0.0) is not None:
            pass
        assert reports.counts["truncated file"] == 1, size
        texts.append(reports.texts["truncated file"])
    assert any(f"of {len(whole)} bytes are there" in text for text in texts), "SQLite saw nothing wrong itself"


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("absent.blf", None, "there is no such file; check the path of the recording"),
        ("empty.blf", b"", "the file is empty; record it again"),
        ("log.xyz", b"abc", ".xyz is not a CAN log format; choose from .asc, .blf"),
        ("bad.blf", b"LOGX" + bytes(400), "it cannot be read as BLF"),
        ("bad.mf4", b"nonsense" * 100, "it cannot be read as MF4"),
        ("worse.mf4", b"MDF     4.10    " + bytes(400), "it cannot be read as MF4"),
        ("bad.db", b"nonsense" * 100, "it cannot be read as DB"),
        ("bad.csv", b"t,speed\n1.0,2.0\n", "it cannot be read as CSV"),
        ("bad.log", b"hello\nworld\n", "it cannot be read as LOG"),
    ],
)
def test_a_file_that_is_no_log_is_one_line(tmp_path, capfd, name, content, expected):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    text = error_of(SourceError, lambda: read_all(CanLog([path], decoder_of(tmp_path))))
    assert text.startswith(f"{path}: {expected}")
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("name", ["a.zip/drive.log", "a.zip/drive.log.gz", "drive.blf.bz2"])
def test_a_compressed_log_that_is_not_read_says_what_to_do(tmp_path, name):
    archive = tmp_path / name.partition("/")[0]
    archive.write_bytes(b"BZ")
    if archive.suffix == ".zip":
        with zipfile.ZipFile(archive, "w") as file:
            file.writestr(name.partition("/")[2], "(1710489600.0) can0 123#00\n")
    text = error_of(SourceError, lambda: read_all(CanLog([tmp_path / name], decoder_of(tmp_path))))
    rule = f"is a CAN log, of which only .gz is unpacked; unpack {archive.name}, and name the logs"
    assert text == f"{tmp_path / name}: {rule}"


def test_without_asammdf_an_mf4_file_names_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "asammdf", None)
    path = tmp_path / "a.mf4"
    path.write_bytes(b"MDF     4.10    " + bytes(400))
    for use in (lambda: CanLog([path], decoder_of(tmp_path)), lambda: log_writer(path)):
        assert error_of(SourceError, use) == f"{path}: MF4 needs asammdf: pip install 'nisus[mf4]'"


@pytest.mark.parametrize("suffix", [".db", ".blf", ".log"])
def test_a_log_read_in_one_thread_is_closed_in_another(tmp_path, messages, suffix):
    path = tmp_path / f"a{suffix}"
    write(path, messages)
    log = CanLog([path], decoder_of(tmp_path))
    thread = threading.Thread(target=log.read, args=(LIMIT_S,))
    thread.start()
    thread.join()
    log.close()
    # The first chunk of a BLF log is its first block, which holds all of them.
    assert log.frames == (len(messages) if suffix == ".blf" else 256) and log.read(0.0) is None


def test_error_frames_are_counted(tmp_path, messages):
    path = tmp_path / "a.blf"
    messages[500] = can.Message(timestamp=messages[500].timestamp, is_error_frame=True, channel=0)
    write(path, messages)
    _, reports = read(path, decoder_of(tmp_path))
    assert reports.counts == {"error frame": 1} and reports.texts["error frame"] == "a.blf: error frame"


def css_decoder(data, reports):
    channels = [
        Channel(READING, 0, "imu", ("AccelerationY", "AngularRateX"), "gnss_imu", where=(Condition("ImuValid", 1, 1),)),
        sensor(1, "OBD_RX", "S01PID0D_VehicleSpeed"),
    ]
    folder = data("can_css_imu100_obd2", "dbc")
    return Decoder([(folder / "canmod-gps.dbc", 2), (folder / "OBD-v4.4.dbc", 1)], channels, width=2, report=reports)


def test_a_cars_mf4_session(data):
    """Rates, ranges and faults as its README reports them: invalid IMU samples are missing, not -64 m/s²."""
    reports = Reports()
    folder = data("can_css_imu100_obd2", "session_00000164")
    log = CanLog(sorted(folder.glob("*.MF4")), css_decoder(data, reports), report=reports)
    got = read_all(log)
    assert log.frames == 292_097 and np.all(np.diff(got.t) >= 0)
    imu, obd = got.value[got.channel == 0], got.value[got.channel == 1, 0]
    minutes = (got.t[-1] - got.t[0]) * 1e-9 / 60
    assert minutes == pytest.approx(39.8, abs=0.1)
    assert len(imu) / minutes / 60 == pytest.approx(101.3, rel=0.01)  # the gaps of the recording
    assert reports.counts == {"condition imu": 3} and np.isnan(imu[:, 0]).sum() == 3
    assert np.nanmin(imu[:, 0]) > -20 and np.nanmin(imu[:, 1]) > -100
    assert len(obd) / minutes / 60 == pytest.approx(2.0, rel=0.05) and 0 <= obd.min() and 80 < obd.max() < 140


def test_blf_and_candump_of_one_drive_agree(data):
    path = data("can_comma2k19_rav4", "dbc", "toyota_2017.dbc")
    wheels = tuple(f"WHEEL_SPEED_{name}" for name in ("FR", "FL", "RR", "RL"))
    channels = [sensor(0, "WHEEL_SPEEDS", *wheels, model_units=("m/s",) * 4), sensor(1, "SPEED", "SPEED")]
    decoder = Decoder([(path, 0)], channels, width=4)
    log = CanLog([data("can_comma2k19_rav4", "rav4_2018-08-02_seg40.blf")], decoder)
    blf = read_all(log)
    candump = read_all(CanLog([data("can_comma2k19_rav4", "rav4_2018-08-02_seg40_bus0.log")], decoder))
    assert log.frames == 98_800
    np.testing.assert_array_equal(blf.value, candump.value)
    assert np.abs(blf.t - candump.t).max() <= 500  # candump writes microseconds
    assert np.all(candump.t % 1000 == 0)
    mean = blf.value[blf.channel == 0].mean(axis=1)
    assert 7.5 < mean.min() and mean.max() < 20.0


def test_an_unfinished_mf4_of_a_logger_that_lost_power(data):
    folder = data("can_css_ev6_bms_uds")
    decoder = Decoder([(folder / "dbc" / "gnss.dbc", 2)], [sensor(0, "gnss_imu", "AccelerationX")], width=1)
    log = CanLog(sorted(folder.glob("*.MF4")), decoder)
    got = read_all(log)
    assert log.frames == 4024 + 3587 and np.all(np.diff(got.t) >= 0)
    assert len(got) / (171 + 189) == pytest.approx(10.0, rel=0.05)


def test_the_span_is_known_before_a_log_is_read(tmp_path, data, messages):
    folder = data("can_css_imu100_obd2", "session_00000164")
    log = CanLog(sorted(folder.glob("*.MF4")), css_decoder(data, Reports()))
    first, last = log.span
    got = read_all(log)
    assert 0 <= got.t[0] - first < 10**9 and 0 <= last - got.t[-1] < 10**9
    for suffix in (".blf", ".log"):
        path = tmp_path / f"a{suffix}"
        write(path, messages)
        log = CanLog([path], decoder_of(tmp_path))
        first, last = log.span
        got = read_all(log)
        # BLF keeps the log's start and end in whole milliseconds.
        assert abs(got.t[0] - first) <= 10**6 and abs(last - got.t[-1]) <= 2 * 10**7, suffix
    write(tmp_path / "a.asc", messages)
    assert CanLog([tmp_path / "a.asc"], decoder_of(tmp_path)).span is None


def test_times_keep_the_microseconds_of_a_log():
    micros = START * 10**6 + np.random.default_rng(0).integers(0, 10**9, 10000)
    assert np.array_equal(to_ns(micros / 1e6), micros * 1000)
    nanos = np.random.default_rng(0).integers(0, 10**12, 10000)
    assert np.array_equal(to_ns(nanos / 1e9), nanos)
    assert to_ns(np.array([-1.25, 1e-9])).tolist() == [-1_250_000_000, 1]


def test_a_database_that_cantools_reads_is_read_once(tmp_path):
    from sources.can.database import load_database

    path = dbc(tmp_path)
    assert load_database(path) is load_database(path)
    assert isinstance(load_database(path), cantools.database.can.Database)
