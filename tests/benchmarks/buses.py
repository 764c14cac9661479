"""Cost of a frame of a live bus, beside python-can's reading of the same packets."""

from __future__ import annotations

import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any

from estimators.errors import SourceError
from sources.can.bus import CanBus, open_bus
from sources.can.decoder import Decoder

from ..sources.can.can_tools import dbc, frame, sensor
from ..support import free_port
from .timing import BenchmarkRow, Bound, timed

GROUP = "239.74.163.9"
BATCHES = (1, 10, 200)
"""Frames queued when the bus is read; the last are few enough for the buffer of any socket."""

ROUNDS = 100


def can_live() -> Iterator[BenchmarkRow]:
    """A frame of a live bus, from the kernel to the decoded event: processor µs, ours and through python-can alone."""
    with tempfile.TemporaryDirectory() as folder:
        path = dbc(Path(folder))

        port = free_port(socket.SOCK_DGRAM)

        def opened() -> Any:
            return open_bus("udp_multicast", GROUP, {"port": port})

        def reader(interface: str, bus: Any) -> CanBus:
            decoder = Decoder([(path, None)], [sensor(0, "ENGINE", "Temp"), sensor(1, "FIX", "Lat", "Lon")], width=2)
            return CanBus(interface, GROUP, decoder, connect=lambda: bus)

        bus, sender = opened(), opened()
        # Any other name has no reader of its own; the socket is hidden, as the look at its losses is the same for both.
        plain = SimpleNamespace(recv=bus.recv, shutdown=bus.shutdown)
        sources = reader("udp_multicast", opened()), reader("python-can", plain)
        try:
            for size in BATCHES:
                costs: tuple[list[float], list[float]] = ([], [])
                for _ in range(ROUNDS):
                    for k in range(size):
                        sender.send(frame(256 + 2 * (k % 2), k.to_bytes(8, "little")))
                    for source, own in zip(sources, costs, strict=True):
                        batch, spent = timed(lambda source=source: source.read(0.0))  # type: ignore[misc]
                        if batch is not None and len(batch) == size:  # Else the last ones were not there yet
                            own.append(1e6 * spent / size)
                if not all(costs):
                    raise SourceError("multicast does not arrive on this machine")
                ours, theirs = map(median, costs)
                figures = {"ours [µs]": ours, "python-can [µs]": theirs, "ratio": theirs / ours}
                yield BenchmarkRow(f"{size} at once", figures, (Bound("ours [µs]", 20.0),) if size > 1 else ())
        finally:
            for source in sources:
                source.close()
            sender.shutdown()
