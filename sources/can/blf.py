"""Frames of a BLF log by columns (python-can makes an object of each frame: 2 µs).

A block of CAN messages alone is read as one array; a block with other frames (CAN FD, errors), or with anything
unusual, is left to python-can. A block that cannot be read is counted with its place, and the next one is looked for.
"""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Iterator

import can
import numpy as np
from can.io.blf import LOG_CONTAINER, LOG_CONTAINER_STRUCT, NO_COMPRESSION, OBJ_HEADER_BASE_STRUCT

from ..units import to_ns

KEY_BITS, REMOTE_FLAG = 0x9FFFFFFF, 0x80  # The highest bit of an id is that of an extended frame, as in `EXTENDED`.
CAN_MESSAGE, CAN_MESSAGE2, RESTORE_POINT = 1, 86, 115
SLOW_TYPES = (73, 100, 101)  # Error frames and CAN FD, left to python-can
HEAD, MARK = OBJ_HEADER_BASE_STRUCT, b"LOBJ"  # Begin of an object
BLOCK = re.compile(MARK + b".{8}" + LOG_CONTAINER.to_bytes(4, "little"), re.DOTALL)  # Begin of a compressed one
MAX_EXACT = 2**53  # Times up to here are exact as float64

_BASE = [("mark", "S4"), ("head", "<u2"), ("version", "<u2"), ("size", "<u4"), ("type", "<u4"), ("flags", "<u4")]
_FRAME = [("channel", "<u2"), ("bits", "u1"), ("dlc", "u1"), ("id", "<u4"), ("data", "u1", (8,))]
LAYOUTS = {
    1: np.dtype([*_BASE, ("own", "V4"), ("time", "<i8"), *_FRAME]),  # type: ignore[list-item]
    2: np.dtype([*_BASE, ("own", "V4"), ("time", "<i8"), ("original", "V8"), *_FRAME]),  # type: ignore[list-item]
}
"""Layout of a CAN message by the version of its header."""


class BlfBlocks(can.BLFReader):
    """python-can's reader, whose items are the columns of a block where possible, otherwise its messages."""

    _tail: bytes
    bad: tuple[tuple[str, object], ...] = ()
    """Places of the blocks that could not be read, and why."""

    def __iter__(self) -> Iterator[can.Message | tuple]:
        begin = self.file.tell()
        while data := self.file.read(HEAD.size):
            place, error = self.file.tell() - len(data), None
            try:
                mark, _, _, size, kind = HEAD.unpack(data)
                if mark != MARK:
                    raise ValueError("no block begins here")
                begin = place
                content = self.file.read(max(0, size - HEAD.size))
                self.file.read(size % 4)
                if kind == LOG_CONTAINER:
                    packed = LOG_CONTAINER_STRUCT.unpack_from(content)[0] != NO_COMPRESSION
                    content = content[LOG_CONTAINER_STRUCT.size :]
                    if packed:
                        inflated = zlib.decompressobj()
                        content = inflated.decompress(content)
                        if not inflated.eof and self.file.tell() >= place + size:
                            raise ValueError("it cannot be decompressed")
                    yield from self._parse_container(content)
                elif kind != RESTORE_POINT:
                    raise ValueError(f"objects of type {kind} are not known here")
                if self.file.tell() == place + size + size % 4:
                    continue
            except Exception as wrong:  # noqa: BLE001  a damaged file makes python-can raise anything
                error, self._tail = wrong, b""
            # A wrong length may have passed over blocks; that of the last one of a file that is cut has none after it.
            if self._seek_block(begin + len(MARK)) or error:
                self.bad += ((f"at byte {place}", error or "its length is wrong"),)

    def _seek_block(self, place: int) -> bool:
        """Move to the first block from a place on, or to the end; return whether there is one."""
        self.file.seek(place)
        while len(part := self.file.read(2**20)) >= HEAD.size:
            if found := BLOCK.search(part):
                self.file.seek(found.start() - len(part), os.SEEK_CUR)
                return True
            self.file.seek(1 - HEAD.size, os.SEEK_CUR)
        return False

    def _parse_container(self, data: bytes) -> Iterator[can.Message | tuple]:
        # After a block that could not be read, an object of it may end here.
        joined = self._tail + data if self._tail else data[max(0, data.find(MARK)) :]
        found = frames_of(joined, self.start_timestamp)
        if found is None:
            self._tail = b""
            yield from super()._parse_container(joined)
            return
        block, end = found
        self._tail = joined[end:]
        yield block


def frames_of(data: bytes, start: float) -> tuple[tuple, int] | None:
    """Return the CAN messages of a block and where its last whole object ends; None if python-can must read it.

    They are columns as in `readers.Raw`, with numbers of buses in place of positions; the bytes (n, 8) are zero beyond
    the length, and the total counts the remote frames too.

    Args:
        data: The block, decompressed, after what the one before it left over.
        start: Start of the log, s.
    """
    content = np.frombuffer(data, np.uint8)
    if content.size < 64:
        return None
    places = np.flatnonzero(content[:-15] == MARK[0])
    places = places[(content[places[:, None] + np.arange(1, 4)] == list(MARK[1:])).all(axis=1)]
    if not places.size:
        return None
    sizes = content[places[:, None] + np.arange(8, 12)].view("<u4")[:, 0].astype(np.int64)
    ends = places + sizes
    whole = ends <= content.size
    # An object begins within 4 bytes after the one before it; marks among the data are no objects.
    gaps = places - np.append(0, ends[:-1])
    if np.any((gaps < 0) | (gaps > 4)) or not np.all(whole[:-1]):
        return None
    places, end = places[whole], int(ends[whole][-1]) if whole.any() else 0
    # The rest may begin within 4 bytes, or is too short to hold the beginning.
    if not places.size or (whole[-1] and content.size - end >= 8):
        return None
    heads = content[places[:, None] + np.arange(6, 16)]
    versions = heads[:, :2].copy().view("<u2")[:, 0]
    kinds = heads[:, 6:].copy().view("<u4")[:, 0]
    version = int(versions[0])
    if np.any(versions != version) or version not in LAYOUTS or np.any(np.isin(kinds, SLOW_TYPES)):
        return None
    layout = LAYOUTS[version]
    if np.any(sizes[: places.size] < layout.fields["channel"][1]):  # type: ignore[index]
        return None
    rows = np.flatnonzero((kinds == CAN_MESSAGE) | (kinds == CAN_MESSAGE2))
    if np.any(sizes[rows] < layout.itemsize):
        return None
    frames = content[places[rows, None] + np.arange(layout.itemsize)].view(layout)[:, 0]
    total = frames.size
    frames = frames[(frames["bits"] & REMOTE_FLAG) == 0]
    if np.any(np.abs(frames["time"]) >= MAX_EXACT):
        return None
    # As python-can rounds: first the product with 1e-5 or 1e-9, exact before it is rounded, then the sum.
    seconds = frames["time"] / np.where(frames["flags"] == 1, 1e5, 1e9) + start
    length = np.minimum(frames["dlc"], 8).astype(np.int64)
    block = (
        to_ns(seconds),
        (frames["id"] & KEY_BITS).astype(np.int64),
        frames["channel"].astype(np.int64) - 1,
        length,
        np.where(np.arange(8) < length[:, None], frames["data"], 0).astype(np.uint8),
        (),
        total,
    )
    return block, end
