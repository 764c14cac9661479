"""Source of messages: rows of named values that other programs send, by HTTP or through a broker."""

from __future__ import annotations

import math
import queue
import threading
import time
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from estimators.errors import is_blank, nearest, quoted, shown_name
from estimators.log import Events

from .dates import ns_of_iso
from .mapping import ABSENT, PRESENT, ChannelMapping
from .source import AssetEvents, Channel, Numbers, Report, ignore
from .tables.text import TextMatch, column_of, no_value

ACCEPTED, DUPLICATE, REFUSED = "accepted", "duplicate", "refused"
"""Whether a message was taken."""

NO_BROKER = "no broker"  # Key of the times at which the connection was lost
REFUSED_MESSAGE = "message refused"  # Key of messages that cannot be read
REFUSED_TOPIC = "topic refused"  # Key of topics that the broker does not deliver
RETRY_S = 1.0  # Until a broker, server or device that was lost is tried again

FIELDS = ("time", "values", "source", "sequence")
"""Fields of a message."""

ASSET = "asset"
"""Field with the name of the asset, of messages to a fleet."""

MAX_NAME = 200
"""Longest name of a sender or an asset."""

FORGOTTEN = "asset forgotten"  # Key of assets that made room for others, after one message

MAX_WAITING = 200_000
"""Messages that may wait to be read; further ones are refused, so that the sender repeats them."""

MAX_GAPS = 1024
"""Gaps between the sequence numbers of a sender that are remembered; numbers of an earlier gap count as duplicates."""

MAX_SENDERS = 1024
"""Senders whose sequence numbers are remembered; the one that was silent longest is forgotten first."""

MAX_FLEET_SENDERS = 1_000_000
"""The same of a fleet, in which each topic of an asset is a sender."""

LATEST = 2**62
"""Times must be below it, ns: the year 2116."""


class Answer(NamedTuple):
    """Whether a message was taken, and why it was refused; its arrival, ns, which no other message has."""

    status: str
    reason: str = ""
    arrival: int = 0


FULL = Answer(REFUSED, "too many messages wait; send it again")
NO_ROOM = Answer(REFUSED, "the fleet has as many assets as it may have; enlarge assets in its YAML")
CLOSED = Answer(REFUSED, "nothing is folded any more; send it again after a restart")


class RowBatch(NamedTuple):
    """Messages as rows: times and arrivals (n,), ns; values and their state (n, columns), see `ChannelMapping`."""

    t: np.ndarray
    arrival: np.ndarray
    values: np.ndarray
    state: np.ndarray
    asset: np.ndarray


class SentNumbers:
    """Sequence numbers of messages by sender, as ranges; of at most so many senders."""

    def __init__(self, senders: int | None = None) -> None:
        self._senders = MAX_SENDERS if senders is None else senders
        self._ranges: OrderedDict[str, list[list[int]]] = OrderedDict()

    def add(self, sender: str, number: int) -> bool:
        """Note a number; return whether it is new."""
        ranges = self._ranges.setdefault(sender, [])
        self._ranges.move_to_end(sender)
        if len(self._ranges) > self._senders:
            self._ranges.popitem(last=False)
        k = bisect_right(ranges, number, key=lambda item: item[0])
        if k and number <= ranges[k - 1][1]:
            return False
        ranges.insert(k, [number, number])
        for left in (k, k - 1):
            if 0 <= left < len(ranges) - 1 and ranges[left][1] + 1 == ranges[left + 1][0]:
                ranges[left : left + 2] = [[ranges[left][0], ranges[left + 1][1]]]
        if len(ranges) > MAX_GAPS:
            ranges[:2] = [[ranges[0][0], ranges[1][1]]]
        return True

    def state(self) -> dict[str, list[list[int]]]:
        """Return the first and last number of each range by sender, for `restore`."""
        return {sender: [[*item] for item in ranges] for sender, ranges in self._ranges.items()}

    def restore(self, state: Mapping[str, Sequence[Sequence[int]]]) -> None:
        """Take over the `state` of another."""
        self._ranges = OrderedDict((sender, [[*map(int, item)] for item in ranges]) for sender, ranges in state.items())


