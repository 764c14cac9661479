"""Events to CAN frames: a twin's channels read backwards."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import can

from estimators.errors import SourceError
from estimators.log import INPUT, KIND_NAMES, READING

from ..source import Channel
from ..units import conversion
from .databases import BusName, find_messages


class _Frame:
    """One message and the values that it carries now."""

    def __init__(self, message: Any) -> None:
        self.message = message
        self.values: dict[str, float] = {}
        for signal in message.signals:
            low, high = _range(signal)
            start = signal.initial if isinstance(signal.initial, (int, float)) else 0.0
            self.values[signal.name] = min(max(float(start), low), high)
        self.known: set[str] = set()
        self.wanted: set[str] = set()
        self.lost = False
        self.reads = False
        self.sent_at: int | None = None

    def frame(self) -> can.Message:
        """The message as a frame, with the values that it has now."""
        data = self.message.encode(self.values, strict=False)
        return can.Message(
            arbitration_id=self.message.frame_id,
            is_extended_id=self.message.is_extended_frame,
            is_fd=bool(getattr(self.message, "is_fd", False)) or len(data) > 8,
            data=data,
            check=True,
        )


def _range(signal: Any) -> tuple[float, float]:
    """What a signal can carry: its bits, and the range that the DBC declares where it declares one."""
    if signal.is_float:
        bits = (-math.inf, math.inf)
    else:
        top = 2 ** (signal.length - 1) if signal.is_signed else 2**signal.length
        raw = (-top if signal.is_signed else 0, top - 1)
        bits = tuple(sorted(r * signal.conversion.scale + signal.conversion.offset for r in raw))
    low, high = signal.minimum, signal.maximum
    if low is None or high is None or not low < high:
        return bits
    return max(bits[0], float(low)), min(bits[1], float(high))


class Encoder:
    """Turns what a simulated asset says into frames.

    A message goes out when one of its channels says something, with the last values of the others; one that carries
    readings only with a new reading, so that an old one is not taken for new. If a reading is lost, the frame is
    lost. Values that a signal cannot carry are held at its limit.

    Raises:
        SourceError: If a message or signal is missing, a unit does not convert, or a channel cannot be read backwards.
    """

    def __init__(self, databases: Sequence[tuple[Path, BusName]], channels: Iterable[Channel]) -> None:
        self._frames: dict[str, _Frame] = {}
        # For each event's kind and index: its frame and, for each row, signal, range, and how to undo the conversions.
        self._routes: dict[tuple[int, int], tuple[_Frame, list[tuple[str, float, float, float, float]]]] = {}
        found = [(Path(path), bus) for path, bus in databases]
        for channel in channels:
            if channel.convert is not None:
                raise SourceError(
                    f"{channel.name}: convert is {channel.convert}; it cannot be encoded, so leave it out"
                )
            if channel.only:
                raise SourceError(f"{channel.name}: only picks frames; it cannot be encoded, so leave it out")
            if channel.accuracy is not None:
                raise SourceError(
                    f"{channel.name}: accuracy comes from the asset; it cannot be encoded, so leave it out"
                )
            messages, _, path = find_messages(found, channel)
            message = messages[0]
            if any(signal.multiplexer_ids for signal in message.signals):
                raise SourceError(f"{path.name}: message {message.name} is multiplexed; it cannot be encoded")
            frame = self._frames.setdefault(message.name, _Frame(message))
            frame.reads = frame.reads or channel.kind == READING
            rows = []
            for k, name in enumerate(channel.signals):
                signal = message.get_signal_by_name(name)
                where = f"{channel.name}: {name}"
                factor, shift = conversion(channel.units[k] or signal.unit, channel.model_units[k], where)
                slope = channel.scale[k] * factor
                if slope == 0.0:
                    raise SourceError(f"{where}: scale is 0; it must differ from 0")
                rows.append((name, slope, channel.scale[k] * shift + channel.offset[k], *_range(signal)))
                frame.wanted.add(name)
            for condition in channel.where:
                signal = message.get_signal_by_name(condition.signal)
                low, high = _range(signal)
                frame.values[condition.signal] = min(max(0.0, condition.low, low), condition.high, high)
            self._routes[channel.kind, channel.index] = (frame, rows)

    def set(self, kind: int, index: int, values: Sequence[float]) -> _Frame | None:
        """Put an event's values into its message; the message, or None if it has none."""
        route = self._routes.get((kind, index))
        if route is None:
            return None
        frame, rows = route
        for (name, slope, shift, low, high), value in zip(rows, values, strict=False):
            if math.isnan(value):
                frame.lost = frame.lost or kind != INPUT  # an input that is NaN stays as it was
            else:
                frame.values[name] = min(max((value - shift) / slope, low), high)
                frame.known.add(name)
        return frame

    def frames(self, t: int, events: Sequence[tuple[int, int, Sequence[float]]], repeat: int) -> list[can.Message]:
        """The frames of the events of one time: (kind, index, values), inputs and true states one by one.

        Args:
            t: Time of the events, ns.
            events: What was said.
            repeat: ns after which an input that did not change is said again, for who joins later.
        """
        touched: dict[int, _Frame] = {}
        for kind, index, values in events:
            frame = self.set(kind, index, values)
            if frame is not None and (kind == READING or not frame.reads):
                touched[id(frame)] = frame
        for (kind, _), (frame, _) in self._routes.items():
            if kind == INPUT and not frame.reads and (frame.sent_at is None or t - frame.sent_at >= repeat):
                touched[id(frame)] = frame
        out = []
        for frame in touched.values():
            if not frame.lost and frame.wanted <= frame.known:
                out.append(frame.frame())
                frame.sent_at = t
            frame.lost = False
        return out

    def __repr__(self) -> str:
        said = ", ".join(f"{KIND_NAMES[kind]} {index}" for kind, index in self._routes)
        return f"Encoder({said})"
