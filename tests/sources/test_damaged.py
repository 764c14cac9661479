"""Damaged binary files: whatever the libraries do with them, the twin goes on, and what is lost is said."""

import random
import struct
from collections import Counter

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from estimators.errors import SourceError
from estimators.log import READING
from sources.can import log as can_log
from sources.can.decoder import Decoder
from sources.can.log import CanLog
from sources.inspect import inspect_recordings
from sources.source import Channel
from sources.tables.table import Table, TimeColumn
from tests.sources import readers_that_fail
from tests.sources.can.can_tools import Reports, dbc, decoding, sensor
from tests.sources.can.test_log import decoder_of, messages, read, write  # noqa: F401  a fixture
from tests.support import error_of, read_all


def flipped(content, seed, *, most=200):
    """A file some of whose bytes, here or there or near an end, are others."""
    rng = random.Random(seed)
    changed = bytearray(content)
    count = rng.choice([1, 3, 10, 40, most])
    span = len(changed) if rng.random() < 0.5 else min(len(changed), 8192)
    first = 0 if rng.random() < 0.7 else len(changed) - span
    for _ in range(count):
        changed[first + rng.randrange(span)] ^= rng.randrange(1, 256)
    return bytes(changed)


def outcome(open_source):
    """What became of a file: its events and what was reported, or its error."""
    reports, count = Reports(), 0
    try:
        source = open_source(reports)
        while (batch := source.read(0.0)) is not None:
            count += len(batch)
        source.close()
    except SourceError as error:
        assert "\n" not in str(error)
        return 0, Counter({"error": 1}), str(error)
    return count, reports.counts, " ".join(reports.texts.values())


def test_an_mf4_that_kills_its_library_is_one_line(tmp_path, data):
    """Each of these seeds ends the process in asammdf 8.8; others may with another version, and none may here."""
    content = data("can_css_imu100_obd2", "session_00000164", "00000005-60FEB5A8.MF4").read_bytes()
    folder = data("can_css_imu100_obd2", "dbc")
    path = tmp_path / "a.mf4"
    for seed in (11, 16, 25, 36, 61, 65, 68, 73):
        path.write_bytes(flipped(content, seed))
        channels = [sensor(0, "gnss_imu", "AccelerationY", "AngularRateX")]

        def open_log(report, channels=channels):
            decoder = Decoder([(folder / "canmod-gps.dbc", 2)], channels, width=2, report=report)
            return CanLog([path], decoder, report=report)

        count, _, text = outcome(open_log)
        assert (not count and text.startswith(f"{path}: it cannot be read as MF4")) or count == 4518


def test_an_unfinished_mf4_whose_records_are_lost_says_so(tmp_path, data):
    """asammdf stops at the first record that it does not know; nothing but the blocks' sizes shows what follows."""
    folder = data("can_css_ev6_bms_uds")
    content = (folder / "00000001-63BEF5CD.MF4").read_bytes()
    path = tmp_path / "a.mf4"
    lost = 0
    for seed in (11, 25, 27, 43, 44, 68, 82, 87, 93, 101):
        path.write_bytes(flipped(content, seed))

        def open_log(report):
            decoder = Decoder(
                [(folder / "dbc" / "gnss.dbc", 2)], [sensor(0, "gnss_imu", "AccelerationX")], width=1, report=report
            )
            return CanLog([path], decoder, report=report)

        count, counts, text = outcome(open_log)
        if count < 1669 - 2:  # a frame or two may have another id now
            lost += 1
            assert counts["error"] or (counts["truncated file"] == 1 and "bytes of records" in text), seed
    assert lost > 5


def cycles(content):
    """Where the channel group that has records tells how many: by the links of ASAM MDF 4, HD, DG, CG."""
    found = []
    group = struct.unpack_from("<Q", content, 64 + 24)[0]
    while group:
        channels = struct.unpack_from("<Q", content, group + 24 + 8)[0]
        while channels:
            links = struct.unpack_from("<Q", content, channels + 16)[0]
            place = channels + 24 + 8 * links + 8
            if struct.unpack_from("<Q", content, place)[0]:
                found.append(place)
            channels = struct.unpack_from("<Q", content, channels + 24)[0]
        group = struct.unpack_from("<Q", content, group + 24)[0]
    return found


