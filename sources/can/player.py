"""Plays a simulated asset on a CAN bus, in real time, as an asset of its own would speak."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import can

from estimators.log import INPUT, READING, TRUTH, Events

from ..source import Channel, Report, Source, ignore
from .bus import open_bus
from .databases import BusName
from .encoder import Encoder

REPEAT = 1_000_000_000
"""ns after which inputs are said again."""

LATE = 1_000_000_000
"""ns of lateness (the process was suspended) that are skipped, not made up for with a burst of frames."""


class Player:
    """Sends what a simulator says as DBC-encoded frames, each when its time has come.

    Use `run` in a process of its own, or `start` for a thread beside the listener.

    Args:
        source: What the asset says, each event when it arrives; it is used up.
        databases: Database files, each with its bus (which matters to listeners only).
        channels: The twin's own channels, read backwards; true states go out too where a message has them.
        interface: python-can's name.
        channel: The bus, as the interface names it.
        bus_options: Further arguments of the interface.
        report: Told of frames that could not be sent.
        connect: Opens the bus; for tests.
        clock: Monotonic time, ns; for tests.

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
        bus_options: Mapping[str, Any] | None = None,
        report: Report = ignore,
        connect: Callable[[], Any] | None = None,
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
        """Called with every frame that was sent, with the wall clock's time; a `can.Logger`, for example."""

    @property
    def finished(self) -> bool:
        """Whether `start` was called and all has been played."""
        return self._thread is not None and not self._thread.is_alive()

    def start(self) -> None:
        """Play in a thread until `close`, or until the simulation ends."""
        self._thread = threading.Thread(target=self.run, name="asset", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop playing and leave the bus."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._bus.shutdown()

    def run(self) -> None:
        """Play here until the simulation ends or another thread calls `close`."""
        begun = self._clock()
        while not self._stop.is_set():
            batch = self._source.read(0.0)
            if batch is None:
                return
            for t, events in self._moments(batch):
                wait = begun + t - self._clock()
                if wait > 0 and self._stop.wait(wait * 1e-9):
                    return
                if wait < -LATE:
                    self._report("asset late", f"CAN bus {self._name}: the asset was held up for {-wait * 1e-9:.1f} s")
                    begun -= wait
                self._say(t, events)

    def _moments(self, batch: Events) -> list[tuple[int, list[tuple[int, int, Sequence[float]]]]]:
        """The events of a batch by the time of their arrival; every input and every true state is one by itself."""
        moments: list[tuple[int, list[tuple[int, int, Sequence[float]]]]] = []
        columns = (batch.arrival.tolist(), batch.kind.tolist(), batch.channel.tolist(), batch.value.tolist())
        for t, kind, channel, value in zip(*columns, strict=True):
            if not moments or moments[-1][0] != t:
                moments.append((t, []))
            events = moments[-1][1]
            if kind == INPUT:
                events += [(INPUT, k, (value[k],)) for k in self._inputs]
            elif kind == TRUTH:
                block = range(channel, channel + len(value))
                events += [(TRUTH, k, (value[k - channel],)) for k in self._truths if k in block]
            elif kind == READING:
                events.append((READING, channel, value))
        return moments

    def _say(self, t: int, events: list[tuple[int, int, Sequence[float]]]) -> None:
        for frame in self._encoder.frames(t, events, REPEAT):
            try:
                frame.timestamp = time.time()
                self._bus.send(frame)
            except (can.CanError, OSError) as error:
                self._report("send failed", f"CAN bus {self._name}: a frame was not sent ({error})")
                continue
            self.sent += 1
            for listener in self.listeners:
                listener(frame)
