"""Messages of J1939 with more than 8 bytes, assembled from the packets of its transport protocol.

A sender announces a message to all nodes (BAM) or to one (RTS) in a frame TP.CM, and sends 7 bytes in each frame TP.DT.

Source: SAE J1939-21, section 5.10.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator
from dataclasses import dataclass, field

import numpy as np

from ..source import Report
from .readers import EXTENDED, BusName, Raw, group_of, wanted_rows

MANAGEMENT, TRANSFER = (group_of(EXTENDED | form << 16) for form in (0xEC, 0xEB))
TRANSPORT = frozenset((MANAGEMENT, TRANSFER))
"""Parameter groups of TP.CM and TP.DT."""

RTS, BAM, ABORT = 16, 32, 255  # First byte of TP.CM

ALL = 0xFF  # Destination of a message to all nodes

TIMEOUTS_NS = {True: 750_000_000, False: 1_250_000_000}
"""Longest time between two packets to all nodes (T1), and to one (T2)."""


@dataclass
class _Session:
    key: int
    size: int
    count: int
    last: int
    packets: dict[int, bytes] = field(default_factory=dict)


class Transport:
    """Assembles messages; those that lack a packet are reported and left out.

    Args:
        wanted: Parameter groups (`group_of`) to assemble; None is all.
        report: Receives incomplete messages.
    """

    def __init__(self, wanted: Container[int] | None, report: Report) -> None:
        self._wanted, self._report = wanted, report
        self._open: dict[tuple[BusName, int, int], _Session] = {}
        self.counts: Counter[tuple[BusName, int]] = Counter()
        """Messages assembled so far, by bus and id with EXTENDED."""

    def take(self, bus: BusName, key: int, t: int, data: bytes) -> tuple[int, bytes] | None:
        """Take a frame; return id (with EXTENDED) and bytes of the message that it completes.

        Args:
            bus: Bus of the frame.
            key: Its id, with EXTENDED.
            t: Its time, ns.
            data: Its bytes.
        """
        group, pair = group_of(key), (bus, key & 0xFF, key >> 8 & 0xFF)
        if group == MANAGEMENT and len(data) >= 8:
            self._manage(pair, key, t, data)
        session = self._open.get(pair) if group == TRANSFER and len(data) >= 8 else None
        if session is None:
            return None
        to_all, number = pair[2] == ALL, data[0]
        late = t - session.last > TIMEOUTS_NS[to_all]
        if late or not 1 <= number <= session.count or (to_all and number != len(session.packets) + 1):
            self._drop(pair)
            return None
        session.last = t
        session.packets[number] = data[1:8]
        if len(session.packets) < session.count:
            return None
        del self._open[pair]
        self.counts[bus, session.key] += 1
        return session.key, b"".join(session.packets[k + 1] for k in range(session.count))[: session.size]

    def add_to(self, raw: Raw) -> Raw:
        """Return frames of a log with the messages that they complete, each after its last packet."""
        if not (found := list(self.take_all(raw))):
            return raw
        rows, longest = np.array([row for row, *_ in found]), raw.data.shape[1]
        keys, parts = [key for _, _, key, _ in found], [data[:longest] for *_, data in found]
        content = np.frombuffer(b"".join(part.ljust(longest, b"\0") for part in parts), np.uint8).reshape(-1, longest)
        added = raw.t[rows], keys, raw.bus[rows], [*map(len, parts)], content
        columns = (np.insert(column, rows + 1, new, axis=0) for column, new in zip(raw[:5], added, strict=True))
        return Raw._make((*columns, raw.buses, raw.total))

    def take_all(self, raw: Raw) -> Iterator[tuple[int, BusName, int, bytes]]:
        """Yield row of the last packet, bus, id and bytes of each message that frames of a log complete."""
        for row in wanted_rows(raw.key, TRANSPORT).tolist():
            bus, data = raw.buses[raw.bus[row]], raw.data[row, : raw.length[row]].tobytes()
            if whole := self.take(bus, int(raw.key[row]), int(raw.t[row]), data):
                yield row, bus, *whole

    def _manage(self, pair: tuple[BusName, int, int], key: int, t: int, data: bytes) -> None:
        bus, source, destination = pair
        if data[0] == ABORT:
            self._drop(pair)
            self._drop((bus, destination, source))
        if data[0] not in (RTS, BAM):
            return
        self._drop(pair)
        size, count, pgn = data[1] | data[2] << 8, data[3], int.from_bytes(data[5:8], "little")
        # A group of format below 240 is sent to the destination.
        whole = EXTENDED | key & 7 << 26 | pgn << 8 | (destination << 8 if pgn >> 8 & 0xFF < 240 else 0) | source
        if self._wanted is None or group_of(whole) in self._wanted:
            self._open[pair] = _Session(whole, size, count, t)
            if not 8 < size <= 7 * count < size + 7:
                self._drop(pair)

    def _drop(self, pair: tuple[BusName, int, int]) -> None:
        session = self._open.pop(pair, None)
        if session is not None:
            self._report(
                "incomplete message",
                f"PGN {group_of(session.key) >> 8 & 0x3FFFF} from source {pair[1]:#04x}: {len(session.packets)} of "
                f"{session.count} packets were received in time and in order; the message is left out",
            )
