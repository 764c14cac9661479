"""CAN frames of an MF4 recording by columns (python-can makes an object of each frame: 30 µs).

Runs in the process that reads the file. asammdf stops silently at a record of unknown id, and trusts a group's record
count; so the bytes of records that the file's blocks declare are compared with those that were read (`lost_records`).

Source: ASAM MDF 4.1, blocks HD, DG, CG, DT, DZ, DL and HL.
"""

from __future__ import annotations

import gc
import logging
import struct
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..worker_process import gist
from .readers import CHUNK_FRAMES, EXTENDED, BusName, LogSummary, Raw, unreadable, wanted_rows

if TYPE_CHECKING:
    from asammdf import MDF, Signal
    from asammdf.blocks.mdf_v4 import Group


@contextmanager
def opened(path: Path) -> Iterator[tuple[MDF, bytes]]:
    """Open a file: it and its bytes, as asammdf completes them; its messages are suppressed.

    Raises:
        SourceError: If nothing can be read.
    """
    from asammdf import MDF  # Here, not above: it takes long, and most logs have other formats.

    # From memory: asammdf completes an unfinished file (a logger that lost power) in place.
    content, fault = BytesIO(path.read_bytes()), None
    logging.getLogger("asammdf").setLevel(logging.CRITICAL + 1)
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        try:
            mdf = MDF(content)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  a damaged file makes asammdf raise anything
            fault = unreadable(path, error)
        if fault:
            gc.collect()  # A partly opened file prints messages when it is released.
            raise fault
        with closing(mdf):
            yield mdf, content.getvalue()
    finally:
        sys.unraisablehook = hook


def read_mf4(path: Path, wanted: frozenset[int] | None, longest: int) -> Iterator[Raw | LogSummary]:
    """Yield the wanted frames of a file in order of time, and its summary; see `readers.read_messages`.

    Raises:
        SourceError: If nothing can be read.
    """
    with opened(path) as (mdf, content):
        yield from _read(path, mdf, content, wanted, longest)


def mf4_span(path: Path) -> Iterator[tuple[int, int]]:
    """Yield first and last time of a file's frames, ns; nothing if it has none.

    Raises:
        SourceError: If nothing can be read.
    """
    with opened(path) as (mdf, _):
        ends = []
        for index, group in enumerate(mdf.groups):
            if group.channel_group.cycles_nr and any(c.name == "CAN_DataFrame" for c in group.channels):
                times = mdf.get_master(index)
                ends += [float(times[0]), float(times[-1])] if len(times) else []
        start = start_of(mdf)
    if ends:
        yield start + round(min(ends) * 1e9), start + round(max(ends) * 1e9)


