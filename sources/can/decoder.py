"""Decode CAN frames to events by DBC, and describe messages that are never received."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cantools.database.can import Message, Signal

from estimators.errors import SourceError, nearest
from estimators.log import READING, Events

from ..mapping import ABSENT, PRESENT, SHORT, ChannelMapping
from ..source import NEVER, Channel, Report, ignore
from ..units import declared_conversion, second_ns
from . import sockets
from .database import load_database
from .ids import KnownIds, MessageIds, claim, sender, shown_id
from .limits import SignalLimits, span_of
from .readers import EXTENDED, GROUP, BusName, Raw, group_bits, group_of
from .signals import extract, ordered, tabulate, vectorises
from .transport import TRANSPORT, Transport


class Frames(NamedTuple):
    """Frames that some channel needs: times (ns), index of the message, length, and bytes (n, longest)."""

    t: np.ndarray
    arrival: np.ndarray
    plan: np.ndarray
    length: np.ndarray
    data: np.ndarray


class SendersError(SourceError):
    """A message has several senders, and its channel names none."""


class Decoder:
    """Decodes the messages that the channels need; frames of other ids are skipped.

    Args:
        databases: Database files, each with the bus that it describes (None: every one).
        channels: Signals that feed the model.
        width: Value columns of an event.
        report: Receives frames that do not decode, and values that the DBC excludes.

    Raises:
        SourceError: If a database lacks a message or signal, or a unit does not convert.
    """

    def __init__(
        self,
        databases: Sequence[tuple[Path, BusName]],
        channels: Iterable[Channel],
        *,
        width: int,
        report: Report = ignore,
    ) -> None:
        self._report = report
        self.width = width
        known = KnownIds(message for path, _ in databases for message in load_database(path).messages)
        grouped: dict[tuple[int, int | None], tuple[Message, BusName, Path, list[Channel]]] = {}
        for channel in channels:
            messages, bus, path = find_messages(databases, channel)
            for message in messages:
                grouped.setdefault((id(message), channel.source), (message, bus, path, []))[3].append(channel)
        self._ids: list[MessageIds] = []
        self._plans: list[tuple[Message, BusName, Path, list[Channel]]] = []
        for (_, source), (message, *others) in grouped.items():
            ids = known.ids(message, source)
            own = copy(message)
            own.protocol = "j1939" if ids.j1939 else message.protocol  # with its codes for missing values
            self._ids.append(ids)
            self._plans.append((own, *others))
        self._check_unique()
        self.wanted = frozenset(ids.wanted for ids in self._ids)
        """Ids of the frames that some channel needs, EXTENDED added, or parameter groups of J1939 (`group_of`)."""
        self._transport = None
        if any(ids.j1939 for ids in self._ids):
            self._transport = Transport(self.wanted, report)
            self.wanted |= TRANSPORT
        self._plan_of: dict[tuple[int, BusName], int] = {}
        self._carriers: dict[int, list[tuple[int, BusName]]] = {}
        """Ids and buses that carry a J1939 message, by its index."""
        self.refuse = False
        """Whether a message of several senders, of which none is chosen, is an error; else it is reported."""
        needed = [
            ordered(message, tuple(dict.fromkeys(name for channel in channels for name in channel.needed)))
            for message, _, _, channels in self._plans
        ]
        self._messages = [message for message, *_ in self._plans]
        self._names = [[signal.name for signal in signals] for signals in needed]
        plans, own = list(zip(self._messages, needed, strict=True)), [own for *_, own in self._plans]
        self._signals, self._limits = tabulate(plans), SignalLimits(plans, own, report)
        self._slow = np.array([not all(map(vectorises, signals)) for signals in needed], np.bool_)
        self._any_slow = bool(self._slow.any())
        self._most = max((len(signals) for signals in needed), default=1)
        self.longest = max((message.length for message in self._messages), default=8)
        if self._transport is not None:
            self.longest = max(self.longest, 8)
        """Bytes of the longest message, of J1939 at least those of a packet."""
        self._mapping = ChannelMapping(
            [
                (channels, names, [signal.unit for signal in signals])
                for (_, _, _, channels), names, signals in zip(self._plans, self._names, needed, strict=True)
            ],
            width=width,
            report=report,
        )
        self._unfed = {(channel.kind, channel.index) for *_, own in self._plans for channel in own}
        """Channels without a value so far."""

    def _check_unique(self) -> None:
        for k, ids in enumerate(self._ids):
            for j in range(k):
                (one, bus, path, own), (other, other_bus, other_path, _) = self._plans[j], self._plans[k]
                if not same_bus(bus, other_bus) or not (self._ids[j].fits(ids.first) or ids.fits(self._ids[j].first)):
                    continue
                if one.name == other.name and path == other_path:
                    raise SourceError(f"{own[0].name}: another channel of {one.name} has a source; give one here, too")
                raise SourceError(
                    f"{path.name}: {one.name} and {other.name} ({other_path.name}) have the same id "
                    f"{ids.key & ~EXTENDED:#x}; say on which bus each database holds, as its channel"
                )

    @property
    def filters(self) -> list[dict[str, int]]:
        """Filters of python-can for the wanted ids."""
        return [
            {
                "can_id": key & ~(EXTENDED | GROUP),
                "can_mask": group_bits(key) if key & GROUP else 0x1FFFFFFF if key & EXTENDED else 0x7FF,
                "extended": bool(key & EXTENDED),
            }
            for key in sorted(self.wanted)
        ]

    @property
    def expected(self) -> list[Expected]:
        """Messages of which some channel has had no value yet, with these channels."""
        found = []
        for ids, (message, bus, _, channels) in zip(self._ids, self._plans, strict=True):
            feeds = {c.name: c.signals for c in channels if (c.kind, c.index) in self._unfed}
            if feeds:
                found.append(Expected(message.name, ids, bus, feeds, (message.cycle_time or 0) / 1000))
        return found

    def missing(self, item: Expected, seen: FrameCounts, *, least: int = 1) -> list[str]:
        """Describe a message whose channels have had no value; nothing if it was received fewer than `least` times."""
        counts = Counter(seen) + (self._transport.counts if self._transport is not None else Counter())
        count = sum(n for (bus, key), n in counts.items() if item.ids.fits(key) and same_bus(item.bus, bus))
        bus = "" if count or item.bus is None else f" on bus {item.bus}"
        what = f"{item.name} ({item.ids}{bus})"
        if not count:
            fed = ", ".join(item.feeds)
            return [f"{what} was never received, so {fed} has no values; {_nearest_match(item, seen)}"]
        remedy = "check its multiplexer in the DBC, and the conditions (where, only) of the channel"
        return [
            f"{channel}: {what} was received {count} times, never with {', '.join(signals)}; {remedy}"
            for channel, signals in item.feeds.items()
            if count >= least
        ]

    def plan_of(self, key: int, bus: BusName) -> int:
        """Return the index of a frame's message, -1 if no channel needs it; `key` is its id, with EXTENDED added."""
        try:
            return self._plan_of[key, bus]
        except KeyError:
            fits = [k for k, ids in enumerate(self._ids) if ids.fits(key) and same_bus(self._plans[k][1], bus)]
            # A frame of a format without bus names may fit several messages; the first one counts.
            plan = min(fits, key=lambda k: self._ids[k].j1939, default=-1)
            if key in self.wanted or group_of(key) in self.wanted:
                self._plan_of[key, bus] = plan
                if plan >= 0 and self._ids[plan].j1939:
                    self._carriers.setdefault(plan, []).append((key, bus))
                    self._choose_sender(plan)
                    plan = self._plan_of[key, bus]
            return plan

    def _choose_sender(self, plan: int) -> None:
        """Use one sender of a J1939 message at most: the only one, or that which the database's id names."""
        ids, (message, _, _, channels) = self._ids[plan], self._plans[plan]
        senders = sorted({sender(key) for key, _ in self._carriers[plan]})
        if len(senders) < 2:
            return
        own = {sender(key) for key, _ in self._carriers[plan] if claim(ids.first, key)}
        for key, bus in self._carriers[plan]:
            self._plan_of[key, bus] = plan if len(own) == 1 and sender(key) in own else -1
        fed = ", ".join(dict.fromkeys(one.name for one in channels))
        text = f"{message.name} ({ids}) is sent by {', '.join(senders)}; "
        if len(own) == 1:
            text += f"{fed} takes that of {min(own)}, as the DBC has it; for another one give the channel its source"
        elif len({name[:4] for name in senders}) > 1:
            text += f"give {fed} one of them, such as source: {senders[0][:4]}"
        else:
            text += f"for {fed}, write the destination address of one of them into the id in the DBC"
        if self.refuse and len(own) != 1:
            raise SendersError(text)
        self._report(NEVER, text)

    def frames_of(self, raw: Raw) -> Frames:
        """Return the wanted frames of a log."""
        if self._transport is not None:
            raw = self._transport.add_to(raw)
        codes, inverse = np.unique((raw.bus << 32) + raw.key, return_inverse=True)
        keys = [(code & 0xFFFFFFFF, raw.buses[code >> 32]) for code in codes.tolist()]
        for item in keys:
            self.plan_of(*item)  # First all of them, since two senders exclude each other.
        plan = np.array([self.plan_of(*item) for item in keys], np.int64)[inverse]
        rows = np.flatnonzero(plan >= 0)
        return Frames(raw.t[rows], raw.t[rows], plan[rows], raw.length[rows], raw.data[rows])

    def gather(self, messages: Sequence[sockets.Message], arrivals: Sequence[int]) -> Frames:
        """Return the wanted messages of python-can, which came at `arrivals` (ns), as arrays.

        Error and remote frames carry no data and are left out.
        """
        t, arrival, plan, length, chunks = [], [], [], [], []
        wanted, longest = self.wanted, self.longest
        for k, message in enumerate(messages):
            key = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
            if message.is_error_frame or message.is_remote_frame:
                continue
            if key not in wanted and group_of(key) not in wanted:
                continue
            time, parts = second_ns(message.timestamp), [(key, bytes(message.data))]
            if self._transport is not None and (whole := self._transport.take(message.channel, key, time, parts[0][1])):
                parts.append(whole)
            for part, data in parts:
                if (which := self.plan_of(part, message.channel)) < 0:
                    continue
                plan.append(which)
                t.append(time)
                arrival.append(arrivals[k])
                length.append(min(len(data), longest))
                chunks.append(data[:longest].ljust(longest, b"\0"))
        numbers = (np.array(column, np.int64) for column in (t, arrival, plan, length))
        rows = np.frombuffer(bytearray().join(chunks), np.uint8).reshape(len(chunks), longest)
        return Frames._make((*numbers, rows))

    def decode(self, frames: Frames) -> Events:
        """Return the events of frames, in their order; the same for live frames and a recording."""
        values = np.empty((frames.plan.size, self._most))
        state = np.empty((frames.plan.size, self._most), np.int8)
        bad = np.zeros(frames.plan.size, np.int8)
        fast = np.where(self._slow[frames.plan], -1, frames.plan) if self._any_slow else frames.plan
        extract(self._signals, fast, frames.length, frames.data, values, state, bad)
        if self._any_slow:
            for i in np.flatnonzero(fast != frames.plan).tolist():
                self._by_cantools(frames, i, values, state, bad)
        if np.count_nonzero(bad):
            self._report_undecodable(frames, bad)
        self._limits.apply(frames.plan, values)
        batch, _ = self._mapping.events(frames.plan, frames.t, frames.arrival, values, state, bad)
        if self._unfed and len(batch):
            self._unfed = {item for item in self._unfed if not _valued(batch, self.width, *item)}
        return batch

    def _by_cantools(self, frames: Frames, i: int, values: np.ndarray, state: np.ndarray, bad: np.ndarray) -> None:
        """Decode one frame of a message with signals that the compiled loop does not support."""
        message, names = self._messages[frames.plan[i]], self._names[frames.plan[i]]
        data = frames.data[i, : frames.length[i]].tobytes()
        try:
            found = message.decode(data, decode_choices=False, allow_truncated=True)
        except (ValueError, KeyError, IndexError):  # cantools' DecodeError is a ValueError
            bad[i] = 1
            return
        for j, name in enumerate(names):
            value, signal = found.get(name), message.get_signal_by_name(name)
            values[i, j] = np.nan if value is None else float(value)
            selector = signal.multiplexer_signal
            excluded = selector is not None and found.get(selector) not in (signal.multiplexer_ids or ())
            state[i, j] = PRESENT if value is not None else ABSENT if excluded else SHORT

    def _report_undecodable(self, frames: Frames, bad: np.ndarray) -> None:
        for i in np.flatnonzero(bad):
            message = self._messages[frames.plan[i]]
            data = frames.data[i, : frames.length[i]].tobytes().hex()
            reason = (
                "its multiplexer has a value that the DBC lacks" if bad[i] == 1 else "it ends before its multiplexer"
            )
            self._report(
                "undecodable frame",
                f"{message.name} ({message.frame_id:#x}) with data {data} does not decode: {reason}",
            )


