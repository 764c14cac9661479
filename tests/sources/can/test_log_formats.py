"""Frames that python-can's readers get wrong: times before a log's start, CAN FD frames cut short, garbled lines."""

import struct

import can
import numpy as np
import pytest
from asammdf import MDF

from estimators.errors import SourceError
from sources.can.decoder import Decoder
from tests.sources.can.can_tools import Reports, dbc, frame, sensor
from tests.sources.can.test_log import START, decoder_of, messages, read, write  # noqa: F401  a fixture

FD = """VERSION ""

BU_: ECU

BO_ 512 LONG: 64 ECU
 SG_ Early : 0|16@1+ (1,0) [0|0] "" ECU
 SG_ Late : 480|16@1+ (1,0) [0|0] "" ECU
"""

NANOSECONDS, TEN_MICROSECONDS = 2, 1  # flags of a BLF object
CAN, CAN_FD, CAN_FD_64 = 1, 100, 101  # its types


def blf_object(kind, data, ticks, flags=NANOSECONDS, version=1):
    """An object of a BLF log; headers as in Vector's binlog, whose times are signed."""
    rest = struct.pack("<LHHq", flags, 0, 0, ticks) if version == 1 else struct.pack("<LBxHq8x", flags, 0, 0, ticks)
    size = 16 + len(rest)
    return (
        struct.pack("<4sHHLL", b"LOBJ", size, version, size + len(data), kind) + rest + data + b"\0" * (len(data) % 4)
    )


def blf_file(path, *containers, start=(2023, 11, 2, 14, 22, 13, 20, 0), told=None):
    """A BLF log of uncompressed containers; `start` is START (2023-11-14 22:13:20) as a SYSTEMTIME."""
    body = b""
    for content in containers:
        size = 32 + len(content)
        body += struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, 10) + struct.pack("<H6xL4x", 0, len(content)) + content
        body += b"\0" * (size % 4)
    head = [b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1, 144 + len(body) if told is None else told, 144, 0, 0, *start, *start]
    path.write_bytes(struct.pack("<4sLBBBBBBBBQQLL8H8H", *head).ljust(144, b"\0") + body)


def classic(k):
    return struct.pack("<HBBL8s", 1, 0, 8, 256, struct.pack("<H6x", k))


def long_payload(k):
    return struct.pack("<H58xH2x", k, 1000 + k)


def fd_100(k, stored=64):
    return struct.pack("<HBBLLBBB5x", 1, 0, 15, 512, 0, 0, 3, 64) + long_payload(k)[:stored]


def fd_101(k, stored=64, ext=b""):
    """A frame that counts 64 bytes, with `stored` of them, and the data that Vector's tools append."""
    end = 32 + 40 + stored if ext else 0
    head = struct.pack("<BBBBLLLLLLLHBBL", 1, 15, 64, 0, 512, 0, 0x3000, 0, 0, 0, 0, 0, 0, end, 0)
    return head + long_payload(k)[:stored] + ext


def fd_decoder(tmp_path, reports=lambda key, text: None):
    channels = [sensor(0, "LONG", "Early"), sensor(1, "LONG", "Late")]
    return Decoder([(dbc(tmp_path, FD, "fd.dbc"), None)], channels, width=1, report=reports)


def test_blf_times_before_the_start_are_negative(tmp_path):
    """As of a logger with a buffer of the time before its trigger (hardbyte/python-can#2101)."""
    ticks = [(-60_000_000_001, NANOSECONDS, 1), (-250_000, TEN_MICROSECONDS, 1), (-1, NANOSECONDS, 2), (5, 1, 2)]
    objects = [blf_object(CAN, classic(k), at, flags, version) for k, (at, flags, version) in enumerate(ticks)]
    blf_file(tmp_path / "a.blf", b"".join(objects))
    got, reports = read(tmp_path / "a.blf", decoder_of(tmp_path))
    exact = [START * 10**9 + at * (10_000 if flags == TEN_MICROSECONDS else 1) for at, flags, _ in ticks]
    # Seconds since 1970 in double precision are 2⁻²² s apart, and are rounded to microseconds.
    assert np.abs(got.t - exact).max() <= 500
    np.testing.assert_allclose(got.value[:, 0], [-40.0, -39.9, -39.8, -39.7], rtol=1e-12)
    assert not reports.counts


