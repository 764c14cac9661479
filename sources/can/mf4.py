"""CAN frames of an MF4 recording, whole columns at a time (python-can makes an object of each frame: 30 µs)."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .decoder import EXTENDED, Decoder, Frames


class Recorded(NamedTuple):
    """What an MF4 file held: the wanted frames, how many frames and error frames in all, and what is wrong with it."""

    frames: Frames
    total: int
    errors: int
    fault: str


class DamagedError(Exception):
    """An MF4 file of which nothing can be read."""


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


def _open(path: Path) -> Any:
    from asammdf import MDF  # Here, not above: it takes a second, and most logs are of other formats.

    try:
        # From memory: asammdf completes an unfinished file (a logger that lost power) in place.
        return MDF(BytesIO(path.read_bytes()))
    except Exception as error:  # noqa: BLE001  a damaged file makes asammdf raise anything
        reason = " ".join(f"{error}".split())[:160] or type(error).__name__
    # What was half opened complains when it is let go of, so that is done here, where nobody listens.
    gc.collect()
    raise DamagedError(reason)


def read_mf4(path: Path, decoder: Decoder) -> Recorded:
    """All frames of a file that the decoder wants, in order of time.

    Raises:
        DamagedError: If nothing can be read.
        OSError: If the file cannot be opened.
    """
    with _hushed():
        mdf = _open(path)
        try:
            return _read(mdf, decoder)
        finally:
            mdf.close()


def mf4_span(path: Path) -> tuple[int, int] | None:
    """First and last time of a file's frames, ns; None if it has none.

    Raises:
        DamagedError: If nothing can be read.
        OSError: If the file cannot be opened.
    """
    with _hushed():
        mdf = _open(path)
        try:
            ends = []
            for index, group in enumerate(mdf.groups):
                if group.channel_group.cycles_nr and any(c.name == "CAN_DataFrame" for c in group.channels):
                    times = mdf.get_master(index)
                    ends += [float(times[0]), float(times[-1])] if len(times) else []
            start = _start(mdf)
        finally:
            mdf.close()
    return (start + round(min(ends) * 1e9), start + round(max(ends) * 1e9)) if ends else None


def _start(mdf: Any) -> int:
    """When the file's clock began, ns: start_time knows the zone, abs_time the part of the second."""
    return int(mdf.header.start_time.timestamp() // 1) * 1_000_000_000 + int(mdf.header.abs_time) % 1_000_000_000


def _read(mdf: Any, decoder: Decoder) -> Recorded:
    start = _start(mdf)
    parts: list[Frames] = []
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
        except Exception as error:  # noqa: BLE001  as above; the other groups may be whole
            fault = fault or " ".join(f"{error}".split())[:160] or type(error).__name__
            continue
        total += len(signal)
        if len(signal) < cycles:
            fault = fault or f"{cycles - len(signal)} of {cycles} frames are gone"
        if len(signal):
            parts.append(_wanted(signal, start, decoder))
    frames = decoder.gather([], None) if not parts else Frames(*(np.concatenate(c) for c in zip(*parts, strict=True)))
    order = np.argsort(frames.t, kind="stable")
    return Recorded(Frames(*(column[order] for column in frames)), total, errors, fault)


def _wanted(signal: Any, start: int, decoder: Decoder) -> Frames:
    """The wanted frames of one group."""
    samples = signal.samples
    fields = samples.dtype.names

    def field(name: str) -> np.ndarray | None:
        full = f"CAN_DataFrame.{name}"
        return np.asarray(samples[full]) if full in fields else None

    ids = np.asarray(field("ID"), np.int64)
    extended = field("IDE")
    key = (ids & 0x1FFFFFFF) | (ids & EXTENDED)
    if extended is not None:
        key |= np.where(np.asarray(extended, np.int64) != 0, EXTENDED, 0)
    bus = field("BusChannel")
    buses = np.zeros(key.size, np.int64) if bus is None else np.asarray(bus, np.int64)
    plan = np.full(key.size, -1, np.int64)
    for wanted in decoder.wanted:
        rows = np.flatnonzero(key == wanted)
        for number in np.unique(buses[rows]):
            plan[rows[buses[rows] == number]] = decoder.plan_of(wanted, None if bus is None else int(number))
    rows = np.flatnonzero(plan >= 0)
    data = np.zeros((rows.size, decoder.longest), np.uint8)
    given = np.asarray(field("DataBytes"))
    if given.ndim == 2:
        given = given[rows, : decoder.longest]
        data[:, : given.shape[1]] = given
    else:  # of varying length, an object each
        for i, row in enumerate(rows):
            item = np.frombuffer(bytes(given[row]), np.uint8)[: decoder.longest]
            data[i, : item.size] = item
    length = np.minimum(np.asarray(field("DataLength"), np.int64)[rows], decoder.longest)
    # What is stored behind a frame's end is not part of it.
    data[np.arange(decoder.longest) >= length[:, None]] = 0
    t = start + np.round(np.asarray(signal.timestamps, np.float64)[rows] * 1e9).astype(np.int64)
    return Frames(t, t, plan[rows], length, data)