def _valued(batch: Events, width: int, kind: int, index: int) -> bool:
    """Return whether a batch has a value of the sensor, input or state `index` in its first `width` columns."""
    rows = batch.kind == kind
    if kind == READING:
        rows = rows & (batch.channel == index)
        return bool(np.isfinite(batch.value[rows, :width]).any())
    column = index - batch.channel[rows]
    inside = np.flatnonzero((column >= 0) & (column < width))
    return bool(np.isfinite(batch.value[rows][inside, column[inside]]).any())


FrameCounts = Mapping[tuple[BusName, int], int]
"""Data frames by bus and id (EXTENDED added)."""

MAX_NAMED_IDS = 3  # Ids, or buses, named in place of a missing one


class Expected(NamedTuple):
    """A message that channels need: its name, ids, bus, and the channels with their signals.

    `period` is its cycle time by the DBC in seconds, 0 if the DBC has none.
    """

    name: str
    ids: MessageIds
    bus: BusName
    feeds: Mapping[str, Sequence[str]]
    period: float


def _nearest_match(item: Expected, seen: FrameCounts) -> str:
    """Describe the nearest match of a missing message: its id on another bus, near ids, or the buses."""
    if not seen:
        return "no frame was received at all"
    buses = sorted({bus for bus, _ in seen}, key=str)
    own = item.ids.key
    other = sorted({bus for bus, key in seen if item.ids.fits(key)}, key=str)
    if other:
        return f"its id was received on bus {_list(other)}; check the DBC's channel"
    if any(key == own ^ EXTENDED for _, key in seen):
        kind = "standard" if own & EXTENDED else "extended"
        return f"its id was received as a {kind} one, {shown_id(own ^ EXTENDED)}; check the id in the DBC"
    ids = {key for _, key in seen}
    if senders := sorted({f"{key & 0xFF:#04x}" for key in ids if own & EXTENDED and group_of(key) == group_of(own)}):
        text = f"its PGN was received from {', '.join(senders[:MAX_NAMED_IDS])}; "
        return text + f"if that is the message of J1939, give the channel source: {senders[0]}"
    near = sorted(ids, key=lambda key: (abs(key - own), key))[:MAX_NAMED_IDS]
    there = f"there are {len(ids)} ids" if len(ids) > 1 else "there is one id"
    on = f" on bus {_list(buses)}" if buses != [None] else ""
    return f"{there}{on}, the nearest {', '.join(map(shown_id, near))}; check the DBC"


