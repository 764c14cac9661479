"""Ids of the frames that carry a message: one, or of J1939 all with its parameter group number (PGN).

An id of 29 bits is priority (3 bits), data page (2), PDU format (8), PDU specific (8) and source address (8). Below
format 240, PDU specific is the destination address; from there on it belongs to the PGN.

Source: SAE J1939-21, section 5.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from cantools.database.can import Message

from .readers import EXTENDED, group_of

PRIORITY = 7 << 26
NULL_ADDRESS = 0xFE  # Source address that no sender has; in a DBC it stands for any


@dataclass(frozen=True)
class MessageIds:
    """The ids of a message: `key`, with EXTENDED, or all of its parameter group, from one `source` or from any.

    `others` are ids without priority of other messages of the group: these are told apart by their addresses.
    """

    key: int
    j1939: bool = False
    source: int | None = None
    others: frozenset[int] = frozenset()

    def __str__(self) -> str:
        if not self.j1939:
            return shown_id(self.key)
        sender = "" if self.source is None else f" from source {self.source:#04x}"
        return f"PGN {(self.wanted >> 8) & 0x3FFFF}{sender}"

    @property
    def wanted(self) -> int:
        """Key by which a reader selects the frames."""
        return group_of(self.key) if self.j1939 else self.key

    @property
    def first(self) -> int:
        """An id without priority that fits, with EXTENDED."""
        key = self.key & ~PRIORITY
        return key if self.source is None else key & ~0xFF | self.source

    def fits(self, key: int) -> bool:
        """Return whether a frame of an id, with EXTENDED, carries the message."""
        if not self.j1939:
            return key == self.key
        if group_of(key) != self.wanted or self.source not in (None, key & 0xFF):
            return False
        own, other = claim(self.first, key), max((claim(one, key) for one in self.others), default=0)
        return own > other or (own == other and (not self.others or self.source is not None))


def claim(known: int, key: int) -> int:
    """Return 2 if an id of a database is that of a frame but for its priority, 1 if it has no source, otherwise 0."""
    if (known ^ key) & ~PRIORITY & ~0xFF:
        return 0
    return 2 if known & 0xFF == key & 0xFF else int(known & 0xFF == NULL_ADDRESS)


def shown_id(key: int) -> str:
    """Return an id as text: 0x7e8, or 0x18fef100x of an extended frame."""
    return f"{key & ~EXTENDED:#x}{'x' if key & EXTENDED else ''}"


def sender(key: int) -> str:
    """Return the addresses in an id of J1939 as text: its source, and its destination if it has one."""
    to = f" to {key >> 8 & 0xFF:#04x}" if key >> 16 & 0xFF < 240 else ""
    return f"{key & 0xFF:#04x}{to}"


class KnownIds:
    """Messages of databases by the ids of their frames."""

    def __init__(self, messages: Iterable[Message]) -> None:
        self._exact: dict[int, Message] = {}
        self._groups: dict[int, list[Message]] = defaultdict(list)
        for message in messages:
            key = key_of(message)
            self._exact.setdefault(key, message)
            if key & EXTENDED:
                self._groups[group_of(key)].append(message)

    def ids(self, message: Message, source: int | None = None) -> MessageIds:
        """Return the ids of a message, or those from one source address, which only J1939 has."""
        key = key_of(message)
        if not key & EXTENDED or (message.protocol != "j1939" and source is None):
            return MessageIds(key)
        others = {key_of(one) & ~PRIORITY for one in self._groups.get(group_of(key), ()) if one.protocol == "j1939"}
        return MessageIds(key, True, source, frozenset(others - {key & ~PRIORITY}))

    def find(self, key: int) -> Message | None:
        """Return the message that a frame of an id, with EXTENDED, carries."""
        found = self._exact.get(key)
        group = self._groups.get(group_of(key), ()) if found is None else ()
        return found or next((one for one in group if self.ids(one).fits(key)), None)


def key_of(message: Message) -> int:
    """Return the id of a message in its database, with EXTENDED."""
    return message.frame_id | (EXTENDED if message.is_extended_frame else 0)