@pytest.mark.parametrize("told", [930, 1100])
def test_an_mf4_that_counts_other_records_than_it_holds_says_so(tmp_path, messages, told):  # noqa: F811
    path = tmp_path / "a.mf4"
    write(path, messages)
    content = bytearray(path.read_bytes())
    [place] = cycles(content)
    assert struct.unpack_from("<Q", content, place)[0] == 1000
    struct.pack_into("<Q", content, place, told)
    path.write_bytes(content)
    _, counts, text = outcome(lambda report: CanLog([path], decoder_of(tmp_path, report), report=report))
    assert counts["error"] or counts["truncated file"]
    assert f"{told} frames" in text or "bytes of records" in text


@pytest.mark.parametrize("suffix", [".blf", ".db", ".mf4", ".trc"])
def test_flipped_logs_are_read_or_refused(tmp_path, messages, suffix):  # noqa: F811
    path = tmp_path / f"a{suffix}"
    write(path, messages)
    content = path.read_bytes()
    whole, _, _ = outcome(lambda report: CanLog([path], decoder_of(tmp_path, report), report=report))
    bad = tmp_path / f"b{suffix}"
    for seed in range(25):
        bad.write_bytes(flipped(content, seed))
        count, counts, text = outcome(lambda report: CanLog([bad], decoder_of(tmp_path, report), report=report))
        # An id that became another one is a frame of another message.
        assert count >= whole - 3 or counts, (seed, count)
        assert str(bad) in text or bad.name in text or not text


def tables(folder):
    rng = np.random.default_rng(2)
    columns = {"t": np.arange(3000) * 0.1, "x": rng.standard_normal(3000)}
    for compression in ("snappy", "none"):
        pq.write_table(pa.table(columns), folder / f"{compression}.parquet", compression=compression)
    np.savez(folder / "plain.npz", **columns)
    savemat(folder / "plain.mat", columns)
    savemat(folder / "packed.mat", columns, do_compression=True)


@pytest.mark.parametrize("name", ["snappy.parquet", "none.parquet", "plain.npz", "plain.mat", "packed.mat"])
def test_flipped_tables_are_read_or_refused(tmp_path, name):
    tables(tmp_path)
    content = (tmp_path / name).read_bytes()
    bad = tmp_path / f"bad_{name}"
    channels = [Channel(READING, 0, "x", ("x",))]

    def open_table(report):
        return Table([bad], time=TimeColumn("t"), channels=channels, width=1, report=report)

    refused = 0
    for seed in range(25):
        bad.write_bytes(flipped(content, seed))
        count, counts, text = outcome(open_table)
        refused += not count
        assert count == 3000 or counts, (seed, count)
        assert bad.name in text or not text
    assert refused


def test_a_reader_that_dies_leaves_what_it_gave(tmp_path, messages, monkeypatch):  # noqa: F811
    path, other = tmp_path / "a.log", tmp_path / "b.log"
    write(path, messages)
    write(other, messages[:10])
    monkeypatch.setattr(can_log, "read_messages", readers_that_fail.frames_then_abort)
    reports = Reports()
    log = CanLog([path], decoder_of(tmp_path), report=reports)
    got = read_all(log)
    assert len(got) == sum(k % 3 != 2 for k in range(256)) and log.frames == 256
    assert reports.counts["truncated file"] == 1
    assert reports.texts["truncated file"] == (
        "a.log: the file is damaged (its reader was ended by SIGABRT); 256 frames were read"
    )
    monkeypatch.setattr(can_log, "read_messages", readers_that_fail.abort_at_once)
    with pytest.raises(SourceError, match=r"a\.log: it cannot be read as LOG \(its reader was ended by SIGABRT\)"):
        read_all(CanLog([path], decoder_of(tmp_path)))