def _list(buses: Sequence[BusName]) -> str:
    shown = ", ".join("without a name" if bus is None else str(bus) for bus in buses[:MAX_NAMED_IDS])
    return shown + (", ..." if len(buses) > MAX_NAMED_IDS else "")


def same_bus(wanted: BusName, actual: BusName) -> bool:
    """Return whether bus `actual` is the bus `wanted`: None is any, and can0 and 0 are the same bus."""
    if wanted is None or actual is None or wanted == actual or str(wanted) == str(actual):
        return True
    if isinstance(wanted, str) == isinstance(actual, str):
        return False
    number, name = (wanted, str(actual)) if isinstance(wanted, int) else (actual, str(wanted))
    digits = name[len(name.rstrip("0123456789")) :]
    return digits != "" and int(digits) == number


def find_messages(databases: Sequence[tuple[Path, BusName]], channel: Channel) -> tuple[list[Message], BusName, Path]:
    """Return the messages that carry a channel, with bus and path of the first database that has them.

    There are several if a DBC gives one name to messages of different ids (two devices of a kind).

    Raises:
        SourceError: If no database has the message, or it lacks a signal.
    """
    name = channel.message
    if name is None:
        raise SourceError(f"{channel.name}: it names no message; add the message of the DBC that carries it")
    known: list[str] = []
    for path, bus in databases:
        database = load_database(path)
        found = [message for message in database.messages if message.name == name]
        if channel.source is not None and found:
            if not all(message.is_extended_frame for message in found):
                raise SourceError(f"{channel.name}: source: {name} has a standard id, without a source address")
            found = [one for one in found if one.frame_id & 0xFF == channel.source] or found[:1]
        for message in found:
            signals = [signal.name for signal in message.signals]
            for signal in channel.needed:
                if signal not in signals:
                    raise SourceError(
                        f"{path.name}: message {name} has no signal {signal!r}; {nearest(signal, signals)}"
                    )
        if found:
            return found, bus, path
        known += [message.name for message in database.messages]
    files = ", ".join(path.name for path, _ in databases)
    raise SourceError(f"{files}: there is no message {name!r}; {nearest(name, known)}")


def ends_of(databases: list[tuple[Path, BusName]], channel: Channel) -> tuple[tuple[float, ...], ...]:
    """Return the two ends of each signal of a channel by the DBC, in the model's units.

    Raises:
        SourceError: If no database has it, or a unit does not convert.
    """
    found = slopes(find_messages(databases, channel)[0][0], channel)
    return tuple(tuple(slope * end + shift for end in span_of(signal)[:2]) for signal, slope, shift in found)


def slopes(message: Message, channel: Channel) -> Iterator[tuple[Signal, float, float]]:
    """Yield each signal of a channel with slope and shift of its conversion to the model's unit.

    Raises:
        SourceError: If a unit does not convert.
    """
    for k, name in enumerate(channel.signals):
        signal, unit = message.get_signal_by_name(name), channel.model_units[k]
        factor, shift = declared_conversion(channel.units[k], signal.unit, unit, f"{channel.name}: {name}")
        yield signal, channel.scale[k] * factor, channel.scale[k] * shift + channel.offset[k]