def test_asc_times_before_the_start_are_negative(tmp_path):
    lines = [
        f"{t:.6f} 1  100             Rx   d 8 {k:02X} 00 00 00 00 00 00 00" for k, t in enumerate((-1.5, -1e-6, 2))
    ]
    (tmp_path / "a.asc").write_text(
        "\n".join(["base hex  timestamps absolute", "no internal events logged", *lines, ""])
    )
    got, reports = read(tmp_path / "a.asc", decoder_of(tmp_path))
    assert got.t.tolist() == [-1_500_000_000, -1000, 2_000_000_000] and not reports.counts


@pytest.mark.parametrize(
    ("kind", "whole", "cut"),
    [(CAN_FD, fd_100(1), fd_100(2, 10)), (CAN_FD_64, fd_101(1), fd_101(2, 10)),
     (CAN_FD_64, fd_101(1, ext=b"\x01" * 24), fd_101(2, 10, ext=b"\x01" * 24))],
    ids=["type 100", "type 101", "type 101 with more after the data"],
)  # fmt: skip
def test_a_blf_fd_frame_cut_short_has_the_bytes_that_are_stored(tmp_path, kind, whole, cut):
    """Not zeros, nor the bytes of the next frame; also at the end of a container and of the log."""
    first = [blf_object(kind, data, 10**9 * k) for k, data in enumerate((whole, cut, whole, cut))]
    last = [blf_object(kind, data, 10**9 * k) for k, data in enumerate((whole, cut), start=4)]
    path, reports = tmp_path / "a.blf", Reports()
    blf_file(path, b"".join(first), b"".join(last))
    got, more = read(path, fd_decoder(tmp_path, reports))
    early, late = (got.value[got.channel == sensor, 0] for sensor in (0, 1))
    assert early.tolist() == [1, 2, 1, 2, 1, 2]
    np.testing.assert_array_equal(late, [1001, np.nan, 1001, np.nan, 1001, np.nan])
    assert sum(reports.counts.values()) == 3 and not more.counts
    assert "LONG" in " ".join(reports.texts.values()) or "sensor1" in " ".join(reports.texts.values())


@pytest.mark.parametrize("lost", [1, 8, 30])
def test_a_blf_whose_header_was_never_completed_says_that_it_is_cut(tmp_path, lost):
    """A logger that lost power has not written the size of the file."""
    objects = b"".join(blf_object(CAN, classic(k), k * 10**9) for k in range(5))
    blf_file(tmp_path / "a.blf", objects, told=144)
    path = tmp_path / "a.blf"
    path.write_bytes(path.read_bytes()[:-lost])
    got, reports = read(path, decoder_of(tmp_path))
    assert len(got) == 4
    text = "a.blf: the file is damaged (its last frame is incomplete); 4 frames were read"
    assert reports.texts == {"truncated file": text}


def long_frames():
    return [can.Message(timestamp=START + k, arbitration_id=512, is_extended_id=False, is_fd=True, bitrate_switch=True,
                       data=long_payload(k), dlc=64, channel=0, is_rx=True) for k in range(3)]  # fmt: skip


@pytest.mark.parametrize("suffix", [".asc", ".log", ".blf", ".trc", ".mf4"])
def test_fd_frames_are_read_from_every_format(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    if suffix == ".trc":  # python-can does not write them
        rows = [
            f"{k + 1:7d} {k * 1000:13.3f} FB 1      0200 Rx -  64   {long_payload(k).hex(' ').upper()}"
            for k in range(3)
        ]
        path.write_text(
            "\n".join([";$FILEVERSION=2.1", ";$STARTTIME=45244.0", ";$COLUMNS=N,O,T,B,I,d,R,l,D", *rows, ""])
        )
    else:
        write(path, long_frames())
    got, reports = read(path, fd_decoder(tmp_path))
    assert got.value[got.channel == 0, 0].tolist() == [0, 1, 2]
    assert got.value[got.channel == 1, 0].tolist() == [1000, 1001, 1002]
    assert np.diff(got.t[got.channel == 0]).tolist() == [10**9, 10**9] and not reports.counts


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".log", ".trc"])
def test_a_garbled_line_loses_only_itself(tmp_path, messages, suffix, capfd):  # noqa: F811
    path = tmp_path / f"a{suffix}"
    write(path, messages)
    whole, _ = read(path, decoder_of(tmp_path))
    lines = path.read_bytes().splitlines()
    place = next(k for k, line in enumerate(lines) if k > 500 and (b"100" in line or b"0x100" in line))
    lines[place] = lines[place][: len(lines[place]) - 2].rsplit(b" ", 1)[0].rsplit(b",", 1)[0] + b" \xb0#x"
    path.write_bytes(b"\n".join([*lines, b""]))
    got, reports = read(path, decoder_of(tmp_path))
    assert len(whole) - 1 <= len(got) <= len(whole)
    assert not set(got.t.tolist()) - set(whole.t.tolist()) and len(set(whole.t.tolist()) - set(got.t.tolist())) <= 1
    assert reports.counts == {"truncated file": 1}
    assert f"the first line {place + 1}: " in reports.texts["truncated file"]
    assert not capfd.readouterr().err