class Messages:
    """Live source of the messages that are sent to it. `send` may be called from any thread.

    A message is `{"time": ..., "values": {"LT101": 1.2}, "source": "plc", "sequence": 7}`. Its time is ISO 8601 with an
    offset, or ns since 1970; without one it is that of its arrival. Values are numbers, texts for conditions on texts,
    or null or a word of quality such as "Bad" for a missing value. A message with the source and sequence number of an
    earlier one is a duplicate.

    Args:
        channels: What feeds the model; their signals are names of values.
        width: Value columns of an event.
        report: Receives measurements that a condition rejects, and words of quality.
        assets: Whether each message has the name of its asset, as `"asset": "pump 3"`; `read` returns `AssetEvents`.

    Raises:
        SourceError: If a unit does not convert to the model's.
    """

    live = utc = True

    def __init__(
        self, channels: Iterable[Channel], *, width: int, report: Report = ignore, assets: bool = False
    ) -> None:
        channels = list(channels)
        self._width, self._report, self._assets = width, report, assets
        self.fields = (*FIELDS, ASSET) if assets else FIELDS
        """Fields of a message."""
        self._columns = list(dict.fromkeys(name for channel in channels for name in channel.needed))
        self.names = tuple(dict.fromkeys(map(column_of, self._columns)))
        """Names of the values that the twin reads."""
        self.units = {
            name: unit or model
            for channel in channels
            for name, unit, model in zip(channel.signals, channel.units, channel.model_units, strict=True)
        }
        """Unit of the numbers among them, by name."""
        self._mapping = ChannelMapping(
            [(channels, self._columns, [None] * len(self._columns))], width=width, report=report
        )
        self._waiting: queue.SimpleQueue[RowBatch] = queue.SimpleQueue()
        self._room = MAX_WAITING
        senders = MAX_FLEET_SENDERS if assets else MAX_SENDERS
        self._sent, self._stored = SentNumbers(senders), SentNumbers(senders)
        self._unstored: deque[tuple[int, str, int]] = deque()
        """Count of messages until each numbered one that is not in `_stored` yet, its sender and number."""
        self.accepted = 0
        """Messages that were accepted."""
        self.mark = 0
        """Accepted messages that were read."""
        self._arrived = 0
        self._stores = False
        self.closed = False
        """Whether it takes no messages any more."""
        self._sending = threading.Lock()
        self.room: Callable[[str], float] = lambda asset: math.inf
        """Return how many assets a fleet can still take; infinity for the name of one that it has."""
        self._coming: set[str] = set()
        """New assets whose first messages wait to be read."""

    def send(self, messages: Sequence[Any]) -> list[Answer]:
        """Take messages in their order; return for each what became of it. Wrong ones do not hold up the others."""
        now = time.time_ns()
        values = np.full((len(messages), len(self._columns)), np.nan)
        state = np.full(values.shape, ABSENT, np.int8)
        t = np.full(len(messages), now, np.int64)
        answers = []
        with self._sending:
            behind = self._arrived - now
            arrival = now + (behind + 1 if 0 <= behind < 10**9 else 0) + np.arange(len(messages))
            self._arrived = int(arrival.max(initial=self._arrived))
            for row, message in enumerate(messages):
                answer = CLOSED if self.closed else FULL if row >= self._room else None
                answer = answer or self._take(message, t[row : row + 1], values[row], state[row])
                answer = answer or (self._asset_room(message[ASSET]) if self._assets else None)
                answer = answer or self._number(message)
                self.accepted += answer.status == ACCEPTED
                answers.append(answer._replace(arrival=int(arrival[row])))
            taken = np.array([answer.status == ACCEPTED for answer in answers], np.bool_)
            if taken.any():
                names = [item[ASSET] if self._assets and ok else "" for item, ok in zip(messages, taken, strict=True)]
                rows = RowBatch(t[taken], arrival[taken], values[taken], state[taken], np.array(names, object)[taken])
                self._room -= rows.t.size
                self._waiting.put(rows)
        return answers

    def _take(self, message: object, t: np.ndarray, values: np.ndarray, state: np.ndarray) -> Answer | None:
        """Write the values of a message into its row; return why it is refused, None if it is not."""
        if not isinstance(message, Mapping) or not isinstance(message.get("values"), Mapping):
            return Answer(REFUSED, 'it must be an object with values, such as {"values": {"NAME": 1.2}}')
        for name in message:
            if name not in self.fields:
                return Answer(REFUSED, f"{shown_name(str(name))} is not known; {nearest(str(name), self.fields)}")
        if self._assets:
            asset = message.get(ASSET)
            if not isinstance(asset, str) or not 0 < len(asset) <= MAX_NAME:
                return Answer(REFUSED, f"asset is {_shown(asset)}; it must be a text of 1 to {MAX_NAME} letters")
            # JSON has them, UTF-8 not, and so neither Parquet files nor addresses.
            if not asset.isascii() and any("\ud800" <= letter <= "\udfff" for letter in asset):
                return Answer(REFUSED, f"asset is {ascii(asset)[:MAX_NAME]}, which has half of a surrogate pair")
            if is_blank(asset):
                return Answer(REFUSED, f"asset is {_shown(asset)}, which is blank; give it a visible name")
        if message.get("time") is not None:
            found = _ns(message["time"])
            if isinstance(found, str):
                return Answer(REFUSED, found)
            t[0] = found
        number, sender = message.get("sequence"), message.get("source", "")
        if number is not None and (type(number) is not int or not 0 <= number < 2**63):
            return Answer(REFUSED, f"sequence is {_shown(number)}; it must be a whole number from 0 on")
        if not isinstance(sender, str) or len(sender) > MAX_NAME:
            return Answer(REFUSED, f"source is {_shown(sender)}; it must be a text of at most {MAX_NAME} letters")
        given = message["values"]
        if not given:
            return Answer(REFUSED, f"values is empty; give one of {', '.join(self.names[:8])}")
        for name in given:
            if name not in self.names:
                return Answer(REFUSED, f"{shown_name(str(name))} is no value of this twin; {nearest(name, self.names)}")
        for k, column in enumerate(self._columns):
            name = column_of(column)
            if name not in given:
                continue
            value, state[k] = given[name], PRESENT
            if isinstance(column, TextMatch):
                values[k] = float(str(value) in column.texts)
            elif isinstance(value, int | float) and not isinstance(value, bool):
                try:
                    values[k] = value
                except OverflowError:
                    return Answer(REFUSED, f"{shown_name(name)} is {_shown(value)}, which is too large")
            elif isinstance(value, str) and (word := no_value(name, value)):
                self._report(*word)
            elif value is not None:
                return Answer(
                    REFUSED, f"{shown_name(name)} is {_shown(value)}; it must be a number, or null if missing"
                )
        return None

    def _asset_room(self, asset: str) -> Answer | None:
        """Return the answer to a message of a new asset for which there is no room, and note one for which there is."""
        room = self.room(asset)
        if room == math.inf or asset in self._coming:
            return None
        if len(self._coming) >= room:
            return NO_ROOM
        self._coming.add(asset)
        return None

    def _number(self, message: Mapping[str, Any]) -> Answer:
        """Remember the sequence number of a message; tell whether it is a duplicate."""
        number, sender = message.get("sequence"), message.get("source", "")
        if number is None:
            return Answer(ACCEPTED)
        if not self._sent.add(sender, number):
            return Answer(DUPLICATE)
        if self._stores:
            self._unstored.append((self.accepted + 1, sender, number))
        return Answer(ACCEPTED)

    def numbers(self, mark: int) -> dict[str, list[list[int]]]:
        """Return the sequence numbers of the first `mark` messages, for `restore`; in one thread, with rising marks."""
        with self._sending:
            while self._unstored and self._unstored[0][0] <= mark:
                self._stored.add(*self._unstored.popleft()[1:])
        return self._stored.state()

    def restore(self, numbers: Numbers) -> None:
        """Take over the `numbers` of the source before a restart, if any, and keep them from now on."""
        self._stores = True
        self._sent.restore(numbers)
        self._stored.restore(numbers)

    def read(self, timeout: float) -> Any:
        """Return the events of the next messages; none after `timeout` seconds without one."""
        try:
            found = [self._waiting.get(timeout=timeout)]
        except queue.Empty:
            none = Events.empty(self._width)
            return AssetEvents(none, np.zeros(0, np.int64), ()) if self._assets else none
        while not self._waiting.empty():
            found.append(self._waiting.get())
        rows = RowBatch(*map(np.concatenate, zip(*found, strict=True)))
        with self._sending:
            self._room += rows.t.size
            self.mark += rows.t.size
        plan, skip = np.zeros(rows.t.size, np.int64), np.zeros(rows.t.size, np.int8)
        assets = rows.asset if self._assets else None
        events, row = self._mapping.events(plan, rows.t, rows.arrival, rows.values, rows.state, skip, assets)
        if not self._assets:
            return events
        codes: dict[str, int] = {}
        with self._sending:
            self._coming.difference_update(rows.asset)
        code = np.array([codes.setdefault(name, len(codes)) for name in rows.asset.tolist()], np.int64)
        return AssetEvents(events, code[row], tuple(codes))

    def now(self) -> int:
        """Return this machine's time, ns, which is that of arrivals."""
        return time.time_ns()

    def close(self) -> None:
        """Refuse all further messages, which nobody would read."""
        with self._sending:
            self.closed = True


def _ns(value: object) -> int | str:
    """Return a time as ns, or why it is none."""
    if isinstance(value, str):
        found = ns_of_iso(value)
        if found is None:
            return f"time is {quoted(value)}; it must be ISO 8601 such as 2026-01-31T12:00:00.5Z, or ns since 1970"
        if found[1]:
            return f"time is {quoted(value)}, which has no offset; append Z for UTC or one such as +01:00"
        value = found[0]
    if type(value) is not int:
        return f"time is {_shown(value)}; it must be a whole number of ns since 1970, or ISO 8601"
    return value if -LATEST < value < LATEST else f"time is {value} ns; it must be before the year 2116"


def _shown(value: object) -> str:
    return shown_name(str(value)) if isinstance(value, str) else shown_name(repr(value))
