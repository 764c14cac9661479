"""Blocks of a BLF log: the same frames as python-can's own reader, message by message."""

import re
import struct
import zlib

import can
import numpy as np
import pytest

from sources.can.blf import BlfBlocks
from sources.can.readers import Columns, LogSummary, _correct_readers, read_messages
from tests.cases import cases

START = 1_700_000_000.0


def message(k, **more):
    return can.Message(**{
        "timestamp": START + 0.001234567 * k, "arbitration_id": 0x100 + k % 7, "is_extended_id": k % 3 == 0,
        "channel": k % 2, "data": bytes((k + j) % 256 for j in range(k % 9)), **more,
    })  # fmt: skip


def write(path, messages):
    with can.BLFWriter(path) as writer:
        writer.max_container_size = 2048  # so that frames lie across two blocks
        for item in messages:
            writer.on_message_received(item)
    return path


def objects(path, records, gap=b""):
    """Write objects of a kind that python-can does not: (type, version, flags, time, body); a gap before the fourth."""
    content = b""
    for k, (kind, version, flags, time, body) in enumerate(records):
        content += gap if k == 3 else b""
        own = struct.pack("<LHHq", flags, 0, 0, time) if version == 1 else struct.pack("<LBxHq8x", flags, 0, 0, time)
        size = 16 + len(own) + len(body)
        content += struct.pack("<4sHHLL", b"LOBJ", 16 + len(own), version, size, kind) + own + body + b"\0" * (size % 4)
    packed = zlib.compress(content)
    block = (
        struct.pack("<4sHHLL", b"LOBJ", 16, 1, 32 + len(packed), 10) + struct.pack("<H6xL4x", 2, len(content)) + packed
    )
    write(path, [])
    head = path.read_bytes()[:144]
    path.write_bytes(head + block + b"\0" * (len(packed) % 4))
    return path


def frame(channel=1, bits=0, data=b"LOBJLOBJ", dlc=8, key=0x123):
    return struct.pack("<HBBL8s", channel, bits, dlc, key, data)


def read(path, wanted, longest):
    *raws, summary = read_messages(path, wanted, longest)
    assert isinstance(summary, LogSummary)
    columns = [np.concatenate([getattr(raw, name) for raw in raws]) for name in ("t", "key", "length", "data")]
    buses = [raw.buses[place] for raw in raws for place in raw.bus.tolist()]
    return columns, buses, summary, sum(raw.total for raw in raws)


def check(path, wanted=None, longest=8):
    """Compare with the frames of python-can's own reader, and return the items of ours."""
    _correct_readers()
    with can.BLFReader(path) as reader:
        messages = list(reader)
    own = Columns(wanted, longest)
    expected = own.of_messages(messages)
    columns, buses, summary, total = read(path, wanted, longest)
    for got, name in zip(columns, ("t", "key", "length", "data"), strict=True):
        np.testing.assert_array_equal(got, getattr(expected, name), err_msg=name)
    assert buses == [expected.buses[place] for place in expected.bus.tolist()]
    assert (summary.seen, total) == (own.seen, len(messages))
    with BlfBlocks(path) as reader:
        return list(reader)


@pytest.mark.parametrize("longest", [3, 8, 64])
@pytest.mark.parametrize("wanted", [None, frozenset({0x101, 0x103 | 1 << 31})])
def test_blocks_of_messages(tmp_path, wanted, longest):
    items = check(write(tmp_path / "a.blf", [message(k) for k in range(500)]), wanted, longest)
    assert len(items) > 5 and all(isinstance(item, tuple) for item in items)


def test_other_frames_among_them(tmp_path):
    """A block that holds CAN FD or error frames is read message by message."""
    messages = [message(k) for k in range(400)]
    messages[10] = message(10, is_remote_frame=True, data=b"", dlc=4)
    messages[200] = message(200, is_fd=True, data=bytes(range(48)))
    messages[300] = message(300, is_error_frame=True)
    items = check(write(tmp_path / "a.blf", messages), longest=64)
    assert {isinstance(item, tuple) for item in items} == {True, False}


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("flags", [1, 2])
def test_headers_times_and_data_that_looks_like_an_object(tmp_path, version, flags):
    """A mark within the data is no object; a block that has one is left to python-can, which skips it."""
    records = [(1, version, flags, 123_456_789 * k + 1, frame(data=bytes([k] * 8), dlc=k)) for k in range(12)]
    (item,) = check(objects(tmp_path / "a.blf", [*records, (99, version, flags, 5, b"12345678")]))
    assert isinstance(item, tuple) and item[-1] == 12
    check(objects(tmp_path / "b.blf", [*records, (86, version, flags, -5, frame())]))
    check(objects(tmp_path / "c.blf", [*records, (86, 3 - version, flags, 7, frame(channel=4, key=1 << 31 | 5))]))
    check(objects(tmp_path / "d.blf", [*records, (1, version, flags, 2**60 + 1, frame(data=b"12345678"))]))


@cases(__file__, "damaged_blocks.csv")
def test_a_damaged_block_loses_only_itself(tmp_path, begin, end, written, lost, fault):
    """Of the blocks of 2048 bytes and frames of 48 each, the fourth has frames 128 to 170 wholly or in part."""
    path = write(tmp_path / "a.blf", [message(k) for k in range(500)])
    data = bytearray(path.read_bytes())
    at = [block.start() for block in re.finditer(rb"LOBJ.{8}\n\0{3}", data, re.DOTALL)][3]
    data[at + int(begin) : at + int(end)] = bytes.fromhex(written)
    path.write_bytes(data)
    (t, *_), _, summary, _ = read(path, None, 8)
    expected = np.delete(np.arange(500), np.arange(*map(int, lost.split())))
    np.testing.assert_array_equal(np.round((t * 1e-9 - START) / 0.001234567), expected)
    assert summary.fault.replace(str(at), "AT").startswith(fault)


def test_bytes_between_objects(tmp_path):
    """Up to 4 are padding; more are damage, and the frames before it are kept."""
    records = [(1, 1, 2, k, frame(data=b"12345678")) for k in range(8)]
    (item,) = check(objects(tmp_path / "a.blf", records, b"\0" * 4))
    assert isinstance(item, tuple)
    _, _, summary, total = read(objects(tmp_path / "b.blf", records, b"\0" * 8), None, 8)
    assert total == 3 and "next object" in summary.fault
