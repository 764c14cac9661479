"""CAN frames to events, by DBC."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimators.errors import SourceError
from estimators.log import READING, Events

from ..clock import second_ns
from ..mapping import ABSENT, PRESENT, SHORT, Mapping
from ..source import Channel, Report, ignore
from .databases import find_messages, load_database, same_bus
from .frames import EXTENDED, BusName, Raw
from .signals import extract, ordered, tabulate, vectorises
from .unseen import Expected, Seen, unheard, unsaid


class Frames(NamedTuple):
    """Frames that some channel needs: times (ns), the message that each is, its length and its bytes (n, longest)."""

    t: np.ndarray
    arrival: np.ndarray
    plan: np.ndarray
    length: np.ndarray
    data: np.ndarray


class Decoder:
    """Decodes the messages that the channels need and rejects all others by their id.

    Args:
        databases: Database files, each with the bus on which it holds (None: every one).
        channels: What feeds the model.
        width: Value columns of an event.
        report: Told of frames that do not decode.

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
        found = [(Path(path), bus) for path, bus in databases]
        for path, _ in found:
            load_database(path)
        grouped: dict[int, tuple[Any, BusName, Path, list[Channel]]] = {}
        for channel in channels:
            messages, bus, path = find_messages(found, channel)
            for message in messages:
                grouped.setdefault(id(message), (message, bus, path, []))[3].append(channel)
        self._plans = list(grouped.values())
        self._keys = [message.frame_id | (EXTENDED if message.is_extended_frame else 0) for message, *_ in self._plans]
        self._check_unique()
        self.wanted = frozenset(self._keys)
        """Ids of the frames that some channel needs, with EXTENDED added for extended ones."""
        self._plan_of: dict[tuple[int, BusName], int] = {}
        needed = [
            ordered(message, tuple(dict.fromkeys(name for channel in channels for name in channel.needed)))
            for message, _, _, channels in self._plans
        ]
        self._messages = [message for message, *_ in self._plans]
        self._names = [[signal.name for signal in signals] for signals in needed]
        self._signals = tabulate(list(zip(self._messages, needed, strict=True)))
        self._slow = np.array([not all(map(vectorises, signals)) for signals in needed], np.bool_)
        self._any_slow = bool(self._slow.any())
        self._most = max((len(signals) for signals in needed), default=1)
        self.longest = max((message.length for message in self._messages), default=8)
        """Bytes of the longest message."""
        self._mapping = Mapping(
            [
                (channels, names, [signal.unit for signal in signals])
                for (_, _, _, channels), names, signals in zip(self._plans, self._names, needed, strict=True)
            ],
            width=width,
            report=report,
        )
        self._silent = {(channel.kind, channel.index) for *_, own in self._plans for channel in own}
        """Channels that no value has come for."""

    def _check_unique(self) -> None:
        for k, key in enumerate(self._keys):
            for j in range(k):
                (one, bus, path, _), (other, other_bus, other_path, _) = self._plans[j], self._plans[k]
                if self._keys[j] == key and same_bus(bus, other_bus):
                    raise SourceError(
                        f"{path.name}: {one.name} and {other.name} ({other_path.name}) have the same id "
                        f"{key & ~EXTENDED:#x}; say on which bus each database holds, as its channel"
                    )

    @property
    def filters(self) -> list[dict[str, Any]]:
        """Filters of python-can's that let through what is wanted."""
        return [
            {
                "can_id": key & ~EXTENDED,
                "can_mask": 0x1FFFFFFF if key & EXTENDED else 0x7FF,
                "extended": bool(key & EXTENDED),
            }
            for key in sorted(self.wanted)
        ]

    @property
    def expected(self) -> list[Expected]:
        """The messages of which some channel has had no value yet, with these channels."""
        found = []
        for key, (message, bus, _, channels) in zip(self._keys, self._plans, strict=True):
            feeds = {c.name: c.signals for c in channels if (c.kind, c.index) in self._silent}
            if feeds:
                found.append(Expected(message.name, key, bus, feeds, (message.cycle_time or 0) / 1000))
        return found

    @staticmethod
    def missing(item: Expected, seen: Seen, *, least: int = 1) -> list[str]:
        """What to say of a message whose channels have had no value; nothing if it came fewer than `least` times."""
        count = sum(n for (bus, key), n in seen.items() if key == item.key and same_bus(item.bus, bus))
        if not count:
            return [unheard(item, seen)]
        return [unsaid(item, channel, count) for channel in item.feeds] if count >= least else []

    def plan_of(self, key: int, bus: BusName) -> int:
        """The message that a frame is, or -1 if nobody needs it; `key` is its id, with EXTENDED added."""
        try:
            return self._plan_of[key, bus]
        except KeyError:
            fits = [k for k, known in enumerate(self._keys) if known == key and same_bus(self._plans[k][1], bus)]
            # A frame whose format does not tell its bus may fit several messages; the first it is.
            plan = fits[0] if fits else -1
            if key in self.wanted:
                self._plan_of[key, bus] = plan
            return plan

    def frames_of(self, raw: Raw) -> Frames:
        """Those frames of a log that are wanted."""
        plan = np.full(raw.key.size, -1, np.int64)
        for key in self.wanted:
            rows = np.flatnonzero(raw.key == key)
            for place in np.unique(raw.bus[rows]):
                plan[rows[raw.bus[rows] == place]] = self.plan_of(key, raw.buses[place])
        rows = np.flatnonzero(plan >= 0)
        t = raw.t[rows]
        return Frames(t, t, plan[rows], raw.length[rows], raw.data[rows])

    def gather(self, messages: Sequence[Any], arrivals: Sequence[int] | None) -> Frames:
        """Those of python-can's messages that are wanted, as arrays; `arrivals` (ns) None takes the frames' own times.

        Error and remote frames carry no data and are left out.
        """
        t, arrival, plan, length, chunks = [], [], [], [], []
        wanted, longest = self.wanted, self.longest
        for k, message in enumerate(messages):
            key = message.arbitration_id | EXTENDED if message.is_extended_id else message.arbitration_id
            if key not in wanted or message.is_error_frame or message.is_remote_frame:
                continue
            which = self.plan_of(key, message.channel)
            if which < 0:
                continue
            plan.append(which)
            t.append(second_ns(message.timestamp))
            if arrivals is not None:
                arrival.append(arrivals[k])
            data = bytes(message.data[:longest])
            length.append(len(data))
            chunks.append(data.ljust(longest, b"\0"))
        times = np.array(t, np.int64)
        return Frames(
            times,
            times if arrivals is None else np.array(arrival, np.int64),
            np.array(plan, np.int64),
            np.array(length, np.int64),
            np.frombuffer(bytearray().join(chunks), np.uint8).reshape(len(chunks), longest),
        )

    def decode(self, frames: Frames) -> Events:
        """The events of frames, in their order; the same for a live frame and for a whole recording."""
        values = np.empty((frames.plan.size, self._most))
        state = np.empty((frames.plan.size, self._most), np.int8)
        bad = np.zeros(frames.plan.size, np.int8)
        fast = np.where(self._slow[frames.plan], -1, frames.plan) if self._any_slow else frames.plan
        extract(self._signals, fast, frames.length, frames.data, values, state, bad)
        if self._any_slow:
            for i in np.flatnonzero(fast != frames.plan).tolist():
                self._by_cantools(frames, i, values, state, bad)
        if bad.any():
            self._tell(frames, bad)
        batch = self._mapping.events(frames.plan, frames.t, frames.arrival, values, state, bad)
        if self._silent and len(batch):
            self._silent = {item for item in self._silent if not _valued(batch, self.width, *item)}
        return batch

    def _by_cantools(self, frames: Frames, i: int, values: np.ndarray, state: np.ndarray, bad: np.ndarray) -> None:
        """Decode one frame of a message with signals that the compiled loop does not know."""
        message, names = self._messages[frames.plan[i]], self._names[frames.plan[i]]
        data = frames.data[i, : frames.length[i]].tobytes()
        try:
            found = message.decode(data, decode_choices=False, allow_truncated=True)
        except (ValueError, KeyError, IndexError):  # cantools' DecodeError is a ValueError
            bad[i] = 1
            return
        for j, name in enumerate(names):
            value = found.get(name)
            values[i, j] = np.nan if value is None else float(value)
            missing = ABSENT if self._elsewhere(message, name, found) else SHORT
            state[i, j] = missing if value is None else PRESENT

    @staticmethod
    def _elsewhere(message: Any, name: str, found: dict[str, Any]) -> bool:
        """Whether a multiplexer says that the frame does not carry the signal."""
        signal = message.get_signal_by_name(name)
        while signal.multiplexer_signal is not None:
            selector = found.get(signal.multiplexer_signal)
            if selector is None or int(selector) not in (signal.multiplexer_ids or ()):
                return True
            signal = message.get_signal_by_name(signal.multiplexer_signal)
        return False

    def _tell(self, frames: Frames, bad: np.ndarray) -> None:
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
    """Whether a batch has a value for the sensor, input or state `index` in its first `width` columns."""
    rows = batch.kind == kind
    if kind == READING:
        rows = rows & (batch.channel == index)
        return bool(np.isfinite(batch.value[rows, :width]).any())
    column = index - batch.channel[rows]
    inside = np.flatnonzero((column >= 0) & (column < width))
    return bool(np.isfinite(batch.value[rows][inside, column[inside]]).any())
