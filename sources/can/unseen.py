"""What a twin's channels are mapped to and the bus or log does not give, with what it gives instead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from .frames import EXTENDED, BusName

Seen = Mapping[tuple[BusName, int], int]
"""Data frames by bus and id (EXTENDED added)."""

NEAR = 3
"""Ids that are named in place of one that was not seen, and buses."""


class Expected(NamedTuple):
    """A message that channels need: its name, its id (EXTENDED added), its bus, and the channels with their signals.

    `period` is the seconds between two of it by the DBC, 0 if that does not say.
    """

    name: str
    key: int
    bus: BusName
    feeds: Mapping[str, Sequence[str]]
    period: float


def shown_id(key: int) -> str:
    """An id as it is written: 0x7e8, or 0x18fef100x of an extended frame."""
    return f"{key & ~EXTENDED:#x}{'x' if key & EXTENDED else ''}"


def unheard(item: Expected, seen: Seen) -> str:
    """That no frame of a message came, and what did: the same id elsewhere, near ids, or the buses that there are."""
    where = "" if item.bus is None else f" on bus {item.bus}"
    return f"{item.name} ({shown_id(item.key)}{where}) never came, so {', '.join(item.feeds)} gets nothing; " + (
        _instead(item, seen)
    )


def unsaid(item: Expected, channel: str, count: int) -> str:
    """That frames of a message came and none gave a channel its value."""
    signals = ", ".join(item.feeds[channel])
    return (
        f"{channel}: {item.name} ({shown_id(item.key)}) came {count} times and never gave {signals}; check its "
        "multiplexer in the DBC, and the conditions (where, only) of the channel"
    )


def _instead(item: Expected, seen: Seen) -> str:
    if not seen:
        return "no frame came at all"
    buses = sorted({bus for bus, _ in seen}, key=str)
    other = sorted({bus for bus, key in seen if key == item.key}, key=str)
    if other:
        return f"that id came on bus {_list(other)}; check the DBC's channel"
    if any(key == item.key ^ EXTENDED for _, key in seen):
        kind = "standard" if item.key & EXTENDED else "extended"
        return f"that id came as {kind} one, {shown_id(item.key ^ EXTENDED)}; check the id in the DBC"
    ids = {key for _, key in seen}
    near = sorted(ids, key=lambda key: (abs(key - item.key), key))[:NEAR]
    there = f"there are {len(ids)} ids" if len(ids) > 1 else "there is one id"
    on = f" on bus {_list(buses)}" if buses != [None] else ""
    return f"{there}{on}, the nearest {', '.join(map(shown_id, near))}; check the DBC"


def _list(buses: Sequence[BusName]) -> str:
    shown = ", ".join("without a name" if bus is None else str(bus) for bus in buses[:NEAR])
    return shown + (", ..." if len(buses) > NEAR else "")