@pytest.mark.parametrize("suffix", [".asc", ".csv", ".log", ".trc", ".mf4"])
@pytest.mark.parametrize("whole", [True, False])
def test_a_block_of_zeros_is_counted_with_its_place(tmp_path, messages, suffix, whole):  # noqa: F811
    """Of whole lines, of which python-can tells nothing in an ASC log, or from within one to within another."""
    path = tmp_path / f"a{suffix}"
    write(path, messages)
    if suffix == ".mf4":
        MDF(path).save(path, compression=0, overwrite=True)
    data = bytearray(path.read_bytes())
    begin = data.find(b"\n", len(data) // 2) + 1 if whole else len(data) // 2
    end = data.find(b"\n", begin + 2000) if whole else begin + 2000
    data[begin:end] = bytes(end - begin)
    path.write_bytes(data)
    text = read(path, decoder_of(tmp_path))[1].texts["truncated file"]
    line = data[:begin].count(b"\n") + 1
    lost = f"1 line cannot be read, the first line {line}: {end - begin} of its bytes are zero"
    assert ("of 1000 frames are zeros alone, from " if suffix == ".mf4" else lost) in text


@pytest.mark.parametrize("share", [0, 0.1])
def test_frames_that_an_mf4_marks_invalid_are_missing_and_counted(tmp_path, messages, share):  # noqa: F811
    write(tmp_path / "a.mf4", messages)
    signal = MDF(tmp_path / "a.mf4").get("CAN_DataFrame", group=0)
    signal.invalidation_bits = np.arange(1000) < 1000 * share
    made = MDF()
    made.append([signal], common_timebase=True)
    made.save(tmp_path / "b.mf4")
    got, reports = read(tmp_path / "b.mf4", decoder_of(tmp_path))
    assert len(got) == sum(k % 3 != 2 for k in range(int(1000 * share), 1000))
    assert ("100 of 1000 frames are marked invalid" in str(reports.texts)) == (share > 0)


def test_a_candump_frame_that_ends_within_a_byte_is_left_out(tmp_path):
    lines = [f"({START}.{k}00000) can0 100#0{k}00000000000000" for k in range(3)]
    lines[1] = lines[1][:-3]
    (tmp_path / "a.log").write_text("\n".join([*lines, ""]))
    got, reports = read(tmp_path / "a.log", decoder_of(tmp_path))
    np.testing.assert_allclose(got.value[:, 0], [-40.0, -39.8])
    text = "a.log: the file is damaged (1 line cannot be read, the first line 2: it ends within a byte)"
    assert reports.texts["truncated file"].startswith(text)


def test_asc_times_that_count_from_event_to_event_are_refused(tmp_path):
    lines = ["base hex  timestamps relative", "0.1 1  100  Rx   d 1 00", "0.1 1  100  Rx   d 1 00", ""]
    (tmp_path / "a.asc").write_text("\n".join(lines))
    with pytest.raises(SourceError, match="count from one event to the next .* export it with absolute"):
        read(tmp_path / "a.asc", decoder_of(tmp_path))


def test_a_remote_frame_of_a_log_is_no_measurement(tmp_path):
    request = frame(256, b"", t=START)
    request.is_remote_frame = True
    write(tmp_path / "a.log", [request, frame(256, bytes(8), t=START + 1)])
    got, reports = read(tmp_path / "a.log", decoder_of(tmp_path))
    assert len(got) == 1 and not reports.counts
