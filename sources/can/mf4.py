"""CAN frames of an MF4 recording, whole columns at a time (python-can makes an object of each frame: 30 µs).

It runs in the process that reads the file; see `apart`.
"""

from __future__ import annotations

import gc
import logging
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from .frames import CHUNK, EXTENDED, BusName, Found, Raw, unreadable
from .mf4_blocks import lost_records


@contextmanager
def _hushed() -> Iterator[None]:
    """Without the lines that asammdf writes when a half-opened file is let go of."""
    logger, hook = logging.getLogger("asammdf"), sys.unraisablehook
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = hook
        logger.setLevel(level)


def _open(path: Path) -> tuple[Any, BytesIO]:
    from asammdf import MDF  # Here, not above: it takes long, and most logs are of other formats.

    # From memory: asammdf completes an unfinished file (a logger that lost power) in place.
    content = BytesIO(path.read_bytes())
    try:
        return MDF(content), content
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001  a damaged file makes asammdf raise anything
        fault = unreadable(path, error)
    # What was half opened complains when it is let go of, so that is done here, where nobody listens.
    gc.collect()
    raise fault


def read_mf4(path: Path, wanted: frozenset[int] | None, longest: int) -> Iterator[Raw | Found]:
    """The wanted frames of a file in order of time, and at last what was found; see `readers.read_frames`.

    Raises:
        SourceError: If nothing can be read.
    """
    with _hushed():
        mdf, content = _open(path)
        try:
            yield from _read(path, mdf, content, wanted, longest)
        finally:
            mdf.close()


def mf4_span(path: Path) -> Iterator[tuple[int, int]]:
    """First and last time of a file's frames, ns; nothing if it has none.

    Raises:
        SourceError: If nothing can be read.
    """
    with _hushed():
        mdf, _ = _open(path)
        try:
            ends = []
            for index, group in enumerate(mdf.groups):
                if group.channel_group.cycles_nr and any(c.name == "CAN_DataFrame" for c in group.channels):
                    times = mdf.get_master(index)
                    ends += [float(times[0]), float(times[-1])] if len(times) else []
            start = _start(mdf)
        finally:
            mdf.close()
    if ends:
        yield start + round(min(ends) * 1e9), start + round(max(ends) * 1e9)


def _start(mdf: Any) -> int:
    """When the file's clock began, ns: start_time knows the zone, abs_time the part of the second."""
    return int(mdf.header.start_time.timestamp() // 1) * 1_000_000_000 + int(mdf.header.abs_time) % 1_000_000_000


def _read(path: Path, mdf: Any, content: BytesIO, wanted: frozenset[int] | None, longest: int) -> Iterator[Raw | Found]:
    start = _start(mdf)
    parts: list[Raw] = []
    named: list[tuple[np.ndarray, np.ndarray | None]] = []
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
            keys, buses = _names(signal)
            part = _wanted(signal, keys, buses, start, wanted, longest)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  as above; the other groups may be complete
            gist = " ".join(f"{error}".split())[:100] or type(error).__name__
            fault = fault or f"{cycles} frames cannot be read: {gist}"
            continue
        total += len(signal)
        if len(signal) < cycles:
            fault = fault or f"{cycles - len(signal)} of {cycles} frames are gone"
        named.append((keys, buses))
        parts.append(part)
    fault = fault or lost_records(mdf, content.getvalue())
    if parts:
        yield from _in_order(parts, total)
    elif fault:
        raise unreadable(path, fault)
    # Counted last: nothing waits for it.
    yield Found(_counted(named), errors, fault)


def _in_order(parts: list[Raw], total: int) -> Iterator[Raw]:
    """The frames of all groups in order of time, some thousands at once."""
    buses = tuple(dict.fromkeys(bus for part in parts for bus in part.buses))
    places = [np.array([buses.index(bus) for bus in part.buses], np.int64)[part.bus] for part in parts]
    t, key, length, data = (np.concatenate([part[k] for part in parts]) for k in (0, 1, 3, 4))
    bus = np.concatenate(places)
    order = np.argsort(t, kind="stable")
    for first in range(0, max(1, t.size), CHUNK):
        rows = order[first : first + CHUNK]
        yield Raw(t[rows], key[rows], bus[rows], length[rows], data[rows], buses, 0 if first else total)


def _field(signal: Any, name: str) -> np.ndarray | None:
    full = f"CAN_DataFrame.{name}"
    return np.asarray(signal.samples[full]) if full in signal.samples.dtype.names else None


def _names(signal: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Ids of the frames of a group, and their buses if it tells them."""
    ids = np.asarray(_field(signal, "ID"), np.int64)
    keys = (ids & 0x1FFFFFFF) | (ids & EXTENDED)
    extended = _field(signal, "IDE")
    if extended is not None:
        keys |= np.where(np.asarray(extended, np.int64) != 0, EXTENDED, 0)
    buses = _field(signal, "BusChannel")
    return keys, None if buses is None else np.asarray(buses, np.int64)


def _counted(named: list[tuple[np.ndarray, np.ndarray | None]]) -> dict[tuple[BusName, int], int]:
    seen: Counter[tuple[BusName, int]] = Counter()
    for keys, buses in named:
        numbers = np.zeros(keys.size, np.int64) if buses is None else buses
        for number in np.unique(numbers):
            found, counts = np.unique(keys[numbers == number], return_counts=True)
            bus = None if buses is None else int(number)
            for key, count in zip(found.tolist(), counts.tolist(), strict=True):
                seen[bus, key] += count
    return dict(seen)


def _wanted(
    signal: Any,
    keys: np.ndarray,
    buses: np.ndarray | None,
    start: int,
    wanted: frozenset[int] | None,
    longest: int,
) -> Raw:
    """The wanted frames of one group."""
    if wanted is None:
        rows = np.arange(keys.size)
    else:
        picked = np.zeros(keys.size, np.bool_)
        for key in wanted:
            picked |= keys == key
        rows = np.flatnonzero(picked)
    names: tuple[BusName, ...] = (None,)
    places = np.zeros(rows.size, np.int64)
    if buses is not None:
        numbers, places = np.unique(buses[rows], return_inverse=True)
        names = tuple(numbers.tolist())
    data = np.zeros((rows.size, longest), np.uint8)
    given = np.asarray(_field(signal, "DataBytes"))
    if given.ndim == 2:
        given = given[rows, :longest]
        data[:, : given.shape[1]] = given
    else:  # of varying length, an object each
        for i, row in enumerate(rows):
            item = np.frombuffer(bytes(given[row]), np.uint8)[:longest]
            data[i, : item.size] = item
    length = np.minimum(np.asarray(_field(signal, "DataLength"), np.int64)[rows], longest)
    # What is stored after a frame's end is not part of it.
    data[np.arange(longest) >= length[:, None]] = 0
    t = start + np.round(np.asarray(signal.timestamps, np.float64)[rows] * 1e9).astype(np.int64)
    return Raw(t, keys[rows], places, length, data, names, len(signal))