def start_of(mdf: MDF) -> int:
    """Return the start of the file's clock, ns: start_time has the zone, abs_time the fraction of the second."""
    return int(mdf.header.start_time.timestamp() // 1) * 1_000_000_000 + int(mdf.header.abs_time) % 1_000_000_000


def _read(
    path: Path, mdf: MDF, content: bytes, wanted: frozenset[int] | None, longest: int
) -> Iterator[Raw | LogSummary]:
    start = start_of(mdf)
    parts: list[tuple[np.ndarray, ...]] = []
    total = errors = 0
    fault = ""
    for index, group in enumerate(mdf.groups):
        names = {channel.name for channel in group.channels}
        cycles = int(group.channel_group.cycles_nr)
        if "CAN_ErrorFrame" in names:
            errors += cycles
        if not cycles or "CAN_DataFrame" not in names:
            continue
        try:
            signal = mdf.get("CAN_DataFrame", group=index)
            ids, lengths = (signal.samples[f"CAN_DataFrame.{name}"] for name in ("ID", "DataLength"))
            zeros = (signal.timestamps == 0) & (ids == 0) & (lengths == 0)  # of lost bytes
            if zeros.any():
                signal.samples, signal.timestamps = signal.samples[~zeros], signal.timestamps[~zeros]
                fault = fault or f"{zeros.sum()} of {cycles} frames are zeros alone, from {zeros.argmax() + 1} on"
            parts.append(_columns(signal, start, wanted, longest))
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  as above; the other groups may be complete
            fault = fault or f"{cycles} frames cannot be read: {gist(error)}"
            continue
        total += len(signal)
        if len(signal) < cycles:
            marked = "marked invalid" if group.channel_group.invalidation_bytes_nr else "missing"
            fault = fault or f"{cycles - len(signal)} of {cycles} frames are {marked}"
    fault = fault or lost_records(mdf, content)
    if fault and not parts:
        raise unreadable(path, fault)
    seen: dict[tuple[BusName, int], int] = {}
    if parts:
        codes, t, key, bus, length, data = (np.concatenate(column) for column in zip(*parts, strict=True))
        numbers, places = np.unique(bus, return_inverse=True)
        buses = tuple(None if number == NO_BUS else number for number in numbers.tolist())
        order = np.argsort(t, kind="stable")
        for first in range(0, max(1, t.size), CHUNK_FRAMES):
            rows = order[first : first + CHUNK_FRAMES]
            yield Raw(t[rows], key[rows], places[rows], length[rows], data[rows], buses, 0 if first else total)
        # Counted last: the frames are needed first.
        for code, count in zip(*(column.tolist() for column in np.unique(codes, return_counts=True)), strict=True):
            number = code >> 32
            seen[None if number == NO_BUS else number, code & 0xFFFFFFFF] = count
    yield LogSummary(seen, errors, fault)


NO_BUS = -1
"""Number of the bus of a group without bus numbers."""


def _columns(signal: Signal, start: int, wanted: frozenset[int] | None, longest: int) -> tuple[np.ndarray, ...]:
    """Return bus and id of all frames of a group as one number, and the columns of the wanted frames as in `Raw`."""

    def column(name: str) -> np.ndarray | None:
        full = f"CAN_DataFrame.{name}"
        return np.asarray(signal.samples[full]) if full in signal.samples.dtype.names else None

    ids = np.asarray(column("ID"), np.int64)
    key = (ids & 0x1FFFFFFF) | (ids & EXTENDED)
    extended, buses = column("IDE"), column("BusChannel")
    if extended is not None:
        key |= np.where(np.asarray(extended, np.int64) != 0, EXTENDED, 0)
    bus = np.full(key.size, NO_BUS) if buses is None else np.asarray(buses, np.int64)
    rows = wanted_rows(key, wanted)
    data = np.zeros((rows.size, longest), np.uint8)
    given = np.asarray(column("DataBytes"))
    if given.ndim == 2:
        given = given[rows, :longest]
        data[:, : given.shape[1]] = given
    else:  # of varying length, an object each
        for i, row in enumerate(rows):
            item = np.frombuffer(bytes(given[row]), np.uint8)[:longest]
            data[i, : item.size] = item
    length = np.minimum(np.asarray(column("DataLength"), np.int64)[rows], longest)
    # Bytes stored after a frame's end are not part of it.
    data[np.arange(longest) >= length[:, None]] = 0
    t = start + np.round(np.asarray(signal.timestamps, np.float64)[rows] * 1e9).astype(np.int64)
    return (bus << 32) + key, t, key[rows], bus[rows], length, data


VLSD = 1  # Flag of a channel group whose records are of varying length

_HEADER = struct.Struct("<4sIQQ")


def lost_records(mdf: MDF, content: bytes) -> str:
    """Describe the records of an opened file that were not read; empty if there are none.

    Args:
        mdf: asammdf's file, opened.
        content: Its bytes, as asammdf completed them.
    """
    groups: dict[int, list[Group]] = {}
    for group in mdf.groups:
        groups.setdefault(int(group.data_group.address), []).append(group)
    if mdf.version < "4":
        return ""
    lost = kept = records = 0
    for members in groups.values():
        data = members[0].data_group
        if any(group.channel_group.flags & VLSD and any(group.signal_data or ()) for group in members):
            continue  # Only the records themselves hold their lengths.
        try:
            promised = _size(content, int(data.data_block_addr))
        except (struct.error, ValueError) as error:
            return f"a block of records cannot be found: {error}"
        fixed = [group.channel_group for group in members if not group.channel_group.flags & VLSD]
        head = int(data.record_id_len)
        if promised is None:
            continue
        taken = 0
        for item in fixed:
            taken += int(item.cycles_nr) * (head + int(item.samples_byte_nr) + int(item.invalidation_bytes_nr))
            records += int(item.cycles_nr)
        kept += taken
        lost += abs(promised - taken)
    if not lost:
        return ""
    about = f", about {max(1, round(lost * records / kept))} records," if kept else ""
    return f"{lost} of {kept + lost} bytes of records{about} were not read"


def _size(content: bytes, address: int) -> int | None:
    """Return the bytes of records in a data block, or in a list of them; None if they are stored by column."""
    total, waiting, seen = 0, [address], set[int]()
    while waiting:
        address = waiting.pop()
        if not address:
            continue
        if address in seen:
            raise ValueError(f"the block at {address:#x} is linked to twice")
        seen.add(address)
        name, _, length, count = _HEADER.unpack_from(content, address)
        if count > len(content) // 8:
            raise ValueError(f"the block at {address:#x} has {count} links")
        links = struct.unpack_from(f"<{count}Q", content, address + _HEADER.size)
        if name == b"##DT":
            total += length - _HEADER.size
        elif name == b"##DZ":
            total += struct.unpack_from("<Q", content, address + _HEADER.size + 8)[0]
        elif name == b"##HL":
            waiting += links[:1]
        elif name == b"##DL":
            waiting += links
        elif name in (b"##DV", b"##LD"):
            return None
        else:
            raise ValueError(f"there is no block of data at {address:#x}")
    return total