def test_a_log_without_a_frame_says_so(tmp_path, messages):  # noqa: F811
    can.Logger(tmp_path / "a.blf").stop()
    write(tmp_path / "b.blf", messages)
    reports = Reports()
    got = read_all(CanLog([tmp_path / "a.blf", tmp_path / "b.blf"], decoder_of(tmp_path), report=reports))
    assert len(got) == 667
    assert reports.texts == {"truncated file": "a.blf: the file is damaged (it holds none); 0 frames were read"}


def test_what_never_comes_is_named_with_what_does(tmp_path, messages):  # noqa: F811
    """One line for each message or column, at the end; nothing where all came."""
    path = tmp_path / "a.log"
    write(path, messages)
    base = dbc(tmp_path)

    def texts(channels, bus=None):
        told = []
        decoder = Decoder([(base, bus)], channels, width=3)
        log = CanLog([path], decoder, report=lambda key, text: told.append((key, text)))
        while log.read(0.0) is not None:
            pass
        return told

    engine = sensor(0, "ENGINE", "Temp")
    assert texts([engine]) == []
    assert texts([engine, sensor(1, "FIX", "Lat")]) == [
        (
            "never seen",
            "a.log: FIX (0x102) was never received, so sensor1 has no values; there are 2 ids on bus can0, the nearest "
            "0x100, 0x12c; check the DBC",
        )
    ]
    [(_, text)] = texts([engine], bus=2)
    assert text == (
        "a.log: ENGINE (0x100 on bus 2) was never received, so sensor0 has no values; its id was received on bus can0; "
        "check the DBC's channel"
    )


def test_a_signal_that_a_message_never_carries_is_named(tmp_path):
    from tests.sources.can.can_tools import frame

    path = tmp_path / "a.log"
    write(path, [frame(259, bytes([1, 13, 50, 0, 0, 0, 0, 0]), t=1e9 + k, bus=0) for k in range(30)])
    channels = [sensor(0, "MUX", "Speed"), sensor(1, "MUX", "Revs")]
    _, reports = read(path, decoding(tmp_path, channels))
    assert reports.counts == {"never seen": 1}
    assert reports.texts["never seen"].startswith("a.log: sensor1: MUX (0x103) was received 30 times, never with Revs;")


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_a_column_without_a_value_is_named(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    if ending == ".csv":
        path.write_text("t,x,y\n" + "".join(f"{k},{k},\n" for k in range(5)))
    else:
        pq.write_table(pa.table({"t": range(5), "x": range(5), "y": pa.array([None] * 5, pa.float64())}), path)
    reports = Reports()
    channels = [Channel(READING, 0, "x", ("x",)), Channel(READING, 1, "why", ("y",))]
    read_all(Table([path], time=TimeColumn("t"), channels=channels, width=1, report=reports))
    assert reports.counts == {"never seen": 1}
    assert reports.texts["never seen"] == f"a{ending}: column 'y' has no value in 5 rows, so why has no values"


@pytest.mark.parametrize(
    ("content", "held"),
    [
        ({"data": np.zeros((9, 3))}, "data (9×3)"),
        ({"s": {"data": np.zeros((9, 3)), "name": "x"}, "k": 3.0}, "s (struct), k (float)"),
    ],
)
def test_a_matlab_file_without_vectors_says_what_it_holds_and_how_to_save_it(tmp_path, content, held):
    savemat(tmp_path / "a.mat", content)
    text = error_of(SourceError, inspect_recordings, [tmp_path / "a.mat"])
    assert text == (
        f"{tmp_path / 'a.mat'}: a table has a vector of times and one of values, and it holds {held}; save each column "
        "as a vector, or those of a struct s with save('a.mat', '-struct', 's', '-v7')"
    )


def test_an_archive_of_one_array_is_not_told_of_delimiters(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.zeros(9))
    text = error_of(SourceError, inspect_recordings, [tmp_path / "a.npz"])
    assert text.endswith("has one column, 'x'; a table has a header, a column of times and one of values")
