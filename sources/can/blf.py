"""Frames of a BLF log by columns (python-can makes an object of each frame: 2 µs).

python-can reads the blocks and decompresses them. A block of CAN messages alone is then read as one array; a block with
other frames (CAN FD, errors), or with anything unusual, is left to python-can, so faults are found and named as before.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import can
import numpy as np

from ..units import to_ns

KEY_BITS, REMOTE_FLAG = 0x9FFFFFFF, 0x80  # The highest bit of an id is that of an extended frame, as in `EXTENDED`.
CAN_MESSAGE, CAN_MESSAGE2 = 1, 86
SLOW_TYPES = (73, 100, 101)  # Error frames and CAN FD, left to python-can
MARK = np.frombuffer(b"LOBJ", np.uint8)  # Begin of an object
MAX_EXACT = 2**53  # Times up to here are exact as float64

_BASE = [("mark", "S4"), ("head", "<u2"), ("version", "<u2"), ("size", "<u4"), ("type", "<u4"), ("flags", "<u4")]
_FRAME = [("channel", "<u2"), ("bits", "u1"), ("dlc", "u1"), ("id", "<u4"), ("data", "u1", (8,))]
LAYOUTS = {
    1: np.dtype([*_BASE, ("own", "V4"), ("time", "<i8"), *_FRAME]),  # type: ignore[list-item]
    2: np.dtype([*_BASE, ("own", "V4"), ("time", "<i8"), ("original", "V8"), *_FRAME]),  # type: ignore[list-item]
}
"""Layout of a CAN message by the version of its header."""


class FrameBlock(NamedTuple):
    """Data frames of a block, as columns: times (ns), ids (EXTENDED added to extended ones), buses, lengths, bytes.

    The bytes (n, 8) are zero beyond the length. `total` counts the remote frames too.
    """

    t: np.ndarray
    key: np.ndarray
    bus: np.ndarray
    length: np.ndarray
    data: np.ndarray
    total: int


class BlfBlocks(can.BLFReader):
    """python-can's reader, whose items are a `FrameBlock` where that is possible, otherwise its messages."""

    _tail: bytes

    def _parse_container(self, data: bytes) -> Iterator[Any]:
        joined = self._tail + data if self._tail else data
        found = frames_of(joined, self.start_timestamp)
        if found is None:
            yield from super()._parse_container(data)
            return
        block, end = found
        self._tail = joined[end:]
        yield block


def frames_of(data: bytes, start: float) -> tuple[FrameBlock, int] | None:
    """Return the CAN messages of a block and where its last whole object ends; None if python-can must read it.

    Args:
        data: The block, decompressed, after what the one before it left over.
        start: Start of the log, s.
    """
    content = np.frombuffer(data, np.uint8)
    if content.size < 64:
        return None
    places = np.flatnonzero(content[:-15] == MARK[0])
    places = places[(content[places[:, None] + np.arange(1, 4)] == MARK[1:]).all(axis=1)]
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
    block = FrameBlock(
        to_ns(seconds),
        (frames["id"] & KEY_BITS).astype(np.int64),
        frames["channel"].astype(np.int64) - 1,
        length,
        np.where(np.arange(8) < length[:, None], frames["data"], 0).astype(np.uint8),
        total,
    )
    return block, end
