"""A live CAN bus, through python-can."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import can

from estimators.errors import SourceError
from estimators.log import Events

from ..source import Report, ignore
from .decoder import Decoder
from .heard import Heard

MOST_FRAMES = 4096
"""Frames taken at once; what is queued beyond them comes next."""

IP_MULTICAST_ALL = (socket.IPPROTO_IP, 49)
IPV6_MULTICAST_ALL = (socket.IPPROTO_IPV6, 29)
"""Socket options of Linux (linux/in.h, linux/in6.h), which Python does not name."""

WAITS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Seconds before each attempt to open a bus again; the last for all that follow."""


def open_bus(interface: str, channel: str | int, options: Mapping[str, Any], filters: list | None = None) -> Any:
    """Open a bus through python-can.

    Raises:
        SourceError: If it cannot be opened.
    """
    options = dict(options)
    if interface == "udp_multicast":
        # Frames must not leave this machine unless the user asks for it: with 0 hops the kernel keeps them here.
        options.setdefault("hop_limit", 0)
    if filters is not None:
        options.setdefault("can_filters", filters)
    try:
        bus = can.Bus(channel=channel, interface=interface, **options)
        if interface == "udp_multicast" and sys.platform == "linux":
            _keep_own_group(bus)
        return bus
    except Exception as error:  # noqa: BLE001  drivers raise anything: OSError, ValueError, ImportError, their own
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise SourceError(
            f"CAN bus {interface}:{channel}: it cannot be opened ({reason}); check interface, channel and options"
        ) from None


def _keep_own_group(bus: Any) -> None:
    """Restrict a multicast bus to the frames of its own group.

    python-can binds its socket to the port alone. Linux then delivers the frames of every group that any process of the
    host has joined on that port, so that two channels would be one bus.
    """
    with socket.socket(fileno=os.dup(bus.fileno())) as sock:
        sock.setsockopt(*(IPV6_MULTICAST_ALL if sock.family == socket.AF_INET6 else IP_MULTICAST_ALL), 0)
        with suppress(BlockingIOError):
            while True:  # Frames of other groups may have arrived since the socket was bound.
                sock.recv(1, socket.MSG_DONTWAIT)


class CanBus:
    """Listens on a bus and decodes what the channels need; a bus that fails is opened again, until `close`.

    Args:
        interface: python-can's name: virtual, udp_multicast, socketcan, ...
        channel: The bus, as the interface names it.
        decoder: What to take from the frames; its ids are set as the bus's filters.
        bus_options: Further arguments of the interface.
        report: Told of error frames, of the bus failing and coming back, and of messages that do not come.
        connect: Opens the bus; for tests.
        clock: Seconds, for the waits between attempts; for tests.

    Raises:
        SourceError: If the bus cannot be opened at first.
    """

    live = True

    def __init__(
        self,
        interface: str,
        channel: str | int,
        decoder: Decoder,
        *,
        bus_options: Mapping[str, Any] | None = None,
        report: Report = ignore,
        connect: Callable[[], Any] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name = f"{interface}:{channel}"
        self._decoder = decoder
        self._report = report
        self._clock = clock
        self._connect = connect or (lambda: open_bus(interface, channel, bus_options or {}, decoder.filters))
        self._closed = threading.Event()
        self._attempts = 0
        self._next_attempt = 0.0
        self._failed_before = False
        self._bus: Any = self._connect()
        self._heard = Heard(f"CAN bus {self._name}", decoder, clock, report)

    def read(self, timeout: float) -> Events | None:
        """The events of the frames that are queued; waits up to `timeout` seconds for the first. None once closed."""
        if self._closed.is_set():
            return None
        if self._bus is None and not self._reconnect(timeout):
            return Events.empty(self._decoder.width)
        messages: list[Any] = []
        arrivals: list[int] = []
        try:
            message = self._bus.recv(timeout)
            while message is not None:
                messages.append(message)
                arrivals.append(time.time_ns())
                message = self._bus.recv(0) if len(messages) < MOST_FRAMES else None
            self._failed_before = False
        except Exception as error:  # noqa: BLE001  drivers raise anything; the twin goes on
            self._failed(error)
        for message in messages:
            if message.is_error_frame:
                self._report("error frame", f"CAN bus {self._name}: error frame")
        batch = self._decoder.decode(self._decoder.gather(messages, arrivals))
        self._heard.note(messages)
        return batch

    def _failed(self, error: Exception) -> None:
        """Once may be one bad packet; twice in a row the bus is given up and opened again."""
        self._report("bus error", f"CAN bus {self._name}: {' '.join(str(error).split()) or type(error).__name__}")
        if not self._failed_before:
            self._failed_before = True
            return
        self._shut()
        self._attempts = 0
        self._next_attempt = self._clock() + WAITS[0]

    def _reconnect(self, timeout: float) -> bool:
        """Try to open the bus when it is time; wait no longer than `timeout`."""
        wait = self._next_attempt - self._clock()
        if wait > 0:
            self._closed.wait(min(wait, timeout))
            if self._closed.is_set() or self._next_attempt > self._clock():
                return False
        try:
            self._bus = self._connect()
        except SourceError as error:
            self._attempts += 1
            wait = WAITS[min(self._attempts, len(WAITS) - 1)]
            self._next_attempt = self._clock() + wait
            self._report("bus error", f"{error}; next attempt in {wait:g} s")
            return False
        self._failed_before = False
        self._report("bus reconnected", f"CAN bus {self._name}: open again")
        return True

    def _shut(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except Exception as error:  # noqa: BLE001  a broken driver may not even close
                self._report("bus error", f"CAN bus {self._name}: it did not close ({error})")

    def now(self) -> int:
        """Wall-clock time, ns."""
        return time.time_ns()

    def close(self) -> None:
        """Leave the bus."""
        self._closed.set()
        self._shut()
