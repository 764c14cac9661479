"""Send the events of a simulated asset as CAN frames, in real time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import can
from cantools.database.can import Message

from estimators.errors import SourceError
from estimators.log import INPUT, READING, TRUTH, Events

from ..source import Channel, Report, Source, ignore
from .bus import open_bus
from .decoder import BusName, find_messages, slopes
from .limits import span_of

INPUT_REPEAT_NS = 1_000_000_000  # ns after which an unchanged input is sent again, for listeners that joined later

MAX_DELAY_NS = 1_000_000_000
"""ns of delay (the process was suspended) beyond which time is skipped instead of sending a burst of frames."""


class Player:
    """Sends the events of a simulator as DBC-encoded frames, each at its arrival time.

    Use `run` in a process of its own, or `start` for a thread.

    Args:
        source: The simulator, read to its end.
        databases: Database files, each with its bus, which is ignored.
        channels: The twin's own channels; true states are sent too if a message has them.
        interface: Interface of python-can.
        channel: Channel of the interface.
        bus_options: Further arguments of the interface.
        report: Receives frames that could not be sent.
        connect: Opens the bus, for tests.
        clock: Monotonic time, ns, for tests.

    Raises:
        SourceError: If the bus cannot be opened or a channel cannot be encoded.
    """

    def __init__(
        self,
        source: Source,
        databases: Sequence[tuple[Path, BusName]],
        channels: Iterable[Channel],
        *,
        interface: str,
        channel: str | int,
        bus_options: Mapping[str, object] | None = None,
        report: Report = ignore,
        connect: Callable[[], can.BusABC] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._source = source
        channels = list(channels)
        self._encoder = Encoder(databases, channels)
        self._inputs = [channel.index for channel in channels if channel.kind == INPUT]
        self._truths = [channel.index for channel in channels if channel.kind == TRUTH]
        self._report = report
        self._clock = clock
        self._stop = threading.Event()
        self._bus = connect() if connect else open_bus(interface, channel, bus_options or {})
        self._name = f"{interface}:{channel}"
        self._thread: threading.Thread | None = None
        self.sent = 0
        """Frames sent so far."""
        self.listeners: list[Callable[[can.Message], object]] = []
        """Called with every sent frame, whose timestamp is the wall clock; a `can.Logger`, for example."""

    @property
    def finished(self) -> bool:
        """Whether a started player has reached the end."""
        return self._thread is not None and not self._thread.is_alive()

    def start(self) -> None:
        """Send in a thread until `close`, or until the simulation ends."""
        self._thread = threading.Thread(target=self.run, name="asset", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop sending and close the bus."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._bus.shutdown()

    def run(self) -> None:
        """Send until the simulation ends or another thread calls `close`."""
        begun = self._clock()
        while not self._stop.is_set():
            batch = self._source.read(0.0)
            if batch is None:
                return
            for t, events in self._moments(batch).items():
                wait = begun + t - self._clock()
                if wait > 0 and self._stop.wait(wait * 1e-9):
                    return
                if wait < -MAX_DELAY_NS:
                    self._report("asset late", f"CAN bus {self._name}: the asset was delayed by {-wait * 1e-9:.1f} s")
                    begun -= wait
                self._send(t, events)

    def _moments(self, batch: Events) -> dict[int, list[tuple[int, int, Sequence[float]]]]:
        """Return the events of a batch by arrival time; every input and every true state is an event of its own."""
        moments: dict[int, list[tuple[int, int, Sequence[float]]]] = {}
        columns = (batch.arrival.tolist(), batch.kind.tolist(), batch.channel.tolist(), batch.value.tolist())
        for t, kind, channel, value in zip(*columns, strict=True):
            events = moments.setdefault(t, [])
            if kind == INPUT:
                events += [(INPUT, k, (value[k],)) for k in self._inputs]
            elif kind == TRUTH:
                block = range(channel, channel + len(value))
                events += [(TRUTH, k, (value[k - channel],)) for k in self._truths if k in block]
            elif kind == READING:
                events.append((READING, channel, value))
        return moments

    def _send(self, t: int, events: list[tuple[int, int, Sequence[float]]]) -> None:
        for frame in self._encoder.frames(t, events):
            try:
                frame.timestamp = time.time()
                self._bus.send(frame)
            except (can.CanError, OSError) as error:
                self._report("send failed", f"CAN bus {self._name}: a frame was not sent ({error})")
                continue
            self.sent += 1
            for listener in self.listeners:
                listener(frame)


class _Frame:
    """A message, the source address of its sender, and its current values."""

    def __init__(self, message: Message, source: int | None) -> None:
        self.message = message
        self.id = message.frame_id if source is None else message.frame_id & ~0xFF | source
        self.values: dict[str, float] = {}
        for signal in message.signals:
            low, high, _ = span_of(signal)
            start = signal.initial if isinstance(signal.initial, (int, float)) else 0.0
            self.values[signal.name] = min(max(float(start), low), high)
        self.known: set[str] = set()
        self.wanted: set[str] = set()
        self.lost = False
        self.reads = False
        self.sent_at: int | None = None

    def frame(self) -> can.Message:
        """Return the message as a frame with its current values."""
        data = self.message.encode(self.values, strict=False)
        return can.Message(
            arbitration_id=self.id,
            is_extended_id=self.message.is_extended_frame,
            is_fd=bool(getattr(self.message, "is_fd", False)) or len(data) > 8,
            data=data,
            check=True,
        )


class Encoder:
    """Encodes the events of a simulated asset as frames.

    A message is sent with each event of its channels and the last values of the others; one that carries measurements
    only with a new measurement, so that an old one is not repeated. If a measurement is lost, the frame is lost. Values
    beyond the range of a signal are clipped.

    Raises:
        SourceError: If a message or signal is missing, a unit does not convert, or a channel cannot be encoded.
    """

    def __init__(self, databases: Sequence[tuple[Path, BusName]], channels: Iterable[Channel]) -> None:
        self._frames: dict[tuple[str, int | None], _Frame] = {}
        # By an event's kind and index: its frame and, for each row, signal, slope, offset and range of the conversion.
        self._routes: dict[tuple[int, int], tuple[_Frame, list[tuple[str, float, float, float, float]]]] = {}
        for channel in channels:
            for given, text in (
                (channel.convert, f"convert is {channel.convert}"),
                (channel.only, "only picks frames"),
                (channel.accuracy, "accuracy comes from the asset"),
            ):
                if given:
                    raise SourceError(f"{channel.name}: {text}; it cannot be encoded, so leave it out")
            messages, _, path = find_messages(databases, channel)
            message = messages[0]
            if any(signal.multiplexer_ids for signal in message.signals):
                raise SourceError(f"{path.name}: message {message.name} is multiplexed; it cannot be encoded")
            frame = self._frames.setdefault((message.name, channel.source), _Frame(message, channel.source))
            frame.reads = frame.reads or channel.kind == READING
            rows = []
            for signal, slope, shift in slopes(message, channel):
                if slope == 0.0:
                    raise SourceError(f"{channel.name}: {signal.name}: scale is 0; it must differ from 0")
                rows.append((signal.name, slope, shift, *span_of(signal)[:2]))
                frame.wanted.add(signal.name)
            for condition in channel.where:
                signal = message.get_signal_by_name(condition.signal)
                low, high, _ = span_of(signal)
                frame.values[condition.signal] = min(max(0.0, condition.low, low), condition.high, high)
            self._routes[channel.kind, channel.index] = (frame, rows)

    def frames(self, t: int, events: Sequence[tuple[int, int, Sequence[float]]]) -> list[can.Message]:
        """Return the frames of the events of one time: (kind, index, values), inputs and true states one by one.

        Args:
            t: Time of the events, ns.
            events: The events.
        """
        touched: dict[int, _Frame] = {}
        for kind, index, values in events:
            if (kind, index) not in self._routes:
                continue
            frame, rows = self._routes[kind, index]
            for (name, slope, shift, low, high), value in zip(rows, values, strict=False):
                if math.isnan(value):
                    frame.lost = frame.lost or kind != INPUT  # an input that is NaN keeps its value
                else:
                    frame.values[name] = min(max((value - shift) / slope, low), high)
                    frame.known.add(name)
            if kind == READING or not frame.reads:
                touched[id(frame)] = frame
        for (kind, _), (frame, _) in self._routes.items():
            if kind == INPUT and not frame.reads and (frame.sent_at is None or t - frame.sent_at >= INPUT_REPEAT_NS):
                touched[id(frame)] = frame
        out = []
        for frame in touched.values():
            if not frame.lost and frame.wanted <= frame.known:
                out.append(frame.frame())
                frame.sent_at = t
            frame.lost = False
        return out
